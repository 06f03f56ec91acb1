"""Ranges of bands and of Gaussians on as many threads as are worth it."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from contextvars import ContextVar
from functools import cache
from itertools import pairwise

import torch
from jaxtyping import Int32
from torch import Tensor

from fb_core.machine.cores import fixed_number, free_cores

_ROWS_PER_THREAD = 20_000  # (Gaussian, cell), or Gaussians: below these another thread costs more than it saves
_PARTS_PER_THREAD = 4  # some take longer than others
_fixed: ContextVar[int | None] = ContextVar("fixed_threads", default=None)


def threads_for(rows: int) -> int:
    """How many threads for so many rows (Gaussian, cell): as many as have enough to do and find a free core, or as
    `fixed_threads` says.
    """
    fixed = _fixed.get()
    if fixed is not None:
        return fixed
    return 1 if rows < 2 * _ROWS_PER_THREAD else min(free_cores(), rows // _ROWS_PER_THREAD)


def fixed_threads(number: int) -> AbstractContextManager[None]:
    """Inside the block so many threads, whatever there is to do, for measuring and for tests.

    Raises ValueError for a number below 1.
    """
    return fixed_number(_fixed, number)


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


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:  # of each process: threads do not outlive a fork
    return ThreadPoolExecutor(max_workers=threads, thread_name_prefix=f"splats-{process}")
