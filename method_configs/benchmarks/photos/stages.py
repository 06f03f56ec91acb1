"""The stages of finding cameras, and how long each of them takes."""

from __future__ import annotations

import time
from collections.abc import Sequence

STAGES = ("features", "matches", "cameras")
"""Reading photos and finding features; matching them; all else."""


def clocks() -> tuple[float, float]:
    """Seconds by the clock, and of this process on processors."""
    return time.perf_counter(), time.process_time()


def between(marks: Sequence[tuple[float, float] | None]) -> dict[str, tuple[float, float]]:
    """Seconds of each stage from the moments at which they began, and the end; a stage that never began took none."""
    known: list[tuple[float, float]] = []
    for mark in reversed(marks):
        known.append(known[-1] if mark is None else mark)
    known.reverse()
    return {
        stage: (known[number + 1][0] - known[number][0], known[number + 1][1] - known[number][1])
        for number, stage in enumerate(STAGES)
    }
