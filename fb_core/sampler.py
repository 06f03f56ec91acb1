"""Sampling: integrate a velocity from noise (t = 1) to data (t = 0); guidance and MultiDiffusion are wrappers of callables.

``integrate(guided(tiled(predict), ...), noise, times)``: `predict` maps a joined sequence [b, n, 66, h, w] and times [b] to
velocities [b, n, 32, h, w]; `tiled` keeps that signature; `guided` binds the conditioning and returns a velocity field
[n, 32, h, w], t -> [n, 32, h, w]. Tiling sits inside guidance, so the guidance map never leaves its views.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import Conditioning, join, unsplit

Predict = Callable[..., Float[Tensor, "b n 32 h w"]]
"""(sequence [b, n, 66, h, w], time [b]) -> velocity [b, n, 32, h, w]."""
VelocityField = Callable[[Float[Tensor, "n 32 h w"], float], Float[Tensor, "n 32 h w"]]
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
    half = 16
    return unsplit(image.expand(*image.shape[:-3], half, *image.shape[-2:]), rays.expand(*rays.shape[:-3], half, *rays.shape[-2:]))


def guided(
    predict: Predict, conditioning: Conditioning, null: Conditioning, scale: Float[Tensor, "n 32 h w"], *, one_batch: bool = True
) -> VelocityField:
    """Classifier-free guidance v = u + scale (c - u) with a scale per latent; a scale of 1 everywhere costs one branch only.

    ``one_batch`` evaluates both branches together (faster, twice the activations); otherwise one after the other. The
    combination is in float32 because a scale of 7 amplifies the branches' rounding 13 times.
    """
    without_guidance = bool((scale == 1).all())

    def field(state: Tensor, time: float) -> Tensor:
        conditional = join(state, conditioning)[None]
        if without_guidance:
            return predict(conditional, state.new_full((1,), time))[0].float()
        unconditional = join(state, null)[None]
        if one_batch:
            u, c = predict(torch.cat([unconditional, conditional]), state.new_full((2,), time)).float()
        else:
            u = predict(unconditional, state.new_full((1,), time))[0].float()
            c = predict(conditional, state.new_full((1,), time))[0].float()
        return u + scale * (c - u)

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

    def predict_tiled(sequence: Tensor, time: Tensor) -> Tensor:
        count = sequence.shape[1]
        if window is None or window >= count:
            return predict(sequence, time)
        total: Tensor | None = None
        visits = torch.zeros(count, device=sequence.device)
        for _ in range(rounds):
            order = torch.arange(count) if generator is None else torch.randperm(count, generator=generator)
            for views in windows(count, window, order=order.to(sequence.device)):
                part = predict(sequence[:, views], time).float()
                if total is None:
                    total = part.new_zeros(part.shape[0], count, *part.shape[2:])
                total.index_add_(1, views, part)
                visits.index_add_(0, views, torch.ones_like(views, dtype=visits.dtype))
        assert total is not None
        return total / visits[None, :, None, None, None]

    return predict_tiled
