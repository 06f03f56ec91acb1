"""``fillerbuster export``: the completed capture of a run as a dataset for other tools."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

from fb_nerfstudio.export import write_export
from fb_nerfstudio.saved_run import gaussian_centers, read_completed
from method_configs.finished_run import quiet, read_run

_logger = logging.getLogger(__name__)


def export_run(
    run: Path, *, format: Literal["nerfstudio", "colmap"], output: Path | None = None, held_out: bool = True, overwrite: bool = False
) -> Path:
    """Write the completed capture of a run that is finished, or was killed after it had generated views; returns the folder.

    Args:
        run: folder of the run, which holds config.yml and checkpoints.
        format: what the dataset is for.
        output: its folder; by default ``export-FORMAT`` in the run's.
        held_out: with the captured pictures that the run did not train on.
        overwrite: replace an earlier export.

    Raises ValueError with one sentence when there is nothing to export, and when the folder is taken or cannot be written.
    """
    folder = run / f"export-{format}" if output is None else output
    config, checkpoint = read_run(run)
    try:
        with quiet():
            completed = read_completed(config, checkpoint)
        points = None if completed.capture.points_path is not None else gaussian_centers(config, checkpoint, completed.world)
    except ValueError as error:
        raise ValueError(f"run {run}: {error}") from error
    if not completed.finished:
        _logger.warning("run %s: its generation was interrupted; only the rounds that were finished are exported", run)
    try:
        pictures = write_export(completed, folder, format=format, points=points, held_out=held_out, overwrite=overwrite)
    except (OSError, ValueError) as error:
        raise ValueError(f"export: {error}; nothing was written") from error
    generated = len(completed.generated)
    _logger.info("wrote %d captured and %d generated views to %s", pictures - generated, generated, folder)
    return folder
