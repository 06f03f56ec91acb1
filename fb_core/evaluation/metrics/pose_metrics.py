"""How far recovered cameras are from the true ones, whatever world they were recovered in, and cameras that were not
found included.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.evaluation.metrics.camera_errors import errors
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.similarity import Similarity

ACCURATE_DEGREES = 15.0
"""Relative rotations and directions of a pair that err by less count as right (the customary RRA@15 and RTA@15)."""


def aligned(found: Sequence[Pinholes | None], truth: Sequence[Pinholes]) -> Similarity | None:
    """The similarity from the world of the found cameras to the true one, by least squares; None if no camera was
    found.

    Places that have nothing in common with the truth would ask for a scale of 0 or less; they get next to none, so that
    all of them fall on the middle of the true ones.
    """
    pairs = [(ours, theirs) for ours, theirs in zip(found, truth, strict=True) if ours is not None]
    if not pairs:
        return None
    first, second = (
        (torch.cat([c.rotations for c in side]), torch.cat([c.centers for c in side]))
        for side in zip(*pairs, strict=True)
    )
    similarity = Similarity.between(first, second)
    if similarity.scale > 0:
        return similarity
    least = 1e-9
    shift = second[1].double().mean(dim=0) - least * similarity.rotation @ first[1].double().mean(dim=0)
    return dataclasses.replace(similarity, scale=least, shift=shift)


def pose_errors(found: Sequence[Pinholes | None], truth: Sequence[Pinholes]) -> dict[str, float]:
    """Errors of found cameras after the best similarity, and shares of pairs that are right.

    Returns medians over the found cameras of `rotation_degrees`, `center` (1 is the farthest true camera's distance
    from their middle) and `focal_percent` (NaN where none was found), `found_share`, and over all pairs (those without
    a camera are wrong) `rra_15` and `rta_15`.
    """
    similarity = aligned(found, truth)
    result = {"rotation_degrees": math.nan, "center": math.nan, "focal_percent": math.nan}
    if similarity is not None:
        pairs = [
            (similarity.cameras(ours), theirs) for ours, theirs in zip(found, truth, strict=True) if ours is not None
        ]
        each = [errors(ours, theirs) for ours, theirs in pairs]
        result = {name: float(torch.cat([one[name] for one in each]).median()) for name in result}
        centers = torch.cat([camera.centers for camera in truth]).double()
        extent = float((centers - centers.mean(dim=0)).norm(dim=1).max())
        result["center"] = result["center"] / extent if extent > 0 else math.nan
    result["found_share"] = sum(camera is not None for camera in found) / len(found)
    return result | pair_accuracy(found, truth)


def pair_accuracy(
    found: Sequence[Pinholes | None], truth: Sequence[Pinholes], *, limit_degrees: float = ACCURATE_DEGREES
) -> dict[str, float]:
    """Shares of all pairs whose relative rotation (`rra_15`) and direction from one to the other (`rta_15`) err by less
    than the limit.

    No alignment takes part. Pairs of true cameras in one place have no direction; they count for rotation alone. NaN
    without a pair.
    """
    there = [index for index, camera in enumerate(found) if camera is not None]
    count = len(found)
    if count < 2:
        return {"rra_15": math.nan, "rta_15": math.nan}
    rotations, centers = _batch(truth)
    first, second = torch.triu_indices(count, count, offset=1)
    baseline = _relative(rotations, centers, first, second)[1]
    apart = baseline.norm(dim=1) > 1e-9 * (1 + float(centers.abs().max()))
    right_turn, right_way = torch.zeros(len(first), dtype=torch.bool), torch.zeros(len(first), dtype=torch.bool)
    if there:
        place = torch.full((count,), -1)
        place[there] = torch.arange(len(there))
        both = (place[first] >= 0) & (place[second] >= 0)
        ours = _relative(
            *_batch([camera for camera in found if camera is not None]), place[first[both]], place[second[both]]
        )
        theirs = _relative(rotations, centers, first[both], second[both])
        cosine = (torch.einsum("nij,nij->n", ours[0], theirs[0]) - 1) / 2
        right_turn[both] = torch.rad2deg(cosine.clamp(-1, 1).acos()) < limit_degrees
        ways = torch.nn.functional.cosine_similarity(ours[1], theirs[1], dim=1, eps=1e-30)
        right_way[both] = torch.rad2deg(ways.clamp(-1, 1).acos()) < limit_degrees
    return {
        "rra_15": float(right_turn.double().mean()),
        "rta_15": float(right_way[apart].double().mean()) if bool(apart.any()) else math.nan,
    }


def _batch(cameras: Sequence[Pinholes]) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]:
    return torch.cat([camera.rotations for camera in cameras]).double(), torch.cat(
        [camera.centers for camera in cameras]
    ).double()


def _relative(
    rotations: Float[Tensor, "n 3 3"], centers: Float[Tensor, "n 3"], first: Tensor, second: Tensor
) -> tuple[Float[Tensor, "p 3 3"], Float[Tensor, "p 3"]]:
    """Rotation from the second camera's axes to the first's, and the way from the first to the second in the first's
    axes.
    """
    back = rotations[first].transpose(1, 2)
    return back @ rotations[second], torch.einsum("nij,nj->ni", back, centers[second] - centers[first])
