"""Colours of generated views that meet the captured ones without a seam.

A diffusion model drifts in exposure and tint from view to view. Where a generated view shows what the splats show
already, the difference is known; spread smoothly over the rest of the picture and taken off, it leaves no edge between
captured and generated surfaces (membrane interpolation by push and pull: Gortler et al. 1996, section 3.3; Perez et al.
2003 for the idea).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

CELLS = 32
"""The correction is constant over cells of a 32nd of the picture, then bilinear: colours are mended, not details."""
_FULL = 0.25  # share of reliable pixels from which a cell's own difference counts in full
_REACH = 3.0  # cells over which a correction fades; much farther it makes generated surfaces worse (measured on rooms)


def without_seams(
    images: Float[Tensor, "n 3 h w"], rendered: Float[Tensor, "n 3 h w"], reliable: Bool[Tensor, "n h w"]
) -> Float[Tensor, "n 3 h w"]:
    """The images with smoothly changed colours that agree with ``rendered`` where that is reliable; values stay in [0,
    1].

    A picture without a reliable pixel stays as it is; the change fades with the distance to reliable pixels.

    Args:
        images: generated pictures, RGB in [0, 1].
        rendered: what the splats show from the same cameras; not looked at where unreliable.
        reliable: pixels that the capture has seen and the splats cover.
    """
    weight = reliable[:, None].to(images)
    difference = torch.where(reliable[:, None], rendered - images, 0.0)
    side = min(CELLS, *images.shape[2:])
    share = F.adaptive_avg_pool2d(weight, side)
    cells = F.adaptive_avg_pool2d(difference, side) / share.clamp(min=1e-6)
    smooth = spread(cells, (share / _FULL).clamp(max=1.0), reach=_REACH)
    return (images + F.interpolate(smooth, size=images.shape[2:], mode="bilinear", align_corners=False)).clamp(0.0, 1.0)


def spread(
    values: Float[Tensor, "n c h w"], weight: Float[Tensor, "n 1 h w"], *, reach: float = math.inf
) -> Float[Tensor, "n c h w"]:
    """Values where their weight is 1, smoothly continued where it is 0 (push and pull over halved resolutions).

    Args:
        values: what is known; finite everywhere, and not looked at where the weight is 0.
        weight: confidence in [0, 1].
        reach: distance in pixels over which continued values fade to 0; infinite continues them undamped.
    """
    height, width = values.shape[2:]
    if height == 1 and width == 1:
        return values * (weight > 0)
    half = (-(-height // 2), -(-width // 2))
    pads = (0, 2 * half[1] - width, 0, 2 * half[0] - height)
    total = 4 * F.avg_pool2d(F.pad(weight, pads), 2)
    means = 4 * F.avg_pool2d(F.pad(values * weight, pads), 2) / total.clamp(min=1e-12)
    coarser = spread(
        means, total.clamp(max=1.0), reach=reach / 2
    )  # a cell that knows anything is as good as one that knows all
    pulled = F.interpolate(coarser, size=(2 * half[0], 2 * half[1]), mode="bilinear", align_corners=False)[
        ..., :height, :width
    ]
    return weight * values + (1 - weight) * math.exp(-1 / reach) * pulled
