"""A refusal in one sentence, and soon."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest

SECONDS = 3.0


def refused(act: Callable[[], Any]) -> str:
    """The sentence, which must come soon; time is this process's own, since other work may share the machine."""
    began = time.process_time()
    with pytest.raises(ValueError) as error:
        act()
    assert time.process_time() - began < SECONDS
    sentence = str(error.value)
    assert 0 < len(sentence) < 700 and "\n" not in sentence, sentence
    return sentence


HUGE_INTEGER = "1" + "0" * 400
