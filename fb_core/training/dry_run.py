"""What a training would cost on this machine: a few real steps of a stage, nothing written."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from fb_core.machine.precision import resolved
from fb_core.memory.live_bytes import LiveBytes
from fb_core.training.recipe import Recipe, make_stage
from fb_core.training.run.distributed import ALONE, Group, own_part
from fb_core.training.run.loop import Run
from fb_core.training.run.options import EngineConfig

_MANY = 10**9


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a stage costs on this machine, per process."""

    parameters: dict[str, int]
    """Of each network."""
    weight_bytes: int
    """Networks and the average of the weights."""
    step_bytes: int
    """Most that a step holds beside them: gradients, activations, data, and the optimiser's states."""
    steps_per_second: float
    """Measured, data included."""
    data_share: float
    """Share of the time in which data were made or waited for."""
    flops: float
    """Floating-point operations of a step's matrix products, convolutions and attention, forward and backward; as
    executed.
    """
    utilisation: float
    """These per second, over what a large matrix product reaches on this device in the same precision."""


def measure(
    recipe: Recipe,
    stage: str,
    *,
    device: torch.device,
    engine: EngineConfig,
    seconds: float = 10.0,
    group: Group = ALONE,
) -> Cost:
    """Train for some seconds on a pool that is only as large as a batch; the transformer's autoencoders are
    untrained.
    """
    recipe = dataclasses.replace(
        recipe,
        pool=dataclasses.replace(recipe.pool, rooms=min(recipe.pool.rooms, recipe.dit_loss.batch)),
        vae_pool=dataclasses.replace(recipe.vae_pool, rooms=min(recipe.vae_pool.rooms, 8)),
    )
    task, loop = make_stage(recipe, stage, None, device=device)
    run = Run(task, dataclasses.replace(loop, steps=_MANY), None, engine=engine, group=group)
    run.train(at_most=1)  # renders the pool, tunes kernels
    networks: dict[str, nn.Module] = {
        name: module
        for name in ("network", "critic", "image_vae", "raymap_vae")
        if isinstance(module := getattr(task, name, None), nn.Module)
    }
    weights = sum(_bytes(network) for network in networks.values()) + _bytes(task.network)
    with LiveBytes() as live, FlopCounterMode(display=False) as flops:
        run.train(at_most=1)
    before = run.step, run.seconds, run.waited
    run.train(minutes=seconds / 60)
    steps, duration, waited = (
        after - then for after, then in zip((run.step, run.seconds, run.waited), before, strict=True)
    )
    rate = steps / duration
    per_second = flops.get_total_flops() * rate
    return Cost(
        parameters={name: sum(p.numel() for p in network.parameters()) for name, network in networks.items()},
        weight_bytes=weights,
        step_bytes=live.peak + sum(_optimizer_bytes(optimizer) for optimizer in run.optimizers),
        steps_per_second=rate,
        data_share=waited / duration,
        flops=flops.get_total_flops(),
        utilisation=per_second / _matmul_rate(device, resolved(engine.precision, device)),
    )


def _bytes(network: nn.Module) -> int:
    return sum(own_part(tensor).numel() * tensor.element_size() for tensor in network.state_dict().values())


def _optimizer_bytes(optimizer: torch.optim.Optimizer) -> int:
    tensors = (
        value for state in optimizer.state.values() for value in state.values() if isinstance(value, torch.Tensor)
    )
    return sum(own_part(tensor).numel() * tensor.element_size() for tensor in tensors)


def _matmul_rate(device: torch.device, dtype: torch.dtype) -> float:
    """Operations per second of the product of two large square matrices."""
    side = 8192 if device.type == "cuda" else 1024
    matrix = torch.rand(side, side, device=device, dtype=dtype)
    product = torch.empty_like(matrix)
    best = float("inf")
    for _ in range(4):
        _finish(device)
        began = time.perf_counter()
        torch.mm(matrix, matrix, out=product)
        _finish(device)
        best = min(best, time.perf_counter() - began)
    return 2 * side**3 / best


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
