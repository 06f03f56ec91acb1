"""``fillerbuster train``: a preset's stages one after the other with a progress bar, then the exported model folder."""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from fb_core.training.loop import Run
from fb_core.training.recipe import STAGES, Recipe, export, run_stage
from method_configs.ablations import PRESETS

_logger = logging.getLogger(__name__)


def train_preset(
    preset: str,
    output: Path,
    *,
    stage: str = "all",
    steps: int | None = None,
    minutes: float | None = None,
    device: str | None = None,
    half: bool = True,
) -> Path | None:
    """Train what is not trained yet and export; returns the model's folder, or None while stages are missing.

    Stages end in order: when the time is up in one, those after it are not begun, because the transformer learns the latents of
    finished autoencoders. Raises ValueError for an unknown preset, stage or device, and for steps or minutes that are not positive.
    """
    recipe = _recipe(preset)
    _require_positive(steps=steps, minutes=minutes)
    where = _device(device)
    until = math.inf if minutes is None else time.monotonic() + 60 * minutes
    for name in STAGES if stage == "all" else (stage,):
        if _steps_done(output / name) >= (steps or _steps_planned(recipe, name)):
            _logger.info("%s is trained already", name)
            continue
        if time.monotonic() >= until:
            break
        run = _train_stage(recipe, name, output, where, steps, (until - time.monotonic()) / 60)
        if run.step < run.config.steps:
            _logger.info("%s stopped at step %d of %d; the same command goes on from there", name, run.step, run.config.steps)
            break
    if not all(_steps_done(output / name) for name in STAGES):
        return None
    export(recipe, output, output / "model", dtype=torch.float16 if half else torch.float32)
    return output / "model"


def _recipe(preset: str) -> Recipe:
    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
    return PRESETS[preset]


def _steps_planned(recipe: Recipe, stage: str) -> int:
    return {"image-vae": recipe.image_vae_loop, "raymap-vae": recipe.raymap_vae_loop, "dit": recipe.dit_loop}[stage].steps


def _steps_done(folder: Path) -> int:
    """Steps that the stage's checkpoint has behind it; 0 without one."""
    path = folder / "checkpoint.pt"
    complete = path.exists() and (folder.name == "dit" or (folder / "spread.json").exists())  # killed while measuring its latents
    return torch.load(path, weights_only=True, map_location="cpu", mmap=True)["step"] if complete else 0


def _require_positive(**values: float | None) -> None:
    for name, value in values.items():
        if value is not None and not value > 0:
            raise ValueError(f"{name}: expected a positive number, got {value}")


def _device(name: str | None) -> torch.device:
    """The device asked for, checked before any work; by default the first GPU, or the CPU where there is none."""
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f"device: expected cpu, cuda or cuda:N, got {name!r}") from error
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ValueError(f"device: {name!r} was asked for, but torch finds no GPU on this machine; use cpu")
    return device


def _train_stage(recipe: Recipe, stage: str, folder: Path, device: torch.device, steps: int | None, minutes: float) -> Run:
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[losses]}"),
    )  # fmt: skip
    with Progress(*columns) as progress:
        bar = progress.add_task(stage, total=None, losses="")

        def show(done: int, total: int, losses: dict[str, float]) -> None:
            told = "  ".join(f"{name} {value:.4g}" for name, value in losses.items())
            progress.update(bar, completed=done, total=total, losses=told)

        return run_stage(recipe, stage, folder, device=device, steps=steps, minutes=minutes, on_progress=show)
