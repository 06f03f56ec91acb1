"""Cameras of photos from their features: two views by an essential matrix, the others one after the other by the points these give.

The pair with many matches and a wide angle begins. Its points place the photo that sees most of them (perspective-n-point), whose matches
give new points, and so on; a bundle adjustment mends all cameras, focal lengths and points on the way and at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from fb_core.geometry.bundle_adjustment import Bundle, adjust
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.feature_pairs import Pair, PhotoFeatures, match_pairs, verified_pair
from fb_core.geometry.feature_panorama import Panorama, panorama_of
from fb_core.geometry.pose_verdict import Arrangement
from fb_core.geometry.triangulation import nearest_points, tracks_of

FOCAL_GUESS = 1.2
"""Focal length in longer sides where nothing tells more: a normal lens (43 mm on film), the customary start."""
_GUESSES = (FOCAL_GUESS, 0.7)  # the second is a phone's (26 mm on film)
_FOCAL_TOLD, _FOCAL_GUESSED = 0.02, 0.5  # deviations of the logarithm
_PANORAMA = 0.8  # share of all matches that rotations alone explain, from which nothing else is looked for
_COPIES_DEGREES = 0.2  # photos in one place that are turned by less are copies of one another
_STARTS = 3  # pairs that may begin
_GOOD_ANGLE_DEGREES = 8.0  # of a starting pair; wider ones are no better
_LEAST_ANGLE_DEGREES = 1.5  # between the rays of a point
_FEWEST_POINTS = 12  # that place a photo
_TRUSTED_POINTS = 24  # of a photo that is beyond doubt
_OUTLIER = 3.0  # tolerances


@dataclass(frozen=True, kw_only=True)
class FeatureCameras:
    """What features say of n photos."""

    cameras: list[Pinholes | None]
    """Each a batch of one, float64, of the whole photo, in a world of their own; None where features do not tell."""
    trusted: list[bool]
    """Whether there is a camera beyond doubt."""
    reasons: list[str]
    """What is to be doubted, or worth knowing; empty where all is well."""
    residuals_degrees: list[float]
    """Root mean square of the angles by which features miss their points, per axis; NaN where there is no camera."""
    arrangement: Arrangement
    """How the cameras stand to each other."""


def chain(photos: Sequence[PhotoFeatures], *, on_progress: Callable[[str, int, int], None] = lambda *_: None) -> FeatureCameras:
    """Cameras of two or more photos. Deterministic; nothing that photos show or lack raises an error.

    Where focal lengths are not told, the chain is built from two guesses, and once more from the better result's.
    """
    matches = match_pairs(photos, lambda done, total: on_progress("matching features", done, total))
    panorama = panorama_of(photos, matches, guess=FOCAL_GUESS)
    if panorama.share >= _PANORAMA or not matches:
        return _one_place(photos, panorama)
    untold = any(photo.focal is None for photo in photos)
    best: _Chain | None = None
    for guess in _GUESSES if untold else _GUESSES[:1]:
        focal = [photo.focal or guess * max(photo.size) for photo in photos]
        best = _better(best, _reconstructed(photos, matches, focal, on_progress))
    if untold and best is not None:
        best = _better(best, _reconstructed(photos, matches, best.focal[best.lens].tolist(), on_progress))
    return best.concluded() if best is not None else _one_place(photos, panorama)


def _reconstructed(
    photos: Sequence[PhotoFeatures],
    matches: dict[tuple[int, int], Int[np.ndarray, "m 2"]],
    focal: Sequence[float],
    on_progress: Callable[[str, int, int], None],
) -> _Chain | None:
    """The best of a few beginnings; None if no two photos make one."""
    pairs = [pair for key, value in matches.items() if (pair := verified_pair(photos, key, value, focal)) is not None]
    best: _Chain | None = None
    apart = [pair for pair in pairs if pair.parallax_degrees >= _LEAST_ANGLE_DEGREES]
    for start in sorted(apart, key=_worth, reverse=True)[:_STARTS]:
        grown = _Chain.begun(photos, pairs, focal, start)
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

    def __init__(self, photos: Sequence[PhotoFeatures], pairs: Sequence[Pair], focal: Sequence[float]):
        self.photos = photos
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
        lenses = list(dict.fromkeys(photo.lens for photo in photos))
        self.lens: Int[np.ndarray, " n"] = np.array([lenses.index(photo.lens) for photo in photos])
        self.focal: Float[np.ndarray, " l"] = np.array([focal[int(np.argmax(self.lens == number))] for number in range(len(lenses))])
        told = np.array([photos[int(np.argmax(self.lens == number))].focal is not None for number in range(len(lenses))])
        self.told, self.deviation = self.focal.copy(), np.where(told, _FOCAL_TOLD, _FOCAL_GUESSED)
        self.rotations = np.tile(np.eye(3), (len(photos), 1, 1))
        self.shifts = np.zeros((len(photos), 3))
        self.registered: Bool[np.ndarray, " n"] = np.zeros(len(photos), bool)
        self.points = np.full((int(track.max()) + 1, 3), np.nan)

    @staticmethod
    def begun(photos: Sequence[PhotoFeatures], pairs: Sequence[Pair], focal: Sequence[float], start: Pair) -> _Chain:
        """With two cameras, one unit apart."""
        grown = _Chain(photos, pairs, focal)
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
            seen = np.bincount(self.owner[self.good & np.isfinite(self.points[self.track, 0])], minlength=len(self.photos))
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
        focal, tolerance = self.focal[self.lens[index]], self.photos[index].tolerance
        points, places = self.points[self.track[mine]], self.offsets[mine] / focal
        options: dict[str, Any] = {"iterationsCount": 1000, "reprojectionError": 3 * tolerance / focal, "confidence": 0.9999}
        done, turn, shift, inliers = cv2.solvePnPRansac(points, places, np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_SQPNP, **options)
        if not done or inliers is None or len(inliers) < max(_FEWEST_POINTS, 0.3 * len(mine)):
            return False
        inliers = inliers[:, 0].astype(np.int64)
        turn, shift = cv2.solvePnPRefineLM(points[inliers], places[inliers], np.eye(3), np.zeros(4), turn, shift)
        self.rotations[index], self.shifts[index] = cv2.Rodrigues(turn)[0], shift[:, 0]
        self.registered[index] = True
        self.good[mine] = False
        self.good[mine[inliers]] = True
        return True

    def triangulate(self) -> None:
        """Points of all tracks that have none and that two placed photos see well."""
        mine = np.flatnonzero(self.good & self.registered[self.owner] & ~np.isfinite(self.points[self.track, 0]))
        if len(mine) == 0:
            return
        tracks, compact = np.unique(self.track[mine], return_inverse=True)
        rotations = self.rotations[self.owner[mine]]
        rays = np.concatenate([self.offsets[mine] / self._focal_of(mine)[:, None], np.ones((len(mine), 1))], axis=1)
        directions = np.einsum("oji,oj->oi", rotations, rays / np.linalg.norm(rays, axis=1, keepdims=True))
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
        focal_free = self.registered.sum() > 2  # two views hardly tell it
        deviation = self.deviation[lenses] if focal_free else np.full(len(lenses), 1e-4)
        told = self.told[lenses] if focal_free else self.focal[lenses]
        bundle = adjust(bundle, told=told, deviation=deviation, steps=steps)
        self.rotations[cameras], self.shifts[cameras] = bundle.rotations, bundle.shifts
        self.focal[lenses], self.points[tracks] = bundle.focal, bundle.points
        seen = np.flatnonzero(self.registered[self.owner] & np.isfinite(self.points[self.track, 0]))
        misses = np.linalg.norm(self._bundle(seen)[0].misses(), axis=1)
        self.good[seen] = misses <= _OUTLIER * self.tolerance[seen]
        self._forget_weak_points()

    def concluded(self) -> FeatureCameras:
        """Cameras, and what is to be doubted of each."""
        used = np.flatnonzero(self.used)
        misses = self._bundle(used)[0].misses()
        cameras, reasons, residuals = list[Pinholes | None](), list[str](), list[float]()
        for index, photo in enumerate(self.photos):
            own = misses[self.owner[used] == index]
            focal = self.focal[self.lens[index]]
            if not self.registered[index] or len(own) < _FEWEST_POINTS:
                cameras.append(None)
                residuals.append(float("nan"))
                reasons.append(f"shares too few features with the others ({len(own)} points, a camera needs {_FEWEST_POINTS})")
                continue
            cameras.append(_camera(photo, self.rotations[index], self.shifts[index], focal))
            residuals.append(float(np.degrees(np.sqrt(np.square(own).mean()) / focal)))
            few = len(own) < _TRUSTED_POINTS
            reasons.append(f"only {len(own)} points are seen in it and in others, expected {_TRUSTED_POINTS}" if few else "")
        trusted = [not reason for reason in reasons]
        return FeatureCameras(cameras=cameras, trusted=trusted, reasons=reasons, residuals_degrees=residuals, arrangement=Arrangement.APART)

    def _focal_of(self, observations: Int[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        return self.focal[self.lens[self.owner[observations]]]

    def _bundle(self, observations: Int[np.ndarray, " k"]) -> tuple[Bundle, np.ndarray, np.ndarray, np.ndarray]:
        """What some observations are of, and which cameras, lenses and tracks it holds."""
        cameras, camera_of = np.unique(self.owner[observations], return_inverse=True)
        tracks, point_of = np.unique(self.track[observations], return_inverse=True)
        lenses, lens = np.unique(self.lens[cameras], return_inverse=True)
        bundle = Bundle(
            rotations=self.rotations[cameras],
            shifts=self.shifts[cameras],
            focal=self.focal[lenses],
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


def _one_place(photos: Sequence[PhotoFeatures], panorama: Panorama) -> FeatureCameras:
    """Rotations are all that features tell."""
    cameras = [
        None if turn is None else _camera(photo, turn, np.zeros(3), focal)
        for photo, turn, focal in zip(photos, panorama.rotations, panorama.focal, strict=True)
    ]
    turns = [turn for turn in panorama.rotations if turn is not None]
    copies = all(np.trace(turn @ turns[0].T) > 1 + 2 * np.cos(np.radians(_COPIES_DEGREES)) for turn in turns)
    here = "shows the same as the others, from the same place" if copies else "taken in the same place as the others: no distances"
    return FeatureCameras(
        cameras=cameras,
        trusted=[camera is not None and not copies for camera in cameras],
        reasons=["shares too few features with the others" if camera is None else here for camera in cameras],
        residuals_degrees=[float("nan")] * len(photos),
        arrangement=Arrangement.ONE_PLACE if turns else Arrangement.NO_CAMERA,
    )


def _camera(photo: PhotoFeatures, rotation: np.ndarray, shift: np.ndarray, focal: float) -> Pinholes:
    height, width = photo.size
    pose = torch.from_numpy(np.concatenate([rotation.T, -(rotation.T @ shift)[:, None]], axis=1))
    return Pinholes(
        camera_to_world=pose[None],
        focal=torch.full((1, 2), float(focal), dtype=torch.float64),
        principal=torch.tensor([[width / 2, height / 2]], dtype=torch.float64),
        width=width,
        height=height,
    )


def _twice(owner: np.ndarray, track: np.ndarray) -> np.ndarray:
    """Features of a photo that has several in one track: which of them belongs there is not known."""
    keys = owner * (int(track.max()) + 2) + track + 1
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    return counts[inverse] > 1
