"""Gaussian splatting as Markov chain Monte Carlo (Kheradmand et al. 2024), without a CUDA extension and without
melting.

gsplat's own strategy needs compiled kernels for relocation and for the noise; here both are a few lines of torch. Three
rules keep regions that few views show as they are, where the published method pulls on every Gaussian at every step:

- the penalties on opacity and scale reach a Gaussian only through views that draw it (`penalize`): Adam divides a lone
  penalty by its own size, so a Gaussian that is out of sight would otherwise lose 0.05 of its logit at every step,
  whatever the weight;
- noise moves only Gaussians that the step's view has drawn: without a picture's gradient nothing would bring them back;
- a relocated Gaussian starts with zero moments, as does the one that it shares its place with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import MCMCStrategy
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fb_core.splatting.footprint import rotations, unit_quaternions
from fb_nerfstudio.splats.strategies.densification import append_rows

_MOST_COPIES = 51
"""Copies at one place that the new opacity and scale account for, as in gsplat."""
_GATE_SLOPE, _GATE_CENTER = 100.0, 0.005
"""Noise fades out around this opacity (the paper's k and 1 - t)."""
_MOST_OPAQUE = 1 - 1.2e-7


def shared_opacity_and_scale(
    opacities: Float[Tensor, " n"], scales: Float[Tensor, "n 3"], copies: Int[Tensor, " n"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"]]:
    """Opacity and scale of each of ``copies`` equal Gaussians that together look like one (equation 9 of the paper).

    Opacities in (0, 1), scales in scene units, copies from 1 (more than 51 count as 51). The new opacity a keeps 1 - o
    = (1 - a)^n; the scale shrinks by o / sum_j C(n, j) (-1)^(j-1) a^j / sqrt(j), j = 1 .. n, the paper's double sum
    added up over its first index.
    """
    count = copies.clamp(1, _MOST_COPIES).double()
    before = opacities.double()
    after = -torch.expm1(torch.log1p(-before) / count)
    term, total = torch.ones_like(after), torch.zeros_like(after)
    for j in range(1, int(count.max()) + 1 if count.numel() else 1):
        term = term * (count - (j - 1)).clamp(min=0) / j * after  # C(n, j) a^j
        total = total + (term if j % 2 else -term) / j**0.5
    return after.to(opacities), (scales.double() * (before / total)[:, None]).to(scales)


def position_noise(
    quats: Float[Tensor, "n 4"],
    log_scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    size: float,
    *,
    generator: torch.Generator | None = None,
) -> Float[Tensor, "n 3"]:
    """Covariance times white noise times ``size``, for Gaussians of opacity up to about 0.005; hardly any for opaque
    ones.
    """
    given = log_scales.dtype
    quats, log_scales, opacities = _exact(quats), _exact(log_scales), _exact(opacities)
    rotation, squares = rotations(unit_quaternions(quats)[0]), (2 * log_scales).exp()
    white = torch.randn(log_scales.shape, generator=generator, dtype=log_scales.dtype, device=log_scales.device)
    body = torch.einsum("ijn,ni->nj", rotation, white) * squares
    gate = torch.sigmoid(_GATE_SLOPE * (_GATE_CENTER - opacities))
    return (torch.einsum("ijn,nj->ni", rotation, body) * (size * gate)[:, None]).to(given)


def _exact(values: Tensor) -> Tensor:
    """At least float32: in half precision an opacity of 0.9998 is 1, whose logit is infinite, and a scale of 1e-8
    is 0.
    """
    return values.to(torch.promote_types(values.dtype, torch.float32))


def penalize(values: Float[Tensor, "..."], weight: float) -> None:
    """Add the gradient of ``weight * values.mean()`` (values >= 0, on their way to the rasterizer) where the picture
    has one.

    Gaussians that no pixel of this view draws keep a gradient of exactly zero.
    """
    if weight and values.requires_grad:
        values.register_hook(lambda gradient: gradient + (gradient != 0) * (weight / values.numel()))


@dataclass
class CappedMCMC(MCMCStrategy):
    """gsplat's MCMC strategy in plain torch, for any device; see the rules at the top of this file.

    ``cap_max`` bounds the number of Gaussians; ``noise_lr`` scales the noise, ``min_opacity`` says which Gaussians are
    dead.
    """

    absgrad: bool = False
    """The rasterizer need not sum absolute gradients."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Nothing is kept between steps; takes what the default strategy takes."""
        return {}

    def count(self, params: Any, state: dict[str, Any], step: int, info: dict[str, Any]) -> None:
        """Nothing is counted: the gradient that `step_post_backward` reads is that of all renders of the step."""

    def step_post_backward(
        self,
        params: Any,
        optimizers: dict[str, torch.optim.Optimizer],
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
        lr: float | None = None,
    ) -> None:
        """Relocate, grow and stir, after the optimizers' step. ``lr`` is that of the means, by default their
        optimizer's.
        """
        rate: float = optimizers["means"].param_groups[0]["lr"] if lr is None else lr
        with torch.autocast(params["means"].device.type, enabled=False):  # parameters keep their own precision
            self._stir(params, rate * self.noise_lr)  # first: the gradients belong to these rows
            if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
                self._relocate(params, optimizers)
                self._grow(params, optimizers, state)

    @torch.no_grad()
    def _stir(self, params: Any, size: float) -> None:
        """Noise on the positions that this step's picture had a say about."""
        means, gradient = params["means"], params["means"].grad
        if gradient is None:
            return
        drawn = (gradient != 0).any(dim=-1).nonzero()[:, 0]
        opacities = _exact(params["opacities"][drawn]).flatten().sigmoid()
        noise = position_noise(params["quats"][drawn], params["scales"][drawn], opacities, size)
        means.index_add_(0, drawn, noise.to(means))

    @torch.no_grad()
    def _relocate(self, params: Any, optimizers: dict[str, torch.optim.Optimizer]) -> int:
        """Move dead Gaussians onto living ones, drawn by opacity; returns how many."""
        opacities = _exact(params["opacities"]).flatten().sigmoid()
        dead = opacities <= self.min_opacity
        source, moved = self._sources(opacities, dead, int(dead.sum())), dead.nonzero()[:, 0]
        if source is None or len(moved) == 0:
            return 0
        self._share(params, source)
        for name, values in params.items():
            values[moved] = values[source]
            _clear_moments(optimizers[name], values, torch.cat([source, moved]))
        return len(moved)

    @torch.no_grad()
    def _grow(self, params: Any, optimizers: dict[str, torch.optim.Optimizer], state: dict[str, Any]) -> int:
        """Add a twentieth, at most up to the cap, as copies of living ones drawn by opacity; returns how many."""
        number = len(params["means"])
        wanted = max(0, min(self.cap_max, int(1.05 * number)) - number)
        opacities = _exact(params["opacities"]).flatten().sigmoid()
        source = self._sources(opacities, opacities <= self.min_opacity, wanted)
        if source is None:
            return 0
        self._share(params, source)
        for name, values in params.items():
            _clear_moments(optimizers[name], values, source)
        append_rows(params, optimizers, state, {name: values[source] for name, values in params.items()})
        return wanted

    @staticmethod
    def _sources(opacities: Float[Tensor, " n"], dead: Bool[Tensor, " n"], number: int) -> Tensor | None:
        """Indices of living Gaussians, drawn with repetition; None where nobody is wanted or nobody lives."""
        weights = opacities.masked_fill(dead, 0.0).double()
        if number == 0 or not bool(weights.sum() > 0):
            return None
        # Not torch.multinomial: that takes at most 2^24 entries.
        ends = weights.cumsum(0)
        drawn = torch.rand(number, dtype=torch.float64, device=ends.device) * ends[-1]
        return torch.searchsorted(ends, drawn, right=True).clamp_(max=len(ends) - 1)

    def _share(self, params: Any, source: Tensor) -> None:
        """Give each source the opacity and scale that it and its copies need."""
        places, copies = source.unique(return_counts=True)
        opacities, scales = params["opacities"], params["scales"]
        whole = _exact(opacities[places]).flatten().sigmoid()
        shared, shrunk = shared_opacity_and_scale(whole, _exact(scales[places]).exp(), copies + 1)
        opacities[places] = (
            torch.logit(shared.clamp(self.min_opacity, _MOST_OPAQUE)).view(-1, *opacities.shape[1:]).to(opacities)
        )
        scales[places] = shrunk.log().to(scales)


def _clear_moments(optimizer: torch.optim.Optimizer, parameter: Tensor, rows: Tensor) -> None:
    for value in optimizer.state.get(parameter, {}).values():
        if isinstance(value, Tensor) and value.shape == parameter.shape:
            value[rows] = 0
