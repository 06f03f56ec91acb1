"""COLMAP's camera models as the lenses that nerfstudio trains on: Brown's (k1, k2, k3, p1, p2) and the equidistant
fisheye (k1 to k4).

Models that are one of these by name are taken as they stand. Others are fitted over their whole picture, and taken
where no pixel is off by more than a fifth of a pixel: less than structure from motion itself leaves. The rest is
refused. Source of the models: COLMAP's documentation, "Camera Models"; their formulas are those of the field (OpenCV;
Devernay and Faugeras' FOV; Fitzgibbon's division; Khomutenko's EUCM; Project Aria's fisheye).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fb_core.data.capture.colmap.reader import ColmapCamera

_MOST_OFF = 0.2  # pixels
_RAYS, _AZIMUTHS = 400, 64
_WIDEST_PERSPECTIVE, _WIDEST_FISHEYE = math.radians(80.0), math.radians(110.0)


@dataclass(frozen=True, kw_only=True)
class ColmapLens:
    """A lens as nerfstudio names it."""

    camera_model: str
    focal: tuple[float, float]
    """Pixels."""
    principal: tuple[float, float]
    """Pixels; the centre of the first one is (0.5, 0.5), as in COLMAP."""
    distortion: dict[str, float]


# model -> (whether it has one focal length, ours, names of the coefficients in COLMAP's order)
_BY_NAME: dict[str, tuple[bool, str, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (True, "PINHOLE", ()),
    "PINHOLE": (False, "PINHOLE", ()),
    "SIMPLE_RADIAL": (True, "OPENCV", ("k1",)),
    "RADIAL": (True, "OPENCV", ("k1", "k2")),
    "OPENCV": (False, "OPENCV", ("k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (False, "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": (True, "OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": (True, "OPENCV_FISHEYE", ("k1", "k2")),
    "SIMPLE_FISHEYE": (True, "OPENCV_FISHEYE", ()),
    "FISHEYE": (False, "OPENCV_FISHEYE", ()),
}
_FITTED = (
    "FULL_OPENCV",
    "FOV",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "DIVISION",
    "EUCM",
)


def lens_of(camera: ColmapCamera, where: str) -> ColmapLens:
    """The lens in nerfstudio's words. Raises ValueError, opened by ``where``, for one that those have no words for."""
    if camera.model in _BY_NAME:
        single, model, names = _BY_NAME[camera.model]
        focal, principal, rest = _split(camera, single)
        distortion = dict(zip(names, rest, strict=True))
        model = model if model != "OPENCV" or any(rest) else "PINHOLE"
        return ColmapLens(camera_model=model, focal=focal, principal=principal, distortion=distortion)
    opening = f"{where}: a {camera.model} camera"
    if camera.model not in _FITTED:
        raise ValueError(
            f"{opening} is no lens that a splat can be trained with; cut its pictures into perspective views first"
        )
    directions, pixels = _samples(camera)
    if len(pixels) < 16:
        raise ValueError(f"{opening} with {[*camera.params]} sees nothing of its picture; calibrate it again")
    (off, lens), _ = sorted(
        (_perspective(camera, directions, pixels), _fisheye(camera, directions, pixels)), key=lambda pair: pair[0]
    )
    if not off <= _MOST_OFF:
        raise ValueError(
            f"{opening} cannot be told by k1 to k4, p1 and p2 (the closest such lens is off by {off:.2g} pixels); run "
            "colmap "
            "image_undistorter, which writes PINHOLE cameras"
        )
    return lens


