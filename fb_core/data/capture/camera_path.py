"""A person's camera path, as nerfstudio's viewer saves it (Render tab), as the views to generate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from fb_core.files.json_files import read_json
from fb_core.files.limits import MOST_VIEWS
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import flip_axes

_LEAST_DEGREES, _MOST_DEGREES = 1.0, 170.0
_MOST_BYTES = 2**26  # of a file: 6 KiB for each of the most cameras
_ORTHONORMAL = 1e-3  # most that a rotation's columns may be off


@dataclass(frozen=True, kw_only=True)
class CameraPath:
    """The path's cameras as square pictures in which the path's own pictures stand centred, their long side filling the
    square's.
    """

    cameras: Pinholes
    """OpenCV axes, in the world of the file (that of the splats where it was drawn beside them), exactly where the path
    puts them.
    """
    aspect: float
    """Width over height of the path's pictures."""


def read_camera_path(path: Path, *, size: int) -> CameraPath:
    """Read a camera path that was saved in nerfstudio's viewer.

    Its poses are camera-to-world with OpenGL axes; ``fov`` is the vertical field of view in degrees of
    a picture of ``render_width`` by ``render_height``.

    Args:
        path: the JSON file.
        size: side of the square pictures in pixels.

    Raises:
        ValueError: one sentence, for a missing file, another tool's format, another lens, and impossible poses or
            fields of view.
    """
    content = _load(path)
    width, height = (_positive(content, key, path) for key in ("render_width", "render_height"))
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise ValueError(f"camera path {path}: expected camera_type perspective, got {kind!r}; save a perspective path")
    entries = content["camera_path"]
    if not isinstance(entries, list) or not entries:
        raise ValueError(
            f"camera path {path}: it has no cameras; add keyframes in the viewer's Render tab and save it again"
        )
    if len(entries) > MOST_VIEWS:
        raise ValueError(
            f"camera path {path}: expected at most {MOST_VIEWS} cameras, got {len(entries)}; save it with fewer per "
            "second"
        )
    poses = torch.stack([_pose(entry, index, path) for index, entry in enumerate(entries)])
    degrees = torch.tensor(
        [_field_of_view(entry, index, path) for index, entry in enumerate(entries)], dtype=torch.float64
    )
    focal = 0.5 * height / torch.tan(torch.deg2rad(degrees) / 2) * size / max(width, height)
    cameras = Pinholes(
        camera_to_world=flip_axes(poses).float(),
        focal=focal[:, None].expand(-1, 2).float().contiguous(),
        principal=torch.full((len(entries), 2), size / 2),
        width=size,
        height=size,
    )
    return CameraPath(cameras=cameras, aspect=width / height)


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise ValueError(f"camera path {path}: no such file; save a path in the viewer's Render tab, or check the name")
    try:
        content = read_json(path, most_bytes=_MOST_BYTES)
    except ValueError as error:
        raise ValueError(
            f"camera path {path}: not a JSON file of a path ({error}); save one in the viewer's Render tab"
        ) from None
    needed = ("camera_path", "render_width", "render_height")
    if not isinstance(content, dict) or any(key not in content for key in needed):
        got = (
            f"the keys {', '.join(sorted(map(str, content))[:6]) or 'none'}"
            if isinstance(content, dict)
            else type(content).__name__
        )
        raise ValueError(
            f"camera path {path}: expected a path of nerfstudio's viewer with {', '.join(needed)}, got {got}; "
            "it is another tool's, so draw the path in the viewer's Render tab and save it there"
        )
    return content


def _positive(content: dict[str, Any], key: str, path: Path) -> float:
    value = content[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not 1 <= value < 1e6:
        raise ValueError(
            f"camera path {path}: expected a number of pixels for {key}, got {value!r}; save the path again"
        )
    return float(value)


def _pose(entry: Any, index: int, path: Path) -> torch.Tensor:
    """Camera-to-world [3, 4] in float64, OpenGL axes."""
    where = f"camera path {path}: camera {index}"
    values = entry.get("camera_to_world") if isinstance(entry, dict) else None
    if isinstance(values, list) and len(values) == 4:
        values = [value for row in values for value in (row if isinstance(row, list) else [row])]
    numbers = isinstance(values, list) and len(values) == 16 and all(isinstance(value, int | float) for value in values)
    if not numbers:
        raise ValueError(
            f"{where} has no camera_to_world of 16 numbers; it is another tool's path, save one in nerfstudio's viewer"
        )
    pose = torch.tensor(values, dtype=torch.float64).reshape(4, 4)[:3]
    scale = torch.linalg.det(pose[:, :3]).clamp(min=0) ** (1 / 3)
    if (
        bool(scale.isfinite()) and float(scale) > 0
    ):  # Blender's add-on writes the scale of a scaled scene into the rotation
        pose[:, :3] /= scale
    rotation = pose[:, :3]
    upright = (
        bool(torch.isfinite(pose).all())
        and float((rotation.T @ rotation - torch.eye(3).double()).abs().max()) < _ORTHONORMAL
    )
    if not upright or float(torch.linalg.det(rotation)) < 0:
        raise ValueError(f"{where}: its camera_to_world is no rotation and place; save the path again")
    return pose


def _field_of_view(entry: dict[str, Any], index: int, path: Path) -> float:
    value = entry.get("fov")
    if isinstance(value, bool) or not isinstance(value, int | float) or not _LEAST_DEGREES <= value <= _MOST_DEGREES:
        raise ValueError(
            f"camera path {path}: camera {index} has a field of view (fov) of {value!r}, expected "
            f"{_LEAST_DEGREES:g} to {_MOST_DEGREES:g} degrees"
        )
    return float(value)


def as_camera_path(cameras: Pinholes) -> dict[str, Any]:
    """Cameras as nerfstudio's viewer saves a path, for :func:`read_camera_path`."""
    poses = flip_axes(cameras.camera_to_world)
    corner = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=poses.dtype)
    degrees = torch.rad2deg(2 * torch.atan(cameras.height / 2 / cameras.focal[:, 1]))
    return {
        "camera_type": "perspective",
        "render_width": cameras.width,
        "render_height": cameras.height,
        "camera_path": [
            {
                "camera_to_world": torch.cat([pose, corner]).flatten().tolist(),
                "fov": float(fov),
                "aspect": cameras.width / cameras.height,
            }
            for pose, fov in zip(poses, degrees, strict=True)
        ],
    }
