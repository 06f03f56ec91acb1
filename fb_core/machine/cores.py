"""Cores that nothing else is busy on."""

from __future__ import annotations

import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

from fb_core.machine.resources import usable_cores

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