def projected(camera: ColmapCamera, points: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of points [n, 3] in camera axes (z forward), by a model that is fitted."""
    single = camera.model == "SIMPLE_DIVISION"
    focal, principal, rest = _split(camera, single)
    return _BENT[camera.model](points, rest) * np.array(focal) + np.array(principal)


def _split(camera: ColmapCamera, single: bool) -> tuple[tuple[float, float], tuple[float, float], tuple[float, ...]]:
    """Focal lengths, principal point and the rest."""
    first = camera.params[:1] * 2 if single else camera.params[:2]
    rest = camera.params[1 if single else 2 :]
    return (first[0], first[1]), (rest[0], rest[1]), rest[2:]


# ---- the models, on the plane of focal length 1 ---------------------------------------------------------------------


def _plane(points: np.ndarray) -> np.ndarray:
    return points[:, :2] / points[:, 2:]


def _tangential(flat: np.ndarray, p1: float, p2: float) -> np.ndarray:
    u, v, square = flat[:, 0], flat[:, 1], (flat**2).sum(axis=1)
    return np.stack([2 * p1 * u * v + p2 * (square + 2 * u * u), p1 * (square + 2 * v * v) + 2 * p2 * u * v], axis=1)


def _equidistant(points: np.ndarray) -> np.ndarray:
    """As long as the angle off the axis."""
    length = np.linalg.norm(points[:, :2], axis=1)
    angle = np.arctan2(length, points[:, 2])
    return points[:, :2] * (angle / np.maximum(length, 1e-12))[:, None]


def _series(square: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    return sum((k * square**power for power, k in enumerate(coefficients, start=1)), np.zeros_like(square))


def _full_opencv(points: np.ndarray, rest: tuple[float, ...]) -> np.ndarray:
    flat, (k1, k2, p1, p2, k3, k4, k5, k6) = _plane(points), rest
    square = (flat**2).sum(axis=1)
    ratio = (1 + _series(square, (k1, k2, k3))) / (1 + _series(square, (k4, k5, k6)))
    return flat * ratio[:, None] + _tangential(flat, p1, p2)


def _fov(points: np.ndarray, rest: tuple[float, ...]) -> np.ndarray:
    flat, (omega,) = _plane(points), rest
    radius = np.maximum(np.linalg.norm(flat, axis=1), 1e-12)
    ratio = np.arctan(radius * 2 * math.tan(omega / 2)) / (radius * omega) if omega else np.ones_like(radius)
    return flat * ratio[:, None]


def _thin_prism(points: np.ndarray, rest: tuple[float, ...]) -> np.ndarray:
    flat, (k1, k2, p1, p2, k3, k4, s1, s2) = _equidistant(points), rest
    square = (flat**2).sum(axis=1)
    prism = square[:, None] * np.array([s1, s2])
    return flat * (1 + _series(square, (k1, k2, k3, k4)))[:, None] + _tangential(flat, p1, p2) + prism


def _aria(points: np.ndarray, rest: tuple[float, ...]) -> np.ndarray:
    flat, (p0, p1, s0, s1, s2, s3) = _equidistant(points), rest[6:]
    bent = flat * (1 + _series((flat**2).sum(axis=1), rest[:6]))[:, None]
    square = (bent**2).sum(axis=1)
    prism = np.stack([s0 * square + s1 * square**2, s2 * square + s3 * square**2], axis=1)
    return bent + _tangential(bent, p1, p0) + prism


def _division(points: np.ndarray, rest: tuple[float, ...]) -> np.ndarray:
    flat, (k,) = _plane(points), rest
    root = np.sqrt(np.maximum(1 - 4 * k * (flat**2).sum(axis=1), 0.0))
    return flat * (2 / (1 + root))[:, None]


def _eucm(points: np.ndarray, rest: tuple[float, ...]) -> np.ndarray:
    alpha, beta = rest
    depth = points[:, 2]
    far = np.sqrt(beta * (points[:, :2] ** 2).sum(axis=1) + depth**2)
    return points[:, :2] / (alpha * far + (1 - alpha) * depth)[:, None]


_BENT = {
    "FULL_OPENCV": _full_opencv,
    "FOV": _fov,
    "THIN_PRISM_FISHEYE": _thin_prism,
    "RAD_TAN_THIN_PRISM_FISHEYE": _aria,
    "SIMPLE_DIVISION": _division,
    "DIVISION": _division,
    "EUCM": _eucm,
}


# ---- fits -----------------------------------------------------------------------------------------------------------


def _samples(camera: ColmapCamera) -> tuple[np.ndarray, np.ndarray]:
    """Directions [n, 3] all over the picture and their pixels [n, 2]; along each azimuth up to the picture's edge, or
    to where the model folds back.
    """
    fisheye = camera.model in ("THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")
    angles = np.linspace(1e-3, _WIDEST_FISHEYE if fisheye else _WIDEST_PERSPECTIVE, _RAYS)
    around = np.linspace(0, 2 * math.pi, _AZIMUTHS, endpoint=False)
    angle, azimuth = np.meshgrid(angles, around)
    directions = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=-1)
    pixels = projected(camera, directions.reshape(-1, 3)).reshape(*angle.shape, 2)
    inside = (pixels > 0).all(axis=-1) & (pixels < np.array([camera.width, camera.height])).all(axis=-1)
    outwards = np.linalg.norm(pixels - np.array(_split(camera, camera.model == "SIMPLE_DIVISION")[1]), axis=-1)
    growing = np.concatenate([np.ones((len(around), 1), dtype=bool), np.diff(outwards, axis=1) > 0], axis=1)
    usable = np.logical_and.accumulate(inside & growing, axis=1)
    return directions[usable], pixels[usable]


def _perspective(camera: ColmapCamera, directions: np.ndarray, pixels: np.ndarray) -> tuple[float, ColmapLens]:
    """(largest error in pixels, the closest Brown lens); infinite where it sees too wide."""
    if directions[:, 2].min() < math.cos(_WIDEST_PERSPECTIVE) + 1e-6:
        directions = directions[:0]
    flat = directions[:, :2] / directions[:, 2:] if len(directions) else np.zeros((0, 2))
    square = (flat**2).sum(axis=1)[:, None]
    columns = [
        flat,
        flat * square,
        flat * square**2,
        flat * square**3,
        _tangential(flat, 1, 0),
        _tangential(flat, 0, 1),
    ]
    return _fitted(camera, columns, pixels[: len(flat)], "OPENCV", ("k1", "k2", "k3", "p1", "p2"))


def _fisheye(camera: ColmapCamera, directions: np.ndarray, pixels: np.ndarray) -> tuple[float, ColmapLens]:
    flat = _equidistant(directions)
    square = (flat**2).sum(axis=1)[:, None]
    columns = [flat * square**power for power in range(5)]
    return _fitted(camera, columns, pixels, "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4"))


def _fitted(
    camera: ColmapCamera, columns: list[np.ndarray], pixels: np.ndarray, model: str, names: tuple[str, ...]
) -> tuple[float, ColmapLens]:
    """Least squares: a common factor of the focal lengths, and that times each coefficient, are linear in the
    pixels.
    """
    focal, principal, _ = _split(camera, camera.model == "SIMPLE_DIVISION")
    matrix = np.stack([column.reshape(-1) for column in columns], axis=1)
    target = (pixels - np.array(principal)) / np.array(focal)
    if not len(pixels):
        return math.inf, ColmapLens(camera_model=model, focal=focal, principal=principal, distortion={})
    solution = np.linalg.lstsq(matrix, target.reshape(-1), rcond=None)[0]
    error = (matrix @ solution).reshape(-1, 2) - target
    scale = float(solution[0])
    lens = ColmapLens(
        camera_model=model,
        focal=(focal[0] * scale, focal[1] * scale),
        principal=principal,
        distortion={name: float(value) / scale for name, value in zip(names, solution[1:], strict=True)},
    )
    return float(np.abs(error * np.array(focal)).max()) if scale > 0 else math.inf, lens
