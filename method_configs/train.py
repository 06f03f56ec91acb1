"""``python -m method_configs.train``: `fillerbuster train` for machines with torch, einops, jaxtyping and safetensors
only.

torchrun starts this module too. Its options are those of the command, `TrainOptions`.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import os
import sys
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from fb_core.data.training.named_data import TrainingData
from fb_core.files.faults import sentence_of
from fb_core.machine.interruption import ENDED_BY_USER, signals_given_back, stop_on_signals
from fb_core.training.run.distributed import left_at_once
from method_configs.commands.train_options import TrainOptions
from method_configs.commands.training import train_preset


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse and train. An error that a user can mend is one sentence on stderr and a non-zero exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", datefmt="%H:%M:%S", stream=sys.stderr)
    for package in ("fb_core", "method_configs"):
        logging.getLogger(package).setLevel(logging.INFO if os.environ.get("RANK", "0") == "0" else logging.WARNING)
    with signals_given_back():  # whoever calls this from Python keeps their own
        stop_on_signals()
        given = parser().parse_args(arguments)
        try:
            train_preset(given.preset, given.output, options_of(given))
        except KeyboardInterrupt:
            sys.stderr.write("Stopped.\n")
            sys.exit(ENDED_BY_USER)
        except (ValueError, FloatingPointError, OSError) as error:
            sys.exit(f"Error: {sentence_of(error)}")


def parser() -> argparse.ArgumentParser:
    """Options from the fields of `TrainOptions`, those of the data's places among them."""
    flags = argparse.ArgumentParser(prog="python -m method_configs.train", description=__doc__)
    flags.add_argument("preset")
    flags.add_argument("--output", type=Path, required=True)
    for options in (TrainOptions, TrainingData):
        types = typing.get_type_hints(options)
        for field in dataclasses.fields(options):
            kind = types[field.name]
            if kind is TrainingData:
                continue
            flag = "--" + field.name.replace("_", "-")
            if kind is bool:
                flags.add_argument(flag, action=argparse.BooleanOptionalAction, default=field.default)
            else:
                flags.add_argument(flag, default=field.default, **_kind(kind))
    return flags


def options_of(given: argparse.Namespace) -> TrainOptions:
    """What was asked for. Raises ValueError for steps or minutes that are not positive."""
    values = vars(given)
    data = TrainingData(**{field.name: values[field.name] for field in dataclasses.fields(TrainingData)})
    own = {field.name: values[field.name] for field in dataclasses.fields(TrainOptions) if field.name != "data"}
    return TrainOptions(data=data, **own)


def _kind(hint: Any) -> dict[str, Any]:
    """What argparse is to know of a field's type: one of a few words, or a number, a word, a path; None among them."""
    parts = [part for part in typing.get_args(hint) or (hint,) if part is not type(None)]
    words = [word for part in (hint, *parts) if typing.get_origin(part) is Literal for word in typing.get_args(part)]
    return {"choices": words} if words else {"type": parts[0]}


if __name__ == "__main__":
    with left_at_once():
        main()
