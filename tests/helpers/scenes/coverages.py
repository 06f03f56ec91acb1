"""Options and turns of cameras for tests of what a capture shows."""

from __future__ import annotations

import math

import torch

from fb_core.completion.options import CompletionConfig
from fb_core.geometry.cameras import Pinholes

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


AUTO = CompletionConfig(context_views=4)


def turning(
    count: int, *, first: float = 0.0, last: float = 2 * math.pi, pitch: float = 0.0, fov: float = 70.0
) -> list[Pinholes]:
    """Cameras in the middle of a room that look all round, or over a part of the way."""
    angle = torch.linspace(first, last, count + 1, dtype=torch.float64)[:-1]
    looks = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, math.tan(pitch))], dim=1)
    centers = 0.2 * torch.stack([angle.sin(), angle.cos(), 0 * angle], dim=1)
    both = Pinholes.looking_at(centers, centers + looks, up=UP, fov_degrees=fov, width=16, height=16)
    return [both[index] for index in range(count)]
