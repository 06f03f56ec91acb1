"""Flows whose velocity is known in closed form, to measure solvers on: mixtures of Gaussians, guided."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.sampling.guidance import GuidanceVariant
from fb_core.sampling.integration.jumps import Jumping, jumps_of, piece_of
from fb_core.sampling.integration.solvers import VelocityField


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """A mixture of k axis-aligned Gaussians in d dimensions, as the law of the data."""

    means: Float[Tensor, "k d"]
    """Centres."""
    variances: Float[Tensor, "k d"]
    """Variances along the axes."""
    log_weights: Float[Tensor, " k"]
    """Logarithms of the shares (their sum does not matter)."""

    @staticmethod
    def drawn(components: int, dimensions: int, *, generator: torch.Generator) -> Mixture:
        """Random centres of size about 0.9 and spreads of 0.1 to 0.5, in float64."""
        double = {"generator": generator, "dtype": torch.float64}
        return Mixture(
            means=0.9 * torch.randn(components, dimensions, **double),
            variances=0.01 + 0.25 * torch.rand(components, dimensions, **double),
            log_weights=torch.randn(components, **double),
        )

    def of(self, components: Sequence[int]) -> Mixture:
        """Some components alone: the law under a condition."""
        chosen = list(components)
        return Mixture(means=self.means[chosen], variances=self.variances[chosen], log_weights=self.log_weights[chosen])

    def velocity(self, state: Float[Tensor, "n d"], time: float) -> Float[Tensor, "n d"]:
        """E[eps - z | z_t] for z_t = (1 - t) z + t eps: exact at every time from 0 to 1."""
        spread = (1 - time) ** 2 * self.variances + time**2
        away = state[:, None] - (1 - time) * self.means
        share = (self.log_weights - 0.5 * (away.square() / spread + spread.log()).sum(dim=-1)).softmax(dim=1)
        each = (time - (1 - time) * self.variances) / spread * away - self.means
        return (share[..., None] * each).sum(dim=1)


def guided_flow(
    everything: Mixture, condition: Mixture, guidance: float, variant: GuidanceVariant = GuidanceVariant()
) -> VelocityField:
    """Classifier-free guidance between two laws."""

    def piece(since: float) -> VelocityField:
        if variant.stands_still_at(since):
            return lambda state, time: torch.zeros_like(state)
        if guidance == 1 or not variant.acts_at(since):
            return condition.velocity

        def field(state: Tensor, time: float) -> Tensor:
            conditional, null = condition.velocity(state, time), everything.velocity(state, time)
            return null + guidance * (conditional - null)

        return field

    return Jumping(jumps=variant.jumps, piece=piece)


def gaussian_endpoint(
    start: Float[Tensor, "n d"], variance: Float[Tensor, " d"], condition: Float[Tensor, " d"], guidance: float
) -> Float[Tensor, "n d"]:
    """Where guidance between two centred Gaussians leads from t = 1 to t = 0, in closed form.

    The unguided flow of variance s multiplies by sqrt(s) (it is linear: dz/dt = z d/dt log sqrt((1 - t)^2 s + t^2)),
    and guidance mixes the exponents.
    """
    return start * variance ** ((1 - guidance) / 2) * condition ** (guidance / 2)


def fine_endpoint(field: VelocityField, start: Float[Tensor, "n d"], *, steps: int) -> Float[Tensor, "n d"]:
    """The endpoint by the classical fourth-order Runge-Kutta method with even steps, anew from every jump of the
    velocity.
    """
    state, ends = start, sorted({jump for jump in jumps_of(field) if 0 < jump < 1}, reverse=True)
    for begin, end in itertools.pairwise([1.0, *ends, 0.0]):
        state = _runge_kutta(piece_of(field, begin), state, begin, end, steps=math.ceil(steps * (begin - end)))
    return state


def _runge_kutta(field: VelocityField, state: Tensor, begin: float, end: float, *, steps: int) -> Tensor:
    step = -(begin - end) / steps
    for number in range(steps):
        time = begin + number * step
        first = field(state, time)
        second = field(state + step / 2 * first, time + step / 2)
        third = field(state + step / 2 * second, time + step / 2)
        fourth = field(state + step * third, max(time + step, end))
        state = state + step / 6 * (first + 2 * second + 2 * third + fourth)
    return state
