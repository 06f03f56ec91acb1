"""A hall with cameras whose places are held exactly, near and far."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
FAR = (3e3, 1e5, 1e6)
# Places are whole eighths: float32 holds them exactly as far as two million units off, so that a moved world is the
# same world
LATTICE = 8


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def away(far: float) -> Tensor:
    return torch.tensor([far, -0.5 * far, 0.25 * far], dtype=torch.float64).round()


def on_lattice(places: Tensor) -> Tensor:
    return (places * LATTICE).round() / LATTICE


def room(count: int = 10, *, inward: bool = False) -> Pinholes:
    """Cameras in a hall of 40 units that look out, or on a ring that look in; float64, places on the lattice."""
    angle = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count * (1.0 if inward else 0.6)
    jitter = torch.randn(count, 3, generator=seeded(), dtype=torch.float64)
    outward = torch.stack([angle.cos(), angle.sin(), 0.1 * jitter[:, 2]], dim=1)
    centers = on_lattice(
        12 * outward + jitter if inward else 4 * jitter * torch.tensor([1.0, 1.0, 0.3], dtype=torch.float64)
    )
    targets = torch.zeros_like(centers) if inward else centers + outward
    return Pinholes.looking_at(centers, targets, up=UP, fov_degrees=65.0, width=32, height=24)


def single(cameras: Pinholes) -> list[Pinholes]:
    return [cameras[index] for index in range(len(cameras))]
