"""OpenCV's inpainting by fast marching (Telea 2004): no weights, nothing is imagined."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_RADIUS = 3  # pixels


def telea(image: Float[Tensor, "3 h w"], known: Bool[Tensor, "h w"], *, radius: int) -> Float[Tensor, "3 h w"]:
    """The picture (RGB in [0, 1], rounded to 8 bits) with its unknown pixels continued from the known ones (there must
    be some).

    ``radius``: pixels around a hole's border that are looked at.
    """
    import cv2

    pixels = (image.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    filled = cv2.inpaint(pixels, (~known).to(torch.uint8).numpy(), radius, cv2.INPAINT_TELEA)
    return torch.from_numpy(filled).permute(2, 0, 1).to(image) / 255


def inpainted(images: Float[Tensor, "m 3 h w"], known: Bool[Tensor, "m h w"]) -> Float[Tensor, "m 3 h w"]:
    """The unknown pixels filled from their surroundings; a picture of which nothing is known comes back grey."""
    filled = [
        telea(image, mask, radius=_RADIUS) if bool(mask.any()) else torch.full_like(image, 0.5)
        for image, mask in zip(images, known, strict=True)
    ]
    return torch.where(known[:, None], images, torch.stack(filled))
