"""``python -m method_configs.train``: `fillerbuster train` for machines with torch, einops, jaxtyping and safetensors
only.

torchrun starts this module too. Its options are those of `train_preset`, read from its signature.
"""

from __future__ import annotations

import argparse
import inspect
import logging
import os
import sys
import typing
from collections.abc import Sequence
from pathlib import Path

from fb_core.files.faults import sentence_of
from fb_core.machine.interruption import ENDED_BY_USER, stop_on_signals
from fb_core.training.run.distributed import left_at_once
from method_configs.commands.training import train_preset


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse and train. An error that a user can mend is one sentence on stderr and a non-zero exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(message)s", datefmt="%H:%M:%S", stream=sys.stderr)
    for package in ("fb_core", "method_configs"):
        logging.getLogger(package).setLevel(logging.INFO if os.environ.get("RANK", "0") == "0" else logging.WARNING)
    stop_on_signals()
    try:
        train_preset(**vars(parser().parse_args(arguments)))
    except KeyboardInterrupt:
        sys.stderr.write("Stopped.\n")
        sys.exit(ENDED_BY_USER)
    except (ValueError, FloatingPointError, OSError) as error:
        sys.exit(f"Error: {sentence_of(error)}")


def parser() -> argparse.ArgumentParser:
    """Options from the signature of `train_preset`."""
    options = argparse.ArgumentParser(prog="python -m method_configs.train", description=__doc__)
    types = typing.get_type_hints(train_preset)
    for name, parameter in inspect.signature(train_preset).parameters.items():
        flag = "--" + name.replace("_", "-")
        if name == "preset":
            options.add_argument(name)
        elif types[name] is bool:
            options.add_argument(flag, action=argparse.BooleanOptionalAction, default=parameter.default)
        else:
            kind = next(
                kind for kind in (Path, int, float, str) if kind is types[name] or kind in typing.get_args(types[name])
            )
            options.add_argument(
                flag, type=kind, required=parameter.default is parameter.empty, default=parameter.default
            )
    return options


if __name__ == "__main__":
    with left_at_once():
        main()
