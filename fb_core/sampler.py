"""Sampling: integrate a velocity from noise (t = 1) to data (t = 0); guidance and MultiDiffusion are wrappers of callables.

``integrate(guided(tiled(predict), ...), noise, times)``: `predict` evaluates the network on some of the views under every branch of
guidance at once, `tiled` keeps that signature, and `guided` makes a velocity field of it. Tiling sits inside guidance, so the guidance
map never leaves its views.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.conditioning import LATENT_CHANNELS, Conditioning, join, unsplit

Predict = Callable[[Float[Tensor, "n 32 h w"], float, Int[Tensor, "n"] | None], Float[Tensor, "b n 32 h w"]]
"""(state of some views, time, which views they are (None: all)) -> velocity under each branch of guidance."""
VelocityField = Callable[[Float[Tensor, "n 32 h w"], float], Float[Tensor, "n 32 h w"]]
"""dz/dt at a state and a time."""
OnStep = Callable[[int, int], None]
"""(steps done, steps in all), called after every step."""


def time_grid(steps: int, *, shift: float = 1.0) -> list[float]:
    """``steps + 1`` times from 1 to 0, uniform before the shift t -> s t / (1 + (s - 1) t) that spends more steps near the noise."""
    if steps < 1:
        raise ValueError(f"sampling steps: expected at least 1, got {steps}")
    if shift <= 0:
        raise ValueError(f"time shift: expected a positive number, got {shift}")
    uniform = [1.0 - k / steps for k in range(steps + 1)]
    return [shift * t / (1.0 + (shift - 1.0) * t) for t in uniform]


def integrate(
    field: VelocityField,
    state: Float[Tensor, "n 32 h w"],
    times: list[float],
    *,
    solver: str = "euler",
    on_step: OnStep | None = None,
) -> Float[Tensor, "n 32 h w"]:
    """Follow dz/dt = field(z, t) along ``times`` (descending), in float32.

    Solvers, one evaluation a step each: ``euler``; ``ab2``, second-order Adams-Bashforth for uneven steps that starts with one Euler step.
    """
    if solver not in ("euler", "ab2"):
        raise ValueError(f"solver: expected 'euler' or 'ab2', got {solver!r}")
    previous, previous_step = None, 0.0
    for index, (now, following) in enumerate(zip(times[:-1], times[1:], strict=True)):
        step = following - now
        slope = field(state, now).float()
        if solver == "ab2" and previous is not None:
            ratio = step / previous_step
            state = state + step * ((1 + ratio / 2) * slope - ratio / 2 * previous)
        else:
            state = state + step * slope
        previous, previous_step = slope, step
        if on_step is not None:
            on_step(index + 1, len(times) - 1)
    return state


def guidance_map(conditioning: Conditioning, *, known: float, unknown: float) -> Float[Tensor, "n 32 h w"]:
    """Guidance scale per latent: the known scale where known, the unknown scale elsewhere, each modality by its own mask."""
    image = unknown + (known - unknown) * conditioning.image_known
    rays = unknown + (known - unknown) * conditioning.rays_known
    return unsplit(image.expand(-1, LATENT_CHANNELS, -1, -1), rays.expand(-1, LATENT_CHANNELS, -1, -1))


def branches(conditioning: Conditioning, null: Conditioning, scale: Float[Tensor, "n 32 h w"]) -> list[Conditioning]:
    """What guidance has to evaluate: (null, conditional), or only the conditional branch when the scale is 1 everywhere."""
    return [conditioning] if bool((scale == 1).all()) else [null, conditioning]


def evaluated_by(network: Callable[[Tensor, Tensor], Tensor], parts: list[Conditioning]) -> Predict:
    """The plain way to evaluate branches: join state and conditioning and run the network (sequence, times) on all of it, every time."""

    def predict(state: Tensor, time: float, views: Tensor | None = None) -> Tensor:
        chosen = slice(None) if views is None else views
        sequences = torch.stack([join(state, Conditioning(channels=part.channels[chosen])) for part in parts])
        return network(sequences, state.new_full((len(parts),), time))

    return predict


def guided(predict: Predict, scale: Float[Tensor, "n 32 h w"]) -> VelocityField:
    """Classifier-free guidance v = u + scale (c - u) with a scale per latent; `predict` gives (u, c), or c alone (see `branches`).

    The combination is in float32: a scale of 7 amplifies the rounding of the branches 13 times.
    """

    def field(state: Tensor, time: float) -> Tensor:
        velocities = predict(state, time, None).float()
        if len(velocities) == 1:
            return velocities[0]
        unconditional, conditional = velocities
        return unconditional + scale * (conditional - unconditional)

    return field


def windows(count: int, size: int, *, order: Tensor) -> list[Tensor]:
    """``order`` cut into windows of ``size`` views; the last one is filled up with the first views of the order when it would be short."""
    if count <= size:
        return [order]
    pieces = list(order.split(size))
    short = size - len(pieces[-1])
    if short > 0:
        pieces[-1] = torch.cat([pieces[-1], order[:short]])
    return pieces


def tiled(predict: Predict, *, window: int | None, rounds: int = 1, generator: torch.Generator | None = None) -> Predict:
    """MultiDiffusion over views (paper, "Raymap prediction"): predictions of windows of views are averaged back per view.

    Args:
        predict: evaluates one window as a sequence of its own.
        window: views per window; None or anything >= n means one window in the given order, without shuffling.
        rounds: how many random partitions are averaged in every evaluation (the paper uses 8 for poses).
        generator: draws the partitions (on the CPU); None keeps the given order.
    """
    if window is not None and window < 1:
        raise ValueError(f"window: expected at least 1 view, got {window}")
    if rounds < 1:
        raise ValueError(f"rounds: expected at least 1, got {rounds}")

    def predict_tiled(state: Tensor, time: float, views: Tensor | None = None) -> Tensor:
        count = len(state)
        if window is None or window >= count:
            return predict(state, time, views)
        total: Tensor | None = None
        visits = torch.zeros(count, device=state.device)
        for _ in range(rounds):
            order = torch.arange(count) if generator is None else torch.randperm(count, generator=generator)
            for part in windows(count, window, order=order.to(state.device)):
                velocities = predict(state[part], time, part if views is None else views[part]).float()
                if total is None:
                    total = velocities.new_zeros(len(velocities), count, *velocities.shape[2:])
                total.index_add_(1, part, velocities)
                visits.index_add_(0, part, torch.ones_like(part, dtype=visits.dtype))
        assert total is not None
        return total / visits[:, None, None, None]

    return predict_tiled
