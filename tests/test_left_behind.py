"""What tests may not leave behind in the process (conftest looks after each of them) is seen when it is there."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import pytest
import torch
from conftest import state_of_process

from fb_core.machine.interruption import signals_given_back


@pytest.mark.parametrize(
    ("name", "change", "undo"),
    [
        ("SIGINT", lambda: signal.signal(signal.SIGINT, print), lambda: None),
        ("SIGTERM", lambda: signal.signal(signal.SIGTERM, print), lambda: None),
        ("default dtype", lambda: torch.set_default_dtype(torch.float64), lambda: torch.set_default_dtype(torch.float)),
        ("default device", lambda: torch.set_default_device("meta"), lambda: torch.set_default_device(None)),
        ("function modes", lambda: torch.set_default_device("meta"), lambda: torch.set_default_device(None)),
        ("gradients", lambda: torch.set_grad_enabled(False), lambda: torch.set_grad_enabled(True)),
    ],
)
def test_what_is_changed_is_seen(name: str, change: Callable, undo: Callable) -> None:
    before = state_of_process()
    with signals_given_back():
        try:
            change()
            during = state_of_process()
        finally:
            undo()
    assert during[name] != before[name] and state_of_process() == before


@pytest.mark.parametrize("block", [nullcontext(), torch.no_grad(), torch.device("meta")])
def test_what_ends_with_its_block_is_no_fault(block: AbstractContextManager) -> None:
    before = state_of_process()
    with block:
        torch.zeros(1)
    assert state_of_process() == before
