"""Signals that ask a training to end: Ctrl-C, a cluster that takes its machine back, a job whose time is nearly up."""

from __future__ import annotations

import signal
import threading
from typing import Any

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)


class StopSignal:
    """A context manager that notes a signal instead of dying from it: ``with StopSignal() as stop: ... if stop.number:
    ...``.

    Whoever presses Ctrl-C twice does not want to wait for the end of the step: the second one is a KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.number = 0
        """The signal that came; 0 for none."""
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopSignal:
        if threading.current_thread() is threading.main_thread():  # elsewhere Python sets no handlers
            self._before = {number: signal.signal(number, self._note) for number in STOPPING}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: object) -> None:
        if number == self.number == signal.SIGINT:
            raise KeyboardInterrupt
        self.number = number
