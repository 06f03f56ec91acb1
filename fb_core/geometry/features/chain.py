"""Cameras of photos from their features: two views by an essential matrix, the others one after the other by the points
these give.

The pair with many matches and a wide angle begins. Its points place the photo that sees most of them
(perspective-n-point), whose matches give new points, and so on; a bundle adjustment mends all cameras, focal lengths
and points on the way and at the end.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.bundle_adjustment import Bundle, adjust, straightened
from fb_core.geometry.features.cameras import FeatureCameras, camera_of, one_place
from fb_core.geometry.features.lenses import FOCAL_GUESS, SAME_LENS, LensGuess
from fb_core.geometry.features.pairs import Pair, PhotoFeatures, match_pairs, rays_through, verified_pair
from fb_core.geometry.features.panorama import panorama_of
from fb_core.geometry.features.triangulation import nearest_points, tracks_of
from fb_core.geometry.features.trust import agreeing_shares, deviations_of, doubt, epipolar_misses
from fb_core.geometry.pose_solver.verdict import Arrangement

_GUESSES = (FOCAL_GUESS, 0.7)  # the second is a phone's (26 mm on film)
_PANORAMA = 0.8  # share of all matches that rotations alone explain, from which nothing else is looked for
_STARTS = 3  # pairs that may begin
_GOOD_ANGLE_DEGREES = 8.0  # of a starting pair; wider ones are no better
_LEAST_ANGLE_DEGREES = 1.5  # between the rays of a point
_FEWEST_POINTS = 12  # that place a photo
_TRUSTED_POINTS = 24  # of a photo that is beyond doubt
_OUTLIER = 3.0  # tolerances
_LIE = 0.1  # logarithm of the focal length found over the one told, from which the tag is not believed
_MOST_ROUNDS = 4  # of freeing lenses
_SHARP, _SHARPEST = (
    4.5,
    0.3,
)  # medians from which a match does not count as explained, but no less than so many tolerances
_SAME_GAIN = 0.005  # share of matches that makes no difference
_FOCAL_FACTORS = (
    1.0,
    0.5,
    0.7,
    1.4,
    2.0,
)  # of what is believed, for the first photo of a lens of which nothing was told


Matches = dict[tuple[int, int], Int[np.ndarray, "_ 2"]]
"""Features of two photos each that belong together."""


def chain(
    photos: Sequence[PhotoFeatures], *, on_progress: Callable[[str, int, int], None] = lambda *_: None
) -> FeatureCameras:
    """Cameras of two or more photos. Deterministic; nothing that photos show or lack raises an error.

    Where focal lengths are not told, the chain is built from two guesses, and once more from the better result's.
    """
    matches = match_pairs(photos, lambda done, total: on_progress("matching features", done, total))
    panorama = panorama_of(photos, matches, guess=FOCAL_GUESS)
    if panorama.share >= _PANORAMA or not matches:
        return one_place(photos, panorama, sure=panorama.share >= _PANORAMA)
    untold = any(photo.focal is None for photo in photos)
    best: _Chain | None = None
    for guess in _GUESSES if untold else _GUESSES[:1]:
        best = _better(best, _reconstructed(photos, matches, LensGuess.of(photos, guess=guess), on_progress))
    if untold and best is not None:
        best = _better(best, _reconstructed(photos, matches, best.lenses, on_progress))
    if best is None:
        return one_place(photos, panorama, sure=panorama.share >= _PANORAMA)
    return _with_fitting_lenses(best, matches, on_progress).concluded(matches)


def _with_fitting_lenses(best: _Chain, matches: Matches, on_progress: Callable[[str, int, int], None]) -> _Chain:
    """The reconstruction with the lenses that the matches ask for: as few numbers as explain them.

    Each round frees one thing more (tags that lie, k1, k2, a focal length for each photo), adjusts, and keeps what
    explains clearly more matches; with new lenses everything is built once more, since pairs were judged by the old
    ones.
    """
    photos = best.photos
    for _ in range(_MOST_ROUNDS if best.registered.sum() > 2 else 0):
        options = [best.with_lenses(lenses) for lenses in best.lenses.freer(best.bad_tags)]
        gains = [_gain(best, option, matches) for option in options]
        chosen = [index for index, option in enumerate(options) if gains[index] > option.lenses.least_gain(best.lenses)]
        if not chosen:
            break
        fitted = options[max(chosen, key=lambda index: gains[index])]
        anew = _reconstructed(photos, matches, fitted.lenses, on_progress)
        best = fitted if anew is None or _gain(fitted, anew, matches) < 0 else anew
    for within in SAME_LENS:
        lenses = best.lenses.merged(within)
        if 1 < len(lenses.focal) < len(best.lenses.focal):  # with one, everything began
            merged = best.with_lenses(lenses)
            if _gain(best, merged, matches) > -_SAME_GAIN:
                return merged
    return best


def _gain(first: _Chain, second: _Chain, matches: Matches) -> float:
    """By which share of all matches the second explains more than the first, to the precision of the better one."""
    misses = [grown.pair_misses(matches) for grown in (first, second)]
    total = sum(map(len, matches.values()))
    limit = min(float(np.median(np.concatenate(list(one.values())))) if one else _OUTLIER for one in misses)
    limit = min(max(_SHARP * limit, _SHARPEST), 2.0)
    explained = [sum(np.maximum(1 - (miss / limit) ** 2, 0.0).sum() for miss in one.values()) / total for one in misses]
    return float(explained[1] - explained[0])


def _reconstructed(
    photos: Sequence[PhotoFeatures],
    matches: Matches,
    lenses: LensGuess,
    on_progress: Callable[[str, int, int], None],
) -> _Chain | None:
    """The best of a few beginnings; None if no two photos make one."""
    focal, bend = lenses.focal[lenses.lens].tolist(), lenses.bend[lenses.lens]
    pairs = [
        pair for key, value in matches.items() if (pair := verified_pair(photos, key, value, focal, bend)) is not None
    ]
    best: _Chain | None = None
    apart = [pair for pair in pairs if pair.parallax_degrees >= _LEAST_ANGLE_DEGREES]
    for start in sorted(apart, key=_worth, reverse=True)[:_STARTS]:
        grown = _Chain.begun(photos, pairs, lenses, start)
        grown.grow(lambda done: on_progress("placing photos", done, len(photos)))
        best = _better(best, grown)
        if grown.registered.all():
            break
    return best


def _worth(pair: Pair) -> float:
    return len(pair.matches) * min(pair.parallax_degrees, _GOOD_ANGLE_DEGREES)


def _better(first: _Chain | None, second: _Chain | None) -> _Chain | None:
    if first is None or second is None:
        return first or second
    return second if second.worth > first.worth else first


class _Chain:
    """A reconstruction that grows."""

    def __init__(self, photos: Sequence[PhotoFeatures], pairs: Sequence[Pair], lenses: LensGuess):
        self.photos = photos
        self.lenses = dataclasses.replace(lenses, focal=lenses.focal.copy(), bend=lenses.bend.copy())  # they change
        starts = np.cumsum([0, *(len(photo.places) for photo in photos)])
        links = [pair.matches + np.array([starts[pair.first], starts[pair.second]]) for pair in pairs]
        track = tracks_of(torch.from_numpy(np.concatenate(links)), int(starts[-1])).numpy()
        owner = np.repeat(np.arange(len(photos)), np.diff(starts))
        kept = (track >= 0) & ~_twice(owner, track)
        self.owner: Int[np.ndarray, " o"] = owner[kept]
        self.track: Int[np.ndarray, " o"] = track[kept]
        self.offsets: Float[np.ndarray, "o 2"] = np.concatenate([photo.offsets for photo in photos])[kept]
        self.tolerance: Float[np.ndarray, " o"] = np.array([photo.tolerance for photo in photos])[self.owner]
        self.good: Bool[np.ndarray, " o"] = np.ones(len(self.owner), bool)
        self.rotations = np.tile(np.eye(3), (len(photos), 1, 1))
        self.shifts = np.zeros((len(photos), 3))
        self.registered: Bool[np.ndarray, " n"] = np.zeros(len(photos), bool)
        self.points = np.full((int(track.max()) + 1, 3), np.nan)

    @staticmethod
    def begun(photos: Sequence[PhotoFeatures], pairs: Sequence[Pair], lenses: LensGuess, start: Pair) -> _Chain:
        """With two cameras, one unit apart."""
        grown = _Chain(photos, pairs, lenses)
        grown.registered[[start.first, start.second]] = True
        grown.rotations[start.second], grown.shifts[start.second] = start.rotation, start.translation
        grown.triangulate()
        grown.adjust(steps=10)
        return grown

    @property
    def worth(self) -> tuple[int, int]:
        """Photos, and observations of points, that it explains."""
        return int(self.registered.sum()), int(self.used.sum())

    @property
    def used(self) -> Bool[np.ndarray, " o"]:
        """Observations of points by placed photos."""
        return self.good & self.registered[self.owner] & np.isfinite(self.points[self.track, 0])

    def grow(self, on_photo: Callable[[int], None]) -> None:
        """Place one photo after the other, the one that sees most points first, until none can be placed."""
        refused: set[int] = set()
        adjusted = 2
        while True:
            on_photo(int(self.registered.sum()))
            seen = np.bincount(
                self.owner[self.good & np.isfinite(self.points[self.track, 0])], minlength=len(self.photos)
            )
            seen[self.registered] = 0
            seen[list(refused)] = 0
            index = int(seen.argmax())
            if seen[index] < _FEWEST_POINTS:
                break
            if not self.place(index):
                refused.add(index)
                continue
            refused.clear()
            self.triangulate()
            if self.registered.sum() >= max(adjusted + 1, 1.15 * adjusted):
                self.adjust(steps=6)
                self.triangulate()
                adjusted = int(self.registered.sum())
        for _ in range(3):
            self.triangulate()
            self.adjust(steps=15)

    def place(self, index: int) -> bool:
        """A photo's camera from the points that it sees; False if they do not agree on one."""
        import cv2

        mine = np.flatnonzero((self.owner == index) & np.isfinite(self.points[self.track, 0]))
        number, tolerance = self.lenses.lens[index], self.photos[index].tolerance
        unseen = not self.lenses.believed[number] and not (self.registered & (self.lenses.lens == number)).any()
        best: tuple[np.ndarray, np.ndarray, np.ndarray, float] | None = None
        for factor in _FOCAL_FACTORS if unseen else _FOCAL_FACTORS[:1]:
            focal = self.lenses.focal[number] * factor
            places = straightened(self.offsets[mine] / focal, self.lenses.bend[number])
            there = np.flatnonzero(np.isfinite(places[:, 0]))
            if len(there) < _FEWEST_POINTS:
                continue
            points, places = self.points[self.track[mine[there]]], places[there]
            options: dict[str, Any] = {
                "iterationsCount": 1000,
                "reprojectionError": 3 * tolerance / focal,
                "confidence": 0.9999,
            }
            done, turn, shift, inliers = cv2.solvePnPRansac(
                points, places, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_SQPNP, **options
            )
            if not done or inliers is None or (best is not None and len(inliers) <= len(best[2])):
                continue
            inliers = inliers[:, 0].astype(np.int64)
            turn, shift = cv2.solvePnPRefineLM(points[inliers], places[inliers], np.eye(3), np.zeros(4), turn, shift)
            best = cv2.Rodrigues(turn)[0], shift[:, 0], mine[there[inliers]], focal
        if best is None or len(best[2]) < max(_FEWEST_POINTS, 0.3 * len(mine)):
            return False
        self.rotations[index], self.shifts[index], agreeing, self.lenses.focal[number] = best
        self.registered[index] = True
        self.good[mine] = False
        self.good[agreeing] = True
        return True

    def triangulate(self) -> None:
        """Points of all tracks that have none and that two placed photos see well."""
        mine = np.flatnonzero(self.good & self.registered[self.owner] & ~np.isfinite(self.points[self.track, 0]))
        plane = self.lenses.plane(self.owner[mine], self.offsets[mine])
        pictured = np.isfinite(plane[:, 0])
        mine, plane = mine[pictured], plane[pictured]
        if len(mine) == 0:
            return
        tracks, compact = np.unique(self.track[mine], return_inverse=True)
        rotations = self.rotations[self.owner[mine]]
        directions = np.einsum("oji,oj->oi", rotations, rays_through(plane))
        centers = -np.einsum("oji,oj->oi", rotations, self.shifts[self.owner[mine]])
        error = float(np.degrees(np.median(2 * self.tolerance[mine] / self._focal_of(mine))))
        points, sound = nearest_points(
            torch.from_numpy(centers),
            torch.from_numpy(directions),
            torch.from_numpy(compact),
            least_angle_degrees=_LEAST_ANGLE_DEGREES,
            most_error_degrees=error,
        )
        enough = np.bincount(compact, minlength=len(tracks)) >= 2
        chosen = sound.numpy() & enough
        self.points[tracks[chosen]] = points.numpy()[chosen]

    def adjust(self, *, steps: int) -> None:
        """Bundle adjustment of what is placed, after which outliers are left out and what was one may come back."""
        used = np.flatnonzero(self.used)
        bundle, cameras, lenses, tracks = self._bundle(used)
        focal_free = bool(self.registered.sum() > 2)  # two views hardly tell it
        bundle = adjust(bundle, self.lenses.known(lenses, focal_free=focal_free), steps=steps)
        self.rotations[cameras], self.shifts[cameras] = bundle.rotations, bundle.shifts
        self.lenses.focal[lenses], self.lenses.bend[lenses], self.points[tracks] = (
            bundle.focal,
            bundle.bend,
            bundle.points,
        )
        seen = np.flatnonzero(self.registered[self.owner] & np.isfinite(self.points[self.track, 0]))
        misses = np.linalg.norm(self._bundle(seen)[0].misses(), axis=1)
        self.good[seen] = misses <= _OUTLIER * self.tolerance[seen]
        self._forget_weak_points()

    def with_lenses(self, lenses: LensGuess) -> _Chain:
        """This reconstruction, adjusted to other lenses."""
        other = copy.copy(self)
        other.lenses = dataclasses.replace(lenses, focal=lenses.focal.copy(), bend=lenses.bend.copy())
        for name in ("good", "rotations", "shifts", "registered", "points"):
            setattr(other, name, getattr(self, name).copy())
        for _ in range(3):
            other.adjust(steps=10)
            other.triangulate()
        if not other.registered.all():
            other.grow(lambda _: None)  # with a lens of their own they may have a place
        else:
            other.adjust(steps=15)
        return other

    @property
    def bad_tags(self) -> Bool[np.ndarray, " l"]:
        """Lenses whose focal length is found far from what is told."""
        return self.lenses.believed & ~self.lenses.fixed & (np.abs(np.log(self.lenses.focal / self.lenses.told)) > _LIE)

    def pair_misses(self, matches: Matches) -> dict[tuple[int, int], Float[np.ndarray, " _"]]:
        """By how many tolerances matches of placed photos miss their epipolar lines."""
        found = {}
        for (i, j), both in matches.items():
            if self.registered[i] and self.registered[j]:
                first = self.lenses.plane(np.full(len(both), i), self.photos[i].offsets[both[:, 0]])
                second = self.lenses.plane(np.full(len(both), j), self.photos[j].offsets[both[:, 1]])
                rotation = self.rotations[j] @ self.rotations[i].T
                way = self.shifts[j] - rotation @ self.shifts[i]
                scale = [self.lenses.focal[self.lenses.lens[index]] / self.photos[index].tolerance for index in (i, j)]
                found[i, j] = epipolar_misses(first, second, rotation, way) * math.sqrt(scale[0] * scale[1])
        return found

    def concluded(self, matches: Matches) -> FeatureCameras:
        """Cameras, and what is to be doubted of each."""
        used = np.flatnonzero(self.used)
        bundle, cameras_of, lenses, _ = self._bundle(used)
        misses, counts = bundle.misses(), np.bincount(self.owner[used], minlength=len(self.photos))
        found = deviations_of(bundle, self.lenses.known(lenses))
        agreeing = agreeing_shares(self.pair_misses(matches), len(self.photos))
        cameras, reasons, residuals = list[Pinholes | None](), list[str](), list[float]()
        for index, photo in enumerate(self.photos):
            if not self.registered[index] or counts[index] < _FEWEST_POINTS:
                cameras.append(None)
                residuals.append(float("nan"))
                reasons.append(
                    f"shares too few features with the others ({counts[index]} points, a camera needs {_FEWEST_POINTS})"
                )
                continue
            own = misses[self.owner[used] == index]
            focal = self.lenses.focal[self.lenses.lens[index]]
            cameras.append(camera_of(photo, self.rotations[index], self.shifts[index], focal))
            residuals.append(float(np.degrees(np.sqrt(np.square(own).mean()) / focal)))
            few = counts[index] < _TRUSTED_POINTS
            reason = (
                f"only {counts[index]} points are seen in it and in others, expected {_TRUSTED_POINTS}" if few else ""
            )
            reasons.append(reason or doubt(found, int(np.searchsorted(cameras_of, index)), agreeing[index]))
        return FeatureCameras(
            cameras=cameras,
            trusted=[not reason for reason in reasons],
            reasons=reasons,
            residuals_degrees=residuals,
            arrangement=Arrangement.APART,
            bends=[(float(k1), float(k2)) for k1, k2 in self.lenses.bend[self.lenses.lens]],
            notes=self.lenses.notes([max(photo.size) for photo in self.photos]),
        )

    def _focal_of(self, observations: Int[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        return self.lenses.focal[self.lenses.lens[self.owner[observations]]]

    def _bundle(self, observations: Int[np.ndarray, " k"]) -> tuple[Bundle, np.ndarray, np.ndarray, np.ndarray]:
        """What some observations are of, and which cameras, lenses and tracks it holds."""
        cameras, camera_of = np.unique(self.owner[observations], return_inverse=True)
        tracks, point_of = np.unique(self.track[observations], return_inverse=True)
        lenses, lens = np.unique(self.lenses.lens[cameras], return_inverse=True)
        bundle = Bundle(
            rotations=self.rotations[cameras],
            shifts=self.shifts[cameras],
            focal=self.lenses.focal[lenses],
            bend=self.lenses.bend[lenses],
            lens=lens,
            points=self.points[tracks],
            camera_of=camera_of,
            point_of=point_of,
            offsets=self.offsets[observations],
            tolerance=self.tolerance[observations],
        )
        return bundle, cameras, lenses, tracks

    def _forget_weak_points(self) -> None:
        """Points that fewer than two photos observe are none; their observations may begin anew."""
        weak = np.bincount(self.track[self.used], minlength=len(self.points)) < 2
        self.points[weak] = np.nan
        self.good[weak[self.track]] = True


def _twice(owner: np.ndarray, track: np.ndarray) -> np.ndarray:
    """Features of a photo that has several in one track: which of them belongs there is not known."""
    keys = owner * (int(track.max()) + 2) + track + 1
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return counts[inverse] > 1
