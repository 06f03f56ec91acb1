"""Sampling: integrate a velocity from noise (t = 1) to data (t = 0); guidance and MultiDiffusion are wrappers of callables.

``integrate(guided(tiled(predict), ...), noise, times)``: `predict` evaluates the network on some of the views under every branch of
guidance at once, `tiled` keeps that signature, and `guided` makes a velocity field of it. Tiling sits inside guidance, so the guidance
map never leaves its views.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.conditioning import LATENT_CHANNELS, Conditioning, join, split, unsplit

Predict = Callable[[Float[Tensor, "n 32 h w"], float, Int[Tensor, "n"] | None], Float[Tensor, "b n 32 h w"]]
"""(state of some views, time, which views they are (None: all)) -> velocity under each branch of guidance."""
VelocityField = Callable[[Float[Tensor, "n 32 h w"], float], Float[Tensor, "n 32 h w"]]
"""dz/dt at a state and a time."""
OnStep = Callable[[int, int], None]
"""(steps done, steps in all), called after every step."""


SOLVERS = ("euler", "ab2")


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """How a sequence is denoised, and in how much memory."""

    steps: int = 24
    """Denoising steps; each evaluates the network once (twice with guidance, three times with a prompt)."""
    guidance_unknown: float = 7.0
    """Classifier-free guidance scale where content is unknown (paper: 7)."""
    guidance_known: float = 1.1
    """Guidance scale where content is known (paper: 1.1)."""
    guidance_text: float = 10.0
    """Guidance scale of a prompt; without a prompt, or at 0, text costs nothing."""
    solver: str = "ab2"
    """'euler' or 'ab2' (second-order Adams-Bashforth: Euler's error in a third of the steps)."""
    shift: float = 1.0
    """Time shift of the grid; above 1 spends more steps near the noise."""
    window: int | None = None
    """Views denoised together; None is all of them (best for images; the paper uses 8 for poses)."""
    rounds: int = 1
    """Random partitions into windows that are averaged per step."""
    views_at_once: int | None = None
    """Views that pass through an autoencoder together; None is as many as memory allows, at most 16."""
    sample_posterior: bool = False
    """Condition on samples of the autoencoders' posteriors, as the original does, instead of on their means."""
    memory_budget_bytes: int | None = None
    """Most memory, weights included, in bytes; None is what the machine has. Decides how the work is cut (`fb_core.memory`)."""

    def __post_init__(self) -> None:
        time_grid(self.steps, shift=self.shift)
        if self.solver not in SOLVERS:
            raise ValueError(f"solver: expected 'euler' or 'ab2', got {self.solver!r}")
        for name in ("rounds", "views_at_once", "window", "memory_budget_bytes"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"{name}: expected at least 1, got {value}")


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
    if solver not in SOLVERS:
        raise ValueError(f"solver: expected 'euler' or 'ab2', got {solver!r}")
    previous, previous_step = None, 0.0
    for index, (now, following) in enumerate(pairwise(times)):
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


def guided(predict: Predict, scale: Float[Tensor, "n 32 h w"], *, text_scale: float | None = None) -> VelocityField:
    """Classifier-free guidance v = u + scale (c - u) with a scale per latent; `predict` gives (u, c), or c alone (see `branches`).

    With a `text_scale`, one more branch t comes last, c with a prompt, and text_scale (t - c) is added to the image's channels.
    The combination is in float32: a scale of 7 amplifies the rounding of the branches 13 times.
    """

    def field(state: Tensor, time: float) -> Tensor:
        velocities = predict(state, time, None).float()
        prompted = None
        if text_scale is not None:
            velocities, prompted = velocities[:-1], velocities[-1]
        conditional = velocity = velocities[-1]
        if len(velocities) == 2:
            velocity = velocities[0] + scale * (conditional - velocities[0])
        if prompted is not None and text_scale is not None:
            image, rays = split(prompted - conditional)
            velocity = velocity + text_scale * unsplit(image, torch.zeros_like(rays))
        return velocity

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
