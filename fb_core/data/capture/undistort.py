"""Straight pictures from lenses that bend: undistortion with OpenCV's lens models (the models that nerfstudio trains
on).

No plane holds a picture of 180 degrees: fisheye lenses that see farther than ``WIDEST_FISHEYE`` off their axis are
straightened to 140 degrees at most, and what lies beyond is left out.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from functools import lru_cache

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.masks import wholly_known

PERSPECTIVE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE_MODELS = ("OPENCV_FISHEYE",)
WIDEST_FISHEYE = 86.0
"""Degrees off the axis, at the middle of a picture's side, up to which OpenCV finds the straight camera of a fisheye
lens.
"""
_KEPT = 70.0  # degrees off the axis at the middle of a side, of a picture from a wider lens
_FOCAL_RATIOS = (0.05, 20.0)  # of straight cameras over bent ones, for lenses that exist
_WIDEST = 3.0  # tangent of the angle off the axis up to which a perspective lens is looked at (72 degrees)
_TABLE, _STEPS = 4096, 4  # angles that the inverse of a fisheye starts from, and steps of Newton from there
# A resampled pixel is known where its mask is at least this. OpenCV interpolates in steps of 1/32 of a pixel, so an
# unknown neighbour that takes part weighs at least 1/1024; the rest is rounding.
_WHOLLY_KNOWN = 1 - 1e-4
_logger = logging.getLogger(__name__)


def check_lens(camera_model: str, distortion: dict[str, float], where: str) -> None:
    """Raises ValueError for a lens that cannot be undistorted; ``where`` opens the sentence."""
    if camera_model not in PERSPECTIVE_MODELS + FISHEYE_MODELS:
        known = ", ".join(PERSPECTIVE_MODELS + FISHEYE_MODELS)
        raise ValueError(
            f"{where}: camera_model {camera_model!r} is not supported, expected one of {known}; undistort the images "
            "first"
        )
    if camera_model in PERSPECTIVE_MODELS and distortion.get("k4", 0.0) != 0.0:
        k4 = distortion["k4"]
        raise ValueError(
            f"{where}: {camera_model} with k4 = {k4:g}, expected only k1, k2, k3, p1, p2; undistort the images first"
        )


def is_straight(camera_model: str, distortion: dict[str, float]) -> bool:
    """Whether the lens is a pinhole. A fisheye lens never is: without coefficients it is equidistant."""
    return camera_model not in FISHEYE_MODELS and not any(distortion.values())


def undistort(
    image: Float[Tensor, "3 h w"],
    mask: Float[Tensor, "1 h w"],
    camera: Pinholes,
    camera_model: str,
    distortion: dict[str, float],
) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"], Pinholes]:
    """The picture that a pinhole camera of the same pose and size would have taken.

    Args:
        image: colours as the lens bent them.
        mask: 1 = known.
        camera: one camera of the image's size; focal and principal of the lens.
        camera_model: a name of nerfstudio's ``camera_model``.
        distortion: any of k1, k2, k3, k4, p1, p2; missing ones are 0.

    Returns:
        Image, mask, camera. The new focal keeps only what the lens saw (no empty border, up to a pixel's rounding);
        what lies outside the lens's picture, and every pixel that touches an unknown one, is unknown.
    """
    check_lens(camera_model, distortion, "undistort")
    if is_straight(camera_model, distortion):
        return image, mask, camera
    import cv2

    straight = straight_camera(camera, camera_model, distortion)
    to_bent = (_fisheye_map if camera_model in FISHEYE_MODELS else _perspective_map)(
        camera, distortion, _matrix(straight)
    )

    def remapped(channels: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        bent = rearrange(channels, "c h w -> h w c").contiguous().numpy()
        result = cv2.remap(
            bent, *to_bent, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0, 0)
        )
        return rearrange(torch.from_numpy(result), "h w c -> c h w")

    return *wholly_known(image, mask, remapped, least=_WHOLLY_KNOWN), straight


def straight_camera(camera: Pinholes, camera_model: str, distortion: dict[str, float]) -> Pinholes:
    """The camera that :func:`undistort` gives, without a picture."""
    check_lens(camera_model, distortion, "straight_camera")
    if is_straight(camera_model, distortion):
        return camera
    import cv2

    size = (camera.width, camera.height)
    if is_too_wide(camera, camera_model, distortion):
        return _capped(camera, distortion)
    if camera_model in FISHEYE_MODELS:
        lens = _fisheye_lens(distortion)
        matrix = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
            _matrix(camera), lens, size, np.eye(3), balance=0
        )
    else:
        matrix, _ = cv2.getOptimalNewCameraMatrix(_matrix(camera), _perspective_lens(distortion), size, 0)
    values = torch.from_numpy(np.asarray(matrix, dtype=np.float64))
    focal, principal = torch.stack([values[0, 0], values[1, 1]])[None], values[None, :2, 2] + 0.5
    return dataclasses.replace(camera, focal=focal.to(camera.focal), principal=principal.to(camera.principal))


def is_too_wide(camera: Pinholes, camera_model: str, distortion: dict[str, float]) -> bool:
    """Whether a fisheye lens sees so far that a straight picture of all of it would be infinitely large, or nearly
    so.
    """
    return camera_model in FISHEYE_MODELS and max(_side_angles(camera, distortion)) > math.radians(WIDEST_FISHEYE)


def _side_angles(camera: Pinholes, distortion: dict[str, float]) -> tuple[float, float]:
    """Angles off the axis (radians) of the farther of the left and the right side's middle, and of the upper and the
    lower one's.
    """
    (focal_x, focal_y), (center_x, center_y) = camera.focal[0].tolist(), camera.principal[0].tolist()
    bent = [max(center_x, camera.width - center_x) / focal_x, max(center_y, camera.height - center_y) / focal_y]
    across, along = _fisheye_angles(torch.tensor(bent, dtype=torch.float64), distortion).tolist()
    return across, along


def _capped(camera: Pinholes, distortion: dict[str, float]) -> Pinholes:
    """A pinhole camera along the lens's axis with square pixels that sees 70 degrees off it at most, to the middle of a
    side.
    """
    across, along = _side_angles(camera, distortion)
    _say_capped(round(2 * math.degrees(max(across, along))))
    widest = math.radians(_KEPT)
    focal = max(
        side / 2 / math.tan(min(angle, widest)) for side, angle in ((camera.width, across), (camera.height, along))
    )
    middle = [camera.width / 2, camera.height / 2]
    return dataclasses.replace(
        camera, focal=camera.focal.new_full((1, 2), focal), principal=camera.principal.new_tensor([middle])
    )


@lru_cache
def _say_capped(degrees: int) -> None:
    """Once for every lens."""
    _logger.warning(
        "a fisheye lens of %d degrees is straightened to %g degrees; what lies beyond is left out", degrees, 2 * _KEPT
    )


def _fisheye_angles(bent: Float[Tensor, "m"], distortion: dict[str, float]) -> Float[Tensor, "m"]:
    """Angles off the axis (radians) of distances from it on a fisheye's picture of focal length 1; those that the lens
    has no angle for get the largest that it has.
    """
    powers = torch.tensor([1.0, *(distortion.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))], dtype=torch.float64)

    def lens(angles: Tensor) -> Tensor:
        return sum((k * angles ** (2 * power + 1) for power, k in enumerate(powers.tolist())), torch.zeros_like(angles))

    table = torch.linspace(0, math.pi, _TABLE, dtype=torch.float64)
    values = lens(table)
    falls = (values.diff() <= 0).nonzero()
    last = int(falls[0]) if len(falls) else _TABLE - 1
    off_axis = torch.from_numpy(np.interp(bent.double().numpy(), values[: last + 1].numpy(), table[: last + 1].numpy()))
    reached = bent.double().clamp(max=float(values[last]))
    for _ in range(_STEPS):
        slope = sum(
            ((2 * power + 1) * k * off_axis ** (2 * power) for power, k in enumerate(powers.tolist())),
            torch.zeros_like(off_axis),
        )
        off_axis = (off_axis - (lens(off_axis) - reached) / slope.clamp(min=1e-3)).clamp(0, float(table[last]))
    return off_axis


def check_straight(camera: Pinholes, camera_model: str, distortion: dict[str, float], where: str) -> None:
    """Raises ValueError for a lens that no pinhole camera can replace: a calibration that failed. ``where`` opens the
    sentence.

    A lens that exists bends outer rays further outwards than inner ones, over half of the picture at the very least.
    """
    fisheye = camera_model in FISHEYE_MODELS
    reach = torch.linspace(
        0, math.pi / 2 if fisheye else _WIDEST, 2000, dtype=torch.float64
    )  # angles, or tangents of angles
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3")
    bent = reach * (
        1 + sum(distortion.get(name, 0.0) * reach ** (2 * power) for power, name in enumerate(names, start=1))
    )
    falls = (bent.diff() <= 0).nonzero()
    farthest = float(bent[int(falls[0])]) if len(falls) else math.inf
    half = min(camera.width / float(camera.focal[0, 0]), camera.height / float(camera.focal[0, 1])) / 2
    ratio = straight_camera(camera, camera_model, distortion).focal / camera.focal
    if not (farthest >= half / 2 and bool(((ratio > _FOCAL_RATIOS[0]) & (ratio < _FOCAL_RATIOS[1])).all())):
        coefficients = ", ".join(f"{name} = {value:g}" for name, value in distortion.items() if value)
        raise ValueError(
            f"{where}: a lens with {coefficients} bends the picture beyond recognition and cannot be undistorted; "
            "calibrate it again"
        )


def _matrix(camera: Pinholes) -> np.ndarray:
    """K as OpenCV counts pixels: the centre of the first pixel is 0, ours is 0.5."""
    matrix = camera.intrinsics[0].double().numpy().copy()
    matrix[:2, 2] -= 0.5
    return matrix


def _perspective_lens(distortion: dict[str, float]) -> np.ndarray:
    """Brown's model, in OpenCV's order."""
    return np.array([distortion.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])


def _fisheye_lens(distortion: dict[str, float]) -> np.ndarray:
    """The equidistant model with four coefficients."""
    return np.array([distortion.get(name, 0.0) for name in ("k1", "k2", "k3", "k4")])


def _perspective_map(
    camera: Pinholes, distortion: dict[str, float], straight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """For each pixel of the pinhole camera the place in the bent picture."""
    import cv2

    size = (camera.width, camera.height)
    return cv2.initUndistortRectifyMap(
        _matrix(camera), _perspective_lens(distortion), np.eye(3), straight, size, cv2.CV_32FC1
    )


def _fisheye_map(camera: Pinholes, distortion: dict[str, float], straight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Like :func:`_perspective_map`."""
    import cv2

    size = (camera.width, camera.height)
    return cv2.fisheye.initUndistortRectifyMap(
        _matrix(camera), _fisheye_lens(distortion), np.eye(3), straight, size, cv2.CV_32FC1
    )


def straight_directions(
    points: Float[Tensor, "m 2"], camera: Pinholes, camera_model: str, distortion: dict[str, float]
) -> Float[Tensor, "m 3"]:
    """Unit viewing directions, in camera axes, of places in a bent picture (pixels, the first pixel's centre is 0.5,
    0.5).

    Raises ValueError for a lens that cannot be undistorted.
    """
    check_lens(camera_model, distortion, "straight_directions")
    import cv2

    if len(points) == 0:
        return points.new_zeros(0, 3)
    if camera_model in FISHEYE_MODELS:  # OpenCV ends at 90 degrees
        flat = (points.double() - camera.principal.double()) / camera.focal.double()
        length = flat.norm(dim=1)
        angles = _fisheye_angles(length, distortion)
        outwards = flat / length.clamp(min=1e-12)[:, None] * angles.sin()[:, None]
        return torch.cat([outwards, angles.cos()[:, None]], dim=1).to(points.dtype)
    bent = (points.double() - 0.5).numpy()[:, None]
    plane = cv2.undistortPoints(bent, _matrix(camera), _perspective_lens(distortion))
    directions = torch.nn.functional.pad(torch.from_numpy(plane.reshape(-1, 2)), (0, 1), value=1.0)
    return torch.nn.functional.normalize(directions, dim=-1).to(points.dtype)
