"""A finished run of ``ns-train``, loaded as nerfstudio's evaluation commands load it, without their messages."""

from __future__ import annotations

import contextlib
import io
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without nerfstudio's tables and messages, which would tear progress bars apart."""
    from nerfstudio.utils.rich_utils import CONSOLE

    before, CONSOLE.quiet = CONSOLE.quiet, True
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        CONSOLE.quiet = before


def load_run(run: Path) -> Any:
    """The pipeline of the run whose folder holds config.yml, from its latest checkpoint, in evaluation mode.

    Raises ValueError when there is no run in the folder, when it has no checkpoint yet, and when it is of another method.
    """
    _latest_checkpoint(run)
    from nerfstudio.utils.eval_utils import eval_setup

    from fb_nerfstudio.datamanager import FillerbusterDataManager

    with quiet():
        pipeline: Any = eval_setup(run / "config.yml", test_mode="test")[1].eval()
    if not isinstance(pipeline.datamanager, FillerbusterDataManager):
        name = type(pipeline.datamanager).__name__
        raise ValueError(f"run {run}: expected a run of fillerbuster or fillerbuster-none, got one with {name}")
    return pipeline


def read_run(run: Path) -> tuple[Any, dict[str, Any]]:
    """Trainer config and latest checkpoint of a run, on the CPU; nothing is built from them.

    Raises ValueError when there is no run in the folder, and when it has no checkpoint yet or a broken one.
    """
    path = _latest_checkpoint(run)
    import torch
    import yaml

    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    try:
        return config, torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ValueError(
            f"run {run}: its checkpoint {path.name} cannot be read ({error}); restore it, or remove it for the one before"
        ) from error


def _latest_checkpoint(run: Path) -> Path:
    if not (run / "config.yml").is_file():
        raise ValueError(f"run {run}: no config.yml there; give the folder that ns-train has made (output/experiment/method/time)")
    checkpoints = sorted((run / "nerfstudio_models").glob("step-*.ckpt"))
    if not checkpoints:
        raise ValueError(f"run {run}: it has no checkpoint yet; let it train on")
    return checkpoints[-1]
