"""Jobs on threads: the results of one thread in their order, bounded in number, and ended by the first error."""

from __future__ import annotations

import threading
import time

import pytest
import torch

from fb_core.machine import parallel
from fb_core.machine.parallel import fixed_workers, in_order, workers_for


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_results_come_in_the_order_of_the_items(workers):
    def late(number: int) -> int:
        time.sleep(0.003 * (number % 3))
        return number**2

    assert list(in_order(late, range(12), workers)) == [number**2 for number in range(12)]
    assert list(in_order(late, [], workers)) == []


@pytest.mark.parametrize("workers", [2, 3])
def test_few_are_worked_on_at_once_and_few_results_wait(workers):
    at_once, begun, most, lock = 0, 0, 0, threading.Lock()

    def counted(number: int) -> int:
        nonlocal at_once, begun, most
        with lock:
            at_once, begun = at_once + 1, begun + 1
            most = max(most, at_once)
        time.sleep(0.002)
        with lock:
            at_once -= 1
        return number

    for done, _ in enumerate(in_order(counted, range(20), workers)):
        assert begun <= done + 2 * workers
    assert most <= workers and begun == 20


@pytest.mark.parametrize("workers", [1, 3])
def test_an_error_comes_where_its_result_would_and_ends_the_rest(workers):
    begun = []

    def failing(number: int) -> int:
        begun.append(number)
        if number == 4:
            raise ValueError("the fourth")
        return number

    seen = []
    with pytest.raises(ValueError, match="the fourth"):
        for result in in_order(failing, range(100), workers):
            seen.append(result)
    assert seen == [0, 1, 2, 3] and len(begun) <= 5 + 2 * workers


@pytest.mark.parametrize("workers", [1, 2])
def test_torch_has_one_thread_inside_and_as_many_as_before_afterwards(workers):
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        assert set(in_order(lambda _: torch.get_num_threads(), range(4), workers)) == {1}
        assert torch.get_num_threads() == 2
        results = in_order(lambda number: number, range(4), workers)
        next(results)
        results.close()
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_workers_are_bounded_by_jobs_cores_and_half_of_the_free_memory(monkeypatch):
    monkeypatch.setattr(parallel, "free_cores", lambda: 8)
    monkeypatch.setattr(parallel, "free_memory_bytes", lambda: 1000)
    assert workers_for(100, 100) == 5
    assert workers_for(3, 1) == 3 and workers_for(100, 1) == 8
    assert workers_for(100, 1e6) == 1 and workers_for(0, 0) == 1
    monkeypatch.setattr(parallel, "free_memory_bytes", lambda: None)
    assert workers_for(100, 1e6) == 8
    with fixed_workers(3):
        assert workers_for(100, 1e6) == 3
    with pytest.raises(ValueError, match="expected 1 thread or more, got 0"), fixed_workers(0):
        pass
