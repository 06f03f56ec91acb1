"""One way of drawing a scene with its gradients, and the seconds that it takes."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from method_configs.benchmarks.splats.scenes import SplatScene

Draw = Callable[..., tuple[Tensor, Tensor]]
"""Pictures and alphas of a scene's inputs."""


def loss_of(images: Tensor, alphas: Tensor) -> Tensor:
    """Some fixed direction in the space of pictures."""
    generator = torch.Generator().manual_seed(0)
    weights = [torch.randn(part.shape, generator=generator).to(part) for part in (images, alphas)]
    return (images * weights[0]).sum() + (alphas * weights[1]).sum()


def seconds_of(draw: Draw, scene: SplatScene, clock: Callable[[], float] = time.process_time) -> tuple[float, float]:
    """Seconds of forward, and of forward and backward without the loss between them; by default of the CPU."""
    inputs = scene.inputs(gradients=True)
    begin = clock()
    images, alphas = draw(**inputs)
    middle = clock()
    loss = loss_of(images, alphas)
    again = clock()
    loss.backward()
    end = clock()
    return middle - begin, (middle - begin) + (end - again)
