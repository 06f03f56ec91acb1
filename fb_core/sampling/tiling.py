"""MultiDiffusion over views (paper, "Raymap prediction"): more views than one sequence holds, in windows whose
predictions are averaged.

Tiling sits inside guidance: it keeps the signature of a prediction, so the guidance map never leaves its views. Inside
a window the index embedding counts the window's views, whichever they are, as it did in training.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.sampling.randomness import Orders, given_order

Predict = Callable[[Float[Tensor, "n 32 h w"], float, Int[Tensor, "n"] | None], Float[Tensor, "b n 32 h w"]]
"""(state of some views, time, which views they are (None: all)) -> velocity under each branch of guidance."""


def windows(count: int, size: int, *, order: Int[Tensor, "n"]) -> list[Int[Tensor, "_"]]:
    """``order`` cut into windows of ``size`` views; the last one is filled up with the first views of the order when it
    would be short.
    """
    if count <= size:
        return [order]
    pieces = list(order.split(size))
    short = size - len(pieces[-1])
    if short > 0:
        pieces[-1] = torch.cat([pieces[-1], order[:short]])
    return pieces


def tiled(predict: Predict, *, window: int | None, rounds: int = 1, orders: Orders = given_order) -> Predict:
    """Predictions of windows of views, averaged back per view; any window and any number of views.

    Args:
        predict: evaluates one window as a sequence of its own.
        window: views per window; None or anything >= n means one window in the given order, without shuffling.
        rounds: how many partitions are averaged in every evaluation (the paper uses 8 for poses).
        orders: the order of the views that every round cuts; `random_orders(seed)` for the paper's random partitions.

    Raises ValueError for windows and rounds below 1.
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
        visits = torch.zeros(count, device=state.device, dtype=torch.float32)
        for number in range(rounds):
            for part in windows(count, window, order=orders(time, number, count).to(state.device)):
                velocities = predict(state[part], time, part if views is None else views[part]).float()
                if total is None:
                    total = velocities.new_zeros(len(velocities), count, *velocities.shape[2:])
                total.index_add_(1, part, velocities)
                visits.index_add_(0, part, torch.ones_like(part, dtype=visits.dtype))
        assert total is not None
        return total / visits[:, None, None, None]

    return predict_tiled
