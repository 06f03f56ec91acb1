"""Which recovered cameras deserve trust, and why the others do not."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.pose_solver.rays import Rays
from fb_core.geometry.pose_solver.seed import Seeds

FEWEST_RAYS = 4
_NARROWEST_LINE = 1e-3  # of its length: usable pixels in a narrower strip are a line
_FOCAL_DOUBT = 0.1  # relative standard deviation of the focal length from which it is not determined
_MIRROR_CLARITY = 4.0  # spread over deviation of the directions from which their handedness is no accident
_WILDEST = 0.5  # radians of deviation from which rays have no camera in common


class Verdict(StrEnum):
    """What is to be thought of one view's camera. Everything but OK means: the camera returned is a placeholder."""

    OK = "ok"
    NO_RAYS = "no rays"
    TOO_FEW_RAYS = "too few rays"
    ON_A_LINE = "pixels on a line"
    PARALLEL = "parallel rays"
    MIRRORED = "mirrored"
    NO_CONSENSUS = "no consensus"


class Arrangement(StrEnum):
    """Where the trusted cameras stand."""

    NO_CAMERA = "no camera"
    ONE_CAMERA = "one camera"
    ONE_PLACE = "one place"
    """A pure rotation: there is no baseline, hence no scale."""
    APART = "apart"


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """A verdict and its reason in words."""

    verdict: Verdict
    reason: str
    """One sentence with the figures that decided."""


def judge_seeds(rays: Rays, seeds: Seeds) -> list[Judgement]:
    """What can be told of each view before its camera is refined."""
    count = rays.usable.sum(dim=1)
    width = _narrow_side(rays)
    doubt = seeds.deviation / count.clamp_min(1).sqrt() / seeds.spread.clamp_min(torch.finfo(torch.float64).tiny)
    parallel = (doubt > _FOCAL_DOUBT / 2) | (seeds.spread < 8 * rays.precision)
    mirrored = seeds.mirrored & (seeds.spread > _MIRROR_CLARITY * seeds.deviation)
    columns = (count, rays.broken, width, parallel, seeds.spread, mirrored, seeds.deviation)
    return [_judged(*values) for values in zip(*(column.tolist() for column in columns), strict=True)]


def _judged(
    count: int, broken: int, width: float, parallel: bool, spread: float, mirrored: bool, deviation: float
) -> Judgement:
    rejected = f" ({broken} rejected: NaN, infinite or without direction)" if broken else ""
    if count == 0:
        return Judgement(
            verdict=Verdict.NO_RAYS, reason=f"no usable ray: all are masked{' or broken' if broken else ''}{rejected}"
        )
    if count < FEWEST_RAYS:
        return Judgement(
            verdict=Verdict.TOO_FEW_RAYS, reason=f"{count} usable rays{rejected}, a camera needs {FEWEST_RAYS}"
        )
    if width < _NARROWEST_LINE:
        return Judgement(
            verdict=Verdict.ON_A_LINE, reason=f"all {count} usable rays{rejected} belong to pixels on one line"
        )
    if parallel:
        said = f"directions spread by {_degrees(spread)} and err by {_degrees(deviation)} degrees"
        return Judgement(
            verdict=Verdict.PARALLEL,
            reason=f"nearly parallel rays say nothing of focal length and roll: {said}{rejected}",
        )
    if mirrored:
        return Judgement(
            verdict=Verdict.MIRRORED,
            reason="the rays are left-handed, no camera has such; flip the image or negate one axis of the "
            f"directions{rejected}",
        )
    if deviation > _WILDEST:
        return Judgement(
            verdict=Verdict.NO_CONSENSUS,
            reason=f"the rays of no camera come closer than {_degrees(deviation)} degrees{rejected}",
        )
    return Judgement(verdict=Verdict.OK, reason=rejected.strip(" ()"))


def judge_share(judgement: Judgement, share: float, least: float) -> Judgement:
    """The judgement once it is known which share of the usable rays agrees with the camera."""
    if judgement.verdict != Verdict.OK or share >= least:
        return judgement
    return Judgement(
        verdict=Verdict.NO_CONSENSUS,
        reason=f"only {share:.0%} of the usable rays agree with one camera, expected {least:.0%}",
    )


def arrangement_of(centers: Float[Tensor, "n 3"], deviation: Float[Tensor, " n"], *, precision: float) -> Arrangement:
    """How trusted cameras stand to each other; centres closer than their uncertainty and rounding are in one place."""
    if len(centers) < 2:
        return Arrangement.ONE_CAMERA if len(centers) else Arrangement.NO_CAMERA
    apart = (centers - centers.mean(dim=0)).norm(dim=1)
    rounding = 4 * precision * centers.norm(dim=1).max()
    return Arrangement.ONE_PLACE if bool((apart <= 5 * deviation + rounding).all()) else Arrangement.APART


def _narrow_side(rays: Rays) -> Float[Tensor, " n"]:
    """Width over length of the strip of the image that holds the usable rays (0 for a line, 1 for a disc)."""
    count = rays.usable.sum(dim=1).clamp_min(1)[:, None, None]
    mean = (rays.pixels * rays.usable[:, None]).sum(dim=2, keepdim=True) / count
    offsets = (rays.pixels - mean) * rays.usable[:, None]
    variances = torch.linalg.eigvalsh(offsets @ offsets.transpose(1, 2) / count).clamp_min(0)
    return (variances[:, 0] / variances[:, 1].clamp_min(torch.finfo(torch.float64).tiny)).sqrt()


def _degrees(radians: float) -> str:
    return f"{radians * 180 / torch.pi:.3g}"
