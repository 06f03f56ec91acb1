"""Options as they were typed, before anybody has looked at them.

The reader of command lines puts a frame and words of its own around an error that comes while it makes an object. So it
makes these, which refuse nothing; what is refused is refused by the command, in one sentence.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar

from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.train_options import TrainOptions

_Options = TypeVar("_Options")


@dataclass(frozen=True, kw_only=True)
class TypedTrainOptions(TrainOptions):
    """As they were typed."""

    def __post_init__(self) -> None:
        pass


@dataclass(frozen=True, kw_only=True)
class TypedCompleteOptions(CompleteOptions):
    """As they were typed."""

    def __post_init__(self) -> None:
        pass


def looked_at(typed: Any, options: type[_Options]) -> _Options:
    """The same values as ``options``. Raises ValueError, in one sentence, for those that make no sense."""
    return options(**{field.name: getattr(typed, field.name) for field in dataclasses.fields(typed)})
