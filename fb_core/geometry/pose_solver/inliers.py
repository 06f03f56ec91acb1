"""Which of all rays agree with the recovered cameras: a few passes over whole raymaps, in their own precision."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

_RAYS_AT_ONCE = 2**16  # so many stay in a processor's cache
_SAFE_SQUARES = (1e-8, 1e8)  # squared lengths of directions whose products neither vanish nor overflow


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Cameras as maps of pixels to directions, and how far off an inlier may be."""

    homography: Float[Tensor, "n 3 3"]
    """M = R K^-1: the direction of pixel (x, y) is M (x, y, 1)."""
    centers: Float[Tensor, "n 3"]
    """Scene units."""
    turn: Float[Tensor, " n"]
    """Largest sine between a ray of weight 1 and its camera's own."""
    shift: Float[Tensor, " n"]
    """Largest distance of the origin of a ray of weight 1 from the centre, scene units."""


def homography_of(
    rotations: Float[Tensor, "n 3 3"], focal: Float[Tensor, "n 2"], principal: Float[Tensor, "n 2"]
) -> Float[Tensor, "n 3 3"]:
    """M = R K^-1."""
    sides = rotations[:, :, :2] / focal[:, None]
    middle = rotations[:, :, 2] - (sides * principal[:, None]).sum(dim=2)
    return torch.cat([sides, middle[..., None]], dim=2)


@torch.no_grad()
def agreeing_rays(
    rays: Float[Tensor, "n 6 *r"],
    x: Float[Tensor, "..."],
    y: Float[Tensor, "..."],
    weights: Float[Tensor, "n *r"],
    limits: Limits,
) -> Bool[Tensor, "n *r"]:
    """Rays that start near their camera's centre and run along its own ray; NaN agrees with nothing.

    ``x`` and ``y`` are pixel coordinates that broadcast to the shape of the weights. A few views at a time.
    """
    agreeing = torch.empty(weights.shape, dtype=torch.bool, device=weights.device)
    at_once = max(1, _RAYS_AT_ONCE // max(1, weights[:1].numel()))
    for first in range(0, len(rays), at_once):
        part = slice(first, first + at_once)
        own = Limits(
            homography=limits.homography[part],
            centers=limits.centers[part],
            turn=limits.turn[part],
            shift=limits.shift[part],
        )
        own_x, own_y = (values if len(values) == 1 else values[part] for values in (x, y))
        agreeing[part] = _agreeing(rays[part], own_x, own_y, weights[part], own)
    return agreeing


def _agreeing(
    rays: Float[Tensor, "n 6 *r"],
    x: Float[Tensor, "..."],
    y: Float[Tensor, "..."],
    weights: Float[Tensor, "n *r"],
    limits: Limits,
) -> Bool[Tensor, "n *r"]:
    """Sines come from cross products, which are exact for small angles (cosines are not)."""

    def wide(values: Tensor) -> Tensor:
        return values.reshape(-1, *[1] * (weights.dim() - 1))

    offsets = [rays[:, axis] - wide(limits.centers[:, axis]) for axis in range(3)]
    near = _dot(offsets, offsets) * weights <= wide(limits.shift.square())
    row = [[wide(limits.homography[:, i, j]) for j in range(3)] for i in range(3)]
    expected = [(row[i][0] * x + row[i][2]) + row[i][1] * y for i in range(3)]
    directions = [rays[:, 3 + axis] for axis in range(3)]
    squared = _dot(directions, directions)
    if not bool(((squared > _SAFE_SQUARES[0]) & (squared < _SAFE_SQUARES[1])).all()):  # directions may have any length
        largest = torch.stack(directions).abs().amax(dim=0)
        directions = [component / largest for component in directions]
        squared = _dot(directions, directions)
    cross = [
        torch.addcmul(directions[i - 2] * expected[i - 1], directions[i - 1], expected[i - 2], value=-1)
        for i in range(3)
    ]
    bound = wide(limits.turn.square()) * _dot(expected, expected) * squared
    return near & (_dot(directions, expected) > 0) & (_dot(cross, cross) * weights <= bound)


def _dot(first: list[Tensor], second: list[Tensor]) -> Tensor:
    return torch.addcmul(torch.addcmul(first[0] * second[0], first[1], second[1]), first[2], second[2])
