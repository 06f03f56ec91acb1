"""Recovered cameras set upright: z up, the middle of the cameras at the origin, the farthest camera at distance 1."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.similarity import Similarity, rounding_of
from fb_core.geometry.viewpoints.paths import up_of

_ONE_PLACE = 1e-6  # units of spread that count as none, beside the rounding of the coordinates


def upright(cameras: Sequence[Pinholes]) -> Similarity:
    """Takes cameras of any sizes to a world whose z axis is their up, of unit extent.

    The turn is the smallest that does it, so headings stay as near as they can to what they were. Cameras that all
    stand in one place keep their scale. Raises ValueError for no camera.
    """
    up = up_of(list(cameras)).double()
    rounding = max(rounding_of(group.centers) for group in cameras if len(group))
    centers = torch.cat([group.centers.double() for group in cameras])
    middle = centers.mean(dim=0)
    extent = float((centers - middle).norm(dim=1).max())
    scale = 1 / extent if extent > _ONE_PLACE + rounding else 1.0
    rotation = turn_between(up, up.new_tensor([0.0, 0.0, 1.0]))
    return Similarity(rotation=rotation, scale=scale, shift=-scale * rotation @ middle)


def turn_between(first: Float[Tensor, " 3"], second: Float[Tensor, " 3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes one unit vector to another; half a turn about some perpendicular axis for
    opposite ones.
    """
    cosine = float(first @ second)
    if cosine < -1 + 1e-12:
        axis = torch.linalg.cross(first, torch.nn.functional.one_hot(first.abs().argmin(), 3).to(first))
        axis = axis / axis.norm()
        return 2 * torch.outer(axis, axis) - torch.eye(3).to(first)
    x, y, z = torch.linalg.cross(first, second).tolist()
    skew = first.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return torch.eye(3).to(first) + skew + skew @ skew / (1 + cosine)
