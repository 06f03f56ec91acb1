"""Recovered cameras in any world, with their covariances."""

import torch

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.similarity import Similarity, nearest_rotations


def each(cameras: Pinholes) -> list[Pinholes]:
    return [cameras[index] for index in range(len(cameras))]


def anywhere(seed: int, scale: float = 3.0) -> Similarity:
    generator = torch.Generator().manual_seed(seed)
    rotation = nearest_rotations(torch.randn(1, 3, 3, generator=generator, dtype=torch.float64))[0]
    return Similarity(rotation=rotation, scale=scale, shift=torch.randn(3, generator=generator, dtype=torch.float64))
