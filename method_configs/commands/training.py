"""``fillerbuster train``: a preset's stages one after the other, then the exported model folder; on one process or
many.

Nothing but fb_core and torch is needed here, so that a bare GPU machine can train (`method_configs.train` is its
entrance).
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import logging
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import torch

from fb_core.checkpoint import CONFIG_FILE, model_target, require_model_or_free
from fb_core.data.meshes.mesh_views import find_meshes
from fb_core.data.training.capture_sequences import find_captures
from fb_core.data.training.folders import TrainingData
from fb_core.data.training.shard_stream import find_shards
from fb_core.files.limits import MOST_TRAINING_STEPS, require_between
from fb_core.machine.resources import usable_device
from fb_core.training.dry_run import Cost, measure
from fb_core.training.recipe import STAGES, Recipe, adopt_autoencoders, export, require_text_encoder, run_stage
from fb_core.training.run.checkpoints import read_state
from fb_core.training.run.distributed import Group, joined
from fb_core.training.run.loop import EngineConfig, OnProgress
from fb_core.training.run.progress_log import ProgressLog
from fb_core.training.stages.perceptual import load_lpips
from method_configs.presets import PRESETS

_logger = logging.getLogger(__name__)
_SECONDS_BETWEEN_LINES = 30.0
GIB = 2**30


def train_preset(
    preset: str,
    output: Path,
    *,
    stage: str = "all",
    steps: int | None = None,
    minutes: float | None = None,
    device: str | None = None,
    half: bool = True,
    precision: str | None = None,
    accumulate: int | None = None,
    recompute: bool = False,
    shard: bool = False,
    sheet_every: int | None = None,
    keep: int | None = None,
    tensorboard: bool = False,
    dry_run: bool = False,
    captures: Path | None = None,
    meshes: Path | None = None,
    images: str | None = None,
    rooms: bool = False,
    text_encoder: Path | None = None,
    lpips: Path | None = None,
    start_from: Path | None = None,
) -> Path | None:
    """Train what is not trained yet and export; returns the model's folder, or None while stages are missing.

    Stages end in order: when the time is up in one, those after it are not begun, because the transformer learns the
    latents of finished autoencoders. Options of the engine that are None or False are the preset's. Under torchrun all
    its processes train together. ``start_from`` is a model folder to begin with; its autoencoders are kept unless a
    stage of theirs is named. The options from ``captures`` to ``lpips`` say where the data lie
    (:class:`fb_core.data.training.folders.TrainingData`).

    Raises ValueError for an unknown preset, stage or device, and for steps or minutes that are not positive. SystemExit
    when a signal ended it, after a checkpoint.
    """
    data = TrainingData(
        captures=captures, meshes=meshes, images=images, rooms=rooms, text_encoder=text_encoder, lpips=lpips
    )
    recipe = dataclasses.replace(_recipe(preset), data=data, start_from=start_from)
    _require_positive(steps=steps, minutes=minutes, accumulate=accumulate, keep=keep)
    require_between("steps", steps or 1, 1, MOST_TRAINING_STEPS)
    stages = STAGES if stage == "all" else (stage,)
    chosen = {"precision": precision, "accumulate": accumulate, "keep": keep, "sheet_every": sheet_every}
    flags = {"recompute": recompute, "shard": shard, "tensorboard": tensorboard}
    changes = {name: value for name, value in chosen.items() if value is not None} | {
        name: True for name, value in flags.items() if value
    }
    engine = dataclasses.replace(recipe.engine, **changes)
    _require_data(recipe, stages, dry_run=dry_run)
    if not dry_run:
        _require_own_model_or_free(output, start_from)  # before days of training, not after them
    with joined(usable_device(device)) as (group, where):
        if dry_run:
            for name in stages:
                _say(group, "%s", _told(name, measure(recipe, name, device=where, engine=engine, group=group)))
            return None
        if stage == "all" and group.is_main:
            adopt_autoencoders(recipe, output)
        group.wait()
        if not _train_stages(
            recipe, stages, output, where, steps, math.inf if minutes is None else minutes, engine, group
        ):
            return None
        if group.is_main:
            export(recipe, output, output / "model", dtype=torch.float16 if half else torch.float32)
        return output / "model"


def _train_stages(
    recipe: Recipe,
    stages: tuple[str, ...],
    output: Path,
    device: torch.device,
    steps: int | None,
    minutes: float,
    engine: EngineConfig,
    group: Group,
) -> bool:
    """Whether every stage has been trained, if only in part."""
    until = time.monotonic() + 60 * minutes
    for name in stages:
        if _steps_done(output / name) >= (steps or _steps_planned(recipe, name)):
            _say(group, "%s is trained already", name)
            if group.is_main and not (output / name / "loss.png").exists():
                ProgressLog(
                    output / name, name, from_step=_steps_done(output / name)
                ).close()  # killed before it was drawn
            continue
        if group.any(time.monotonic() >= until):
            break
        left = (until - time.monotonic()) / 60
        with _progress(name, group) as show:
            run = run_stage(
                recipe,
                name,
                output,
                device=device,
                steps=steps,
                minutes=left,
                on_progress=show,
                engine=engine,
                group=group,
            )
        if run.signal:
            _say(group, "%s stopped by signal %d at step %d of %d, which is saved; the same command goes on from there",
                 name, run.signal, run.step, run.config.steps)  # fmt: skip
            sys.exit(128 + run.signal)
        if run.step < run.config.steps:
            _say(
                group,
                "%s stopped at step %d of %d; the same command goes on from there",
                name,
                run.step,
                run.config.steps,
            )
            break
    return all(_steps_done(output / name) for name in STAGES)


def _require_own_model_or_free(output: Path, start_from: Path | None) -> None:
    """Raises ValueError where the training's model would replace one that it has not made itself, or the one that it
    begins with.
    """
    target = model_target(
        output / "model", overwrite=True, inputs=() if start_from is None else (start_from / CONFIG_FILE,)
    )
    require_model_or_free(target)
    begun = any((output / stage / "checkpoint.pt").exists() for stage in STAGES)
    if not begun and target.folder.is_dir() and any(target.folder.iterdir()):
        raise ValueError(
            f"output {output}: there is a model, but no training that made it; choose another folder, or move the "
            "model away"
        )


def _require_data(recipe: Recipe, stages: tuple[str, ...], *, dry_run: bool) -> None:
    """Raises ValueError, before the first stage, for data that were named and are not there or that the preset does not
    learn from, and for the text model where a later stage needs it.
    """
    data, reads_text = recipe.data, bool(recipe.dit.text_width)
    named = {
        "images": (data.images, bool(recipe.single_view_share), "captioned pictures"),
        "lpips": (data.lpips, bool(recipe.image_vae_loss.perceptual), "LPIPS"),
        "text_encoder": (data.text_encoder, reads_text, "text"),
    }
    for name, (given, is_used, what) in named.items():
        if given is not None and not is_used:
            raise ValueError(
                f"{name}: preset {recipe.name!r} learns nothing from {what}; leave it out, or choose another preset, "
                f"got {given}"
            )
    if data.captures is not None:
        find_captures(data.captures)
    if data.meshes is not None:
        find_meshes(data.meshes)
    if data.images is not None:
        find_shards(data.images)
    if data.lpips is not None and "image-vae" in stages:
        load_lpips(data.lpips)
    if reads_text and "dit" in stages and not (dry_run and data.text_encoder is None):
        require_text_encoder(recipe)


def _recipe(preset: str) -> Recipe:
    if preset not in PRESETS:
        raise ValueError(f"preset: expected one of {', '.join(PRESETS)}, got {preset!r}")
    return PRESETS[preset]


def _steps_planned(recipe: Recipe, stage: str) -> int:
    return {"image-vae": recipe.image_vae_loop, "raymap-vae": recipe.raymap_vae_loop, "dit": recipe.dit_loop}[
        stage
    ].steps


def _steps_done(folder: Path) -> int:
    """Steps that the stage's checkpoint has behind it; 0 without one."""
    path = folder / "checkpoint.pt"
    complete = path.exists() and (
        folder.name == "dit" or (folder / "spread.json").exists()
    )  # killed while measuring its latents
    return read_state(path, mapped=True)["step"] if complete else 0


