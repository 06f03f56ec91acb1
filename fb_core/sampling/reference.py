"""The original's velocity with its flaw F1, for comparisons: see `reference_compatible` in
`fb_core.sampling.options.SamplingConfig`.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.sampling.guidance import combined
from fb_core.sampling.integration.solvers import VelocityField
from fb_core.sampling.randomness import Orders
from fb_core.sampling.tiling import Predict


def reference_field(
    predict: Predict,
    scale: Float[Tensor, "n 32 h w"],
    *,
    text_scale: float | None = None,
    window: int | None = None,
    rounds: int = 1,
    orders: Orders,
) -> VelocityField:
    """Guidance inside tiling: predictions of views in a drawn order meet the guidance map of the views in the given
    order.

    So the two scales of the map land on arbitrary views, in every evaluation on others, also when one window holds all
    views.

    Raises ValueError, when it is evaluated, for a window that does not divide the number of views.
    """

    def field(state: Tensor, time: float) -> Tensor:
        count = len(state)
        size = count if window is None else min(window, count)
        if count % size:
            raise ValueError(
                f"window: the original needs a divisor of its {count} views, got {size}; leave reference_compatible out"
            )
        total = torch.zeros_like(state)
        for number in range(rounds):
            order = orders(time, number, count).to(state.device)
            for views, scales in zip(order.split(size), scale.split(size), strict=True):
                velocities = predict(state[views], time, views).float()
                total.index_add_(0, views, combined(velocities, scales, text_scale=text_scale).to(total.dtype))
        return total / rounds

    return field
