"""Ranges of bands and of Gaussians on as many threads as are worth it."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import torch
from jaxtyping import Int32
from torch import Tensor

from fb_core.machine.resources import usable_cores

_ROWS_PER_THREAD = 20_000  # (Gaussian, cell), or Gaussians: below these another thread costs more than it saves
_PARTS_PER_THREAD = 4  # some take longer than others
_LOOKS_EVERY_SECONDS, _OLD_SECONDS = 5.0, 60.0
_IDLE_SHARE = 0.3  # of a core that others may use while it still counts as free
_fixed: ContextVar[int | None] = ContextVar("fixed_threads", default=None)


def threads_for(rows: int) -> int:
    """How many threads for so many rows (Gaussian, cell): as many as have enough to do and find a free core, or as
    `fixed_threads` says.
    """
    fixed = _fixed.get()
    if fixed is not None:
        return fixed
    return 1 if rows < 2 * _ROWS_PER_THREAD else min(free_cores(), rows // _ROWS_PER_THREAD)


@contextmanager
def fixed_threads(number: int) -> Iterator[None]:
    """Inside the block so many threads, whatever there is to do, for measuring and for tests.

    Raises ValueError for a number below 1.
    """
    if number < 1:
        raise ValueError(f"number: expected 1 thread or more, got {number}")
    token = _fixed.set(number)
    try:
        yield
    finally:
        _fixed.reset(token)


def in_parts(work: Callable[[int, int], None], starts: Int32[Tensor, " cells+1"], threads: int) -> None:
    """``work(first, last)`` for ranges of bands (or cells) that together are all of them.

    Args:
        work: what is done with those from `first` to `last` (excluded); ranges must not disturb each other.
        starts: where the list of each begins, and how many rows there are in all, by which ranges are cut.
        threads: how many at once.
    """
    cells, rows = starts.shape[0] - 1, int(starts[-1])
    if threads <= 1 or cells < 2:
        work(0, cells)
        return
    parts = min(threads * _PARTS_PER_THREAD, cells)
    cuts = torch.searchsorted(starts, torch.arange(1, parts, dtype=torch.int32) * (rows // parts)).tolist()
    edges = [0, *cuts, cells]
    ranges = [(first, last) for first, last in pairwise(edges) if last > first]
    list(_pool(os.getpid(), threads).map(lambda part: work(*part), ranges))


def in_ranges(work: Callable[[int, int], None], number: int, threads: int) -> None:
    """``work(first, last)`` for ranges that together are 0 to ``number``, about as many as threads; see `in_parts`."""
    parts = min(threads, number)
    if parts <= 1:
        work(0, number)
        return
    edges = [number * part // parts for part in range(parts + 1)]
    list(_pool(os.getpid(), threads).map(lambda part: work(*part), pairwise(edges)))


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
    busy, own = _busy_seconds(), time.process_time()
    if busy is not None and before.busy is not None and now - before.at < _OLD_SECONDS:
        others = (busy - before.busy - (own - before.own)) / (now - before.at)
    else:
        others = (os.getloadavg()[0] if hasattr(os, "getloadavg") else 1.0) - 1  # this process is 1 of the load
    free = max(1, usable_cores() - max(0, math.ceil(others - _IDLE_SHARE)))
    _last_look = _Look(at=now, busy=busy, own=own, free=free)
    return free


def _busy_seconds() -> float | None:
    """Seconds that the cores which this process may use have worked, for whomever; None where the system does not
    tell.
    """
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
        names = {f"cpu{number}" for number in os.sched_getaffinity(0)}
        rows = [line.split() for line in lines if line.split()[:1] and line.split()[0] in names]
        # user, nice, system, (idle, waiting,) interrupts of both kinds, and what the host gave to others
        ticks = sum(int(row[column]) for row in rows for column in (1, 2, 3, 6, 7, 8))
        return ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, IndexError, ValueError):
        return None


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:  # of each process: threads do not outlive a fork
    return ThreadPoolExecutor(max_workers=threads, thread_name_prefix=f"splats-{process}")
