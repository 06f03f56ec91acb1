"""Distances between points, exact however far both lie from the world's origin."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def rounding_of(points: Float[Tensor, "n d"]) -> float:
    """How far places may be apart, in their unit, by the rounding of their coordinates alone; it grows with the way to the origin."""
    return 8 * torch.finfo(points.dtype).eps * float(points.abs().max()) if len(points) else 0.0


def distances_between(a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
    """Euclidean distances of every point of ``a`` to every point of ``b``, in their unit.

    torch.cdist multiplies matrices where there are many points, |a|^2 + |b|^2 - 2 a.b, which in float32 leaves nothing of small distances
    far from the origin. Here differences are taken first, near the origin.
    """
    if not len(b):
        return a.new_zeros(len(a), 0)
    middle = b.mean(dim=0)
    return torch.cdist(a - middle, b - middle, compute_mode="donot_use_mm_for_euclid_dist")
