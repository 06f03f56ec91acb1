"""Ctrl-C and SIGTERM, told to a program when it can stand them: never in the middle of an import.

Python raises KeyboardInterrupt wherever the main thread happens to be. An import is no place to be left: modules
swallow it in an ``except:`` around an optional dependency, so that the command goes on, or stay half set up, which is a
crash later.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

ENDED_BY_USER = 128 + signal.SIGINT
"""Exit code of a command that Ctrl-C has ended, as shells report it."""
DEBUG_VARIABLE = "FILLERBUSTER_DEBUG"
"""Environment variable that, set to anything, shows the traceback of an error."""
_LATER_SECONDS = 0.05


def raise_interrupt(number: int) -> NoReturn:
    """KeyboardInterrupt for Ctrl-C; SystemExit(128 + number) for others, so that children are ended on the way out."""
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    raise SystemExit(128 + number)


def stop_on_signals(stop: Callable[[int], object] = raise_interrupt) -> None:
    """From now on ``stop(number)``, which raises or notes it, is called in the main thread for SIGINT and SIGTERM.

    A signal that comes during an import waits for the very end of it, and one whose error was lost in a place from
    where Python cannot raise (a destructor, a callback of C code) comes again. Outside the main thread Python sets no
    handlers, nor does this.
    """
    if threading.current_thread() is not threading.main_thread():
        return

    came = signal.SIGINT

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = signal.Signals(number)
        importer = _importer(frame)
        if importer is None:
            stop(number)
        elif sys.gettrace() is None:
            _call_after_import(importer, lambda: stop(number))
        else:  # a debugger's place
            _again(number)

    def report(lost: Any) -> None:
        """Errors that Python could not raise are printed, as it does; an interruption comes again."""
        if issubclass(lost.exc_type, KeyboardInterrupt | SystemExit):
            _again(came)
        else:
            sys.__unraisablehook__(lost)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handle)
    sys.unraisablehook = report


@contextmanager
def signals_given_back() -> Iterator[None]:
    """After the block SIGINT and SIGTERM go to whom they went before it, whatever was asked for inside."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    hook = sys.unraisablehook
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook


def _again(number: int) -> None:
    """Sends this process's main thread the signal a moment later."""
    main = threading.main_thread().ident
    assert main is not None  # it runs
    later = threading.Timer(_LATER_SECONDS, signal.pthread_kill, (main, number))
    later.daemon = True
    later.start()


def _importer(frame: FrameType | None) -> FrameType | None:
    """The frame whose code has begun the outermost import that is under way; None outside of imports."""
    importer = None
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            importer = frame.f_back
        frame = frame.f_back
    return importer


def _call_after_import(importer: FrameType, call: Callable[[], object]) -> None:
    """Call as soon as this frame goes on, which is when its import has ended, and before anything else. Asking again
    later by the clock would miss commands that end soon after.
    """

    def trace(frame: FrameType, event: str, argument: Any) -> None:
        sys.settrace(None)
        frame.f_trace, frame.f_trace_opcodes = None, False
        call()

    importer.f_trace, importer.f_trace_opcodes = trace, True  # not at its next line, but at once
    sys.settrace(lambda *_: None)  # of this thread: new frames are not traced, the importer's is
