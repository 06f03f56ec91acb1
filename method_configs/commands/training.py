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
from dataclasses import dataclass
from pathlib import Path

import torch

from fb_core.checkpoint import CONFIG_FILE, model_target, require_model_or_free
from fb_core.data.meshes.mesh_views import find_meshes
from fb_core.data.training.capture_sequences import find_captures
from fb_core.data.training.shard_stream import find_shards
from fb_core.machine.devices import chosen_device
from fb_core.training.dry_run import Cost, measure
from fb_core.training.recipe import STAGES, Recipe, adopt_autoencoders, export, require_text_encoder, run_stage
from fb_core.training.run.checkpoints import read_state
from fb_core.training.run.distributed import Group, in_group
from fb_core.training.run.loop import OnProgress
from fb_core.training.run.options import EngineConfig
from fb_core.training.run.progress_log import ProgressLog
from fb_core.training.stages.perceptual import load_lpips
from method_configs.commands.train_options import TrainOptions
from method_configs.presets import PRESETS

_logger = logging.getLogger(__name__)
_SECONDS_BETWEEN_LINES = 30.0
GIB = 2**30


@dataclass(frozen=True, kw_only=True)
class _Training:
    """A training that is about to run: what, where, how, and with whom."""

    recipe: Recipe
    output: Path
    options: TrainOptions
    engine: EngineConfig
    device: torch.device
    group: Group

    @property
    def stages(self) -> tuple[str, ...]:
        return STAGES if self.options.stage == "all" else (self.options.stage,)

    def steps_of(self, stage: str) -> int:
        """Steps that a stage is to have in all."""
        return self.options.steps or _steps_planned(self.recipe, stage)

    def say(self, message: str, *values: object) -> None:
        if self.group.is_main:
            _logger.info(message, *values)


def train_preset(preset: str, output: Path, options: TrainOptions = TrainOptions()) -> Path | None:
    """Train what is not trained yet and export; returns the model's folder, or None while stages are missing.

    Stages end in order: when the time is up in one, those after it are not begun, because the transformer learns the
    latents of finished autoencoders. Under torchrun all its processes train together. With ``options.start_from`` the
    autoencoders of that model are kept unless a stage of theirs is named.

    Raises ValueError for an unknown preset or device. SystemExit when a signal ended it, after a checkpoint.
    """
    recipe = dataclasses.replace(_recipe(preset), data=options.data, start_from=options.start_from)
    engine = dataclasses.replace(recipe.engine, **options.engine_changes)
    stages = STAGES if options.stage == "all" else (options.stage,)
    _require_data(recipe, stages, dry_run=options.dry_run)
    if not options.dry_run:
        _require_own_model_or_free(output, options.start_from)  # before days of training, not after them
    with in_group(chosen_device(options.device)) as (group, where):
        training = _Training(recipe=recipe, output=output, options=options, engine=engine, device=where, group=group)
        if options.dry_run:
            for name in training.stages:
                training.say(
                    "%s", _cost_in_words(name, measure(recipe, name, device=where, engine=engine, group=group))
                )
            return None
        if options.stage == "all" and group.is_main:
            adopt_autoencoders(recipe, output)
        group.wait()
        if not _train_stages(training):
            return None
        if group.is_main:
            export(recipe, output, output / "model", dtype=torch.float16 if options.half else torch.float32)
        return output / "model"


def _train_stages(training: _Training) -> bool:
    """Whether every stage has been trained, if only in part."""
    output, group = training.output, training.group
    until = time.monotonic() + 60 * (math.inf if training.options.minutes is None else training.options.minutes)
    for name in training.stages:
        if _steps_done(output / name) >= training.steps_of(name):
            training.say("%s is trained already", name)
            if group.is_main and not (output / name / "loss.png").exists():
                ProgressLog(
                    output / name, name, from_step=_steps_done(output / name)
                ).close()  # killed before it was drawn
            continue
        if group.any(time.monotonic() >= until):
            break
        if not _train_stage(training, name, minutes=(until - time.monotonic()) / 60):
            break
    return all(_steps_done(output / name) for name in STAGES)


def _train_stage(training: _Training, name: str, *, minutes: float) -> bool:
    """Whether it was trained to its end. SystemExit when a signal ended it."""
    with progress_shown(name, training.group) as show:
        run = run_stage(
            training.recipe,
            name,
            training.output,
            device=training.device,
            steps=training.options.steps,
            minutes=minutes,
            on_progress=show,
            engine=training.engine,
            group=training.group,
        )
    if run.signal:
        training.say("%s stopped by signal %d at step %d of %d, which is saved; the same command goes on from there",
                     name, run.signal, run.step, run.config.steps)  # fmt: skip
        sys.exit(128 + run.signal)
    if run.step < run.config.steps:
        training.say(
            "%s stopped at step %d of %d; the same command goes on from there", name, run.step, run.config.steps
        )
        return False
    return True


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


def _cost_in_words(stage: str, cost: Cost) -> str:
    """A stage's cost in one line."""
    sizes = ", ".join(f"{name} {count / 1e6:.1f} M" for name, count in cost.parameters.items())
    return (
        f"{stage}: parameters {sizes}; memory {(cost.weight_bytes + cost.step_bytes) / GIB:.2f} GiB "
        f"(weights and average {cost.weight_bytes / GIB:.2f}, a step {cost.step_bytes / GIB:.2f}); "
        f"{cost.steps_per_second:.3g} steps per second, {100 * cost.data_share:.0f} % of the time for data; "
        f"{cost.flops:.3g} FLOPs per step, {100 * cost.utilisation:.0f} % of what a matrix product reaches here"
    )


@contextlib.contextmanager
def progress_shown(stage: str, group: Group) -> Iterator[OnProgress | None]:
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
