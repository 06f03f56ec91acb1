"""A finished run of ``ns-train``, loaded without nerfstudio's messages, and without running anything that its files
name.
"""

from __future__ import annotations

import contextlib
import io
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fb_core.files.whole import swept


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

    The same as nerfstudio's ``eval_setup`` gives, but for what it does with files: options and weights are read as
    plain values.

    Raises ValueError as :func:`read_run`.
    """
    config, state = read_run(run)
    import torch

    with quiet():
        pipeline = config.pipeline.setup(
            device=torch.device("cuda" if torch.cuda.is_available() else "cpu"), test_mode="test"
        ).eval()
        pipeline.load_pipeline(state["pipeline"], state["step"])
    return pipeline


def read_run(run: Path) -> tuple[Any, dict[str, Any]]:
    """Trainer config and latest checkpoint of a run, on the CPU; nothing is built from them.

    Raises ValueError when there is no run in the folder, when its config.yml names anything but what a run of ours is
    made of (as a run of another method does), and when it has no checkpoint yet or a broken one.
    """
    path = _latest_checkpoint(swept(run))
    import torch

    from fb_nerfstudio.runs.run_config import read_run_config

    config = read_run_config(run / "config.yml")
    _require_our_parts(run, config)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise ValueError(
            f"run {run}: its checkpoint {path.name} cannot be read ({error}); restore it, or remove it for the one "
            "before"
        ) from error
    if not (isinstance(state, dict) and isinstance(state.get("pipeline"), dict) and isinstance(state.get("step"), int)):
        raise ValueError(
            f"run {run}: {path.name} is no checkpoint of ns-train; restore it, or remove it for the one before"
        )
    return config, state


def capture_of(config: Any) -> Path:
    """Where the capture of a run lies, by its options."""
    return Path(config.pipeline.datamanager.data or config.data or config.pipeline.datamanager.dataparser.data)


def identity_of(run: Path, state: dict[str, Any]) -> dict[str, Any]:
    """What tells the latest checkpoint of a run that was read, whose content is ``state``, from every other, in what
    JSON can hold.
    """
    file = _checkpoints(run)[-1].stat()
    return {"run": str(run.absolute()), "step": state["step"], "checkpoint": [file.st_size, file.st_mtime_ns]}


def _require_our_parts(run: Path, config: Any) -> None:
    """Raises ValueError for options of another pipeline, datamanager or model than ours, before any of them is
    built.
    """
    from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

    from fb_nerfstudio.datamanager import FillerbusterDataManagerConfig
    from fb_nerfstudio.splats.splat_model import FillerbusterSplatModelConfig

    parts = {
        VanillaPipelineConfig: config.pipeline,
        FillerbusterDataManagerConfig: getattr(config.pipeline, "datamanager", None),
        FillerbusterSplatModelConfig: getattr(config.pipeline, "model", None),
    }
    for kind, part in parts.items():
        if not isinstance(part, kind):
            raise ValueError(
                f"run {run}: expected a run of fillerbuster or fillerbuster-none, got one with {type(part).__name__}"
            )


def _latest_checkpoint(run: Path) -> Path:
    """The file. Raises ValueError when there is no run in the folder, or no checkpoint."""
    if not (run / "config.yml").is_file():
        raise ValueError(
            f"run {run}: no config.yml there; give the folder that ns-train has made (output/experiment/method/time)"
        )
    checkpoints = _checkpoints(run)
    if not checkpoints:
        raise ValueError(f"run {run}: it has no checkpoint yet; let it train on")
    return checkpoints[-1]


def _checkpoints(run: Path) -> list[Path]:
    """From the oldest to the latest."""
    return sorted((run / "nerfstudio_models").glob("step-*.ckpt"))
