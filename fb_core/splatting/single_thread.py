"""Run torch's CPU kernels on the calling thread alone, in the precision of their inputs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch


@contextmanager
def single_thread() -> Iterator[None]:
    """Hold torch's intra-op pool at one thread inside the block, keep autocast out, and give the caller's settings back
    afterwards.

    Why: the rasterizer works on blocks that fit in the cache, about a tenth of a millisecond an operation. A parallel
    region around each costs more than it saves, and on a machine that is shared (a data loader, a viewer, a second
    training) the OpenMP barriers spin: measured, two threads on two busy cores took 6.2 s where one took 0.16 s.
    Whoever has idle cores renders several views in several processes instead. Autocast would put products of half the
    digits into buffers of full precision; a backward pass inside it comes back here too.
    """
    with ExitStack() as settings:
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                settings.enter_context(torch.autocast(device, enabled=False))
        before = torch.get_num_threads()
        if before != 1:
            torch.set_num_threads(1)
            settings.callback(torch.set_num_threads, before)
        yield
