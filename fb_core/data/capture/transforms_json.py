"""The numbers of a transforms.json: JSON objects to cameras and back, every fault told in one sentence.

Here OpenGL axes (x right, y up, z backward) become OpenCV axes (x right, y down, z forward) and the reverse.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.undistort import FISHEYE_MODELS, PERSPECTIVE_MODELS
from fb_core.files.json_files import read_json
from fb_core.files.limits import is_finite
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import flip_axes

JSON_NAME = "transforms.json"
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
INTRINSIC_KEYS = (
    *("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y"),
    *(*DISTORTION_KEYS, "camera_model", "is_fisheye"),
)
_SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG", ".webp", ".tif", ".tiff", ".exr")
_BLANK = 64  # bytes of a file that may be nothing but white space
_LAST_ROW_TOLERANCE = 1e-5  # what tools that compute in single precision leave of 0 0 0 1
_ROTATION_TOLERANCE = 1e-3  # an error of that size moves a pixel by one at a focal of 1000


def load_transforms(path: Path) -> dict[str, Any]:
    """The JSON object in a file. Raises ValueError for a file that is empty, no JSON, or no object with frames."""
    if path.stat().st_size <= _BLANK and not path.read_bytes().strip():
        raise ValueError(f"capture {path}: the file is empty; process the pictures again")
    try:
        meta = read_json(path)
    except ValueError as error:
        raise ValueError(f"capture {path}: not a JSON file ({error}); process the pictures again") from error
    if not isinstance(meta, dict):
        raise ValueError(
            f"capture {path}: expected a JSON object with 'frames', got a {type(meta).__name__}; process the pictures "
            "again"
        )
    return meta


def camera_from(where: str, image_path: Path, entry: dict[str, Any], shared: dict[str, Any]) -> Pinholes:
    """One float64 camera with OpenCV axes.

    Args:
        where: opens the sentence of an error.
        image_path: asked for its size where the file does not tell w and h.
        entry: the frame's object.
        shared: the whole file's object; its intrinsics win over the frame's, as in nerfstudio.

    Raises ValueError for missing intrinsics and for ones that no camera has.
    """
    values = {**entry, **shared}
    if "w" in values and "h" in values:
        width, height = finite_number(where, values, "w"), finite_number(where, values, "h")
        if min(width, height) < 1 or width % 1 or height % 1:
            raise ValueError(
                f"{where}: expected w and h in whole pixels, at least 1, got {width:g} and {height:g}; correct the file"
            )
    else:
        height, width = media.posed_size(image_path)
    focal_x = _focal(where, values, "fl_x", "camera_angle_x", width)
    if focal_x is None:
        raise ValueError(
            f"{where}: intrinsics are missing, expected fl_x (pixels) or camera_angle_x (radians); process the "
            "pictures again"
        )
    focal_y = _focal(where, values, "fl_y", "camera_angle_y", height)
    focal = (focal_x, focal_x if focal_y is None else focal_y)
    if min(focal) <= 0:
        raise ValueError(
            f"{where}: expected focal lengths above 0 pixels, got {focal[0]:g} and {focal[1]:g}; correct the file"
        )
    center_x = finite_number(where, values, "cx") if "cx" in values else width / 2
    center_y = finite_number(where, values, "cy") if "cy" in values else height / 2
    return Pinholes(
        camera_to_world=flip_axes(checked_pose(where, entry.get("transform_matrix")))[None],
        focal=torch.tensor([focal], dtype=torch.float64),
        principal=torch.tensor([[center_x, center_y]], dtype=torch.float64),
        width=int(width),
        height=int(height),
    )


def camera_entry(camera: Pinholes) -> dict[str, Any]:
    """The JSON keys of one camera: the exact inverse of :func:`camera_from` for float64 (and exact for float32)
    cameras.
    """
    (focal_x, focal_y), (center_x, center_y) = camera.focal[0].tolist(), camera.principal[0].tolist()
    pose = [*flip_axes(camera.camera_to_world[0].double()).tolist(), [0.0, 0.0, 0.0, 1.0]]
    intrinsics = {
        "fl_x": focal_x,
        "fl_y": focal_y,
        "cx": center_x,
        "cy": center_y,
        "w": camera.width,
        "h": camera.height,
    }
    return {**intrinsics, "transform_matrix": pose}


def with_suffix(path: Path) -> Path:
    """The file itself, or, for a name without a suffix as Blender's tools write it, the picture of that name."""
    if path.suffix or path.exists():
        return path
    return next((named for suffix in _SUFFIXES if (named := path.with_name(path.name + suffix)).exists()), path)


