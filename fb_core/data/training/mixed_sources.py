"""Several sources as one: multi-view sources drawn from row by row, and steps of single pictures among steps of
sequences.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.training.task import Draw, Sequences, Source, TaskConfig
from fb_core.sampling.randomness import generator_of


class AnyOf:
    """Each row comes from one of several multi-view sources, with equal odds."""

    def __init__(self, sources: Sequence[Source]):
        self.sources = tuple(sources)

    @property
    def views(self) -> int:
        """What every one of them has."""
        return min(source.views for source in self.sources)

    def advance(self, step: int, rows: range | None = None) -> None:
        """All of them go to this step."""
        for source in self.sources:
            source.advance(step, rows)

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """Each row from one of them."""
        return torch.cat(
            [source.images(one, lambda _, g=generator: g) for source, one, generator in self._choices(rows, draw)]
        )

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """Each row from one of them."""
        return torch.cat(
            [
                source.raymaps(one, task, lambda _, g=generator: g)
                for source, one, generator in self._choices(rows, draw)
            ]
        )

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """Each row from one of them."""
        return one_batch(
            [
                source.sequences(one, task, lambda _, g=generator: g)
                for source, one, generator in self._choices(rows, draw)
            ]
        )

    def _choices(self, rows: range, draw: Draw) -> list[tuple[Source, range, torch.Generator]]:
        """(source, the row alone, its generator) of each row."""
        chosen = []
        for row in rows:
            generator = draw(row)
            source = self.sources[int(torch.randint(len(self.sources), (), generator=generator))]
            chosen.append((source, range(row, rows.stop, rows.stop), generator))
        return chosen


class Alternating:
    """Steps of single pictures among steps of multi-view sequences, as evenly as their share allows (a half: every
    second step).

    So both sources know which batch of theirs a step is, wherever a training is resumed.
    """

    def __init__(self, multi_view: Source, single_view: Source, *, single_share: float):
        if not 0 < single_share < 1:
            raise ValueError(f"single-view share: expected a number between 0 and 1, got {single_share}")
        self.multi_view, self.single_view, self.single_share = multi_view, single_view, single_share
        self._now: Source = multi_view

    @property
    def views(self) -> int:
        """Of the multi-view source."""
        return self.multi_view.views

    def advance(self, step: int, rows: range | None = None) -> None:
        """Choose the step's source and go to its batch."""
        before = math.floor(step * self.single_share)
        is_single = math.floor((step + 1) * self.single_share) > before
        self._now = self.single_view if is_single else self.multi_view
        self._now.advance(before if is_single else step - before, rows)

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """Of the step's source."""
        return self._now.images(rows, draw)

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """Of the multi-view source."""
        return self.multi_view.raymaps(rows, task, draw)

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """Of the step's source."""
        return self._now.sequences(rows, task, draw)


class SeveralPerRow:
    """Several sequences in each row of a batch."""

    def __init__(self, source: Source, count: int):
        self.source, self.count = source, count

    @property
    def views(self) -> int:
        """Of the source."""
        return self.source.views

    def advance(self, step: int, rows: range | None = None) -> None:
        """The source goes to this step."""
        self.source.advance(step, rows)

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """One for each row."""
        return self.source.images(rows, draw)

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """One for each row."""
        return self.source.raymaps(rows, task, draw)

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """``count`` for each row, one after the other from the row's generator."""
        parts = []
        for row in rows:
            generator = draw(row)
            alone = range(row, rows.stop, rows.stop)
            parts += [self.source.sequences(alone, task, lambda _, g=generator: g) for _ in range(self.count)]
        return one_batch(parts)


class Later:
    """One source up to a step, another from then on, with sequences of another length (None = as the task or the source
    says).
    """

    def __init__(self, first: Source, then: Source, *, from_step: int, views: int | None = None):
        self.first, self.then, self.from_step, self._views = first, then, from_step, views
        self._is_later = False

    @property
    def _now(self) -> Source:
        return self.then if self._is_later else self.first

    @property
    def views(self) -> int:
        """Of the first source."""
        return self.first.views

    def advance(self, step: int, rows: range | None = None) -> None:
        """Choose the source and take it to the step, counted from its own first one."""
        self._is_later = step >= self.from_step
        self._now.advance(step - self.from_step if self._is_later else step, rows)

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """Of the step's source."""
        return self._now.images(rows, draw)

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """Of the step's source."""
        return self._now.raymaps(rows, task, draw)

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """Of the step's source, with as many views as its sequences have."""
        own = task if self._views is None or not self._is_later else dataclasses.replace(task, views=self._views)
        return self._now.sequences(rows, own, draw)


def turn(count: int, *, seed: int, step: int) -> tuple[int, int]:
    """Which of ``count`` things a step's turn is, and how often it was that one's turn before.

    Every ``count`` steps each has one turn, in an order of its own: equal odds, known for any step without looking at
    others.
    """
    before, place = divmod(step, count)
    return int(torch.randperm(count, generator=generator_of(seed, before))[place]), before


class InTurn:
    """One of several sources at each step (see :func:`turn`), each with sequences of its own length."""

    def __init__(self, sources: Sequence[Source], *, views: Sequence[int], seed: int):
        self.sources, self._lengths, self.seed = tuple(sources), tuple(views), seed
        self._which = 0

    @property
    def views(self) -> int:
        """What every one of them has."""
        return min(source.views for source in self.sources)

    def advance(self, step: int, rows: range | None = None) -> None:
        """Choose the step's source and take it to the step, counted by its own turns."""
        self._which, before = turn(len(self.sources), seed=self.seed, step=step)
        self.sources[self._which].advance(before, rows)

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """Of the step's source."""
        return self.sources[self._which].images(rows, draw)

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """Of the step's source."""
        return self.sources[self._which].raymaps(rows, task, draw)

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """Of the step's source, with as many views as its sequences have."""
        return self.sources[self._which].sequences(
            rows, dataclasses.replace(task, views=self._lengths[self._which]), draw
        )


_ALL_OR_NONE = ("image_latents", "distance")


def one_batch(parts: list[Sequences]) -> Sequences:
    """One batch of batches of the same sizes.

    Latents and distances are kept if all have them; truth is everywhere where nothing is said.
    """
    fields: dict[str, Tensor | tuple[str, ...] | None] = {}
    for field in dataclasses.fields(Sequences):
        values = [getattr(part, field.name) for part in parts]
        if field.name == "captions":
            given = [value or ("",) * len(part.images) for value, part in zip(values, parts, strict=True)]
            fields[field.name] = sum(given, ()) if any(values) else None
        elif all(value is None for value in values) or (
            field.name in _ALL_OR_NONE and any(value is None for value in values)
        ):
            fields[field.name] = None
        else:
            whole = [
                torch.ones_like(part.image_known) if value is None else value
                for value, part in zip(values, parts, strict=True)
            ]
            fields[field.name] = torch.cat(whole)
    return Sequences(**fields)  # type: ignore[arg-type]
