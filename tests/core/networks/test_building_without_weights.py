"""A network without weights is built whole or not at all, and nothing of it stays behind in torch."""

import contextlib
import sys
from collections.abc import Iterator
from types import FrameType
from typing import Any

import pytest
import torch
from torch import nn

from fb_core.networks.weights import without_weights


@contextlib.contextmanager
def interrupted_as_torch_puts_its_mode_back() -> Iterator[list[str]]:
    """KeyboardInterrupt in this thread at the moment at which torch forgets its default device
    (findings/torch_device_outlives_an_interruption.sh); what was interrupted is listed.
    """
    happened: list[str] = []
    before = sys.gettrace()

    def trace(frame: FrameType, event: str, argument: Any) -> None:
        if frame.f_code is contextlib._GeneratorContextManager.__exit__.__code__:
            name = frame.f_locals["self"].gen.gi_code.co_name
            if name == "_pop_mode_temporarily":
                happened.append(name)
                raise KeyboardInterrupt

    sys.settrace(trace)
    try:
        yield happened
    finally:
        sys.settrace(before)


def test_an_interruption_leaves_the_default_device_as_it_was():
    with interrupted_as_torch_puts_its_mode_back() as happened:
        network = without_weights(lambda: nn.Linear(2, 3))
    assert not happened and network.weight.device.type == "meta" and not network.training
    assert torch.empty(1).device.type == "cpu"


def test_what_building_raises_arrives_and_leaves_the_default_device_as_it_was():
    def build() -> nn.Module:
        raise ValueError("heads: expected a divisor of 12, got 5.")

    with pytest.raises(ValueError, match="got 5"):
        without_weights(build)
    assert torch.empty(1).device.type == "cpu"
