"""Rotations as matrices and as quaternions, and camera axes of other conventions."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def rotations_of(quaternions: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3 3"]:
    """Rotations of unit quaternions (w, x, y, z), in their precision; the inverse of :func:`quaternions_of`."""
    w, x, y, z = quaternions.unbind(dim=-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quaternions_of(rotations: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 4"]:
    """Unit quaternions (w, x, y, z; w >= 0) of rotations, in float64, accurate for every angle.

    The eigenvector of Bar-Itzhack's symmetric 4 x 4 matrix to its largest eigenvalue; for exact rotations that
    eigenvalue is 1.
    """
    r = rotations.double()
    xx, yy, zz = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    rows = [
        [xx + yy + zz, r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]],
        [r[:, 2, 1] - r[:, 1, 2], xx - yy - zz, r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0]],
        [r[:, 0, 2] - r[:, 2, 0], r[:, 0, 1] + r[:, 1, 0], yy - xx - zz, r[:, 1, 2] + r[:, 2, 1]],
        [r[:, 1, 0] - r[:, 0, 1], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1], zz - xx - yy],
    ]
    matrix = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2) / 3
    quaternions = torch.linalg.eigh(matrix).eigenvectors[..., -1]
    return torch.where(quaternions[:, :1] < 0, -quaternions, quaternions)


def flip_axes(camera_to_world: Float[Tensor, "*n 3 4"]) -> Float[Tensor, "*n 3 4"]:
    """OpenGL camera axes (x right, y up, z back) to OpenCV's (x right, y down, z forward), or back: it is its own
    inverse.

    Negates the second and third column; centres stay. Exact in floating point, differentiable.
    """
    return camera_to_world * camera_to_world.new_tensor([1.0, -1.0, -1.0, 1.0])
