"""Cores that nothing else is busy on."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from fb_core.machine.resources import busy_seconds, usable_cores

_LOOKS_EVERY_SECONDS, _OLD_SECONDS = 5.0, 60.0
_IDLE_SHARE = 0.3  # of a core that others may use while it still counts as free


@dataclass(frozen=True, kw_only=True)
class _Look:
    """What a look at the machine has found."""

    at: float
    """By `time.monotonic`."""
    busy: float | None
    """Seconds that the cores of this process have worked since the system's start; None where it does not tell."""
    own: float
    """Those among them that this process took."""
    free: int


_last_look = _Look(at=-1e9, busy=None, own=0.0, free=1)


def free_cores() -> int:
    """Cores that this process may use and that nothing else is busy on, 1 at least; looked at every few seconds.

    What this process does itself is no reason to leave a core alone: the load average counts its threads too, so it
    decides only where there was no look shortly before, or where the system tells nothing else.
    """
    global _last_look
    before, now = _last_look, time.monotonic()
    if now - before.at <= _LOOKS_EVERY_SECONDS:
        return before.free
    busy, own = busy_seconds(), time.process_time()
    if busy is not None and before.busy is not None and now - before.at < _OLD_SECONDS:
        others = (busy - before.busy - (own - before.own)) / (now - before.at)
    else:
        others = (os.getloadavg()[0] if hasattr(os, "getloadavg") else 1.0) - 1  # this process is 1 of the load
    free = max(1, usable_cores() - max(0, math.ceil(others - _IDLE_SHARE)))
    _last_look = _Look(at=now, busy=busy, own=own, free=free)
    return free


@contextmanager
def fixed_number(fixed: ContextVar[int | None], number: int) -> Iterator[None]:
    """Inside the block the variable says how many threads are to be taken, whatever is free, for measuring and for
    tests.

    Raises ValueError for a number below 1.
    """
    if number < 1:
        raise ValueError(f"number: expected 1 thread or more, got {number}")
    token = fixed.set(number)
    try:
        yield
    finally:
        fixed.reset(token)
