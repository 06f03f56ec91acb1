"""The rotation between two calibrated cameras from correspondences: essential matrix or, where the camera hardly moved,
rotation alone.

Candidates of the essential matrix come from OpenCV's robust fits; each is refined on the robust distance from epipolar
lines, since a fit within a tolerance leaves degrees open where the scene is a wall. The one with most matches before
both cameras is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fb_core.geometry.features.pairs import angles_degrees, rays_through

FEWEST = 10
"""Fewer matches that agree say nothing."""
_DRAWS = 200  # of two matches, for a rotation alone
_CLEARLY = 3.0  # squared misses of a rotation alone over those of a movement; 2 is expected where there is none
_REFINED = 6  # candidates, the best ones
_ENOUGH = 150  # matches to refine a movement on
_CAP = 3.0  # tolerances from which a match counts as an outlier


@dataclass(frozen=True, kw_only=True)
class Turn:
    """How one camera is turned against another."""

    rotation: Float[np.ndarray, "3 3"]
    """From the first camera's axes to the second's."""
    inliers: int
    """Matches that agree with it."""
    moved: bool
    """Whether a movement beside the rotation was needed."""


def two_view_rotation(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], *, tolerance: float
) -> Turn | None:
    """The rotation that explains the matches; None where too few agree with any.

    Args:
        first, second: matches in the plane at distance 1 of either camera.
        tolerance: distance there by which a match may be off.
    """
    if len(first) < FEWEST:
        return None
    rays = rays_through(first), rays_through(second)
    turn, misses = _rotation_alone(*rays, tolerance)
    turned = int((misses <= tolerance).sum())
    rotation, inliers, lines = _movement(first, second, rays, turn, tolerance)
    still = np.minimum(misses[inliers], _CAP * tolerance)
    if inliers.sum() >= FEWEST and (still**2).sum() > _CLEARLY * (lines[inliers] ** 2).sum():
        return Turn(rotation=rotation, inliers=int(inliers.sum()), moved=True)
    return Turn(rotation=turn, inliers=turned, moved=False) if turned >= FEWEST else None


def _movement(
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    rays: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]],
    turn: Float[np.ndarray, "3 3"],
    tolerance: float,
) -> tuple[Float[np.ndarray, "3 3"], Bool[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Rotation, the matches that agree, and every match's distance from its epipolar line."""

    def judged(rotation: np.ndarray, way: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        lines = _line_distances(first, second, rotation, way)
        near = lines <= tolerance
        inliers = near & max(
            (_before(rays, rotation, sign * way, tolerance) for sign in (1, -1)),
            key=lambda before: (near & before).sum(),
        )
        return (
            inliers.sum() - np.minimum(lines / tolerance, 1).mean(),
            inliers,
            lines,
        )  # the closer one of two that as many agree with

    def best_first(starts: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
        return sorted(starts, key=lambda start: -judged(*start)[0])

    starts = [
        *best_first(_candidates(first, second, tolerance))[:_REFINED],
        *best_first([(turn, way) for way in np.eye(3)])[:1],
    ]
    refined = [_refined(first, second, *start, tolerance) for start in starts]
    results = [(rotation, *judged(rotation, way)) for rotation, way in refined]
    rotation, _, inliers, lines = max(results, key=lambda result: result[1])
    return rotation, inliers, lines


def _candidates(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], tolerance: float
) -> list[tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]:
    """Rotations and directions of movement of OpenCV's essential matrices and, as walls are planes, of its
    homography.
    """
    import cv2

    motions, identity = [], np.eye(3)
    for method in (cv2.USAC_MAGSAC, cv2.RANSAC, cv2.LMEDS):
        try:
            essential, _ = cv2.findEssentialMat(first, second, identity, method, 0.9999, tolerance)
        except cv2.error:  # an assertion of OpenCV's own on some matches of good pictures
            continue
        for rows in (
            () if essential is None else np.split(essential, range(3, len(essential), 3))
        ):  # one below the other
            if rows.shape == (3, 3) and np.isfinite(rows).all():
                one, other, way = cv2.decomposeEssentialMat(rows)
                motions += [(one, way[:, 0]), (other, way[:, 0])]
    plane, _ = cv2.findHomography(first, second, cv2.USAC_MAGSAC, 2 * tolerance, maxIters=5000, confidence=0.9999)
    if plane is not None and np.isfinite(plane).all():
        _, turns, ways, _ = cv2.decomposeHomographyMat(plane, identity)
        motions += [
            (turn, way[:, 0] / length)
            for turn, way in zip(turns, ways, strict=True)
            if (length := np.linalg.norm(way)) > 0
        ]
    return motions


def _refined(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], rotation: Float[np.ndarray, "3 3"],
    way: Float[np.ndarray, "3"],
    tolerance: float,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:  # fmt: skip
    """Least robust distance (Cauchy) from epipolar lines, over three angles of rotation and two of direction."""
    import cv2
    from scipy.optimize import least_squares

    some = slice(None, None, max(1, len(first) // _ENOUGH))
    a, b = _lifted(first[some]), _lifted(second[some])
    aside = np.linalg.svd(way[None])[2][1:]  # two unit vectors across the direction

    def at(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = way + values[3:] @ aside
        return cv2.Rodrigues(values[:3])[0] @ rotation, moved / np.linalg.norm(moved)

    def misses(values: np.ndarray) -> np.ndarray:
        return _sampson(a, b, *at(values))

    optimum: Any = least_squares(misses, np.zeros(5), loss="cauchy", f_scale=tolerance / 2, max_nfev=25)
    return at(optimum.x)


def _line_distances(
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    rotation: Float[np.ndarray, "3 3"],
    way: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " m"]:
    """First order distances of matches from their epipolar lines (Sampson 1982)."""
    return _sampson(_lifted(first), _lifted(second), rotation, way)


def _lifted(places: np.ndarray) -> np.ndarray:
    """[m, 2] -> [m, 3] with a one."""
    return np.concatenate([places, np.ones((len(places), 1))], axis=1)


def _sampson(a: np.ndarray, b: np.ndarray, rotation: np.ndarray, way: np.ndarray) -> np.ndarray:
    """The distances [m] of places [m, 3]; called thousands of times, so that nothing is checked or built twice here."""
    x, y, z = way
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    lines, back = a @ essential.T, b @ essential
    spread = lines[:, 0] ** 2 + lines[:, 1] ** 2 + back[:, 0] ** 2 + back[:, 1] ** 2
    return np.abs((b * lines).sum(axis=1)) / np.sqrt(spread + 1e-30)


def _before(
    rays: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]],
    rotation: Float[np.ndarray, "3 3"],
    way: Float[np.ndarray, "3"],
    tolerance: float,
) -> Bool[np.ndarray, " m"]:
    """Matches whose rays meet before both cameras, or are too close to parallel to tell, pointing the same way."""
    one, other = rays[0] @ rotation.T, rays[1]
    normal = np.cross(other, one)
    sine = np.linalg.norm(normal, axis=1)
    depth = -(normal * np.cross(other, way)).sum(axis=1), -(normal * np.cross(one, way)).sum(axis=1)
    far = (sine <= tolerance) & ((one * other).sum(axis=1) > 0)
    return far | ((depth[0] > 0) & (depth[1] > 0))


def _rotation_alone(
    first: Float[np.ndarray, "m 3"], second: Float[np.ndarray, "m 3"], tolerance: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " m"]]:
    """The rotation that most matches agree with, two at a time and then all that agree; and by how much it misses each
    (radians).
    """
    draws = np.random.default_rng(0).integers(len(first), size=(_DRAWS, 2))
    turns = nearest_rotation_between(first[draws], second[draws])
    agree = np.einsum("rij,mj,mi->rm", turns, first, second) >= math.cos(min(tolerance, math.pi / 2))
    turn = turns[int(agree.sum(axis=1).argmax())]
    misses = np.radians(angles_degrees(first @ turn.T, second))
    for _ in range(5):
        inliers = misses <= tolerance
        if inliers.sum() < 2:
            break
        better = nearest_rotation_between(first[inliers][None], second[inliers][None])[0]
        now = np.radians(angles_degrees(first @ better.T, second))
        if (now <= tolerance).sum() < inliers.sum():
            break
        turn, misses = better, now
    return turn, misses


def nearest_rotation_between(
    first: Float[np.ndarray, "r k 3"], second: Float[np.ndarray, "r k 3"]
) -> Float[np.ndarray, "r 3 3"]:
    """Least-squares rotations from k vectors to k others (Kabsch 1976)."""
    left, _, right = np.linalg.svd(np.einsum("rki,rkj->rij", second, first))
    sign = np.ones((len(first), 3))
    sign[:, 2] = np.linalg.det(left @ right)
    return (left * sign[:, None, :]) @ right
