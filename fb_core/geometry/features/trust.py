"""Which cameras from features deserve trust: what their observations determine, and whether all matches agree with
them.

A bundle adjustment gives every camera a place, also where nothing fixes it: behind a weak link, along the axis of a
lens whose focal length is not known, before a plane. Its normal equations say how well each camera is determined
against the others.

Before a plane that is not all: a further photo gives the eight numbers of a homography, whatever it shows, and asks
for six of its camera and for its focal length, unless something vouches for that. What is not counted more often than
it is asked for can be explained by other cameras as well, at other focal lengths, however small the deviations at any
one of these explanations are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from fb_core.geometry.features.bundle_adjustment import Bundle, Equations, Lenses

PESSIMISM = 3.0
"""Observations err together (the same tracks, the same lens), which their scatter does not tell."""
NO_PLACE = "the points that it shares with the others allow no camera with the focal length believed"
"""What speaks against a photo that could not be placed."""
ALONE = "it can be placed only against other photos, and no camera of these can be trusted"
"""What speaks against the only camera of which nothing else does."""
_ON_THE_PLANE = 3.0  # tolerances: a few matches fix the homography, and err as the others do
_FLAT = 0.8  # share of two photos' matches from which they show a plane, and the others are mistakes
_FEWEST = 8  # matches that say something
_RAYLEIGH = 1.177  # median of the distribution of distances, in deviations per axis
_LEAST_SIGMA = 0.1  # tolerances; places of features are no better
_MOST_TURN_DEGREES, _MOST_SHIFT = (
    1.0,
    0.05,
)  # deviations of a camera that is not doubtful; shifts in distances of the farthest camera
_MOST_FOCAL = 0.05  # relative deviation of a focal length that is not named as the reason
_ON_THE_LINE, _LEAST_AGREEING = 2.0, 0.6  # tolerances; share of the matches
_EXACT = 1e12  # inverse variance of what is known
_DROPPED = 0.1  # share of the cameras that leave the reference at once
_CHANCE = 3  # numbers that agree although nothing asks them to: seldom by chance


@dataclass(frozen=True, kw_only=True)
class Deviations:
    """How far cameras may be off, as standard deviations against those that fix each other best."""

    turn_degrees: Float[np.ndarray, " n"]
    shift: Float[np.ndarray, " n"]
    """In distances of the reference's farthest camera from its middle."""
    focal: Float[np.ndarray, " l"]
    """Of the focal lengths, relative."""
    lens: Int[np.ndarray, " n"]
    """Of each camera."""
    sound: Bool[np.ndarray, " n"]
    """Cameras whose deviations are small enough."""


def deviations_of(bundle: Bundle, lenses: Lenses) -> Deviations:
    """Of an adjusted bundle. What `lenses` says of focal lengths counts as a measurement; what is not free in it is
    taken as exact.
    """
    count = len(bundle.rotations)
    reduced = Equations.of(bundle, lenses).reduced()[0]
    relative = np.linalg.norm(bundle.misses(), axis=1) / bundle.tolerance
    sigma = sigma_of(relative)
    centers = -np.einsum("nji,nj->ni", bundle.rotations, bundle.shifts)
    to_world = _to_world(bundle)
    within = np.diag(
        np.concatenate([np.zeros(6 * count), np.where(lenses.free, lenses.precisions(bundle), 1.0).ravel()])
    )
    prior = np.diag(
        np.concatenate([np.zeros(6 * count), np.where(lenses.free, lenses.precisions(bundle), _EXACT).ravel()])
    )
    gauge = _gauge(centers, len(reduced))
    information = (reduced - within) / sigma**2 + prior  # sigma is that of observations, not of what was told
    own = to_world @ information @ to_world.T
    directions = np.linalg.qr(gauge)[0]
    covariance = np.linalg.inv(
        (own + own.T) / 2 + np.trace(information[: 6 * count, : 6 * count]) / count * directions @ directions.T
    )
    return _against_the_best(covariance, gauge, centers, bundle.lens)


