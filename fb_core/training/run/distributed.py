"""Several processes that train one network: who they are, what they agree on, and weights that are spread over them.

One process per device, started by torchrun. Gradients are averaged by DistributedDataParallel, or the transformer's
weights are spread over the processes (FSDP). Small agreements (losses, "stop") travel as CPU tensors, so that they
never wait for a GPU's queue.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from fb_core.networks.transformer.dit import DiT


@dataclass(frozen=True, kw_only=True)
class Group:
    """The processes of one training; alone by default."""

    rank: int = 0
    """Which of them this process is; rank 0 alone writes files and messages."""
    size: int = 1
    """How many there are."""

    @property
    def is_main(self) -> bool:
        """Whether this process writes."""
        return self.rank == 0

    def mean(self, values: list[float]) -> list[float]:
        """The mean over all processes, the same on each; NaN if any has NaN."""
        if self.size == 1:
            return values
        total = torch.tensor(values, dtype=torch.float64)
        dist.all_reduce(total)
        return (total / self.size).tolist()

    def any(self, flag: bool) -> bool:
        """Whether it is so for any process; all must ask."""
        return flag if self.size == 1 else self.mean([float(flag)])[0] > 0

    def gather(self, value: Any) -> list[Any]:
        """Every process's value, on each."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        dist.all_gather_object(values, value)
        return values

    def wait(self) -> None:
        """Until all have come here."""
        self.any(False)


ALONE = Group()


@contextlib.contextmanager
def in_group(device: torch.device) -> Iterator[tuple[Group, torch.device]]:
    """The group that torchrun has started this process in, and this process's device; one process alone joins nothing.

    ``device`` is what all were asked for: of several GPUs each process takes its own (cuda becomes cuda:LOCAL_RANK).
    """
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield ALONE, device
        return
    if device.type == "cuda":
        device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(device)
    dist.init_process_group("cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo")
    try:
        yield Group(rank=dist.get_rank(), size=size), device
    finally:
        dist.destroy_process_group()


@contextlib.contextmanager
def left_at_once() -> Iterator[None]:
    """For a program's outermost block: one of several processes ends with the block, by ``os._exit`` and the code it
    would have had.

    torch keeps threads of a process group alive after `torch.distributed.destroy_process_group` once
    DistributedDataParallel has used it. While the interpreter is taken apart they abort the process now and then (3 of
    48 measured, "terminate called without an active exception", torch 2.15), and torchrun then ends a whole training
    that is complete. A process alone ends as always.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    code = 0
    try:
        yield
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else int(error.code is not None)
        if isinstance(error.code, str):
            sys.stderr.write(f"{error.code}\n")
    except BaseException:  # printed, as the interpreter would
        traceback.print_exc()
        code = 1
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def shard(network: DiT) -> None:
    """Spread the transformer's weights, gradients and optimiser states over all processes (FSDP).

    Self-attention and feed-forward, three quarters of the weights, are gathered block by block when they are needed;
    the rest (norms' modulation, text, patches), which `DiT.modulate` and `DiT.text_context` read for all blocks at
    once, at the network's call.
    """
    from torch.distributed.fsdp import fully_shard

    for block in network.blocks:
        fully_shard(block.attn1)
        fully_shard(block.ff)
    fully_shard(network)


def averaging(module: nn.Module, group: Group, *, sharded: bool) -> nn.Module:
    """The module whose backward pass averages gradients over all processes."""
    if group.size == 1 or sharded:  # sharded networks average by themselves
        return module
    return DistributedDataParallel(module, gradient_as_bucket_view=True)


@contextlib.contextmanager
def averaged_if(module: nn.Module, network: nn.Module, last: bool) -> Iterator[None]:
    """Forward and backward of one of several parts of a batch: gradients travel with the last part only."""
    if isinstance(module, DistributedDataParallel) and not last:
        with module.no_sync():
            yield
        return
    if is_sharded(network):
        network.set_requires_gradient_sync(last)  # type: ignore[operator]
    yield


def is_sharded(network: nn.Module) -> bool:
    """Whether `shard` was applied."""
    return hasattr(network, "set_requires_gradient_sync")


def _mapped(tree: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """A copy of nested dictionaries and lists with every tensor changed."""
    if isinstance(tree, Tensor):
        return change(tree)
    if isinstance(tree, dict):
        return {key: _mapped(value, change) for key, value in tree.items()}
    return [_mapped(value, change) for value in tree] if isinstance(tree, list) else tree


def whole(tree: Any, *, keep: bool = True) -> Any:
    """Nested dictionaries and lists with sharded tensors gathered on the CPU; all processes must ask, those with
    ``keep`` get them.
    """

    def gathered(value: Tensor) -> Tensor:
        if not hasattr(value, "full_tensor"):
            return value
        full = value.full_tensor()  # type: ignore[attr-defined]
        return full.cpu() if keep else full.new_empty(0)

    return _mapped(tree, gathered)


def sharded_like(value: Tensor, like: Tensor) -> Tensor:
    """A whole tensor spread as ``like`` is (which may mean: as it is)."""
    if not hasattr(like, "full_tensor"):
        return value
    from torch.distributed.tensor import distribute_tensor

    return distribute_tensor(value.to(like.device), like.device_mesh, like.placements)  # type: ignore[attr-defined]


def own_part(value: Tensor) -> Tensor:
    """What this process holds of a tensor; shares its memory."""
    return value.to_local() if hasattr(value, "full_tensor") else value  # type: ignore[attr-defined]
