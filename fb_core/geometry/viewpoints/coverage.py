"""What of a scene its pictures show, and which further views would show most of the rest.

The scene stands as points on a surface all around, each with a weight. Views are chosen one after the other by what
they add, until the next one would add too little: a capture that lacks a corner gets views of that corner, one that
lacks nothing gets none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.paths import seen_by

SEEN_AGAIN = 0.35
"""A surface point that a new view shows is worth this much less to the next one: one generated picture may err."""
_CONTEXT = 0.5  # share of a view that the capture should show, so that the model has something to go on from
_AT_ONCE = 256  # candidates, which bounds memory
_ALONE = 0.2  # worth of a view that shows nothing known, beside one that shows enough


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """How much of the surface around a capture its pictures show."""

    surface: Float[Tensor, "k 3"]
    """Points all over it."""
    weight: Float[Tensor, "k"]
    """How much each of them counts, 0 or more."""
    seen: Bool[Tensor, "k"]
    """Whether a picture shows it."""

    @staticmethod
    def of(
        cameras: Sequence[Pinholes],
        surface: Float[Tensor, "k 3"],
        weight: Float[Tensor, "k"],
        known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
    ) -> Coverage:
        """Of a capture's cameras, one each; ``known`` are masks of the known parts of their pictures (None = all of
        it).
        """
        return Coverage(surface=surface, weight=weight, seen=seen_by(cameras, surface, known))

    @property
    def unseen_share(self) -> float:
        """Weight of what no picture shows over all weight, from 0 to 1; 0 where nothing has any weight."""
        total = float(self.weight.sum())
        return float(self.weight[~self.seen].sum()) / total if total > 0 else 0.0


@dataclass(frozen=True, kw_only=True)
class ChosenViews:
    """New views in the order in which they were chosen."""

    indices: tuple[int, ...]
    """Which of the candidates they are."""
    gains: tuple[float, ...]
    """Share of all weight that each of them added when it was chosen, known surroundings counted in."""
    unseen_share: float
    """Share of all weight that neither a captured nor a chosen view shows."""


def shown_by(
    centers: Float[Tensor, "c 3"], looks: Float[Tensor, "c 3"], surface: Float[Tensor, "k 3"], half_angle_radians: float
) -> Bool[Tensor, "c k"]:
    """Which points lie in the cone of half that opening around each unit look direction. Occlusion is not
    considered.
    """
    inside = []
    for some, ways in zip(centers.split(_AT_ONCE), looks.split(_AT_ONCE), strict=True):
        towards = F.normalize(surface - some[:, None], dim=2)
        inside.append((towards @ ways[:, :, None])[..., 0] > math.cos(half_angle_radians))
    return torch.cat(inside) if inside else torch.zeros(0, len(surface), dtype=torch.bool)


def choose_views(
    coverage: Coverage,
    shown: Bool[Tensor, "c k"],
    *,
    most: int,
    least_gain: float,
    worth: Float[Tensor, "c"] | None = None,
    centers: Float[Tensor, "c 3"] | None = None,
) -> ChosenViews:
    """The candidates that add most, one after the other, until the next one would add too little.

    A candidate adds the weight of the unseen points that it shows; points that a chosen view shows count less and less.
    It is worth its whole gain when the capture shows half of what it shows, and a fifth of it when nothing: the model
    continues what it sees, and takes its tones from there. A place is used again only when nothing is added from any
    other: views of one surface from several places tell where it stands. Of equals the first is taken, so the order of
    candidates decides nothing else.

    Args:
        coverage: what the capture shows.
        shown: which surface points each candidate would show.
        most: views at most, 0 or more.
        least_gain: share of the unseen weight, from 0 to 1, that a view must add at least.
        worth: how much more than others each candidate is worth for what it adds; None is 1 each.
        centers: where each candidate stands; None is a place for each.

    Raises ValueError for bounds out of their ranges.
    """
    if most < 0:
        raise ValueError(f"choose_views: expected 0 or more views at most, got {most}")
    if not 0 <= least_gain <= 1:
        raise ValueError(f"choose_views: expected a least gain from 0 to 1, got {least_gain}")
    total = float(coverage.weight.sum())
    need = torch.where(coverage.seen, 0.0, coverage.weight)
    least = least_gain * float(need.sum())
    matrix = shown.float()
    size = matrix.sum(dim=1).clamp(min=1)
    surroundings = (matrix @ coverage.seen.to(matrix)) / size
    certain = _ALONE + (1 - _ALONE) * (surroundings / _CONTEXT).clamp(max=1)
    known, indices, gains = coverage.seen.clone(), list[int](), list[float]()
    unused = torch.ones(len(shown), dtype=torch.bool, device=shown.device)
    while len(indices) < most and len(shown):
        added = matrix @ need.float()
        gain = torch.where((added > 0) & (added >= least), added * certain, 0.0)
        elsewhere = gain * unused
        offered = elsewhere if bool((elsewhere > 0).any()) else gain
        best = int((offered if worth is None else offered * worth).argmax())
        if float(gain[best]) <= 0:
            break
        unused[best] = False
        if centers is not None:
            unused &= (centers != centers[best]).any(dim=1)
        indices.append(best)
        gains.append(float(gain[best]) / total)
        need = torch.where(shown[best], need * SEEN_AGAIN, need)
        known |= shown[best]
    left = float(coverage.weight[~known].sum()) / total if total > 0 else 0.0
    return ChosenViews(indices=tuple(indices), gains=tuple(gains), unseen_share=left)
