"""Folders of photos made on the way."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from fb_core.data import media
from fb_core.data.photos.collection import THUMBNAIL_SIDE
from fb_core.data.photos.photo import Photo
from fb_core.geometry.cameras import Pinholes


def made(
    image: torch.Tensor, name: str = "a", *, camera: Pinholes | None = None, mask: torch.Tensor | None = None
) -> Photo:
    """A photo that exists in memory only."""
    known = torch.ones_like(image[:1]) if mask is None else mask
    size = (image.shape[1], image.shape[2])
    photo = Photo(
        name=name,
        source=Path(name),
        size=size,
        focal_prior=None,
        device="",
        seconds=None,
        camera=camera,
        thumbnail=media.shrink(image, THUMBNAIL_SIDE),
        pixels=lambda: (image, known),
    )
    return dataclasses.replace(photo, thumbnail=photo.load(THUMBNAIL_SIDE))
