"""``fillerbuster eval scaling``: its options and its figure. Heavy imports wait until it runs."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from fb_core.files.ownership import signature
from fb_core.files.whole import whole_file

if TYPE_CHECKING:
    from fb_core.evaluation.results import Report

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """The same hidden views from more and more known ones, and in sequences longer than in training."""

    model: Path | None = None
    """Model folder; by default the bundled one."""
    rooms: int = 20
    """Unseen rooms."""
    contexts: tuple[int, ...] = (3, 8, 16)
    """Numbers of known views."""
    lengths: tuple[int, ...] = (1, 2, 3)
    """Sequence lengths, in multiples of the length in training."""
    scored: int = 8
    """Hidden views that are scored in each room."""
    family: Literal["narrow", "medium", "wide"] = "narrow"
    """How varied room and cameras are; the bundled model knows narrow rooms."""
    seed: int = 0
    """Decides rooms, cameras and samples."""
    json: Path | None = None
    """Write all measurements to this file."""
    figure: Path | None = None
    """Draw both curves into this file (png, svg or pdf)."""

    def run(self) -> None:
        """Measure and report."""
        from fb_core.evaluation.results import Report
        from fb_core.evaluation.scaling import ScalingTask, evaluate_scaling
        from fb_core.inpainter import Fillerbuster
        from method_configs.benchmarks.command import show

        model = Fillerbuster.from_pretrained(self.model)
        names = ("rooms", "contexts", "lengths", "scored", "family", "seed")
        trained = {} if "views" not in model.info else {"trained_views": model.info["views"]}
        task = ScalingTask(**{name: getattr(self, name) for name in names}, **trained)
        report = Report(seed=self.seed)
        sampling = model.recommended_sampling
        report.rows.extend(
            evaluate_scaling(model, task, sampling, on_room=lambda what: _logger.info("measuring %s", what))
        )
        figure = self.figure
        show(report, self.json, [] if figure is None else [lambda: draw(report, figure)])


def draw(report: Report, path: Path) -> None:
    """PSNR of the same hidden views over the number of known views, and over the length of the sequence."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(8, 3.5), sharey=True, layout="constrained")
    curves = (("context", "known", "known views"), ("length", "views", "views in one sequence"))
    for axes, (part, across, label) in zip(panels, curves, strict=True):
        rows = [row for row in report.rows if row["part"] == part]
        places, heights, spread = ([row[name] for row in rows] for name in (across, "psnr", "standard_error"))
        axes.errorbar(places, heights, spread, fmt="o-", capsize=3)
        axes.set_xlabel(label)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("PSNR of the hidden views (dB)")
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=150, metadata=signature(path))
    pyplot.close(figure)
    _logger.info("wrote %s", path)
