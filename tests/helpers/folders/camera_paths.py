"""A camera path as nerfstudio's viewer saves it."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from helpers.scenes.completions import UP

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import flip_axes


def write_path(file: Path, count: int = 7, *, width: int = 64, height: int = 36, fov: float = 50.0, **changes) -> Path:
    """A path as nerfstudio's viewer saves it, out through the wall of the room."""
    centers = torch.stack([torch.linspace(0, 9, count), torch.zeros(count), torch.zeros(count)], dim=1)
    cameras = Pinholes.looking_at(
        centers, centers + torch.tensor([0.0, 1.0, 0.2]), up=UP, fov_degrees=60.0, width=4, height=4
    )
    poses = flip_axes(cameras.camera_to_world)
    entries = [
        {"camera_to_world": [*pose.flatten().tolist(), 0, 0, 0, 1], "fov": fov, "aspect": width / height}
        for pose in poses
    ]
    content = {
        "camera_type": "perspective",
        "render_height": height,
        "render_width": width,
        "camera_path": entries,
        "fps": 24,
        "seconds": 4,
    }
    file.write_text(json.dumps(content | changes))
    return file