def sigma_of(relative: Float[np.ndarray, " o"]) -> float:
    """The deviation, per axis and in tolerances, that misses of so many tolerances are believed to have."""
    return max(_LEAST_SIGMA, float(np.median(relative)) / _RAYLEIGH) * PESSIMISM


def _to_world(bundle: Bundle) -> Float[np.ndarray, "d d"]:
    """Orthogonal, from changes in camera axes to those in the world: R' = exp(w) R is turned by -R^T w, and a shift s
    moves by -R^T s.
    """
    count, lenses = len(bundle.rotations), 3 * len(bundle.focal)
    result = np.eye(6 * count + lenses)
    for index, rotation in enumerate(bundle.rotations):
        for part in (0, 3):
            rows = slice(6 * index + part, 6 * index + part + 3)
            result[rows, rows] = -rotation.T
    return result


def _gauge(centers: Float[np.ndarray, "n 3"], width: int) -> Float[np.ndarray, "d 7"]:
    """What turning, shifting and scaling the world does to turns and places of its cameras."""
    count = len(centers)
    arms = centers - centers.mean(axis=0)
    result = np.zeros((width, 7))
    for index in range(count):
        x, y, z = arms[index]
        result[6 * index : 6 * index + 3, :3] = np.eye(3)
        result[6 * index + 3 : 6 * index + 6, :3] = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # w x arm
        result[6 * index + 3 : 6 * index + 6, 3:6] = np.eye(3)
        result[6 * index + 3 : 6 * index + 6, 6] = arms[index]
    return result


def _against_the_best(
    covariance: np.ndarray, gauge: np.ndarray, centers: Float[np.ndarray, "n 3"], lens: np.ndarray
) -> Deviations:
    """Deviations once the world is tied to the cameras that fix each other, found by leaving out the worst again and
    again.
    """
    chosen = np.arange(len(centers))
    while True:
        turn, shift, focal = _tied(covariance, gauge, centers, chosen)
        badness = np.maximum(turn / _MOST_TURN_DEGREES, shift / _MOST_SHIFT)
        worst = chosen[np.argsort(badness[chosen])]
        bad = int((badness[chosen] > 1).sum())
        if bad == 0 or len(chosen) <= 2:
            return Deviations(turn_degrees=turn, shift=shift, focal=focal, lens=lens, sound=badness <= 1)
        chosen = np.sort(worst[: -min(bad, max(1, int(_DROPPED * len(chosen))))])


def _tied(
    covariance: np.ndarray, gauge: np.ndarray, centers: Float[np.ndarray, "n 3"], chosen: Int[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " l"]]:
    """Deviations of turns (degrees), places (extents) and log focal lengths in the world in which the chosen cameras
    move least.
    """
    count = len(centers)
    extent = max(float(np.linalg.norm(centers[chosen] - centers[chosen].mean(axis=0), axis=1).max()), 1e-12)
    weight = np.zeros(len(gauge))
    for index in chosen:
        weight[6 * index : 6 * index + 3] = 1.0
        weight[6 * index + 3 : 6 * index + 6] = 1 / extent**2
    weighted = gauge * weight[:, None]
    tie = np.eye(len(gauge)) - gauge @ np.linalg.pinv(gauge.T @ weighted) @ weighted.T
    variances = np.einsum("ij,ij->i", tie @ covariance, tie)[: 6 * count].reshape(count, 2, 3).sum(axis=2)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    focal = np.sqrt(np.maximum(np.diag(covariance)[6 * count :: 3], 0.0))
    return np.degrees(deviations[:, 0]), deviations[:, 1] / extent, focal


def epipolar_misses(
    first: Float[np.ndarray, "m 2"],
    second: Float[np.ndarray, "m 2"],
    rotation: Float[np.ndarray, "3 3"],
    way: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " m"]:
    """First order distances (Sampson 1982) of matches in the planes at depth 1; infinite where a lens pictures
    nothing.
    """
    x, y, z = way
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    a, b = (np.concatenate([places, np.ones((len(places), 1))], axis=1) for places in (first, second))
    lines, back = a @ essential.T, b @ essential
    spread = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    return np.nan_to_num(np.abs((b * lines).sum(axis=1)) / np.sqrt(spread + 1e-30), nan=math.inf)


