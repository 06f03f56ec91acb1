"""Cameras and their world, moved by a similarity."""

from __future__ import annotations

import torch

from fb_core.geometry.cameras import Pinholes


def moved(
    cameras: Pinholes, *, scale: float = 1.0, turn: torch.Tensor | None = None, shift: torch.Tensor | None = None
) -> Pinholes:
    """The cameras after x -> scale * turn x + shift."""
    turn = torch.eye(3, dtype=torch.float64) if turn is None else turn
    centers = scale * cameras.centers @ turn.T + (0 if shift is None else shift)
    pose = torch.cat([turn @ cameras.rotations, centers[..., None]], dim=2)
    return Pinholes(
        camera_to_world=pose,
        focal=cameras.focal,
        principal=cameras.principal,
        width=cameras.width,
        height=cameras.height,
    )
