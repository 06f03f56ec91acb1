"""The device that a person names, and what is said of one that is not there."""

from __future__ import annotations

import pytest
import torch

from fb_core.machine.devices import chosen_device


@pytest.mark.parametrize(("gpus", "expected"), [(0, "cpu"), (2, "cuda")])
def test_without_a_name_it_is_a_gpu_if_there_is_one(gpus: int, expected: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    assert chosen_device(None) == torch.device(expected) and chosen_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize(
    ("gpus", "name", "sentence"),
    [
        (0, "cuda", "'cuda' was asked for, but torch finds no GPU on this machine; use cpu"),
        (2, "cuda:2", "'cuda:2' was asked for, but torch has 2 GPUs; use cpu"),
        (2, "toaster", "expected one that this machine has, such as cpu, cuda or cuda:N, got 'toaster'"),
        (0, "xpu", "expected one that this machine has"),
        (0, "meta", "expected one that this machine has"),
    ],
)
def test_one_that_is_not_there_is_one_sentence(gpus: int, name: str, sentence: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    with pytest.raises(ValueError, match="device: ") as refused:
        chosen_device(name)
    assert sentence in str(refused.value) and "\n" not in str(refused.value)


def test_a_gpu_that_is_there_is_taken_without_touching_it(monkeypatch: pytest.MonkeyPatch):
    """torchrun gives every process another one than the one that is named."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch, "ones", lambda *_, **__: pytest.fail("memory is taken"))
    assert chosen_device("cuda:1") == torch.device("cuda", 1)
