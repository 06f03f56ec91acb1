"""Whether a photo was taken with the lens that it is believed to share: a focal length of its own against that one.

Before a wall, a zoomed photo looks like one from nearer by, and a bundle adjustment moves camera and points until they
agree. So the points are those that the other photos fix, with their uncertainty, and a photo is placed by them twice:
with a lens that others have, and with a focal length of its own, which must explain its places better by more than one
number more always does (Schwarz 1978).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from fb_core.geometry.features.bundle_adjustment import Bundle, adjusted_points, radial
from fb_core.geometry.features.lenses import FOCAL_GUESSED, ONE_LENS
from fb_core.geometry.features.trust import PESSIMISM, sigma_of
from fb_core.geometry.pose_solver.refine import rotation_of

_FACTORS = (1.0, 0.6, 1.7)  # of the focal length that is believed: zoom and way to the wall hide one another
_POINT_STEPS = 4  # of Newton's method, from places that were found with the photo
_MOST_STEPS, _MOST_DAMPING, _CONVERGED = 60, 1e8, 1e-7  # of the minimisation; relative gain of a step
_NEAREST = 1e-6  # depth of points that are not behind the camera


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What one photo pictures of points that other photos fix."""

    points: Float[np.ndarray, "m 3"]
    """World."""
    offsets: Float[np.ndarray, "m 2"]
    """Pixels from the principal point."""
    tolerance: float
    """Pixels by which a place may well be off."""
    whiten: Float[np.ndarray, "m 2 2"]
    """From tolerances to units in which the uncertainty of the points is that of the places, too."""
    bend: Float[np.ndarray, "2"]
    """k1 and k2 of the photo's lens."""

    def misses(self, placed: Placed) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2 7"]]:
        """Projected minus observed, in tolerances, less where the points are uncertain; and by turn, shift (both in
        camera axes) and log focal length.
        """
        turned = self.points @ placed.rotation.T
        seen = turned + placed.shift
        depth = np.maximum(seen[:, 2], _NEAREST)
        plane = seen[:, :2] / depth[:, None]
        squares = (plane**2).sum(axis=1)
        factor, outwards = radial(squares, np.tile(self.bend, (len(plane), 1)))
        slope = (outwards - factor) / np.maximum(squares, 1e-12)
        bent = factor[:, None] * plane
        by_plane = factor[:, None, None] * np.eye(2) + slope[:, None, None] * plane[:, :, None] * plane[:, None, :]
        to_plane = np.zeros((len(plane), 2, 3))
        to_plane[:, 0, 0] = to_plane[:, 1, 1] = 1.0
        to_plane[:, :, 2] = -plane
        by_shift = by_plane @ to_plane / depth[:, None, None]
        skew = np.cross(np.eye(3), turned[:, None, :]).transpose(0, 2, 1)  # w x p
        changes = np.concatenate([by_shift @ skew, by_shift, bent[:, :, None]], axis=2)
        whiten = self.whiten / self.tolerance
        misses = np.einsum("mij,mj->mi", whiten, placed.focal * bent - self.offsets)
        return misses, whiten @ (placed.focal * changes)


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A camera: world to camera, and its focal length in pixels."""

    rotation: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    focal: float

    def moved(self, step: Float[np.ndarray, "d"]) -> Placed:
        """After a turn and a shift in camera axes, and a change of log focal length where there is one."""
        turn = rotation_of(torch.from_numpy(step[None, :3].copy())).numpy()[0]
        zoom = math.exp(float(np.clip(step[6], -1.0, 1.0))) if len(step) > 6 else 1.0
        return Placed(rotation=turn @ self.rotation, shift=self.shift + step[3:6], focal=self.focal * zoom)


@dataclass(frozen=True, kw_only=True)
class LensTrial:
    """What a photo says of its lens."""

    better: Placed | None
    """Its camera with a lens that explains it clearly better than the one it is believed to have; None if none does."""
    lens: int | None
    """Which lens that is, of those that photos have; None for one of its own."""
    evidence: float
    """Twice the logarithm of how much likelier its places are with it."""
    focal: float
    """The likeliest focal length of its own, pixels."""
    likelier: bool
    """Whether that explains more than chance would if places erred independently, however little it may be."""


def sight_of(bundle: Bundle, camera: int) -> Sight:
    """What a camera of a bundle pictures of points that at least two others observe, where these say that they are."""
    others = np.flatnonzero(bundle.camera_of != camera)
    fixed = np.flatnonzero(np.bincount(bundle.point_of[others], minlength=len(bundle.points)) >= 2)
    number = np.full(len(bundle.points), -1)
    number[fixed] = np.arange(len(fixed))
    others = others[number[bundle.point_of[others]] >= 0]
    others_bundle = dataclasses.replace(
        bundle,
        points=bundle.points[fixed],
        camera_of=bundle.camera_of[others],
        point_of=number[bundle.point_of[others]],
        offsets=bundle.offsets[others],
        tolerance=bundle.tolerance[others],
    )
    others_bundle, covariance = adjusted_points(others_bundle, steps=_POINT_STEPS)
    mine = np.flatnonzero((bundle.camera_of == camera) & (number[bundle.point_of] >= 0))
    points, variance = others_bundle.points[number[bundle.point_of[mine]]], covariance[number[bundle.point_of[mine]]]
    tolerance, lens = float(bundle.tolerance[mine].mean()), bundle.lens[camera]
    seen = points @ bundle.rotations[camera].T + bundle.shifts[camera]
    depth = np.maximum(seen[:, 2], _NEAREST)
    rows = np.zeros((len(mine), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[:, :, 2] = -seen[:, :2] / depth[:, None]
    rows = (bundle.focal[lens] / tolerance / depth)[:, None, None] * rows @ bundle.rotations[camera]
    spread = np.eye(2) + rows @ variance @ rows.transpose(0, 2, 1)
    sound = (seen[:, 2] > _NEAREST) & np.isfinite(spread).all(axis=(1, 2))
    return Sight(
        points=points[sound],
        offsets=bundle.offsets[mine][sound],
        tolerance=tolerance,
        whiten=np.linalg.inv(np.linalg.cholesky(spread[sound])),
        bend=bundle.bend[lens],
    )


def lens_trial(sight: Sight, believed: Placed, focal: Sequence[float], own: int) -> LensTrial:
    """What a photo says of its lens.

    Args:
        sight: what it pictures.
        believed: its camera now.
        focal: of the lenses that it may have, pixels.
        own: which of them it is believed to have.
    """
    free = min((_placed(sight, _zoomed(sight, believed, factor), free=True) for factor in _FACTORS), key=_cost)
    shared = [_placed(sight, _zoomed(sight, free.placed, value / free.placed.focal), free=False) for value in focal]
    shared[own] = min(shared[own], _placed(sight, believed, free=False), key=_cost)
    sigma = sigma_of(np.linalg.norm(sight.misses(free.placed)[0], axis=1))
    best = min(range(len(focal)), key=lambda index: shared[index].cost)
    one_more = math.log(2 * len(sight.points))  # what one number more explains by chance
    gain = (shared[best].cost - free.cost) / sigma**2
    chosen, lens = (free, None) if gain > one_more else (shared[best], best)
    evidence = (shared[own].cost - chosen.cost) / sigma**2
    clear = lens != own and evidence > one_more
    return LensTrial(
        better=chosen.placed if clear else None,
        lens=lens if clear else None,
        evidence=evidence,
        focal=free.placed.focal,
        likelier=(shared[own].cost - free.cost) / (sigma / PESSIMISM) ** 2 > one_more,
    )


def lens_doubt(trial: LensTrial, focal: float) -> str:
    """What speaks against a photo's lens with such a focal length (pixels); empty if nothing does."""
    if trial.likelier and abs(math.log(trial.focal / focal)) > ONE_LENS:
        return f"its features ask for {trial.focal / focal:.2f} times the focal length, which the others do not confirm"
    return ""


