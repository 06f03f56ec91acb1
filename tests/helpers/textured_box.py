"""Photos of a box from inside whose walls carry noise in 3D: enough features to find cameras by, exact by
construction.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
import torch.nn.functional as F

from fb_core.data import media
from fb_core.geometry.cameras import Pinholes

HALF = 3.0
UP = torch.tensor([0.0, 0.0, 1.0])


def render(cameras: Pinholes) -> torch.Tensor:
    """Pictures [n, 3, h, w]."""
    generator = torch.Generator().manual_seed(5)
    volumes = [torch.rand(1, 3, cells, cells, cells, generator=generator) for cells in (12, 40, 90)]
    directions, centers = cameras.directions(), cameras.centers[:, None, None]
    distance = ((directions.sign() * HALF - centers) / directions).amin(dim=-1, keepdim=True)
    places = ((centers + distance * directions) / HALF * 0.98)[:, None]
    looked_up = [
        F.grid_sample(volume.expand(len(cameras), -1, -1, -1, -1), places, align_corners=True)[:, :, 0]
        for volume in volumes
    ]
    return (0.4 * looked_up[0] + 0.35 * looked_up[1] + 0.25 * looked_up[2]).clamp(0, 1)


def cameras_on_an_arc(count: int, *, width: int = 160, height: int = 120, degrees: float = 50.0) -> Pinholes:
    """Cameras that look at one wall and its corners from places apart."""
    angles = torch.linspace(-0.5, 0.5, count) * math.radians(degrees)
    centers = torch.stack([2.2 * angles.sin(), 1.2 - 2.2 * angles.cos(), 0.3 * (3 * angles).sin()], dim=1)
    targets = torch.tensor([[0.0, 2.5, 0.2]]).expand(count, 3)
    return Pinholes.looking_at(centers, targets, up=UP, fov_degrees=75.0, width=width, height=height)


def save_photos(folder: Path, cameras: Pinholes, *, name: str = "photo", suffix: str = ".png") -> Path:
    """Writes the cameras' pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, picture in enumerate(render(cameras)):
        media.write_image(folder / f"{name}_{index:03d}{suffix}", picture)
    return folder