def listed_lens(where: str, values: dict[str, Any]) -> dict[str, Any]:
    """The same keys with nerfstudio's list of coefficients, if there is one, spread over k1, k2, k3, k4, p1, p2.

    Raises ValueError for a list of another length, or of other things than numbers.
    """
    listed = values.get("distortion_params")
    if listed is None or values.get("camera_model", "OPENCV") not in (*PERSPECTIVE_MODELS, *FISHEYE_MODELS):
        return values  # models that are not supported have lists of their own
    if not isinstance(listed, list) or len(listed) != len(DISTORTION_KEYS):
        raise ValueError(
            f"{where}: expected distortion_params as six numbers k1, k2, k3, k4, p1, p2, got {str(listed)[:60]}; "
            "correct the file"
        )
    return {**values, **dict(zip(DISTORTION_KEYS, listed, strict=True))}


def model_of(entry: dict[str, Any], shared: dict[str, Any]) -> str:
    """The lens model's name; instant-ngp's ``is_fisheye`` says it, too."""
    fisheye = shared.get("is_fisheye", entry.get("is_fisheye", False)) is True
    return str(shared.get("camera_model", entry.get("camera_model", "OPENCV_FISHEYE" if fisheye else "OPENCV")))


def to_json(meta: dict[str, Any], where: str) -> str:
    """The text of a JSON file; doubles keep every bit. Raises ValueError for extras that are no plain finite JSON
    values.
    """
    try:
        return json.dumps(meta, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{where}: extras must be plain finite JSON values ({error}); convert tensors with tolist()"
        ) from error


def _focal(where: str, values: dict[str, Any], name: str, angle_name: str, length: float) -> float | None:
    if name in values:
        return finite_number(where, values, name)
    if angle_name not in values:
        return None
    angle = finite_number(where, values, angle_name)
    if not 0 < angle < math.pi:
        raise ValueError(f"{where}: expected {angle_name} between 0 and pi radians, got {angle:g}; correct the file")
    return 0.5 * length / math.tan(angle / 2)


def finite_number(where: str, values: dict[str, Any], key: str) -> float:
    """``values[key]`` as a float. Raises ValueError for anything else."""
    value = values[key]
    if not is_finite(value):
        raise ValueError(f"{where}: expected a finite number for {key}, got {value!r}; correct the file")
    return float(value)


def checked_pose(where: str, matrix: Any) -> Float[Tensor, "3 4"]:
    """The OpenGL camera-to-world matrix as it stands in the file, once it is known to be a rigid motion. Raises
    ValueError for anything else, NaN and mirrors included.
    """
    try:
        pose = torch.tensor(matrix, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        pose = torch.empty(0)
    if tuple(pose.shape) not in ((4, 4), (3, 4)):
        raise ValueError(
            f"{where}: expected transform_matrix as 4 x 4 (or 3 x 4) numbers, got {str(matrix)[:60]}; correct the file"
        )
    if not bool(torch.isfinite(pose).all()):
        raise ValueError(
            f"{where}: the pose (transform_matrix) holds NaN or infinity, expected finite numbers; remove the frame"
        )
    if len(pose) == 4 and float((pose[3] - pose.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().max()) > _LAST_ROW_TOLERANCE:
        raise ValueError(
            f"{where}: expected 0 0 0 1 as the pose's (transform_matrix) last row, got {pose[3].tolist()}; correct "
            "the file"
        )
    rotation = pose[:3, :3]
    error = float((rotation.T @ rotation - torch.eye(3, dtype=torch.float64)).abs().max())
    determinant = float(torch.linalg.det(rotation))
    if error > _ROTATION_TOLERANCE or determinant < 0:
        kind = "singular" if abs(determinant) < 1e-9 else "mirrored" if determinant < 0 else "scaled or sheared"
        raise ValueError(
            f"{where}: the pose (transform_matrix) is {kind} (determinant {determinant:.4g}), expected a rotation and "
            "a position; "
            "remove the frame or process the pictures again"
        )
    return pose[:3]
