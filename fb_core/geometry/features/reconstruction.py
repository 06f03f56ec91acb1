"""A reconstruction from features that grows: points place photos, photos place points, an adjustment mends all."""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features import trust
from fb_core.geometry.features.bundle_adjustment import Bundle, adjust, straight_places
from fb_core.geometry.features.cameras import FeatureCameras, camera_of_photo
from fb_core.geometry.features.lenses import LensGuess
from fb_core.geometry.features.own_lens import LensTrial, Placed, focal_doubt, lens_doubt, lens_trial, sight_of
from fb_core.geometry.features.pairs import Pair, PhotoFeatures, rays_through
from fb_core.geometry.features.triangulation import nearest_points, tracks_of
from fb_core.geometry.pose_solver.verdict import Arrangement

LEAST_ANGLE_DEGREES = 1.5
"""Between the rays of a point."""
_FEWEST_POINTS = 12  # that place a photo
_TRUSTED_POINTS = 24  # of a photo that is beyond doubt
_OUTLIER = 3.0  # tolerances
_LIE = 0.1  # logarithm of the focal length found over the one told, from which the tag is not believed
# Of what is believed, for the first photo of a lens of which nothing was told
_FOCAL_FACTORS = (1.0, 0.5, 0.7, 1.4, 2.0)

_MOST_DOUBTED = "the focal lengths of most photos are in doubt, so that the others stand against too few"
_TWO_OF_THREE = "another photo shows the same points and fits no camera; which of the photos is wrong cannot be told"

Matches = dict[tuple[int, int], Int[np.ndarray, "_ 2"]]
"""Features of two photos each that belong together."""


