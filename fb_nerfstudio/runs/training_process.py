"""``ns-train`` as a child process whose progress (generated views, training steps) is read from what it prints."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

from fb_core.files.faults import CannotWrite

Report = Callable[[str, int, int], None]
"""(phase, done, total); the phase is ``generate`` (denoising steps of all rounds) or ``train`` (iterations)."""

_ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")
_TRAINING_STEP = re.compile(r"(\d+) \(\d+\.\d+%\)")
_DENOISING_STEP = re.compile(r"(?:Anchors|Inpainted|Round (\d+)): \d+ views\D*?(\d+)/(\d+)\s")
_WINDOW = 4000  # characters that are searched for the latest progress


class TrainingProcess:
    """One running ``ns-train`` on the cores it is given; everything it prints goes to a file."""

    def __init__(
        self, arguments: Sequence[str], *, log: Path, iterations: int, rounds: int, threads: int, report: Report
    ):
        """Starts at once.

        Args:
            arguments: what follows ``ns-train``.
            log: file for the output.
            iterations: training steps that were asked for.
            rounds: rounds of generated views that were asked for (0 without completion).
            threads: threads that torch may use.
            report: told of progress, from another thread.
        """
        self.name, self.log, self.seconds = arguments[0], log, {"generate": 0.0, "all": 0.0}
        self._iterations, self._rounds, self._report = iterations, rounds, report
        self._began = time.monotonic()
        self._generating_since: float | None = None
        self._generated = 0.0  # seconds of generations that are over
        self._tail = ""  # of what it prints, also where its log cannot be written
        self._unwritten: CannotWrite | None = None
        # A forced terminal makes rich print the bars of the generation into the pipe, where they are read below.
        surroundings = {"FORCE_COLOR": "1", "TERM": "xterm-256color", "COLUMNS": "120", "PYTHONUNBUFFERED": "1"}
        try:
            opened = log.open("wb", buffering=0)  # each piece is on the disk at once, for whoever looks at the file
        except OSError as error:
            raise CannotWrite(log, error) from error
        self._child = subprocess.Popen(
            [str(Path(sys.executable).with_name("ns-train")), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env={**os.environ, **surroundings, "OMP_NUM_THREADS": str(threads)},
        )
        self._reader = threading.Thread(target=self._read, args=(opened,), daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """The process's number."""
        return self._child.pid

    @property
    def running(self) -> bool:
        """Whether the training has not ended yet."""
        return self._child.poll() is None

    def finish(self) -> None:
        """Wait for the end. Raises ValueError with the last line of the output when the training failed."""
        code = self._child.wait()
        self._reader.join()
        if code != 0:
            lines = [line for line in self._tail.splitlines() if line.strip()]
            last = lines[-1].strip() if lines else "no output"
            where = f"all of its output: {self.log}" if self._unwritten is None else str(self._unwritten)
            raise ValueError(f"ns-train {self.name} ended with code {code}: {last} ({where})")

    def stop(self) -> None:
        """End the training if it still runs."""
        if self.running:
            self._child.terminate()
            try:
                self._child.wait(timeout=10)
            except subprocess.TimeoutExpired:
                self._child.kill()
        self._reader.join(timeout=10)

    def _read(self, log: IO[bytes]) -> None:
        assert self._child.stdout is not None
        window = ""
        with log:
            while chunk := os.read(self._child.stdout.fileno(), 1 << 16):
                text = chunk.decode("utf-8", errors="replace")
                window = (window + text)[-_WINDOW:]
                self._keep(log, _ESCAPES.sub("", text))
                self._follow(_ESCAPES.sub("", window))
        self._child.stdout.close()
        self.seconds["all"] = time.monotonic() - self._began

    def _keep(self, log: IO[bytes], text: str) -> None:
        """Write to the log while that is possible. The pipe is read on in any case, or the training would wait for
        ever.
        """
        self._tail = (self._tail + text)[-_WINDOW:]
        if self._unwritten is None:
            try:
                log.write(text.encode())
            except OSError as error:
                self._unwritten = CannotWrite(self.log, error)

    def _follow(self, text: str) -> None:
        """Report the latest progress that ``text`` tells of."""
        trained, denoised = _last(_TRAINING_STEP, text), _last(_DENOISING_STEP, text)
        if denoised is not None and (trained is None or denoised.end() > trained.end()):
            now = time.monotonic()
            self._generating_since = self._generating_since or now
            self.seconds["generate"] = self._generated + now - self._generating_since
            done, total = int(denoised[2]), int(denoised[3])
            self._report("generate", int(denoised[1] or 0) * total + done, self._rounds * total)
        elif trained is not None:
            self._generated, self._generating_since = (
                self.seconds["generate"],
                None,
            )  # rounds may have training between them
            self._report("train", min(int(trained[1]) + 1, self._iterations), self._iterations)


def _last(pattern: re.Pattern[str], text: str) -> re.Match[str] | None:
    return next(iter(reversed(list(pattern.finditer(text)))), None)
