"""COLMAP models as COLMAP itself writes them, with features and tracks, for tests: any camera model, text or binary,
rigs beside them.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import torch

from fb_core.data.capture.colmap.reader import CAMERA_MODELS
from fb_core.data.capture.frames import Capture
from fb_core.geometry.rotations import quaternions_of

Camera = tuple[str, int, int, Sequence[float]]
"""Model, width, height, parameters."""
POINTS = [(0.5, -0.25, 1.0, 255, 128, 0), (-1.0, 0.5, 0.25, 0, 64, 255)]


def poses_of(capture: Capture) -> list[tuple[list[float], list[float]]]:
    """World-to-camera quaternion and translation of each frame."""
    rotations = capture.poses[:, :, :3].transpose(1, 2)
    quaternions = quaternions_of(rotations)
    translations = -(rotations @ capture.poses[:, :, 3:])[:, :, 0]
    return [(q.tolist(), t.tolist()) for q, t in zip(quaternions, translations, strict=True)]


def write_model(
    folder: Path, names: Sequence[str], poses: Sequence, cameras: Sequence[Camera], of: Sequence[int], *, text: bool
) -> None:
    """``of`` says which camera (from 0) took which picture."""
    folder.mkdir(parents=True, exist_ok=True)
    (_write_text if text else _write_binary)(folder, names, poses, cameras, of)


def _write_text(
    folder: Path, names: Sequence[str], poses: Sequence, cameras: Sequence[Camera], of: Sequence[int]
) -> None:
    lines = ["# Camera list", "# Number of cameras"]
    lines += [f"{n + 1} {m} {w} {h} {' '.join(map(repr, map(float, p)))}" for n, (m, w, h, p) in enumerate(cameras)]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for number, (name, (q, t), camera) in enumerate(zip(names, poses, of, strict=True), start=1):
        features = (
            "10.5 12.5 1 20.0 3.5 -1" if number % 2 else ""
        )  # COLMAP writes an empty line for a picture without features
        lines += [f"{number} {' '.join(map(repr, [*q, *t]))} {camera + 1} {name}", features]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    lines = [f"{n + 1} {x} {y} {z} {r} {g} {b} 0.5 1 0 2 0" for n, (x, y, z, r, g, b) in enumerate(POINTS)]
    (folder / "points3D.txt").write_text("# 3D point list\n" + "\n".join(lines) + "\n")


def _write_binary(
    folder: Path, names: Sequence[str], poses: Sequence, cameras: Sequence[Camera], of: Sequence[int]
) -> None:
    data = struct.pack("<Q", len(cameras))
    for number, (model, width, height, params) in enumerate(cameras, start=1):
        data += struct.pack("<iiQQ", number, CAMERA_MODELS.index(model), width, height) + struct.pack(
            f"<{len(params)}d", *params
        )
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(names))
    for number, (name, (q, t), camera) in enumerate(zip(names, poses, of, strict=True), start=1):
        data += struct.pack("<i7di", number, *q, *t, camera + 1) + name.encode() + b"\0"
        features = number % 2
        data += struct.pack("<Q", features) + struct.pack("<ddq", 10.5, 12.5, 1) * features
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(POINTS))
    for number, point in enumerate(POINTS, start=1):
        data += struct.pack("<Q3d3BdQ", number, *point, 0.5, 2) + struct.pack("<4i", 1, 0, 2, 0)
    (folder / "points3D.bin").write_bytes(data)


def colmap_capture(
    folder: Path, capture: Capture, *, text: bool = False, place: str = "sparse/0", pictures: str = "images"
) -> Path:
    """The pictures of a capture with a COLMAP model of their PINHOLE cameras."""
    (folder / pictures).mkdir(parents=True)
    names = [frame.image_path.name for frame in capture.frames]
    for frame in capture.frames:
        (folder / pictures / frame.image_path.name).write_bytes(frame.image_path.read_bytes())
    cameras: list[Camera] = []
    for frame in capture.frames:
        camera = frame.camera
        params = torch.cat([camera.focal[0], camera.principal[0]]).tolist()
        cameras.append(("PINHOLE", camera.width, camera.height, params))
    write_model(folder / place, names, poses_of(capture), cameras, range(len(names)), text=text)
    return folder
