"""``fillerbuster sheet``: what a run was given, what it generated, and what its splats make of both, in one picture."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.completion.results.completed_views import CompletedViews
from fb_core.evaluation.figures.contact_sheet import Strip, evenly, write_contact_sheet
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.files.ownership import require_own_or_new
from fb_nerfstudio.bridge import batch_image, batch_known, to_nerfstudio
from fb_nerfstudio.runs.finished_run import load_run, quiet

COLUMNS = 8
_logger = logging.getLogger(__name__)


@torch.no_grad()
@quiet()
def write_sheet(run: Path, output: Path, *, before: Path | None = None) -> None:
    """Draw captured, generated and held-out views of a finished run, each above the run's render at the same camera.

    Args:
        run: folder of the run, which holds config.yml and checkpoints.
        output: the picture's file; missing folders are made.
        before: folder of another run on the same capture, whose render at each of these cameras is drawn too.

    Raises ValueError when there is no finished run in the folder, and when ``output`` is a file that is no earlier
    picture of ours.
    """
    require_own_or_new(output)
    pipeline = load_run(run)
    manager: Any = pipeline.datamanager
    bank: CompletedViews | None = manager.generated_views
    models = {"Rendered there": pipeline.model}
    if before is not None:
        models = {f"Rendered there by {before.resolve().parent.name}": load_run(before).model} | models
    strips = _captured(models, "Captured views", manager.cached_train, manager.train_dataset.cameras)
    if bank is not None:
        for role in dict.fromkeys(one.role for one in bank.origins):
            strips += _generated(
                models, f"Generated, {role}", bank, [i for i, one in enumerate(bank.origins) if one.role == role]
            )
    strips += _captured(models, "Held-out views", manager.cached_eval, manager.eval_dataset.cameras)
    count = f"{len(manager.train_dataset)} captured and {0 if bank is None else len(bank)} generated views"
    title, subtitle = f"{run.parent.parent.name}, {run.parent.name}", f"{count}, {pipeline.model.num_points} Gaussians"
    write_contact_sheet(output, strips, title=title, subtitle=subtitle, columns=COLUMNS)
    _logger.info("wrote %s", output)


def _captured(models: dict[str, Any], heading: str, batches: Sequence[dict], cameras: Any) -> list[Strip]:
    """Views of the capture and their renders. Pictures are cached undistorted, in the cameras' order."""
    chosen = evenly(range(len(batches)), COLUMNS)
    pictures = [batch_image(batches[index], "cpu") for index in chosen]
    known = [batch_known(batches[index], "cpu") for index in chosen]
    return _with_renders(
        models, heading, len(batches), pictures, [cameras[index : index + 1] for index in chosen], known
    )


def _generated(models: dict[str, Any], heading: str, bank: CompletedViews, indices: list[int]) -> list[Strip]:
    chosen = evenly(indices, COLUMNS)
    pictures = [bank.images[index].movedim(-1, 0).float() / 255 for index in chosen]
    return _with_renders(
        models, heading, len(indices), pictures, [to_nerfstudio(bank.cameras[index]) for index in chosen]
    )


def _with_renders(
    models: dict[str, Any],
    heading: str,
    total: int,
    pictures: list[Float[Tensor, "3 h w"]],
    cameras: list[Any],
    known: list[Float[Tensor, "1 h w"]] | None = None,
) -> list[Strip]:
    """The pictures, and below them what each model's splats show there with its PSNR over the ``known`` pixels
    (default: all).
    """
    strips = [Strip(heading=f"{heading} ({len(pictures)} of {total})", pictures=pictures)]
    counted = [torch.ones_like(picture[:1]) for picture in pictures] if known is None else known
    for title, model in models.items():
        renders = [
            model.get_outputs_for_camera(camera.to(model.device))["rgb"].cpu().movedim(-1, 0).clamp(0, 1)
            for camera in cameras
        ]
        captions = [_decibels(*three) for three in zip(renders, pictures, counted, strict=True)]
        strips.append(Strip(heading=title, pictures=renders, captions=captions))
    return strips


def _decibels(render: Float[Tensor, "3 h w"], picture: Float[Tensor, "3 h w"], known: Float[Tensor, "1 h w"]) -> str:
    counted = known[0] > 0
    return (
        f"{float(psnr(render[None, :, counted, None], picture[None, :, counted, None])):.1f} dB"
        if bool(counted.any())
        else ""
    )
