"""What a stage of a training must offer, and the draws of its rows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from fb_core.sampling.randomness import generator_of


class Stage(ABC):
    """One thing that is trained: a network, the data of a step, and their loss.

    Rows of a step's batch are numbered from 0; a process asks for some of them, ``range(part, batch, parts)``. What a
    row holds depends on (seed, step, row) alone. Losses are means over rows, so that the mean over equal parts is the
    loss of the batch.
    """

    name: str
    """Names the stage's folder."""
    network: nn.Module
    """What is trained, averaged and exported."""
    critic: nn.Module | None = None
    """A further network that is optimised beside it, such as a discriminator. Its loss is part of ``loss``; it is up to
    the stage that neither network gets gradients of the other's loss.
    """

    @property
    @abstractmethod
    def batch(self) -> int:
        """Rows of a step's batch, over all processes."""

    @abstractmethod
    def draw(self, step: int, rows: range) -> Any:
        """The data of these rows; no gradients, full precision. Steps are asked for in order, perhaps ahead from
        another thread.
        """

    @abstractmethod
    def losses(self, drawn: Any) -> dict[str, Tensor]:
        """Mean losses over what was drawn; the entry ``loss`` is what is minimised."""


def row_generator(seed: int, step: int, row: int, stream: int = 0) -> torch.Generator:
    """A CPU generator for one purpose (``stream``) of one row of a step's batch."""
    return generator_of(seed, step, row, stream)