class Reconstruction:
    """A reconstruction that grows."""

    def __init__(self, photos: Sequence[PhotoFeatures], pairs: Sequence[Pair], lenses: LensGuess):
        self.photos = photos
        self.lenses = dataclasses.replace(lenses, focal=lenses.focal.copy(), bend=lenses.bend.copy())  # they change
        starts = np.cumsum([0, *(len(photo.places) for photo in photos)])
        links = [pair.matches + np.array([starts[pair.first], starts[pair.second]]) for pair in pairs]
        track = tracks_of(torch.from_numpy(np.concatenate(links)), int(starts[-1])).numpy()
        owner = np.repeat(np.arange(len(photos)), np.diff(starts))
        usable = (track >= 0) & ~_twice(owner, track)
        self.owner: Int[np.ndarray, " o"] = owner[usable]
        self.track: Int[np.ndarray, " o"] = track[usable]
        self.offsets: Float[np.ndarray, "o 2"] = np.concatenate([photo.offsets for photo in photos])[usable]
        self.tolerance: Float[np.ndarray, " o"] = np.array([photo.tolerance for photo in photos])[self.owner]
        self.good: Bool[np.ndarray, " o"] = np.ones(len(self.owner), bool)
        self.rotations = np.tile(np.eye(3), (len(photos), 1, 1))
        self.shifts = np.zeros((len(photos), 3))
        self.registered: Bool[np.ndarray, " n"] = np.zeros(len(photos), bool)
        self.points = np.full((int(track.max()) + 1, 3), np.nan)

    @staticmethod
    def begun(photos: Sequence[PhotoFeatures], pairs: Sequence[Pair], lenses: LensGuess, start: Pair) -> Reconstruction:
        """With two cameras, one unit apart."""
        grown = Reconstruction(photos, pairs, lenses)
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
            places = straight_places(self.offsets[mine] / focal, self.lenses.bend[number])
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
            least_angle_degrees=LEAST_ANGLE_DEGREES,
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

    def with_lenses(self, lenses: LensGuess) -> Reconstruction:
        """This reconstruction, adjusted to other lenses."""
        other = self._copied(lenses)
        other._settle()
        return other

    def with_lens_of(self, index: int, trial: LensTrial) -> Reconstruction:
        """This reconstruction, adjusted to the better lens of one photo."""
        assert trial.better is not None
        other = self._copied(self.lenses.with_photo(index, lens=trial.lens, focal=trial.better.focal))
        other.rotations[index], other.shifts[index] = trial.better.rotation, trial.better.shift
        other.good[other.owner == index] = True
        other._settle()
        return other

    def _copied(self, lenses: LensGuess) -> Reconstruction:
        other = copy.copy(self)
        other.lenses = dataclasses.replace(lenses, focal=lenses.focal.copy(), bend=lenses.bend.copy())
        for name in ("good", "rotations", "shifts", "registered", "points"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def _settle(self) -> None:
        """Adjusted until outliers and points have settled, too."""
        for _ in range(3):
            self.adjust(steps=10)
            self.triangulate()
        if not self.registered.all():
            self.grow(lambda _: None)  # with a lens of their own they may have a place
        else:
            self.adjust(steps=15)

    def lens_trials(self) -> dict[int, LensTrial]:
        """What photos say of their lenses, of which the others tell enough points."""
        unknown = self.registered & ~self.lenses.fixed[self.lenses.lens]
        trials = {index: self._lens_trial(index) for index in np.flatnonzero(unknown).tolist()}
        return {index: trial for index, trial in trials.items() if trial is not None}

    def _lens_trial(self, index: int) -> LensTrial | None:
        pictured = np.zeros(len(self.points), bool)
        pictured[self.track[self.owner == index]] = True
        seen = self.registered[self.owner] & np.isfinite(self.points[self.track, 0]) & pictured[self.track]
        bundle, cameras, _, _ = self._bundle(np.flatnonzero(seen & (self.good | (self.owner == index))))
        sight = sight_of(bundle, int(np.searchsorted(cameras, index))) if index in cameras else None
        if sight is None or len(sight.points) < _TRUSTED_POINTS:
            return None
        own = self.lenses.lens[index]
        choices = np.flatnonzero((self.lenses.family == self.lenses.family[own]) & ~self.lenses.fixed)
        believed = Placed(rotation=self.rotations[index], shift=self.shifts[index], focal=float(self.lenses.focal[own]))
        focal = self.lenses.focal[choices].tolist()
        trial = lens_trial(sight, believed, focal, int(np.searchsorted(choices, own)))
        return trial if trial.lens is None else dataclasses.replace(trial, lens=int(choices[trial.lens]))

    def _lens_doubts(self, trials: dict[int, LensTrial]) -> list[str]:
        """What speaks against the lens of each photo; empty where nothing does."""
        own = self.lenses.lens
        focal = self.lenses.focal[own].tolist()
        doubts = [
            lens_doubt(trials[index], focal[index]) if index in trials else "" for index in range(len(self.photos))
        ]
        alone = self._copied(self.lenses.one_each())
        bundle, cameras, lenses, _ = alone._bundle(np.flatnonzero(alone.used))
        deviations = trust.deviations_of(bundle, alone.lenses.known(lenses))
        for camera, index in enumerate(cameras.tolist()):
            if self._own_to_tell[index]:
                deviation = float(deviations.focal[deviations.lens[camera]])
                doubts[index] = doubts[index] or focal_doubt(deviation, told=bool(self.lenses.believed[own[index]]))
        return doubts

    @property
    def _own_to_tell(self) -> Bool[np.ndarray, " n"]:
        """Photos that must tell their focal length themselves: nothing but their size says that others have it, or a
        tag does that no other photo of the same device bears out. Of two photos, tags are all there is.
        """
        own = self.lenses.lens
        shared = (np.bincount(own) > 1)[own]
        vouched = shared & np.array([photo.same_lens for photo in self.photos])
        tag_testable = self.lenses.believed[own] & (self.registered.sum() > 2)
        return ~self.lenses.fixed[own] & ~vouched & (tag_testable | (shared & ~self.lenses.believed[own]))

    def _plane_doubt(self, matches: Matches) -> str:
        """What speaks against all cameras if all photos show one plane; empty if they do not."""
        pairs = zip(self.lenses.lens, self.photos, strict=True)
        scale = [self.lenses.focal[lens] / one.tolerance for lens, one in pairs]
        shown = [trust.flat(scale[i] * first, scale[j] * second) for (i, j), first, second in self._placed(matches)]
        if any(photo.known for photo in self.photos) or not any(shown) or False in shown:
            return ""
        own, count, used = self._own_to_tell & self.registered, int(self.registered.sum()), self.lenses.lens
        untold = {int(lens) for lens in used[self.registered & ~own] if not self.lenses.believed[lens]}
        if not self.lenses.believed.any() and trust.borne_out(count, len(set(used[self.registered]))):
            return ""
        return trust.plane_doubt(count, int(own.sum()) + len(untold))

    @property
    def bad_tags(self) -> Bool[np.ndarray, " l"]:
        """Lenses whose focal length is found far from what is told."""
        return self.lenses.believed & ~self.lenses.fixed & (np.abs(np.log(self.lenses.focal / self.lenses.told)) > _LIE)

    def _placed(self, matches: Matches) -> Iterator[tuple[tuple[int, int], np.ndarray, np.ndarray]]:
        """Matches of placed photos, in the planes at depth 1."""
        for (i, j), both in matches.items():
            if self.registered[i] and self.registered[j]:
                first = self.lenses.plane(np.full(len(both), i), self.photos[i].offsets[both[:, 0]])
                yield (i, j), first, self.lenses.plane(np.full(len(both), j), self.photos[j].offsets[both[:, 1]])

    def pair_misses(self, matches: Matches) -> dict[tuple[int, int], Float[np.ndarray, " _"]]:
        """By how many tolerances matches of placed photos miss their epipolar lines."""
        misses = {}
        for (i, j), first, second in self._placed(matches):
            rotation = self.rotations[j] @ self.rotations[i].T
            way = self.shifts[j] - rotation @ self.shifts[i]
            scale = [self.lenses.focal[self.lenses.lens[index]] / self.photos[index].tolerance for index in (i, j)]
            misses[i, j] = trust.epipolar_misses(first, second, rotation, way) * math.sqrt(scale[0] * scale[1])
        return misses

    def concluded(self, matches: Matches, trials: dict[int, LensTrial]) -> FeatureCameras:
        """Cameras, and what is to be doubted of each, given what photos say of their lenses. Photos whose lens is
        doubted say nothing of the cameras of others.
        """
        doubts = self._lens_doubts(trials)
        doubted, placed = np.array([bool(one) for one in doubts]) & self.registered, int(self.registered.sum())
        rest = self._without(doubted)
        why = rest._plane_doubt(matches) or (_MOST_DOUBTED if 2 * doubted.sum() >= placed else "")
        if why or not doubted.any():
            return self._concluded(matches, [one or why for one in doubts])
        whole, others = self._concluded(matches, doubts), rest._concluded(matches, doubts)
        return whole.with_those_of(others, np.flatnonzero(rest.registered).tolist())

    def _without(self, doubted: Bool[np.ndarray, " n"]) -> Reconstruction:
        """This reconstruction, adjusted to the other photos; itself where none or all are doubted."""
        if not doubted.any() or doubted[self.registered].all():
            return self
        other = self._copied(self.lenses)
        other.registered &= ~doubted
        other._forget_weak_points()
        for _ in range(2):
            other.adjust(steps=10)
        return other

    def _concluded(self, matches: Matches, doubts: Sequence[str]) -> FeatureCameras:
        used = np.flatnonzero(self.used)
        bundle, cameras_of, lenses, _ = self._bundle(used)
        misses, counts = bundle.misses(), np.bincount(self.owner[used], minlength=len(self.photos)).tolist()
        relative = np.linalg.norm(misses, axis=1) / bundle.tolerance
        deviations, sigma = trust.deviations_of(bundle, self.lenses.known(lenses)), trust.sigma_of(relative)
        agreeing = trust.agreeing_shares(self.pair_misses(matches), len(self.photos))
        shown = np.bincount(self.owner[np.isfinite(self.points[self.track, 0])], minlength=len(self.photos))
        refused = ~self.registered & (shown >= _TRUSTED_POINTS)
        cameras, reasons, residuals = list[Pinholes | None](), list[str](), list[float]()
        for index, photo in enumerate(self.photos):
            if not self.registered[index] or counts[index] < _FEWEST_POINTS:
                cameras.append(None)
                residuals.append(float("nan"))
                shared = max(counts[index], int(shown[index]))
                reasons.append(
                    trust.NO_PLACE if refused[index] else trust.few_points(shared, _FEWEST_POINTS, "a camera needs")
                )
                continue
            mine = self.owner[used] == index
            focal = self.lenses.focal[self.lenses.lens[index]]
            cameras.append(camera_of_photo(photo, self.rotations[index], self.shifts[index], focal))
            residuals.append(float(np.degrees(np.sqrt(np.square(misses[mine]).mean()) / focal)))
            if counts[index] < _TRUSTED_POINTS:
                reason = trust.few_points(counts[index], _TRUSTED_POINTS, "expected")
            elif refused.any() and self.registered.sum() == 2:
                reason = _TWO_OF_THREE
            else:
                reason = trust.outlying(relative[mine], sigma) or doubts[index]
            reasons.append(reason or trust.doubt(deviations, int(np.searchsorted(cameras_of, index)), agreeing[index]))
        if reasons.count("") == 1:  # cameras stand where they stand against one another
            reasons[reasons.index("")] = trust.ALONE
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
