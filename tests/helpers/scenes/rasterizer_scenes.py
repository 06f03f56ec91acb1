"""Seeded scenes and comparisons that the rasterizer tests share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def look_at(eye: tuple[float, float, float], target=(0.0, 0.0, 0.0), dtype=torch.float64) -> Tensor:
    """World to camera, OpenCV axes, world z up."""
    eye, target = torch.tensor(eye, dtype=dtype), torch.tensor(target, dtype=dtype)
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=dtype)), dim=0
    )
    viewmat = torch.eye(4, dtype=dtype)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


def scene(
    n: int = 40,
    cameras: int = 1,
    width: int = 37,
    height: int = 29,
    channels: int = 3,
    seed: int = 0,
    dtype=torch.float64,
) -> dict:
    """A cloud around the origin seen from a ring, with an off-centre principal point."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=dtype)

    eyes = [(3.0 * math.cos(0.8 * k), 3.0 * math.sin(0.8 * k), 0.7 - 0.2 * k) for k in range(cameras)]
    K = torch.tensor([[1.1 * width, 0, 0.47 * width], [0, 1.2 * width, 0.55 * height], [0, 0, 1]], dtype=dtype)
    return dict(
        means=0.7 * normal(n, 3),
        quats=normal(n, 4),
        scales=0.15 * torch.exp(0.6 * normal(n, 3)),
        opacities=torch.sigmoid(1.5 * normal(n)),
        colors=torch.rand(n, channels, generator=g, dtype=dtype),
        viewmats=torch.stack([look_at(eye, dtype=dtype) for eye in eyes]),
        Ks=K.expand(cameras, 3, 3).contiguous(),
        width=width,
        height=height,
    )


def with_gradients(inputs: dict, names=INPUTS) -> dict:
    return {name: value.detach().clone().requires_grad_() if name in names else value for name, value in inputs.items()}


def relative(got: Tensor, expected: Tensor) -> float:
    got, expected = got.detach().double(), expected.detach().double()
    return float((got - expected).norm() / expected.norm().clamp(min=1e-12))


def backward(images: Tensor, alphas: Tensor, seed: int = 1) -> None:
    g = torch.Generator().manual_seed(seed)
    weights = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t.dtype) for t in (images, alphas)]
    ((images * weights[0]).sum() + (alphas * weights[1]).sum()).backward()