def agreeing_shares(misses: dict[tuple[int, int], Float[np.ndarray, " _"]], count: int) -> list[float]:
    """For each photo, the share of its matches with other photos that lie on their epipolar lines; NaN where there is
    none.

    Args:
        misses: of the matches of two photos each, in tolerances.
        count: of the photos.
    """
    good, total = np.zeros(count), np.zeros(count)
    for pair, each in misses.items():
        for index in pair:
            good[index] += (each <= _ON_THE_LINE).sum()
            total[index] += len(each)
    return np.where(total > 0, good / np.maximum(total, 1), math.nan).tolist()


def outlying(relative: Float[np.ndarray, " o"], sigma: float) -> str:
    """What speaks against a camera whose observations miss by more than deviations were reckoned with (both in
    tolerances); empty if nothing does.
    """
    own = float(np.median(relative)) / _RAYLEIGH
    return "" if own <= sigma else f"its features miss their points {own / sigma * PESSIMISM:.0f} times as far as usual"


def few_points(count: int, least: int, why: str) -> str:
    """What speaks against a photo that shows so few points of the others."""
    return f"shares too few features with the others ({count} points, {why} {least})"


def doubt(found: Deviations, camera: int, agreeing: float) -> str:
    """What speaks against one of the cameras of a bundle; empty if nothing does."""
    if agreeing < _LEAST_AGREEING:
        return (
            f"only {agreeing:.0%} of its matches with other photos agree with its camera, expected "
            f"{_LEAST_AGREEING:.0%}"
        )
    if found.sound[camera]:
        return ""
    turn, shift = found.turn_degrees[camera], found.shift[camera]
    focal = found.focal[found.lens[camera]]
    why = f"its focal length by {min(focal, 9.99):.0%}, " if focal > _MOST_FOCAL else ""
    off = f"{why}its direction by {turn:.2g} degrees, its place by {min(shift, 9.99):.0%} of the extent"
    return (
        f"the photos hardly determine its camera ({off} or so); add photos that overlap more, from places farther apart"
    )


def flat(first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"]) -> bool | None:
    """Whether one homography explains matches of two photos (places in tolerances); None if they are too few to say.

    The way from the closer look to the other one decides: on the way back, errors grow.
    """
    import cv2

    pictured = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
    if pictured.sum() < _FEWEST:
        return None
    share = 0.0
    for one, other in ((first, second), (second, first)):
        _, inliers = cv2.findHomography(
            one[pictured], other[pictured], cv2.USAC_MAGSAC, _ON_THE_PLANE, None, 2000, 0.999
        )
        share = max(share, 0.0 if inliers is None else float(inliers.mean()))
    return share >= _FLAT


def surplus_of_a_plane(photos: int, focal_lengths: int) -> int:
    """By how many numbers photos of a plane tell more than their cameras and so many focal lengths that nothing else
    tells. The plane asks for three; the world's place, turn and scale for none of seven.
    """
    return 8 * (photos - 1) - (6 * photos + focal_lengths + 3 - 7)


def borne_out(photos: int, lenses: int) -> bool:
    """Whether photos of a plane that so few lenses explain tell so much more that lenses of their own, which would
    explain all of it as well, need not be thought of.
    """
    return surplus_of_a_plane(photos, lenses) >= _CHANCE


def plane_doubt(photos: int, focal_lengths: int) -> str:
    """What speaks against cameras of photos that all show one plane; empty if they determine more than is asked for."""
    if surplus_of_a_plane(photos, focal_lengths) > 0:
        return ""
    if focal_lengths == 0:
        return f"{photos} photos of a plane fit other cameras as well; add photos from other places"
    return (
        f"{photos} photos of a plane fit other cameras as well, with other focal lengths; add photos that show "
        "something before or behind it, or tell their focal lengths"
    )
