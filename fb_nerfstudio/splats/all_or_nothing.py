"""Changes of a scene between two iterations that are made whole or not at all: Gaussians, their optimizers, what the
strategy counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import torch


@contextmanager
def undone_on_error(splats: Any, optimizers: Any) -> Iterator[None]:
    """Whatever is done to the Gaussians in this block is undone where it ends with an error of any kind, an
    interruption included.

    Gaussians come and go by new tensors (`append_rows`, gsplat's `remove`), so that the earlier ones need only be kept,
    not copied. No training step may be made in the block.

    Args:
        splats: the model that is trained; nothing is kept of one without ``gauss_params``.
        optimizers: nerfstudio's, or None.
    """
    put_back = _kept(splats, optimizers)
    try:
        yield
    except BaseException:
        put_back()
        raise


def _kept(splats: Any, optimizers: Any) -> Any:
    """A function that brings the present state back."""
    gaussians = getattr(splats, "gauss_params", None)
    if gaussians is None:
        return lambda: None
    parameters, counted, info = dict(gaussians.items()), dict(splats.strategy_state), splats.info
    owners = optimizers or SimpleNamespace(parameters={}, optimizers={})
    groups = {name: list(values) for name, values in owners.parameters.items()}
    moments = {name: _moments(optimizer) for name, optimizer in owners.optimizers.items()}

    def put_back() -> None:
        for name, values in parameters.items():
            gaussians[name] = values
        splats.strategy_state.clear()
        splats.strategy_state.update(counted)
        splats.info = info
        for name, values in groups.items():
            owners.parameters[name] = values
        for name, (state, trained) in moments.items():
            optimizer = owners.optimizers[name]
            optimizer.state.clear()
            optimizer.state.update({parameter: dict(values) for parameter, values in state.items()})
            for group, values in zip(optimizer.param_groups, trained, strict=True):
                group["params"] = values

    return put_back


def _moments(optimizer: torch.optim.Optimizer) -> tuple[dict[Any, dict[str, Any]], list[list[Any]]]:
    """The optimizer's running means by parameter, and the parameters of its groups."""
    return {parameter: dict(values) for parameter, values in optimizer.state.items()}, [
        list(group["params"]) for group in optimizer.param_groups
    ]
