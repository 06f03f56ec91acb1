"""Depth maps of planes, in closed form."""

from __future__ import annotations

import torch

from fb_core.geometry.cameras import Pinholes


def camera(height: int = 24, width: int = 32, focal: tuple[float, float] = (30.0, 33.0)) -> Pinholes:
    return Pinholes(
        camera_to_world=torch.eye(4, dtype=torch.float64)[None, :3],
        focal=torch.tensor([focal], dtype=torch.float64),
        principal=torch.tensor([[width / 2 + 0.7, height / 2 - 1.3]], dtype=torch.float64),
        width=width,
        height=height,
    )


def plane_depth(cameras: Pinholes, normal: torch.Tensor, offset: float) -> torch.Tensor:
    """z-depth of the plane ``normal . x = offset`` in camera coordinates."""
    rays = (cameras.pixel_centers() - cameras.principal[0]) / cameras.focal[0]
    rays = torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1)
    return (offset / (rays @ normal))[None]
