"""How many bytes of tensors are alive at once while code runs; on the meta device, without computing or allocating
anything.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode


class LiveBytes:
    """A context manager that counts the storages that operations make while it is entered, until they are freed.

    ``with LiveBytes() as live: network(x)`` leaves the most bytes that were alive at once in ``live.peak``; tensors
    that were there before do not count. Scratch memory inside an operation is not seen, but for that of convolutions,
    which is counted as on a CPU. Attention counts as its fused kernels need memory (its output), also on the meta
    device, where torch would write out all weights.
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
        # No function of its own for each storage: the tests' shape checks would check and compile every one of them.
        self._sizes[key] = weakref.ref(storage, partial(self._freed, key, size)), size
        self.now += size

    def _freed(self, key: int, size: int, _: weakref.ref) -> None:
        self._sizes.pop(key, None)
        self.now -= size


class _Counting(TorchDispatchMode):
    """Tells its counter of every operation's tensors."""

    def __init__(self, live: LiveBytes):
        super().__init__()
        self.live = live

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        kwargs = kwargs or {}
        self.live._known_before(_flat(args))
        self.live._known_before(_flat(kwargs.values()))
        shortcut = _SHORTCUTS.get(func) if isinstance(args[0] if args else None, Tensor) and args[0].is_meta else None
        made = shortcut(*args) if shortcut else None
        made = func(*args, **kwargs) if made is None else made
        self.live._made(_flat((made,)), _convolution_scratch(*args[:2]) if func is _ATEN.convolution.default else 0)
        return made


def _flat(values: Iterable[Any]) -> Iterator[Any]:
    """What stands in (nested) lists and tuples."""
    for value in values:
        if isinstance(value, list | tuple):
            yield from _flat(value)
        else:
            yield value


def _convolution_scratch(pixels: Tensor, weight: Tensor) -> int:
    """Copies of pixels and weights in another order in float32; all patches side by side where half precision is
    emulated.
    """
    if weight.element_size() >= 4:
        return pixels.numel() * pixels.element_size() + weight.numel() * weight.element_size()
    return pixels.numel() * pixels.element_size() * weight.shape[-1] * weight.shape[-2]


def _convolved(
    x: Tensor, weight: Tensor, bias: Tensor | None, stride: list[int], padding: list[int], *_: Any
) -> Tensor:
    sides = [(x.shape[i + 2] + 2 * padding[i] - weight.shape[i + 2]) // stride[i] + 1 for i in (0, 1)]
    return x.new_empty(x.shape[0], weight.shape[0], *sides)


def _group_normed(x: Tensor, weight: Any, bias: Any, *sizes: Any) -> tuple:
    count, _channels, _places, groups, _eps = sizes
    return torch.empty_like(x), x.new_empty(count, groups), x.new_empty(count, groups)


def _pointwise(x: Tensor, *others: Any) -> Tensor | None:
    """Like `x` for equal partners and plain numbers; broadcasting and mixed types are left to torch."""
    alike = all(
        not isinstance(other, Tensor) or (other.shape == x.shape and other.dtype == x.dtype) for other in others
    )
    return torch.empty_like(x) if alike and x.is_floating_point() else None


_ATEN = torch.ops.aten
_SHORTCUTS: dict[Any, Callable] = {
    _ATEN.convolution.default: _convolved,
    _ATEN.native_group_norm.default: _group_normed,
    **dict.fromkeys(
        (_ATEN.silu.default, _ATEN.add.Tensor, _ATEN.mul.Tensor, _ATEN.sub.Tensor, _ATEN.div.Tensor), _pointwise
    ),
}
"""Shapes of what torch's own rules on the meta device take long to find."""


class _FusedAttention(TorchFunctionMode):
    """On the meta device, attention makes its output only, laid out as fused kernels do: heads next to channels."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        if func is F.scaled_dot_product_attention and args[0].is_meta:
            query, value = args[0], args[2]
            batch, heads, words, _ = query.shape
            return query.new_empty(batch, words, heads, value.shape[-1]).transpose(1, 2)
        return func(*args, **(kwargs or {}))
