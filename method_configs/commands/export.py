"""``fillerbuster export``: the completed capture of a run as a dataset for other tools."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

from fb_core.data.capture.frames import Capture
from fb_core.data.capture.own_files import own_points
from fb_core.files.ownership import Target
from fb_nerfstudio.runs.export import KIND, write_export
from fb_nerfstudio.runs.finished_run import quiet, read_run
from fb_nerfstudio.runs.saved_run import gaussian_centers, read_completed

_logger = logging.getLogger(__name__)


def export_run(
    run: Path,
    *,
    format: Literal["nerfstudio", "colmap"],
    output: Path | None = None,
    held_out: bool = True,
    overwrite: bool = False,
) -> Path:
    """Write the completed capture of a run that is finished, or was killed after it had generated views; returns the
    folder.

    Args:
        run: folder of the run, which holds config.yml and checkpoints.
        format: what the dataset is for.
        output: its folder; by default ``export-FORMAT`` in the run's.
        held_out: with the captured pictures that the run did not train on.
        overwrite: replace an earlier export.

    Raises ValueError with one sentence when there is nothing to export, and when the folder is taken or cannot be
    written.
    """
    folder = run / f"export-{format}" if output is None else output
    config, checkpoint = read_run(run)
    try:
        with quiet():
            completed = read_completed(config, checkpoint)
        points = (
            gaussian_centers(config, checkpoint, completed.world) if own_points(completed.capture) is None else None
        )
    except ValueError as error:
        raise ValueError(f"run {run}: {error}") from error
    if not completed.finished:
        _logger.warning("run %s: its generation was interrupted; only the rounds that were finished are exported", run)
    try:
        target = Target(folder=folder, kind=KIND, overwrite=overwrite, inputs=_read(run, completed.capture))
        pictures = write_export(completed, target, format=format, points=points, held_out=held_out)
    except (OSError, ValueError) as error:
        raise ValueError(f"export: {error}; nothing was written") from error
    generated = len(completed.generated)
    _logger.info("wrote %d captured and %d generated views to %s", pictures - generated, generated, folder)
    return folder


def _read(run: Path, capture: Capture) -> tuple[Path, ...]:
    """All that an export reads: the run's options and checkpoints, and the capture with folders of its files
    elsewhere.
    """
    files = [path for frame in capture.frames for path in (frame.image_path, frame.mask_path)]
    elsewhere = {path.resolve().parent for path in (*files, capture.points_path) if path is not None}
    return (run / "config.yml", run / "nerfstudio_models", capture.root, *sorted(elsewhere))
