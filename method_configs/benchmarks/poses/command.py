"""``fillerbuster bench poses``: its options and its figure. Heavy imports wait until it runs."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fb_core.files.ownership import signature
from fb_core.files.whole import whole_file

if TYPE_CHECKING:
    from fb_core.evaluation.results import Report

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Poses:
    """Cameras from raymaps: time and error of the solver on damaged raymaps, beside 700 steps of plain gradient
    descent.
    """

    json: Path | None = None
    """Write all measurements to this file."""
    figure: Path | None = None
    """Draw a chart into this file (png, svg or pdf)."""
    quick: bool = False
    """A miniature that shows that everything runs; its figures mean nothing."""
    views: int = 16
    """Raymaps of a case."""
    size: int = 256
    """Their side in pixels."""
    draws: int = 3
    """Scenes of each case."""
    plain_steps: int = 700
    """Steps of the plain fit; 0 leaves it out."""
    seed: int = 0
    """Decides cameras, noise and outliers."""

    def run(self) -> None:
        """Measure and report."""
        import dataclasses

        from method_configs.benchmarks.command import show
        from method_configs.benchmarks.poses import damaged_raymaps as benchmark

        config = dataclasses.replace(benchmark.QUICK, seed=self.seed)
        if not self.quick:
            names = ("views", "size", "draws", "plain_steps", "seed")
            config = benchmark.PosesBenchmark(**{name: getattr(self, name) for name in names})
        report = benchmark.run_poses(config, on_cell=lambda cell: _logger.info("measuring %s", cell))
        figure = self.figure
        show(report, self.json, [] if figure is None else [lambda: draw(report, figure)])


def draw(report: Report, path: Path) -> None:
    """Rotation error over CPU time, a pair of points for each case: the plain fit and the solver."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    rows = [row for row in report.rows if row["part"] == "poses"]
    figure, axes = pyplot.subplots(figsize=(8, 4.5), layout="constrained")
    places = range(len(rows))
    for shift, prefix, label in ((-0.15, "plain_", "plain gradient descent"), (0.15, "", "solver")):
        shown = [(place, row) for place, row in zip(places, rows, strict=True) if f"{prefix}cpu_seconds" in row]
        medians = [row[f"{prefix}rotation_degrees_median"] for _, row in shown]
        above = [row[f"{prefix}rotation_degrees_max"] - median for (_, row), median in zip(shown, medians, strict=True)]
        where = [place + shift for place, _ in shown]
        if shown:
            seconds = sum(row[f"{prefix}cpu_seconds"] for _, row in shown) / len(shown)
            axes.errorbar(
                where,
                medians,
                yerr=[[0.0] * len(above), above],
                fmt="o",
                capsize=3,
                label=f"{label}, {seconds:.2g} s of CPU",
            )
    axes.set_yscale("log")
    axes.set_ylabel("rotation error in degrees, median to worst view")
    axes.set_xticks(list(places), [row["case"].replace(", ", ",\n").replace("% ", "%\n") for row in rows], fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend()
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=150, metadata=signature(path))
    pyplot.close(figure)
    _logger.info("wrote %s", path)