def _require_positive(**values: float | None) -> None:
    for name, value in values.items():
        if value is not None and not value > 0:
            raise ValueError(f"{name}: expected a positive number, got {value}")


def _say(group: Group, message: str, *values: object) -> None:
    if group.is_main:
        _logger.info(message, *values)


def _told(stage: str, cost: Cost) -> str:
    """A stage's cost in one line."""
    sizes = ", ".join(f"{name} {count / 1e6:.1f} M" for name, count in cost.parameters.items())
    return (
        f"{stage}: parameters {sizes}; memory {(cost.weight_bytes + cost.step_bytes) / GIB:.2f} GiB "
        f"(weights and average {cost.weight_bytes / GIB:.2f}, a step {cost.step_bytes / GIB:.2f}); "
        f"{cost.steps_per_second:.3g} steps per second, {100 * cost.data_share:.0f} % of the time for data; "
        f"{cost.flops:.3g} FLOPs per step, {100 * cost.utilisation:.0f} % of what a matrix product reaches here"
    )


@contextlib.contextmanager
def _progress(stage: str, group: Group) -> Iterator[OnProgress | None]:
    """A bar where a person watches, a line in the log now and then elsewhere; for the first process only."""
    if not group.is_main:
        yield None
    elif sys.stderr.isatty() and importlib.util.find_spec("rich") is not None:
        with _bar(stage) as show:
            yield show
    else:
        yield _lines(stage)


def _losses(losses: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in losses.items())


@contextlib.contextmanager
def _bar(stage: str) -> Iterator[OnProgress]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
        TextColumn("{task.fields[losses]}"),
    )  # fmt: skip
    with Progress(*columns) as progress:
        bar = progress.add_task(stage, total=None, losses="")
        yield lambda done, total, losses: progress.update(bar, completed=done, total=total, losses=_losses(losses))


def _lines(stage: str) -> OnProgress:
    last_time, last_step = time.monotonic(), None

    def show(done: int, total: int, losses: dict[str, float]) -> None:
        nonlocal last_time, last_step
        last_step = done - 1 if last_step is None else last_step
        passed = time.monotonic() - last_time
        if passed >= _SECONDS_BETWEEN_LINES or done == total:
            _logger.info(
                "%s: step %d of %d, %.3g steps per second, %s",
                stage,
                done,
                total,
                (done - last_step) / passed,
                _losses(losses),
            )
            last_time, last_step = time.monotonic(), done

    return show
