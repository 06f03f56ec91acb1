"""What a model's cameras are worth: it is asked twice, and what it knows it says twice.

A generative model answers a question that it cannot answer as firmly as any other. Its raymaps then are those of good
pinhole cameras, each time of other ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

AGREEING_DEGREES = 15.0
"""Two answers agree on a pair of photos when the turn and the way from one to the other differ by less (the customary
limit of RRA@15 and RTA@15). Answers that have nothing in common agree on 2 % of the pairs.
"""
LEAST_AGREEMENT = 0.5
"""Share of a photo's pairs that two answers must agree on."""
_ONE_PLACE = 0.05
"""Of the way between the farthest two cameras: a shorter one has no direction that a model could say twice."""


def agreement(
    first: Sequence[Pinholes | None], second: Sequence[Pinholes | None], *, apart: bool
) -> Float[Tensor, " n"]:
    """For each photo the share of the others, of those with two cameras, to which both answers turn and shift it alike.

    No alignment takes part, so each answer may have a world of its own. NaN for a photo without two cameras, and where
    no other photo has them.

    Args:
        first: cameras of the photos, one each; None where there is none.
        second: the other answer, of the same photos.
        apart: whether the cameras stand apart. Where all stand in one place, or both answers say so of a pair (photos
            from a tripod, a photo twice), there is no way from one to the other, and the turn decides alone.
    """
    shares = torch.full((len(first),), math.nan, dtype=torch.float64)
    both = [(a, b) for a, b in zip(first, second, strict=True) if a is not None and b is not None]
    if len(both) < 2:
        return shares
    there = [a is not None and b is not None for a, b in zip(first, second, strict=True)]
    turns, ways = zip(*(_relative(cameras) for cameras in zip(*both, strict=True)), strict=True)
    cosine = (torch.einsum("ijab,ijab->ij", *turns) - 1) / 2
    alike = torch.rad2deg(cosine.clamp(-1, 1).acos()) < AGREEING_DEGREES
    if apart:
        between = torch.nn.functional.cosine_similarity(*ways, dim=2, eps=1e-30)
        alike &= (torch.rad2deg(between.clamp(-1, 1).acos()) < AGREEING_DEGREES) | (_short(ways[0]) & _short(ways[1]))
    alike.fill_diagonal_(False)
    shares[torch.tensor(there)] = alike.double().sum(dim=1) / (len(both) - 1)
    return shares


def _short(ways: Float[Tensor, "n n 3"]) -> Bool[Tensor, "n n"]:
    """Which pairs of cameras stand in one place, beside how far the others stand apart."""
    lengths = ways.norm(dim=2)
    return lengths <= _ONE_PLACE * lengths.max()


def _relative(cameras: Sequence[Pinholes]) -> tuple[Float[Tensor, "n n 3 3"], Float[Tensor, "n n 3"]]:
    """Rotation from each camera's axes to each other's, and the way from one to the other in the first's axes."""
    rotations = torch.cat([camera.rotations for camera in cameras]).double()
    centers = torch.cat([camera.centers for camera in cameras]).double()
    turns = torch.einsum("iba,jbc->ijac", rotations, rotations)
    return turns, torch.einsum("iba,ijb->ija", rotations, centers[None] - centers[:, None])
