"""Pixels of known views carried over into other views: a first guess of what these show.

Every ray of an unknown view is followed to a distance, by default to infinity, and the known views are asked for the
colour there. Where several show the place, the one that has it nearest to its own middle answers, for that one looks
most the same way.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.raymap import axes_of

BELIEF_BY_DIRECTION = 0.35
"""How far to believe pixels that are carried over by direction alone, which are off where surfaces are near (what
models learn).
"""
BELIEF_OF_RENDERS = 0.7
"""How far to believe pixels whose geometry is known but for the errors of splats (what models learn)."""
SAME_SURFACE = 0.06
"""Share of the distance by which two distances may differ and still be those of one surface."""
_LEAST_COSINE = 0.05
"""Rays that leave a known view's axis by more than 87 degrees are not looked up in it."""
_WHOLE = 0.99
"""Share of an interpolated pixel that must be known."""


class Carried(NamedTuple):
    """A guess of m views."""

    images: Float[Tensor, "m 3 h w"]
    """Colours in [0, 1]; 0 where there is none."""
    there: Float[Tensor, "m 1 h w"]
    """1 where a known view tells the colour, else 0."""


class _Lens(NamedTuple):
    """Pinholes as their raymaps tell them, up to the place of the camera."""

    axes: Float[Tensor, "k 3 3"]
    focal: Float[Tensor, "k 2"]
    """In half widths and half heights."""
    shift: Float[Tensor, "k 2"]
    """Principal point from the middle, in half widths and half heights."""


def carried_over(
    images: Float[Tensor, "k 3 h w"],
    known: Float[Tensor, "k 1 h w"],
    raymaps: Float[Tensor, "k 6 h w"],
    wanted: Float[Tensor, "m 6 h w"],
    *,
    distance: Float[Tensor, "m 1 h w"] | None = None,
    known_distance: Float[Tensor, "k 1 h w"] | None = None,
    same_surface: float = SAME_SURFACE,
) -> Carried:
    """The guess of m views from k known ones, all with known rays of pinhole cameras (any crop; no lens distortion).

    Args:
        images: known colours in [0, 1]; where ``known`` is below 1 nothing is taken.
        known: 1 = known.
        raymaps: rays of the known views, origins in any unit.
        wanted: rays of the views to be guessed.
        distance: how far along each of these rays the surface lies, in the unit of the origins; None = infinitely far,
            so that only directions count.
        known_distance: the same of the known views, where it is known: then what another surface hides is left out.
        same_surface: relative difference of distances up to which two views show the same surface.
    """
    count, (height, width) = len(wanted), wanted.shape[-2:]
    if not len(images) or not count:
        return Carried(wanted.new_zeros(count, 3, height, width), wanted.new_zeros(count, 1, height, width))
    lens = _lens_of_rays(raymaps)
    directions = rearrange(wanted[:, 3:], "m c h w -> 1 m h w c")
    origins = raymaps[:, :3].flatten(2).mean(dim=2)
    if distance is not None:
        points = rearrange(wanted[:, :3] + distance * wanted[:, 3:], "m c h w -> 1 m h w c")
        directions = points - origins[:, None, None, None]
    seen = torch.einsum("kmhwc,kcd->kmhwd", directions.expand(len(images), -1, -1, -1, -1), lens.axes)
    length = seen.norm(dim=-1).clamp(min=1e-9)
    cosine = seen[..., 2] / length
    place = (
        seen[..., :2] / seen[..., 2:].clamp(min=1e-9) * lens.focal[:, None, None, None]
        + lens.shift[:, None, None, None]
    )
    inside = (cosine > _LEAST_COSINE) & (place.abs() <= 1).all(dim=-1)
    known_views = torch.cat([torch.where(known >= 1, images, torch.zeros_like(images)), (known >= 1).to(images)], dim=1)
    looked_up = _sampled(known_views, place)
    inside &= looked_up[:, :, 3] > _WHOLE
    if distance is not None and known_distance is not None:
        surface = _sampled(known_distance, place, mode="nearest")[:, :, 0]
        inside &= (surface / length - 1).abs() < same_surface
    score, best = torch.where(inside, cosine, cosine.new_full((), -2.0)).max(dim=0)
    chosen = repeat(best, "m h w -> 1 m c h w", c=3)
    there = (score > -2.0)[:, None].to(images)
    return Carried(looked_up[:, :, :3].gather(0, chosen)[0] * there, there)


def _sampled(
    values: Float[Tensor, "k c h w"], place: Float[Tensor, "k m oh ow 2"], mode: str = "bilinear"
) -> Float[Tensor, "k m c oh ow"]:
    """Values of each known view at the places that are asked of it."""
    grid = rearrange(place, "k m h w xy -> k (m h) w xy")
    taken = F.grid_sample(values, grid, mode=mode, padding_mode="border", align_corners=False)
    return rearrange(taken, "k c (m h) w -> k m c h w", m=place.shape[1])


def _lens_of_rays(raymaps: Float[Tensor, "k 6 h w"]) -> _Lens:
    """Axes, focal lengths and principal points from the rays' directions."""
    height, width = raymaps.shape[-2:]
    axes = torch.stack([axes_of(directions) for directions in raymaps[:, 3:]])
    seen = torch.einsum("kchw,kcd->khwd", raymaps[:, 3:], axes)
    tangents = seen[..., :2] / seen[..., 2:]
    sides = []
    for first, last, pixels in (
        (tangents[:, :, 0, 0], tangents[:, :, -1, 0], width),
        (tangents[:, 0, :, 1], tangents[:, -1, :, 1], height),
    ):
        first, last, reach = (
            first.mean(dim=1),
            last.mean(dim=1),
            1 - 1 / pixels,
        )  # from the first pixel's centre to the last one's
        focal = 2 * reach / (last - first)
        sides.append((focal, reach - focal * last))
    (focal_x, shift_x), (focal_y, shift_y) = sides
    return _Lens(axes, torch.stack([focal_x, focal_y], dim=1), torch.stack([shift_x, shift_y], dim=1))
