"""Optimisers of a training step: AdamW, or Muon for the matrices inside the transformer's blocks; and their gradients'
norm.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from fb_core.training.run.distributed import sharded_like
from fb_core.training.run.muon import Muon

OptimizerName = Literal["adamw", "muon"]
OPTIMIZERS: tuple[OptimizerName, ...] = get_args(OptimizerName)


def make_optimizers(
    network: nn.Module,
    *,
    name: OptimizerName,
    learning_rate: float,
    weight_decay: float,
    betas: tuple[float, float],
    iteration: torch.dtype = torch.float32,
) -> list[Optimizer]:
    """The optimisers of a network; vectors (gains, biases) have no weight decay. ``iteration`` is the precision of
    Muon's iteration.

    Muon takes the matrices of the transformer's blocks and the kernels inside an autoencoder's, AdamW all else; Muon's
    step is scaled to AdamW's usual size, so that one learning rate serves both.
    """
    matrices, vectors, orthogonal = [], [], []
    for parameter_name, parameter in network.named_parameters():
        if not parameter.requires_grad:
            continue
        if name == "muon" and _is_inner(parameter_name, parameter):
            orthogonal.append(parameter)
        else:
            (matrices if parameter.ndim >= 2 else vectors).append(parameter)
    groups = [{"params": matrices, "weight_decay": weight_decay}, {"params": vectors, "weight_decay": 0.0}]
    optimizers: list[Optimizer] = [torch.optim.AdamW(groups, lr=learning_rate, betas=betas, foreach=True)]
    if orthogonal:
        optimizers.append(Muon(orthogonal, learning_rate=learning_rate, weight_decay=weight_decay, iteration=iteration))
    return optimizers


def _is_inner(name: str, parameter: nn.Parameter) -> bool:
    """Matrices of the transformer's blocks, kernels of the autoencoders' (not of their first and last layers)."""
    if parameter.ndim == 2:
        return name.startswith("transformer_blocks.")
    return parameter.ndim == 4 and "_block" in name and parameter[0].numel() > 1


def load_optimizer(optimizer: Optimizer, state: dict) -> None:
    """Take a saved state in, spread over the processes as the parameters are."""
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    spread_state = {
        number: {
            key: sharded_like(value, parameters[number]) if _follows(value, parameters[number]) else value
            for key, value in entry.items()
        }
        for number, entry in state["state"].items()
    }
    optimizer.load_state_dict({**state, "state": spread_state})


def _follows(value: object, parameter: Tensor) -> bool:
    return isinstance(value, Tensor) and value.shape == parameter.shape and value.ndim > 0


def clip_gradients(network: nn.Module, largest: float) -> float:
    """Scale gradients so that their norm is at most ``largest``; returns the norm that they had."""
    norm = nn.utils.clip_grad_norm_(network.parameters(), largest)
    return float(norm.full_tensor() if hasattr(norm, "full_tensor") else norm)  # type: ignore[attr-defined]
