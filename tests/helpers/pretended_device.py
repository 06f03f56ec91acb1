"""A GPU that nobody has: torch's fake tensors on ``cuda``, and answers for what code asks of their values.

Fake tensors know their device, shape and precision, and mixing devices raises as on a real GPU. What depends on values
(is anything known? which rows?) has no answer there; so one is given: no or yes, and "all rows" for yes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

DEVICE = torch.device("cuda", 0)
_INDEXING = (torch.ops.aten.index.Tensor, torch.ops.aten.index_put.default, torch.ops.aten.index_put_.default)


class Answers(TorchDispatchMode):
    """The same answer to every question about a value."""

    def __init__(self, answer: bool):
        super().__init__()
        self.answer = answer

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Scalars and rows that were asked for; all else goes on to the fake tensors."""
        if func is torch.ops.aten._local_scalar_dense.default:
            dtype = args[0].dtype
            kind = bool if dtype == torch.bool else float if dtype.is_floating_point else int
            return kind(self.answer)
        if func is torch.ops.aten.nonzero.default:
            count = args[0].numel() if self.answer else 0
            return torch.empty(count, args[0].ndim, dtype=torch.int64, device=args[0].device)
        if func is torch.ops.aten.bincount.default:
            least = args[2] if len(args) > 2 else (kwargs or {}).get("minlength", 0)
            return torch.empty(max(least, 1), dtype=torch.int64, device=args[0].device)
        if func in _INDEXING and any(_is_mask(one) for one in args[1]):
            indices: list[Tensor | None] = []
            for one in args[1]:
                if not _is_mask(one):
                    indices.append(one)
                    continue
                rows = torch.empty(one.numel() if self.answer else 0, dtype=torch.int64, device=one.device)
                indices += [rows] * one.ndim
            args = (args[0], indices, *args[2:])
        return func(*args, **(kwargs or {}))


def _is_mask(index: Tensor | None) -> bool:
    return index is not None and index.dtype == torch.bool


@contextmanager
def pretended(answer: bool) -> Iterator[None]:
    """Within, tensors are fake; values that code asks for are ``answer``."""
    with FakeTensorMode(), Answers(answer):
        yield


@contextmanager
def made_there(dtype: torch.dtype = torch.float32) -> Iterator[None]:
    """Modules that are made within have weights on the pretended device; moving them there later is not possible."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        with DEVICE:
            yield
    finally:
        torch.set_default_dtype(before)


def drawn(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Any tensor on the pretended device."""
    return torch.rand(*shape, device=DEVICE, dtype=dtype)
