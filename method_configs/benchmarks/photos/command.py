"""``fillerbuster bench photos``: cameras of photos by features, stage by stage, on one thread and on all cores, beside
COLMAP where it is installed.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from method_configs.benchmarks.photos.stages import STAGES, between, clocks
from method_configs.benchmarks.table_files import TableFiles

if TYPE_CHECKING:
    from fb_core.data.photos.photo import Photo
    from fb_core.evaluation.results import Report
    from fb_core.geometry.cameras import Pinholes

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Photos(TableFiles):
    """Seconds of finding cameras by features, with their errors where the photos come with cameras, on one thread and
    on all cores in the same run; beside COLMAP where its package pycolmap is installed.
    """

    source: Path
    """Folder of photos, or posed capture, whose cameras are hidden and compared with."""
    most: int = 16
    """Photos at most."""

    def run(self) -> None:
        """Measure and report. Raises ValueError for fewer than two photos."""
        import importlib.util

        from fb_core.data.photos.collection import read_photos
        from fb_core.evaluation.results import Report
        from fb_core.machine.resources import usable_cores
        from method_configs.benchmarks.photos.colmap import cameras_by_colmap

        photos = read_photos(self.source, most=self.most)
        hidden = [dataclasses.replace(photo, camera=None) for photo in photos]
        with_colmap = importlib.util.find_spec("pycolmap") is not None
        if not with_colmap:
            _logger.warning("pycolmap is not installed, so COLMAP is left out; pip install pycolmap for its rows")
        report = Report(seed=self.seed)
        first: list[Pinholes | None] | None = None
        for threads in sorted({1, usable_cores()}):
            _logger.info("%d photos on %d threads", len(photos), threads)
            ours, seconds = cameras_by_features(hidden, threads)
            row = self._row("fillerbuster", threads, photos, ours, seconds)
            first = ours if first is None else first
            report.rows.append(row | {"equal_to_one_thread": _equal(first, ours)})
            if with_colmap:
                theirs, seconds = cameras_by_colmap(hidden, threads)
                report.rows.append(self._row("COLMAP", threads, photos, theirs, seconds) | {"equal_to_one_thread": "-"})
        self.publish(report, draw)

    def _row(
        self,
        name: str,
        threads: int,
        photos: Sequence[Photo],
        cameras: Sequence[Pinholes | None],
        seconds: dict[str, tuple[float, float]],
    ) -> dict[str, Any]:
        """Seconds of each stage, by the clock and of the processors, and the errors."""
        from fb_core.evaluation.metrics.pose_metrics import pose_errors

        truth = [photo.camera for photo in photos if photo.camera is not None]
        found = sum(camera is not None for camera in cameras)
        wrong = {"rotation_degrees": math.nan, "center": math.nan, "focal_percent": math.nan}
        if len(truth) == len(photos):
            wrong = {key: value for key, value in pose_errors(cameras, truth).items() if key in wrong}
        wall, processor = (sum(seconds[stage][clock] for stage in STAGES) for clock in (0, 1))
        return {
            "part": f"cameras of {len(photos)} photos", "method": name, "threads": threads, "seconds": wall,
            "cpu_seconds": processor, "found_share": found / len(photos), **wrong,
            **{f"{stage}_seconds": seconds[stage][0] for stage in STAGES},
            **{f"{stage}_cpu_seconds": seconds[stage][1] for stage in STAGES},
        }  # fmt: skip


def cameras_by_features(
    photos: Sequence[Photo], threads: int
) -> tuple[list[Pinholes | None], dict[str, tuple[float, float]]]:
    """Cameras of the photos as `complete` finds them, and the seconds of each stage, by the clock and of the
    processors.
    """
    from fb_core.machine.parallel import fixed_workers
    from fb_core.registration.by_features import recover_with_features

    began: dict[str, tuple[float, float]] = {}

    def note(what: str, *_: int) -> None:
        stage = {"looking for features": "features", "matching features": "matches"}.get(what, "cameras")
        began.setdefault(stage, clocks())

    began["features"] = clocks()
    with fixed_workers(threads):
        cameras = recover_with_features(photos, on_progress=note)[0].cameras
    return cameras, between([*(began.get(stage) for stage in STAGES), clocks()])


def _equal(first: Sequence[Pinholes | None], second: Sequence[Pinholes | None]) -> bool:
    """Whether two answers are the same to the bit."""
    import torch

    return all(
        (one is None and other is None)
        or (
            one is not None
            and other is not None
            and torch.equal(one.camera_to_world, other.camera_to_world)
            and torch.equal(one.focal, other.focal)
        )
        for one, other in zip(first, second, strict=True)
    )


def draw(report: Report, path: Path) -> None:
    """Seconds by the clock, a bar for each method and number of threads, its stages on top of one another."""
    from method_configs.benchmarks.figures import new_axes, save_figure
    from method_configs.benchmarks.table_files import origin_of

    figure, axes = new_axes("seconds by the clock")
    names = [f"{row['method']}\n{row['threads']} threads" for row in report.rows]
    bottom = [0.0] * len(names)
    for stage in STAGES:
        values = [row[f"{stage}_seconds"] for row in report.rows]
        axes.bar(names, values, bottom=bottom, label=stage)
        bottom = [low + value for low, value in zip(bottom, values, strict=True)]
    axes.legend()
    save_figure(figure, path, origin_of(report))
