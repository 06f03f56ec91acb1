"""Which photos show the same places: SIFT features, matched and verified by the geometry of two views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fb_core.geometry.features.bundle_adjustment import straight_places
from fb_core.geometry.features.triangulation import detect, mutual_matches
from fb_core.machine.parallel import in_order, workers_for
from fb_core.masks import resampled

_COARSE_SIDE, _COARSE_LIMIT = 320, 400  # small copies of photos that tell which of them are worth matching
FEATURES = 2500
"""Of one photo at most."""
ALL_PAIRS = 16
"""Photos of which every pair is matched; of more, small copies tell which pairs are worth it."""
_PARTNERS = 12  # of each photo when there are more
_BYTES_PER_MATCH = 16.0  # of two photos' features: their similarity, and what finds the largest of it
_RATIO = 0.8  # most distance to a match, as a share of that to the second likeliest (ratio test of Lowe 2004)
_IN_FRONT = 0.8  # least share of the matches on epipolar lines whose points lie in front of both cameras
FEWEST_MATCHES = 16
"""Pairs with fewer verified matches say nothing."""
# A match may miss its epipolar line by the longer side over this number, and by one pixel at least.
_SIDE_PER_PIXEL = 700


@dataclass(frozen=True, kw_only=True)
class PhotoFeatures:
    """Distinctive places of one photo."""

    places: Float[Tensor, "k 2"]
    """(x, y) in pixels; the centre of the top left pixel is (0.5, 0.5)."""
    descriptors: Float[Tensor, "k d"]
    """Unit vectors."""
    coarse: Float[Tensor, "c d"]
    """Descriptors of a small copy of the photo."""
    size: tuple[int, int]
    """(height, width) in pixels; the principal point is the middle."""
    focal: float | None
    """In pixels, where it is known."""
    lens: str
    """Photos with the same text share one focal length (in pixels of this size), unless they say otherwise."""
    same_lens: bool = False
    """Whether photos of this lens are known to share it (the device is told, or a film), not only to have one size."""
    known: bool = False
    """Whether the focal length stands and the lens is straight: the photo's camera is known."""

    @property
    def offsets(self) -> Float[np.ndarray, "k 2"]:
        """Places from the middle, pixels, float64."""
        return self.places.double().numpy() - np.array([self.size[1] / 2, self.size[0] / 2])

    @property
    def tolerance(self) -> float:
        """Pixels by which a place may be off."""
        return max(1.0, max(self.size) / _SIDE_PER_PIXEL)


def features_of(
    image: Float[Tensor, "3 h w"],
    known: Float[Tensor, "1 h w"] | None = None,
    *,
    focal: float | None,
    lens: str,
    same_lens: bool = False,
    posed: bool = False,
    coarse: bool = True,
) -> PhotoFeatures:
    """Features of a photo, RGB in [0, 1]; `known` is 1 where it may be used. The camera of a `posed` photo is known.

    Without `coarse` those of a small copy are left out, which nobody asks for among up to `ALL_PAIRS` photos.
    """
    size = (image.shape[1], image.shape[2])
    places, descriptors, _ = detect(image, known, limit=FEATURES)
    return PhotoFeatures(
        places=places,
        descriptors=descriptors,
        coarse=_coarse(image, known) if coarse else descriptors[:0],
        size=size,
        focal=focal,
        lens=lens,
        same_lens=same_lens,
        known=posed,
    )


def _coarse(image: Float[Tensor, "3 h w"], known: Float[Tensor, "1 h w"] | None) -> Float[Tensor, "c d"]:
    """Descriptors of a small copy of a photo."""
    size = image.shape[1:]
    shrink = min(1.0, _COARSE_SIDE / max(size))
    small = [max(1, round(side * shrink)) for side in size]
    everything = torch.ones_like(image[:1])

    def shrunk(channels: Float[Tensor, "c h w"]) -> Float[Tensor, "c h2 w2"]:
        return torch.nn.functional.interpolate(channels[None], size=small, mode="bilinear", antialias=True)[0]

    small_image, share = resampled(image, everything if known is None else known, shrunk)
    return detect(small_image, None if known is None else (share > 0.5).float(), limit=_COARSE_LIMIT)[1]


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two photos with matches that one motion of the camera explains."""

    first: int
    second: int
    matches: Int[np.ndarray, "m 2"]
    """Features of both."""
    rotation: Float[np.ndarray, "3 3"]
    """From the first camera's axes to the second's."""
    translation: Float[np.ndarray, "3"]
    """Unit vector: where the first camera's centre is in the second's axes."""
    parallax_degrees: float
    """Median angle between the matches' rays once the rotation is taken out."""


def pairs_at_most(count: int) -> int:
    """How many pairs of so many photos are matched at most."""
    return count * (min(count, ALL_PAIRS) - 1) // 2 if count <= ALL_PAIRS else count * _PARTNERS


def candidate_pairs(photos: Sequence[PhotoFeatures]) -> list[tuple[int, int]]:
    """Pairs that are worth matching: all of few photos, otherwise each photo's likeliest partners by features of small
    copies.
    """
    count = len(photos)
    if count <= ALL_PAIRS:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    alike = torch.zeros(count, count)
    for i in range(count):
        for j in range(i + 1, count):
            if min(len(photos[i].coarse), len(photos[j].coarse)) >= 2:
                match_count = len(mutual_matches(photos[i].coarse @ photos[j].coarse.T, ratio=_RATIO)[0])
                alike[i, j] = alike[j, i] = match_count
    chosen: set[tuple[int, int]] = set()
    for i in range(count):
        for j in alike[i].topk(min(_PARTNERS, count)).indices.tolist():
            if i != j and alike[i, j] > 0:
                chosen.add((min(i, j), max(i, j)))
    return sorted(chosen)


