"""COLMAP's sparse models: cameras, images and points, as text and as the same numbers in binary files.

COLMAP's axes are ours (x right, y down, z forward), and so are its pixels: the centre of the first one is (0.5, 0.5).
Only the direction of the pose changes: COLMAP stores world-to-camera, as a unit quaternion (w first) and a translation.
Source of both formats: COLMAP's documentation, "Output Format".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fb_core.data.capture.point_cloud import Points
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import quaternions_of, rotations_of
from fb_core.geometry.similarity import nearest_rotations

_PINHOLE_ID, _PINHOLE_NAME = 1, "PINHOLE"


@dataclass(frozen=True, kw_only=True)
class ColmapImage:
    """One picture of a model."""

    name: str
    """File name relative to the folder of the pictures, without blanks."""
    camera: Pinholes
    """One undistorted camera."""


def write_colmap(folder: Path, images: Sequence[ColmapImage], points: Points) -> None:
    """Writes cameras, images and points3D (each .txt and .bin) into a folder that is made; images are numbered from 1
    in their order.

    Pictures of equal intrinsics share a camera. Doubles keep every bit in both formats. A rotation that is not quite
    one becomes the nearest; centres stay. Points have no tracks. Raises ValueError for names with blanks, which the
    text format cannot hold.
    """
    for image in images:
        if not image.name or len(image.name.split()) != 1 or len(image.camera) != 1:
            raise ValueError(
                f"write_colmap: expected one camera and a name without blanks for each picture, got {image.name!r}; "
                "rename it"
            )
    folder.mkdir(parents=True, exist_ok=True)
    cameras: dict[tuple, int] = {}
    numbers = [cameras.setdefault(_intrinsics(image.camera), len(cameras) + 1) for image in images]
    poses = [_world_to_camera(image.camera) for image in images]
    _write_cameras(folder, {number: intrinsics for intrinsics, number in cameras.items()})
    _write_images(folder, [image.name for image in images], numbers, poses)
    _write_points(folder, points)


def _intrinsics(camera: Pinholes) -> tuple:
    """Width, height, fx, fy, cx, cy."""
    return (camera.width, camera.height, *camera.focal[0].double().tolist(), *camera.principal[0].double().tolist())


def _world_to_camera(camera: Pinholes) -> list[float]:
    """Quaternion and translation; the translation belongs to the quaternion's own rotation, so that the centre is
    kept.
    """
    quaternion = quaternions_of(nearest_rotations(camera.rotations.double().transpose(1, 2)))
    translation = -(rotations_of(quaternion) @ camera.centers.double()[:, :, None])[0, :, 0]
    return [*quaternion[0].tolist(), *translation.tolist()]


def _write_cameras(folder: Path, cameras: dict[int, tuple]) -> None:
    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    blocks = [struct.pack("<Q", len(cameras))]
    for number, (width, height, *params) in cameras.items():
        lines.append(f"{number} {_PINHOLE_NAME} {width} {height} {_numbers(params)}")
        blocks.append(struct.pack("<iiQQ4d", number, _PINHOLE_ID, width, height, *params))
    _write(folder / "cameras", lines, blocks)


def _write_images(folder: Path, names: list[str], cameras: list[int], poses: list[list[float]]) -> None:
    lines = [
        "# Image list with two lines of data per image:",
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "#   POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    blocks = [struct.pack("<Q", len(names))]
    for number, (name, camera, pose) in enumerate(zip(names, cameras, poses, strict=True), start=1):
        lines += [f"{number} {_numbers(pose)} {camera} {name}", ""]
        blocks.append(struct.pack("<i7di", number, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", 0))
    _write(folder / "images", lines, blocks)


def _write_points(folder: Path, points: Points) -> None:
    lines = [
        "# 3D point list with one line of data per point:",
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    colors = (points.colors.double().clamp(0, 1) * 255).round().int().tolist()
    blocks = [struct.pack("<Q", len(points))]
    for number, (position, color) in enumerate(zip(points.positions.double().tolist(), colors, strict=True), start=1):
        lines.append(f"{number} {_numbers(position)} {' '.join(map(str, color))} 0.0")
        blocks.append(struct.pack("<Q3d3BdQ", number, *position, *color, 0.0, 0))
    _write(folder / "points3D", lines, blocks)


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))  # the shortest text that reads back to the same bits


def _write(stem: Path, lines: list[str], blocks: list[bytes]) -> None:
    stem.with_suffix(".txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    stem.with_suffix(".bin").write_bytes(b"".join(blocks))
