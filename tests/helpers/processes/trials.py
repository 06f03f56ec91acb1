"""Commands that are killed and interrupted at many moments, and go on."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from helpers.processes.contents import content
from helpers.processes.fork_server import Ended, ForkServer, Moment

KILL, INT, TERM = signal.SIGKILL, signal.SIGINT, signal.SIGTERM
FAULTS = ("Traceback", "Exception ignored", "Error:", "core dumped")
"""What no line of a command that was ended by a signal says."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """A command and what must hold of what it leaves."""

    job: dict[str, Any]
    """What `ForkServer.run` takes."""
    prepare: Callable[[Path], None] = lambda folder: None
    """Makes the folder as it is before the command."""
    left: Callable[[Path, Ended], None] = lambda folder, ended: None
    """Asserts what must hold once the command was ended by the signal."""
    going_on: Callable[[Path], dict[str, Any] | None] | None = None
    """The job that goes on, None where all is done; by default the same job."""
    result: Callable[[Path], Any] | None = None
    """What is compared with an undisturbed run; by default names and content of all files."""


def tried(server: ForkServer, root: Path, trial: Trial, moments: Callable[[Ended], Sequence[Moment]]) -> None:
    """Run it undisturbed, then once for each moment; all moments that fail are told at the end."""
    result = trial.result or content
    whole = root / "whole"
    whole.mkdir(parents=True)
    trial.prepare(whole)
    undisturbed = server.run(trial.job, watch=whole)
    assert undisturbed.code == 0, undisturbed.said
    expected, failed, count = result(whole), [], 0
    for moment in moments(undisturbed):
        folder = root / "disturbed"
        folder.mkdir()
        trial.prepare(folder)
        try:
            _disturbed(server, folder, trial, moment, expected)
        except AssertionError as error:
            failed.append(f"{moment}: {str(error)[:1500]}")
        count += 1
        shutil.rmtree(folder)
    assert not failed, f"{len(failed)} of {count} moments:\n" + "\n".join(failed)


def _disturbed(server: ForkServer, folder: Path, trial: Trial, moment: Moment, expected: Any) -> None:
    result = trial.result or content
    ended = server.run(trial.job, watch=folder, moment=moment)
    is_done = ended.code in (0, -moment.signal) and moment.after is not None  # it came too late
    if not is_done:
        ended_well(ended, moment)
    trial.left(folder, ended)
    job = trial.job if trial.going_on is None else trial.going_on(folder)
    if job is not None:
        again = server.run(job, watch=folder)
        assert again.code == 0, f"going on: {again.said[-1500:]}"
    found = result(folder)
    assert found == expected, difference(found, expected)


def ended_well(ended: Ended, moment: Moment) -> None:
    """By the signal: one line and 130 for Ctrl-C, no traceback for any."""
    expected = -KILL if moment.signal == KILL else 128 + moment.signal
    assert ended.code == expected, f"code {ended.code}: {ended.said[-1500:]}"
    if moment.signal != KILL:
        assert not [fault for fault in FAULTS if fault in ended.said], ended.said[-1500:]
    if moment.signal == INT:
        lines = [line for line in ended.said.splitlines() if "Stopped" in line or "stopped by signal" in line]
        assert len(lines) == 1, ended.said[-1500:]
        assert ended.said.rstrip().endswith(lines[0].rstrip()), ended.said[-1500:]


def spread(count: int, of: int) -> list[int]:
    """So many places among 0 ... of - 1, evenly, with the first and the last."""
    return sorted({round(index * (of - 1) / max(1, count - 1)) for index in range(count)})


def moments(*, kill: int, interrupt: int, term: int = 0, timed: int = 0) -> Callable[[Ended], list[Moment]]:
    """Before so many changes of files each, and after ``timed`` shares of the time, for SIGKILL and SIGINT each."""

    def of(whole: Ended) -> list[Moment]:
        counts = {KILL: kill, INT: interrupt, TERM: term}
        events = [
            Moment(signal=number, event=event)
            for number, count in counts.items()
            for event in spread(count, whole.events)
            if count
        ]
        shares = [(index + 0.5) / timed * 0.8 for index in range(timed)]
        return events + [
            Moment(signal=number, after=share * whole.seconds) for share in shares for number in (KILL, INT)
        ]

    return of


def difference(found: Any, expected: Any) -> str:
    if not isinstance(found, dict) or not isinstance(expected, dict):
        return "another result"
    told = [f"{name} is left" for name in found if name not in expected] + [
        f"{name} is missing" for name in expected if name not in found
    ]
    return "; ".join(
        told + [f"{name} is another" for name in found if name in expected and found[name] != expected[name]]
    )