def match_pairs(
    photos: Sequence[PhotoFeatures], on_pair: Callable[[int, int], None]
) -> dict[tuple[int, int], Int[np.ndarray, "m 2"]]:
    """Mutual matches of all candidate pairs that a fundamental matrix or a homography explains; no focal length is
    needed for that.
    """
    matches_of_pair: dict[tuple[int, int], np.ndarray] = {}
    pairs = candidate_pairs(photos)
    most = max((len(photo.places) for photo in photos), default=0)
    found = in_order(lambda pair: _matched(photos, *pair), pairs, workers_for(len(pairs), _BYTES_PER_MATCH * most**2))
    for number, (pair, matches) in enumerate(zip(pairs, found, strict=True)):
        on_pair(number, len(pairs))
        if matches is not None:
            matches_of_pair[pair] = matches
    return matches_of_pair


def _matched(photos: Sequence[PhotoFeatures], i: int, j: int) -> Int[np.ndarray, "m 2"] | None:
    """The matches of a pair that one fundamental matrix explains; None where they are too few."""
    if min(len(photos[i].places), len(photos[j].places)) < FEWEST_MATCHES:
        return None
    rows, columns = mutual_matches(photos[i].descriptors @ photos[j].descriptors.T, ratio=_RATIO)
    matches = torch.stack([rows, columns], dim=1).numpy()
    if len(matches) < FEWEST_MATCHES:
        return None
    first, second = photos[i].offsets[matches[:, 0]], photos[j].offsets[matches[:, 1]]
    inliers = _on_epipolar_lines(first, second, max(photos[i].tolerance, photos[j].tolerance))
    return matches[inliers] if inliers.sum() >= FEWEST_MATCHES else None


def verified_pair(
    photos: Sequence[PhotoFeatures],
    key: tuple[int, int],
    matches: Int[np.ndarray, "m 2"],
    focal: Sequence[float],
    bend: Float[np.ndarray, "n 2"] | None = None,
) -> Pair | None:
    """The motion between two photos of known lenses (k1 and k2 in `bend`), with the matches that agree with it; None if
    too few do.
    """
    i, j = key
    first = photos[i].offsets[matches[:, 0]] / focal[i]
    second = photos[j].offsets[matches[:, 1]] / focal[j]
    if bend is not None and bend.any():
        first, second = straight_places(first, bend[i]), straight_places(second, bend[j])
        pictured = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
        matches, first, second = matches[pictured], first[pictured], second[pictured]
        if len(matches) < FEWEST_MATCHES:
            return None
    tolerance = max(photos[i].tolerance / focal[i], photos[j].tolerance / focal[j])
    rotation, translation, inliers = _motion(first, second, tolerance)
    if inliers.sum() < FEWEST_MATCHES:
        return None
    angle = angles_degrees(rays_through(first[inliers]) @ rotation.T, rays_through(second[inliers]))
    return Pair(
        first=i,
        second=j,
        matches=matches[inliers],
        rotation=rotation,
        translation=translation[:, 0],
        parallax_degrees=float(np.median(angle)),
    )


def _on_epipolar_lines(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], tolerance: float
) -> Bool[np.ndarray, " m"]:
    """Matches that one fundamental matrix explains."""
    import cv2

    for method in (cv2.USAC_MAGSAC, cv2.RANSAC):
        try:
            _, inliers = cv2.findFundamentalMat(first, second, method, tolerance, 0.9999, 5000)
        except cv2.error:  # the first method fails an assertion of OpenCV's own on some matches of good photos
            continue
        return np.zeros(len(first), bool) if inliers is None else inliers[:, 0] > 0
    return np.zeros(len(first), bool)


def _motion(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], tolerance: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 1"], Bool[np.ndarray, " m"]]:
    """Rotation, direction of translation, and the matches that they put on their epipolar lines and before both
    cameras.

    On a wall, a matrix with a wrong motion lies within the tolerance of all matches too, but puts half of them behind a
    camera. Where that happens, the one of least median error, which has no tolerance to be satisfied with, is tried as
    well.
    """
    import cv2

    best = np.eye(3), np.zeros((3, 1)), np.zeros(len(first), bool)
    for method in (cv2.USAC_MAGSAC, cv2.LMEDS):
        try:
            essential, inliers = cv2.findEssentialMat(first, second, np.eye(3), method, 0.9999, tolerance)
        except cv2.error:
            continue
        if essential is None or essential.shape != (3, 3) or inliers.sum() < FEWEST_MATCHES:
            continue
        near = _misses(essential, first, second) <= tolerance
        _, rotation, translation, inliers = cv2.recoverPose(
            essential, first, second, np.eye(3), mask=near[:, None].astype(np.uint8)
        )
        if (inliers[:, 0] > 0).sum() > best[2].sum():
            best = rotation, translation, inliers[:, 0] > 0
        if best[2].sum() >= _IN_FRONT * near.sum():
            break
    return best


def _misses(
    essential: Float[np.ndarray, "3 3"], first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, " m"]:
    """First order distances of matches from their epipolar lines (Sampson 1982), in the unit of the places."""
    a, b = (np.concatenate([places, np.ones((len(places), 1))], axis=1) for places in (first, second))
    lines, back = a @ essential.T, b @ essential
    return np.abs((b * lines).sum(axis=1)) / np.sqrt(
        (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1) + 1e-30
    )


def rays_through(places: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 3"]:
    """Unit vectors through places in the plane at distance 1."""
    rays = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def angles_degrees(first: Float[np.ndarray, "k 3"], second: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, " k"]:
    """Between unit vectors, exact for small angles."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), (first * second).sum(axis=1)))
