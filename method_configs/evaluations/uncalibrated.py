"""``fillerbuster eval uncalibrated``: its options. Heavy imports wait until it runs."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Uncalibrated:
    """Cameras of unposed views of unseen rooms by the model and by features, and fly-throughs made from them."""

    model: Path | None = None
    """Model folder; by default the bundled one."""
    rooms: int = 20
    """Unseen rooms."""
    views: int = 16
    """Views per room, whose cameras are to be found."""
    path: int = 8
    """Views of the fly-through."""
    sides: tuple[int, ...] = (64, 256)
    """Sides in pixels of the pictures that features are looked for in; the model always sees its own size."""
    loops: int = 4
    """Rooms, the first ones, in which the closed loop poses, views, poses is measured too."""
    family: Literal["narrow", "medium", "wide"] = "narrow"
    """How varied room and cameras are; the bundled model knows narrow rooms."""
    capture: Path | None = None
    """A posed capture whose cameras are hidden and then compared with, instead of rooms; --views of its photos are
    taken.
    """
    seed: int = 0
    """Decides rooms, cameras and samples."""
    json: Path | None = None
    """Write all measurements to this file."""

    def run(self) -> None:
        """Measure and report."""
        from fb_core.data.photos.collection import read_photos
        from fb_core.evaluation.results import Report
        from fb_core.evaluation.uncalibrated import UncalibratedTask, evaluate_capture, evaluate_uncalibrated, summary
        from fb_core.inpainter import Fillerbuster
        from method_configs.benchmarks.command import show

        def say(what: str) -> None:
            _logger.info("measuring %s", what)

        report = Report(seed=self.seed)
        model = Fillerbuster.from_pretrained(self.model)
        if self.capture is not None:
            photos = read_photos(self.capture, most=self.views)
            report.rows.extend(evaluate_capture(model, photos, seed=self.seed, on_method=say))
        else:
            names = ("rooms", "views", "path", "sides", "loops", "family", "seed")
            task = UncalibratedTask(**{name: getattr(self, name) for name in names})
            report.rows.extend(summary(list(evaluate_uncalibrated(model, task, on_room=say))))
        show(report, self.json, [])
