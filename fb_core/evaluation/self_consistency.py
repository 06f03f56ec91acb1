"""Poses -> views -> poses: whether generated views look as if they were taken where they were asked for. Needs no
ground truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.photos.photo import Photo
from fb_core.evaluation.metrics.pose_metrics import pose_errors
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.registration.choice import register


def photo_of(
    image: Float[Tensor, "3 h w"], *, name: str, device: str, focal: float | None = None, camera: Pinholes | None = None
) -> Photo:
    """A picture in memory as a photo."""
    image = image.detach().cpu()

    def pixels() -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]:
        return image, torch.ones_like(image[:1])

    return Photo(
        name=name,
        source=Path(name),
        size=(image.shape[1], image.shape[2]),
        focal_prior=focal,
        device=device,
        seconds=None,
        camera=camera,
        thumbnail=image,
        pixels=pixels,
    )


def self_consistency(
    images: Sequence[Float[Tensor, "3 _h _w"]],
    cameras: Sequence[Pinholes],
    *,
    method: Literal["model", "features"],
    model: Fillerbuster | None,
    seed: int,
    sampling: SamplingConfig | None = None,
    views_at_once: int = 16,
) -> dict[str, float]:
    """Errors of cameras that are recovered from pictures alone against those that the pictures belong to.

    Args:
        images: given and generated pictures, RGB in [0, 1], of any sizes; two or more.
        cameras: of each, a batch of one for the picture's own size: recovered ones of given pictures, those asked for
            of generated ones.
        method: as in `register`.
        model: for the method "model".
        seed: decides the samples.
        sampling: as in `register`.
        views_at_once: as in `register`.

    Returns what `pose_errors` does, and `trusted_share`: of all pictures, those whose recovered camera is trusted.
    """
    photos = [
        photo_of(
            image,
            name=f"view {number}",
            device=f"{image.shape[2]} x {image.shape[1]}, focal length {float(camera.focal[0, 0]):.4g}",
        )
        for number, (image, camera) in enumerate(zip(images, cameras, strict=True))
    ]
    registration = register(
        photos, method=method, model=model, seed=seed, sampling=sampling, views_at_once=views_at_once
    )
    trusted = sum(verdict == "ok" for verdict in registration.verdicts) / len(photos)
    return pose_errors(registration.cameras, list(cameras)) | {"trusted_share": trusted}
