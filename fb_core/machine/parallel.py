"""Independent jobs on threads, for work that libraries do without Python's lock; the results are those of one
thread.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import TypeVar

import torch

from fb_core.machine.cores import fixed_number, free_cores
from fb_core.machine.resources import free_memory_bytes

Item = TypeVar("Item")
Result = TypeVar("Result")
_fixed: ContextVar[int | None] = ContextVar("fixed_workers", default=None)


def workers_for(jobs: int, bytes_each: float) -> int:
    """Threads for so many jobs that each take so many bytes at once: as many as find a free core and together at most
    half of the free memory, 1 at least; or as `fixed_workers` says.
    """
    fixed = _fixed.get()
    if fixed is not None:
        return fixed
    free = free_memory_bytes()
    room = jobs if free is None else int(free / 2 / max(bytes_each, 1.0))
    return max(1, min(jobs, free_cores(), room))


def fixed_workers(number: int) -> AbstractContextManager[None]:
    """Inside the block so many threads, whatever is free, for measuring and for tests.

    Raises ValueError for a number below 1.
    """
    return fixed_number(_fixed, number)


def in_order(work: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """The results for all items in their order, to the bit those of one thread; an error comes where its result would.

    At most ``workers`` items are worked on at once, and at most twice as many results wait. torch computes on one
    thread in each of them, also where there is one worker: how it shares its sums among threads changes their last
    digits. To be exhausted, or closed.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # new threads begin with the number that was set last
    try:
        if workers <= 1:
            yield from map(work, items)
            return
        waiting: deque[Future[Result]] = deque()
        with ThreadPoolExecutor(workers, thread_name_prefix="fillerbuster") as pool:
            try:
                for item in items:
                    waiting.append(pool.submit(work, item))
                    if len(waiting) >= 2 * workers:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:  # an error, Ctrl-C, or nobody asks for more
                for future in waiting:
                    future.cancel()
    finally:
        torch.set_num_threads(before)