def focal_doubt(deviation: float, *, told: bool) -> str:
    """What speaks against a photo of whose focal length only its size, or one tag that nothing else bears out (`told`),
    says something, given how well its features would tell it (relative deviation); empty if nothing does.
    """
    if deviation <= FOCAL_GUESSED / 2:
        return ""
    if told:
        return "only a tag tells its focal length: its features can hardly tell zoom from distance, and tags may lie"
    return "nothing says whether it was zoomed: its features tell hardly anything of its focal length, and no tag does"


@dataclass(frozen=True, kw_only=True)
class _Fit:
    placed: Placed
    cost: float


def _cost(fit: _Fit) -> float:
    return fit.cost


def _placed(sight: Sight, start: Placed, *, free: bool) -> _Fit:
    """Where Cauchy's loss of the misses is least, by Levenberg-Marquardt; `free`: the focal length, too."""
    placed, damping = start, 1e-3
    misses, changes = sight.misses(placed)
    squares = (misses**2).sum(axis=1)
    cost = float(np.log1p(squares).sum())
    for _ in range(_MOST_STEPS):
        rows = (changes[:, :, : 6 + free] / np.sqrt(1 + squares)[:, None, None]).reshape(-1, 6 + free)
        hessian, gradient = rows.T @ rows, rows.T @ (misses / np.sqrt(1 + squares)[:, None]).ravel()
        step = -np.linalg.solve(hessian + np.diag(damping * np.diag(hessian) + 1e-12), gradient)
        trial = placed.moved(step)
        misses_there, changes_there = sight.misses(trial)
        squares_there = (misses_there**2).sum(axis=1)
        there = float(np.log1p(squares_there).sum())
        if there >= cost:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
            continue
        gain, damping = (cost - there) / cost, max(damping / 10, 1e-9)
        placed, misses, changes, squares, cost = trial, misses_there, changes_there, squares_there, there
        if gain < _CONVERGED:
            break
    return _Fit(placed=placed, cost=cost)


def _zoomed(sight: Sight, placed: Placed, factor: float) -> Placed:
    """With so many times the focal length, from so much farther away that the middle of the points stays as large."""
    depth = float(np.median((sight.points @ placed.rotation.T + placed.shift)[:, 2]))
    shift = placed.shift + np.array([0.0, 0.0, (factor - 1) * depth])
    return Placed(rotation=placed.rotation, shift=shift, focal=placed.focal * factor)
