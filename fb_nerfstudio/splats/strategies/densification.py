"""Changing the number of Gaussians in the middle of training: a cap on densification, and appending new ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from gsplat.strategy.ops import duplicate, split
from torch import Tensor


@dataclass
class CappedStrategy(DefaultStrategy):
    """gsplat's default strategy that never lets the Gaussians exceed a number.

    While the cap does not bind it is gsplat's own. Where growth would pass the cap, those with the greatest mean screen
    gradient grow, as many as fit, each by one.
    """

    max_gaussians: int | None = None
    """Most Gaussians that densification may leave; None for no limit."""

    def count(self, params: Any, state: dict[str, Any], step: int, info: dict[str, Any]) -> None:
        """Count the screen gradients of one more render of this step (``info``), before `step_post_backward`."""
        if step < self.refine_stop_iter:
            self._update_state(params, state, info)

    @torch.no_grad()
    def _grow_gs(
        self, params: Any, optimizers: dict[str, torch.optim.Optimizer], state: dict[str, Any], step: int
    ) -> tuple[int, int]:
        if self.max_gaussians is None:
            return super()._grow_gs(params, optimizers, state, step)
        gradient = state["grad2d"] / state["count"].clamp_min(1)
        steep = gradient > self.grow_grad2d
        small = params["scales"].exp().amax(dim=-1) <= self.grow_scale3d * state["scene_scale"]
        wide = state["radii"] > self.grow_scale2d if step < self.refine_scale2d_stop_iter else torch.zeros_like(steep)
        copies, splits = steep & small, (steep & ~small) | wide
        room = max(self.max_gaussians - len(gradient), 0)
        if int(copies.sum() + splits.sum()) <= room:
            return super()._grow_gs(params, optimizers, state, step)
        wanted = copies | splits
        best = gradient.masked_fill(~wanted, -1.0).topk(min(room, int(wanted.sum()))).indices
        chosen = torch.zeros_like(wanted).index_fill_(0, best, True)
        copies, splits = chosen & copies & ~splits, chosen & splits
        copied, halved = int(copies.sum()), int(splits.sum())
        if copied:
            duplicate(params=params, optimizers=optimizers, state=state, mask=copies)
        if halved:
            not_copies = torch.zeros(copied, dtype=torch.bool, device=splits.device)
            split(
                params=params,
                optimizers=optimizers,
                state=state,
                mask=torch.cat([splits, not_copies]),
                revised_opacity=self.revised_opacity,
            )
        return copied, halved


@torch.no_grad()
def append_rows(
    params: torch.nn.ParameterDict,
    optimizers: dict[str, torch.optim.Optimizer],
    state: dict[str, Any],
    rows: dict[str, Tensor],
) -> None:
    """Append Gaussians. The others keep their values and their optimizer state; new ones start with zero moments.

    The parameters are replaced by new ones, as gsplat's strategies do: a parameter that a live graph still refers to
    must not change its shape. ``state`` is the strategy's, whose running sums grow by zeros.
    """
    added = len(next(iter(rows.values())))
    for name, new in rows.items():
        old = params[name]
        grown = torch.nn.Parameter(torch.cat([old, new.to(old)]))
        optimizer = optimizers.get(name)
        if optimizer is not None:
            moments = optimizer.state.pop(old, {})
            optimizer.state[grown] = {key: _with_zeros(value, len(old), added) for key, value in moments.items()}
            optimizer.param_groups[0]["params"] = [grown]
        params[name] = grown
    for key, value in state.items():
        if isinstance(value, Tensor):
            state[key] = _with_zeros(value, len(value), added)


def _with_zeros(value: Any, length: int, added: int) -> Any:
    """Per-Gaussian tensors grow by zero rows; step counters and other values stay."""
    if not isinstance(value, Tensor) or value.ndim == 0 or len(value) != length:
        return value
    return torch.cat([value, value.new_zeros(added, *value.shape[1:])])
