"""A baseline without a network: the known pixels carried to other cameras by their depth."""

from __future__ import annotations

import torch
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

_NEAREST = 1.02  # points of one pixel within this factor of the nearest depth are the same surface


def reproject(
    images: Float[Tensor, "k 3 h w"], depth: Float[Tensor, "k h w"], known: Pinholes, unknown: Pinholes
) -> tuple[Float[Tensor, "m 3 h w"], Bool[Tensor, "m h w"]]:
    """Every known pixel drawn as one point into the unknown cameras, nearest surface first; also returns where
    something was drawn.

    ``depth`` is the z-depth of the known pixels in scene units. Pixels on which several points of the nearest surface
    fall get their mean.
    """
    height, width = unknown.height, unknown.width
    points = rearrange(known.unproject(depth), "k h w c -> (k h w) c")
    colors = rearrange(images, "k c h w -> (k h w) c")
    pixels, depths = unknown.project(points)
    pictures = [_draw(*drawn, colors, height, width) for drawn in zip(pixels, depths, strict=True)]
    return torch.stack([picture for picture, _ in pictures]), torch.stack([drawn for _, drawn in pictures])


def _draw(
    pixels: Float[Tensor, "p 2"], depths: Float[Tensor, "p"], colors: Float[Tensor, "p 3"], height: int, width: int
):
    column, row = pixels.floor().unbind(dim=1)
    visible = (depths > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = (row * width + column)[visible].long()
    depths, colors = depths[visible], colors[visible]
    nearest = depths.new_full((height * width,), torch.inf).scatter_reduce_(0, place, depths, "amin")
    weight = (depths <= nearest[place] * _NEAREST).to(colors)
    sums = colors.new_zeros(height * width, 4).index_add_(
        0, place, torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1) * weight[:, None]
    )
    mean = sums[:, :3] / sums[:, 3:].clamp_min(1)
    return rearrange(mean, "(h w) c -> c h w", h=height), (sums[:, 3] > 0).view(height, width)
