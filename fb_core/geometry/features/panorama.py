"""Photos taken in one place: rotations, and the focal length with which rotations explain the matches best."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from fb_core.geometry.features.pairs import PhotoFeatures, angles_degrees, rays_through

_GUESSES = np.geomspace(0.4, 3.0, 16)  # longer sides: 103 to 19 degrees of view
_PAIRS = 6  # with most matches, by which guesses are judged
_MAY_MISS = 2.0  # tolerances


@dataclass(frozen=True, kw_only=True)
class Panorama:
    """Cameras that differ in rotation and focal length alone."""

    rotations: list[Float[np.ndarray, "3 3"] | None]
    """World to camera; None for photos that match none of the others."""
    focal: list[float]
    """Pixels."""
    share: float
    """Of all matches, those that these rotations explain; 0 where there is no match."""


@dataclass(frozen=True, kw_only=True)
class _Homography:
    first: int
    second: int
    map: Float[np.ndarray, "3 3"]
    """Of offsets in pixels."""
    places: tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]


def panorama_of(
    photos: Sequence[PhotoFeatures], matches: dict[tuple[int, int], Int[np.ndarray, "m 2"]], *, guess: float
) -> Panorama:
    """The rotations that explain most matches, chained from the pair with most matches outwards.

    All untold focal lengths are taken as one number of longer sides: the one with which matches miss least, or the
    guess if that does as well as any (photos that are identical fit every focal length).
    """
    homographies = _homographies(photos, matches)
    total = sum(len(pair_matches) for pair_matches in matches.values())
    if not homographies:
        return Panorama(rotations=[None] * len(photos), focal=_focal(photos, guess), share=0.0)

    def miss(sides: float) -> float:
        return sum(
            len(one.places[0]) * float(np.median(_turn(photos, one, _focal(photos, sides))[1]))
            for one in homographies[:_PAIRS]
        )

    sides = guess
    if any(photo.focal is None for photo in photos):
        sides = _least(miss, start=guess)
    focal = _focal(photos, sides)
    turns, explained = dict[tuple[int, int], np.ndarray](), 0
    for one in homographies:
        turns[one.first, one.second], misses = _turn(photos, one, focal)
        explained += int((misses < _MAY_MISS).sum())
    return Panorama(rotations=_chained(len(photos), turns), focal=focal, share=explained / total)


def _least(miss: Callable[[float], float], *, start: float) -> float:
    """Where a positive function of the focal length is least: the best of a few, refined; the start if nothing beats
    it.
    """
    from scipy.optimize import minimize_scalar

    best = int(np.argmin([miss(float(guess)) for guess in _GUESSES]))
    low, high = _GUESSES[max(0, best - 1)], _GUESSES[min(len(_GUESSES) - 1, best + 1)]
    optimum: Any = minimize_scalar(miss, bounds=(low, high), method="bounded", options={"xatol": 1e-3})
    return float(optimum.x) if optimum.fun < miss(start) - 1e-3 else start


def _homographies(
    photos: Sequence[PhotoFeatures], matches: dict[tuple[int, int], Int[np.ndarray, "m 2"]]
) -> list[_Homography]:
    """Those with most matches first."""
    import cv2

    homographies = []
    for (i, j), both in sorted(matches.items(), key=lambda item: -len(item[1])):
        places = photos[i].offsets[both[:, 0]], photos[j].offsets[both[:, 1]]
        homography, _ = cv2.findHomography(*places, cv2.USAC_MAGSAC, max(photos[i].tolerance, photos[j].tolerance))
        if homography is not None:
            homographies.append(_Homography(first=i, second=j, map=homography, places=places))
    return homographies


def _focal(photos: Sequence[PhotoFeatures], sides: float) -> list[float]:
    return [photo.focal or sides * max(photo.size) for photo in photos]


def _turn(
    photos: Sequence[PhotoFeatures], homography: _Homography, focal: Sequence[float]
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " m"]]:
    """The rotation nearest to a homography between photos of given focal lengths, and by how many tolerances it misses
    the matches.
    """
    (first, second), (i, j) = homography.places, (homography.first, homography.second)
    normalised = np.diag([1 / focal[j], 1 / focal[j], 1]) @ homography.map @ np.diag([focal[i], focal[i], 1])
    left, _, right = np.linalg.svd(normalised * np.sign(np.linalg.det(normalised)))
    turn = left @ right
    angles = angles_degrees(rays_through(first / focal[i]) @ turn.T, rays_through(second / focal[j]))
    return turn, np.radians(angles) / max(photos[i].tolerance / focal[i], photos[j].tolerance / focal[j])


def _chained(
    count: int, turns: dict[tuple[int, int], Float[np.ndarray, "3 3"]]
) -> list[Float[np.ndarray, "3 3"] | None]:
    """World-to-camera rotations along the first of the given pairs that reach each photo."""
    rotations: list[np.ndarray | None] = [None] * count
    rotations[next(iter(turns))[0]] = np.eye(3)
    grown = True
    while grown:
        grown = False
        for (i, j), turn in turns.items():
            first, second = rotations[i], rotations[j]
            if (first is None) != (second is None):
                rotations[i], rotations[j] = (turn.T @ second, second) if first is None else (first, turn @ first)
                grown = True
                break
    return rotations
