"""``fillerbuster bench sampler``: its options and its figure. Heavy imports wait until it runs."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fb_core.files.ownership import signature
from fb_core.files.whole import whole_file

if TYPE_CHECKING:
    from fb_core.evaluation.results import Report

_logger = logging.getLogger(__name__)
_COLORS = {"euler": "tab:gray", "heun": "tab:green", "ab2": "tab:blue", "corrected": "tab:red"}


@dataclass(frozen=True, kw_only=True)
class Sampler:
    """Error against passes of all solvers and time grids, on a solvable flow and on a trained model."""

    json: Path | None = None
    """Write all measurements to this file."""
    figure: Path | None = None
    """Draw a chart into this file (png, svg or pdf)."""
    quick: bool = False
    """A miniature that shows that everything runs; its figures mean nothing."""
    model: Path | None = None
    """Model folder; by default the bundled one."""
    flow_only: bool = False
    """Leave the model out and measure the solvable flow alone."""
    guidance: tuple[float, ...] = (1.0, 3.0, 7.0)
    """Guidance scales; none at all: only the steps that the model deserves, by task."""
    fine_steps: int = 1000
    """Steps of the solution that errors are measured against."""
    problems: int = 2
    """Solvable flows, and rooms for the model, over which errors are averaged."""
    views: int = 4
    """Views per room; half of them are known."""
    size: int = 64
    """Their side in pixels."""
    seed: int = 0
    """Decides flows, rooms and noise."""

    def run(self) -> None:
        """Measure and report.

        Raises ValueError for options that make no benchmark.
        """
        import dataclasses

        from fb_core.inpainter import Fillerbuster
        from method_configs.benchmarks.command import show
        from method_configs.benchmarks.sampler import solvers_and_grids as benchmark

        if not self.guidance:
            return self._run_tasks()
        config = dataclasses.replace(benchmark.QUICK, seed=self.seed)
        if not self.quick:
            names = ("guidance", "fine_steps", "problems", "views", "size", "seed")
            config = benchmark.SamplerBenchmark(**{name: getattr(self, name) for name in names})
        config = dataclasses.replace(config, model=not self.flow_only)
        model = None if self.flow_only else Fillerbuster.from_pretrained(self.model)
        report = benchmark.run_sampler(config, model, on_cell=lambda cell: _logger.info("measuring %s", cell))
        figure = self.figure
        show(report, self.json, [] if figure is None else [lambda: draw(report, figure)])

    def _run_tasks(self) -> None:
        from fb_core.inpainter import Fillerbuster
        from method_configs.benchmarks.command import show
        from method_configs.benchmarks.sampler.steps_by_task import STEPS, draw_tasks, run_tasks

        if self.flow_only:
            raise ValueError("guidance: without any there is only the model to measure; leave --flow-only out")
        report = run_tasks(
            Fillerbuster.from_pretrained(self.model),
            rooms=self.problems, views=self.views, size=self.size, seed=self.seed,
            on_cell=lambda cell: _logger.info("measuring %s", cell),
            steps=(1, 2, 3) if self.quick else STEPS,
        )  # fmt: skip
        figure = self.figure
        show(report, self.json, [] if figure is None else [lambda: draw_tasks(report, figure)])


def draw(report: Report, path: Path) -> None:
    """Error over passes: one panel per flow and guidance scale, one line per solver on the default's grid, other grids
    faint.
    """
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    curves = [row for row in report.rows if "reached" in row]
    flows, scales = (list(dict.fromkeys(row[key] for row in curves)) for key in ("part", "guidance"))
    shape = {"figsize": (4 * len(scales), 3.4 * len(flows)), "layout": "constrained", "sharex": True, "squeeze": False}
    figure, panels = pyplot.subplots(len(flows), len(scales), **shape)
    for flow, row_of_panels in zip(flows, panels, strict=True):
        for scale, axes in zip(scales, row_of_panels, strict=True):
            _draw_panel(axes, [row for row in curves if row["part"] == flow and row["guidance"] == scale])
            axes.set_title(f"{flow}, guidance {scale:g}", fontsize=10)
        row_of_panels[0].set_ylabel("relative error of the end")
    for axes in panels[-1]:
        axes.set_xlabel("passes of the network")
    panels[0][0].legend(fontsize=7)
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=130, metadata=signature(path))
    pyplot.close(figure)
    _logger.info("wrote %s", path)


def _draw_panel(axes: Any, rows: list[dict[str, Any]]) -> None:
    from fb_core.sampling.options import SamplingConfig
    from method_configs.benchmarks.sampler.solvers_and_grids import grid_name

    usual = grid_name(SamplingConfig().shift)
    for solver, color in _COLORS.items():
        for grid in dict.fromkeys(row["grid"] for row in rows):
            points = sorted(
                (row["passes"], row["error"]) for row in rows if row["solver"] == solver and row["grid"] == grid
            )
            style = {"linewidth": 0.7, "alpha": 0.35}
            if grid == usual:
                style = {"marker": "o", "markersize": 3, "linewidth": 1.8, "label": f"{solver}, {grid}"}
            axes.plot(*zip(*points, strict=True), color=color, **style)
    original = next(row for row in rows if row["solver"].startswith("original"))
    axes.plot(original["passes"], original["error"], "k*", label="the original")
    axes.axhline(original["error"], color="black", linewidth=0.6, linestyle=":")
    axes.axvline(32, color="black", linewidth=0.6, linestyle=":")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.spines[["top", "right"]].set_visible(False)
