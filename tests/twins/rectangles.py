"""The readable twin of the training's masks: one rectangle at a time."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def rotated_rectangle(
    height: int, width: int, *, center: tuple[float, float], size: tuple[float, float], angle_radians: float
) -> Tensor:
    """1 inside a rotated rectangle, 0 outside, tested at the pixel centres; center (y, x) and size (h, w) in pixels.
    Shape [h, w].
    """
    y, x = torch.meshgrid(torch.arange(height) + 0.5 - center[0], torch.arange(width) + 0.5 - center[1], indexing="ij")
    along = x * math.cos(angle_radians) + y * math.sin(angle_radians)
    across = -x * math.sin(angle_radians) + y * math.cos(angle_radians)
    return ((along.abs() <= size[1] / 2) & (across.abs() <= size[0] / 2)).float()


def partly_known_slowly(height: int, width: int, generator: torch.Generator) -> Tensor:
    """`fb_core.masks.partly_known` from the same draws: 0 in any of 2 to 10 rectangles of 10 to 50 % of the sides."""
    known = torch.ones(height, width)
    for _ in range(int(torch.randint(2, 11, (), generator=generator))):
        size_y, size_x, y, x, turn = torch.rand(5, generator=generator).double().tolist()
        size = ((0.1 + 0.4 * size_y) * height, (0.1 + 0.4 * size_x) * width)
        angle = 2 * math.pi * turn
        known -= rotated_rectangle(height, width, center=(y * height, x * width), size=size, angle_radians=angle)
    return known.clamp(0, 1)[None]
