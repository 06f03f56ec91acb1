"""Which cores nothing else is busy on."""

from __future__ import annotations

import pytest

from fb_core.machine import cores


def test_own_threads_leave_a_core_free_and_others_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten seconds on two cores: with both of them its own, a process goes on with two; with one that is taken, not."""
    clock = {"monotonic": 1000.0, "process_time": 0.0, "busy": 0.0}
    monkeypatch.setattr(cores, "usable_cores", lambda: 2)
    monkeypatch.setattr(cores.time, "monotonic", lambda: clock["monotonic"])
    monkeypatch.setattr(cores.time, "process_time", lambda: clock["process_time"])
    monkeypatch.setattr(cores, "busy_seconds", lambda: clock["busy"])
    monkeypatch.setattr(cores.os, "getloadavg", lambda: (3.0, 3.0, 3.0))
    monkeypatch.setattr(cores, "_last_look", cores._Look(at=-1e9, busy=None, own=0.0, free=1))
    assert cores.free_cores() == 1  # the load alone is known
    for own, others, expected in ((19.0, 0.5, 2), (10.0, 10.0, 1), (10.0, 0.0, 2), (0.1, 6.0, 1)):
        clock = {"monotonic": clock["monotonic"] + 10, "process_time": clock["process_time"] + own,
                 "busy": clock["busy"] + own + others}  # fmt: skip
        assert cores.free_cores() == expected, (own, others)
    clock["monotonic"] += 1000  # the last look is too old to tell
    assert cores.free_cores() == 1
