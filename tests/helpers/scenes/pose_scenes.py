"""Cameras and damaged raymaps for the tests of camera recovery."""

from __future__ import annotations

import math

import torch
from helpers.scenes.random_cameras import random_rotations

from fb_core.geometry.cameras import Pinholes


def scattered(
    count: int,
    *,
    width: int,
    height: int,
    seed: int = 0,
    fov_degrees: tuple[float, float] = (40.0, 70.0),
    scale: float = 1.0,
) -> Pinholes:
    """Cameras anywhere in a cube, turned anyhow, with square pixels, centred, and a field of view between the two
    angles (float64).
    """
    generator = torch.Generator().manual_seed(seed)
    least, most = fov_degrees
    angles = torch.deg2rad(least + (most - least) * torch.rand(count, 1, generator=generator, dtype=torch.float64))
    centers = scale * (torch.rand(count, 3, 1, generator=generator, dtype=torch.float64) * 2 - 1)
    return Pinholes(
        camera_to_world=torch.cat([random_rotations(count, generator), centers], dim=2),
        focal=(width / 2 / torch.tan(angles / 2)).expand(-1, 2).clone(),
        principal=torch.tensor([width / 2, height / 2], dtype=torch.float64).repeat(count, 1),
        width=width,
        height=height,
    )


def smaller(count: int = 1) -> Pinholes:
    return scattered(count, width=12, height=10)


def spoiled(
    raymaps: torch.Tensor, *, degrees: float, origins: float, outliers: float, generator: torch.Generator
) -> torch.Tensor:
    """Noise on directions (degrees) and origins, and a block at the top left that belongs to another camera."""

    def noise(like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=generator, dtype=like.dtype)

    found = raymaps.clone()
    found[:, :3] += origins * noise(found[:, :3])
    found[:, 3:] = torch.nn.functional.normalize(found[:, 3:] + math.radians(degrees) * noise(found[:, 3:]), dim=1)
    height, width = (round(side * math.sqrt(outliers)) for side in found.shape[-2:])
    turn = random_rotations(len(found), generator).to(found)
    found[:, 3:, :height, :width] = torch.einsum("nij,njhw->nihw", turn, found[:, 3:, :height, :width])
    found[:, :3, :height, :width] += 0.5
    return found


def rotation_degrees(found: Pinholes, truth: Pinholes) -> torch.Tensor:
    """Angle between the cameras' rotations, exact for small ones."""
    turn = found.rotations.double().transpose(1, 2) @ truth.rotations.double()
    axis = torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], dim=1
    )
    return torch.rad2deg(torch.atan2(axis.norm(dim=1), turn.diagonal(dim1=1, dim2=2).sum(dim=1) - 1))
