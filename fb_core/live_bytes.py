"""How many bytes of tensors are alive at once while code runs; on the meta device, without computing or allocating anything."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from contextlib import ExitStack
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class LiveBytes:
    """A context manager that counts the storages that operations make while it is entered, until they are freed.

    ``with LiveBytes() as live: network(x)`` leaves the most bytes that were alive at once in ``live.peak``; tensors that were there
    before do not count. Scratch memory inside an operation is not seen, but for that of convolutions, which is counted as on a CPU.
    Attention counts as its fused kernels need memory (its output), also on the meta device, where torch would write out all weights.
    """

    def __init__(self) -> None:
        self.now = 0
        """Bytes alive."""
        self.peak = 0
        """Most bytes alive since entered."""
        self._sizes: dict[int, tuple[weakref.ref, int]] = {}
        self._modes = ExitStack()

    def __enter__(self) -> LiveBytes:
        self._modes.enter_context(_Counting(self))
        self._modes.enter_context(_FusedAttention())
        return self

    def __exit__(self, *error: object) -> None:
        self._modes.close()

    def _known_before(self, tensors: Iterable[Any]) -> None:
        for tensor in tensors:
            if isinstance(tensor, Tensor) and tensor.untyped_storage()._cdata not in self._sizes:
                self._remember(tensor.untyped_storage(), 0)

    def _made(self, tensors: Iterable[Any], scratch: int) -> None:
        for tensor in tensors:
            if isinstance(tensor, Tensor) and tensor.untyped_storage()._cdata not in self._sizes:
                storage = tensor.untyped_storage()
                self._remember(storage, storage.nbytes())
        self.peak = max(self.peak, self.now + scratch)

    def _remember(self, storage: torch.UntypedStorage, size: int) -> None:
        key = storage._cdata

        def freed(_: weakref.ref) -> None:
            self._sizes.pop(key, None)
            self.now -= size

        self._sizes[key] = weakref.ref(storage, freed), size
        self.now += size


class _Counting(TorchDispatchMode):
    """Tells its counter of every operation's tensors."""

    def __init__(self, live: LiveBytes):
        super().__init__()
        self.live = live

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        self.live._known_before(tree_leaves((args, kwargs)))
        made = func(*args, **kwargs)
        self.live._made(tree_leaves(made), _convolution_scratch(*args[:2]) if func in _CONVOLUTIONS else 0)
        return made


_CONVOLUTIONS = (torch.ops.aten.convolution.default,)


def _convolution_scratch(pixels: Tensor, weight: Tensor) -> int:
    """Copies of pixels and weights in another order in float32; all patches side by side where half precision is emulated."""
    if weight.element_size() >= 4:
        return pixels.numel() * pixels.element_size() + weight.numel() * weight.element_size()
    return pixels.numel() * pixels.element_size() * weight.shape[-1] * weight.shape[-2]


class _FusedAttention(TorchFunctionMode):
    """On the meta device, attention makes its output only, laid out as fused kernels do: heads next to channels."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        if func is F.scaled_dot_product_attention and args[0].is_meta:
            query, value = args[0], args[2]
            batch, heads, words, _ = query.shape
            return query.new_empty(batch, words, heads, value.shape[-1]).transpose(1, 2)
        return func(*args, **(kwargs or {}))
