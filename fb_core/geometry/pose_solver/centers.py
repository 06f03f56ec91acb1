"""One centre for the ray origins of a view: the median, then means of those near it, so that almost half of them may be
wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.pose_solver.rays import length_of

_MEDIAN_OF_NORM_3D = 1.5382  # median length of a three-dimensional standard normal vector
_KEPT = 4.5  # beyond so many deviations an origin is an outlier (one in 20 000 true ones is)
_SOFT_ROUNDS = 3


@dataclass(frozen=True, kw_only=True)
class Centers:
    """Centres with their uncertainty."""

    position: Float[Tensor, "n 3"]
    """Scene units; zero where a view has no usable ray."""
    deviation: Float[Tensor, " n"]
    """Standard deviation of an inlying origin with weight 1, per axis, scene units."""
    variance: Float[Tensor, " n"]
    """Variance of the position, per axis, if the origins err independently."""
    limit: Float[Tensor, " n"]
    """Origins of weight 1 farther than this from the centre are outliers."""


def median_over(values: Float[Tensor, "n r"], usable: Bool[Tensor, "n r"]) -> Float[Tensor, " n"]:
    """Lower median of the usable entries of each row, zero for a row without any."""
    if values.shape[1] == 0:
        return values.new_zeros(len(values))
    return torch.where(usable, values, torch.nan).nanmedian(dim=1).values.nan_to_num(0.0)


def robust_centers(origins: Float[Tensor, "n 3 r"], weights: Float[Tensor, "n r"], *, precision: float) -> Centers:
    """The centre of each view's ray origins; differentiable in the inlying origins.

    Median by coordinate, Geman-McClure weighted means from there, at last the weighted mean of the inliers, which is
    efficient for normal noise. All is reckoned relative to the median, so that a far-away scene costs no digits.
    """
    usable = weights > 0
    fixed = origins.detach()
    start = torch.stack([median_over(fixed[:, axis], usable) for axis in range(3)], dim=-1)
    offsets = (fixed - start[..., None]) * usable[:, None]
    floor = precision * (start.norm(dim=-1) + median_over(length_of(offsets), usable)) + torch.finfo(torch.float64).tiny
    root = weights.sqrt()
    center = torch.zeros_like(start)
    deviation = floor
    robust_weights = weights
    for round_ in range(_SOFT_ROUNDS + 2):
        lengths = length_of(offsets - center[..., None]) * root
        if round_ <= _SOFT_ROUNDS:
            deviation = median_over(lengths, usable) / _MEDIAN_OF_NORM_3D
        else:
            inliers = robust_weights > 0
            degrees_of_freedom = (3 * inliers.sum(dim=1) - 3).clamp_min(1)
            deviation = (torch.where(inliers, lengths.square(), 0.0).sum(dim=1) / degrees_of_freedom).sqrt()
        deviation = torch.maximum(deviation, floor)
        relative = lengths / deviation[:, None]
        soft = weights / (1 + (relative / 3).square()).square()
        robust_weights = soft if round_ < _SOFT_ROUNDS else torch.where(relative <= _KEPT, weights, 0.0)
        center = _mean(offsets, robust_weights)
    lengths = length_of(offsets - center[..., None]) * root
    inliers = robust_weights > 0
    squares = torch.where(inliers, lengths.square(), 0.0).sum(dim=1)
    deviation = torch.maximum((squares / (3 * inliers.sum(dim=1) - 3).clamp_min(1)).sqrt(), floor)
    total = robust_weights.sum(dim=1)
    variance = deviation.square() / torch.where(total > 0, total, 1.0)
    if origins.requires_grad:
        center = _mean(origins - start[..., None], robust_weights)
    return Centers(position=start + center, deviation=deviation, variance=variance, limit=_KEPT * deviation)


def _mean(offsets: Float[Tensor, "n 3 r"], weights: Float[Tensor, "n r"]) -> Float[Tensor, "n 3"]:
    total = weights.sum(dim=1, keepdim=True)
    return torch.einsum("nr,nir->ni", weights / torch.where(total > 0, total, 1.0), offsets)
