"""Which precision matrix products are fast in on this machine: asked of the processor itself, with a product of each
kind.

Processors with bfloat16 units do a product of bfloat16 about twice as fast as one of float32; without them they emulate
it, many times slower. A list of processors would be wrong for some; a probe takes a fraction of a second.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from functools import cache
from typing import Concatenate, Literal, ParamSpec, Protocol, TypeVar, get_args, runtime_checkable

import torch

Precision = Literal["auto", "float32", "bfloat16"]
"""'auto' is what `resolved` says."""
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
_SIDE = 384
_RUNS = 3
_WORTH = 1.2
"""bfloat16 must be so many times faster to be worth its rounding."""


_P = ParamSpec("_P")
_R = TypeVar("_R")


@runtime_checkable
class _Placed(Protocol):
    @property
    def device(self) -> torch.device: ...


_S = TypeVar("_S", bound=_Placed)


def in_own_precision(method: Callable[Concatenate[_S, _P], _R]) -> Callable[Concatenate[_S, _P], _R]:
    """Keep a caller's autocast out of a method: its object and options say what is computed in which precision."""

    @functools.wraps(method)
    def called(self: _S, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        with torch.autocast(self.device.type, enabled=False):
            return method(self, *args, **kwargs)

    return called


@cache
def bfloat16_speed(device: str) -> float:
    """How many times faster a bfloat16 product is than one of float32 on a kind of device (cpu, cuda, ...), as measured
    now.

    The fastest of a few runs of each counts, by the clock of this thread on a CPU, so that what else runs there matters
    little.
    """
    seconds = {}
    for dtype in (torch.float32, torch.bfloat16):
        a = torch.ones(_SIDE, _SIDE, device=device, dtype=dtype)
        seconds[dtype] = min(_seconds(a) for _ in range(_RUNS + 1))
    return seconds[torch.float32] / max(seconds[torch.bfloat16], 1e-9)


def _seconds(a: torch.Tensor) -> float:
    if a.device.type == "cuda":
        torch.cuda.synchronize(a.device)
    started = time.perf_counter()
    torch.mm(a, a)
    if a.device.type == "cuda":
        torch.cuda.synchronize(a.device)
    return time.perf_counter() - started


def resolved(precision: Precision, device: torch.device | str = "cpu") -> torch.dtype:
    """The dtype that a choice means on a device; 'auto' is bfloat16 where a probe says that it is faster, else float32.

    Raises ValueError for a choice that does not exist.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, got {precision!r}")
    if precision != "auto":
        return torch.bfloat16 if precision == "bfloat16" else torch.float32
    kind = torch.device(device).type
    if kind not in ("cpu", "cuda"):
        return torch.float32
    return torch.bfloat16 if bfloat16_speed(kind) >= _WORTH else torch.float32


def precision_in_words(precision: Precision, device: torch.device | str = "cpu") -> str:
    """One line that says what was chosen and why."""
    chosen = str(resolved(precision, device)).removeprefix("torch.")
    if precision != "auto":
        return f"{chosen}, as asked for"
    return (
        f"{chosen}, because a product of bfloat16 is {bfloat16_speed(torch.device(device).type):.1f} times as "
        "fast as one of float32 here"
    )
