"""Seconds of the stages of a command."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Seconds of each stage, by a clock that is never set back."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._began = time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """A stage, which is timed even where it ends with an error."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = round(time.perf_counter() - began, 2)

    def rounded(self) -> dict[str, float]:
        """Tenths of seconds of each stage, and in all since the clock was made."""
        every = self.seconds | {"total": time.perf_counter() - self._began}
        return {name: round(value, 1) for name, value in every.items()}
