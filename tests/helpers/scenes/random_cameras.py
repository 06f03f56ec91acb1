"""Seeded cameras anywhere, for tests of geometry."""

from __future__ import annotations

import torch

from fb_core.geometry.cameras import Pinholes


def random_rotations(count: int, generator: torch.Generator) -> torch.Tensor:
    matrix = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)).Q
    return matrix * torch.linalg.det(matrix)[:, None, None].sign()


def random_cameras(seed: int = 0, count: int = 3, *, scale: float = 1.0, width: int = 7, height: int = 5) -> Pinholes:
    """Cameras anywhere, turned anyhow, with unequal focal lengths and an off-centre principal point (float64)."""
    generator = torch.Generator().manual_seed(seed)
    rotations = random_rotations(count, generator)
    centers = scale * torch.randn(count, 3, 1, generator=generator, dtype=torch.float64)
    wide = torch.tensor([width, height], dtype=torch.float64)
    return Pinholes(
        camera_to_world=torch.cat([rotations, centers], dim=2),
        focal=wide * (0.4 + torch.rand(count, 2, generator=generator, dtype=torch.float64)),
        principal=wide * (0.3 + 0.4 * torch.rand(count, 2, generator=generator, dtype=torch.float64)),
        width=width,
        height=height,
    )
