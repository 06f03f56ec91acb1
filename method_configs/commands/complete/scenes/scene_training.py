"""The training that ``ns-train fillerbuster`` runs, in this process and within a budget: splats of photos, completed,
for one film.

Everything is nerfstudio's trainer with this project's datamanager and splat model; only the schedule is shortened to
the steps there are. A training that was killed goes on from its latest checkpoint.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from fb_core.completion.options import CompletionConfig
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.machine.interruption import raise_interrupt, signals_given_back
from fb_nerfstudio.runs.finished_run import quiet
from fb_nerfstudio.splats.splat_file import Splats
from method_configs.splats import fillerbuster

_WHOLE_STEPS = 1000  # trainings of fewer steps have a shorter schedule
CHECKPOINTS = 8
"""Checkpoints that a training leaves on its way."""
_ON_PROGRESS = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class SceneSchedule:
    """How long splats are trained, and how."""

    steps: int
    """In all."""
    complete_at: int
    """Step before which new views are generated."""
    most_gaussians: int
    """At most so many."""
    scale: float = 1.0
    """Size of the pictures that are trained on over that of the capture's, whose details tell where the first Gaussians
    stand.
    """

    def __post_init__(self) -> None:
        if self.steps < 1 or self.most_gaussians < 1:
            raise ValueError(
                f"schedule: expected at least 1 step and 1 Gaussian, got {self.steps} and {self.most_gaussians}"
            )


@dataclass(frozen=True, kw_only=True)
class TrainedScene:
    """What a training has left, in the world of its capture."""

    splats: Splats
    """Finished."""
    generated: CompletedViews | None
    """New views that took part, None where none was needed."""
    trust: float | None
    """In the model on this capture, None where it was not measured."""


def train_scene(
    capture: Path,
    folder: Path,
    schedule: SceneSchedule,
    completion: CompletionConfig,
    *,
    device: str,
    seed: int,
    on_progress: _ON_PROGRESS,
) -> TrainedScene:
    """Train on a capture; the run lies in ``folder``, and goes on where it was if it is there.

    Args:
        capture: folder with a transforms.json whose cameras stand about the origin, none farther off than about 1; its
            world is kept.
        folder: of the run.
        schedule: how long.
        completion: what is generated, and when.
        device: where to compute.
        seed: decides all that is drawn.
        on_progress: told what is being done, how much of it is done, and how much there is.

    Raises ValueError (`Refused`) in one sentence for what cannot be trained on.
    """
    config = scene_config(capture, folder, schedule, completion, device=device, seed=seed)
    config.refuse_bad_input()
    _forget_writers()
    torch.manual_seed(seed)
    with quiet(), signals_given_back():
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.when_stopped = raise_interrupt  # this command says how to go on
        trainer.setup()
        left = schedule.steps - trainer._start_step
        manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
        if left > 0:
            trainer.config.max_num_iterations = left
            _tell(trainer, schedule.steps, on_progress)
            trainer.train()
        splats = Splats.of_parameters(model.gauss_params, sh_degree=model.config.sh_degree)
        return TrainedScene(
            splats=splats, generated=manager.generated_views, trust=manager.get_extra_state().get("trust")
        )


def scene_config(
    capture: Path, folder: Path, schedule: SceneSchedule, completion: CompletionConfig, *, device: str, seed: int
) -> Any:
    """The options of ``ns-train fillerbuster`` with a schedule of so many steps."""
    config: Any = copy.deepcopy(fillerbuster.config)
    steps = schedule.steps
    config.data, config.output_dir, config.experiment_name, config.timestamp = (
        capture,
        folder.parent,
        folder.name,
        "run",
    )
    config.method_name, config.vis = "splats", "tensorboard"
    config.machine.seed, config.machine.device_type = seed, torch.device(device).type
    config.max_num_iterations, config.steps_per_save = steps, max(1, -(-steps // CHECKPOINTS))
    config.steps_per_eval_image = config.steps_per_eval_all_images = 10 * steps  # the film is the evaluation
    config.logging.local_writer.enable, config.logging.steps_per_log = False, max(1, steps // 20)
    scheduler = config.optimizers["means"]["scheduler"]
    scheduler.max_steps = max(scheduler.max_steps, steps)
    manager, model = config.pipeline.datamanager, config.pipeline.model
    manager.completion, manager.data, manager.camera_res_scale_factor = completion, capture, schedule.scale
    parser = manager.dataparser  # the capture's world is that of the training
    parser.orientation_method, parser.center_method, parser.auto_scale_poses = "none", "none", False
    model.max_gaussians = schedule.most_gaussians
    shorter = min(1.0, steps / _WHOLE_STEPS)
    for name in ("warmup_length", "refine_every", "stop_screen_size_at", "stop_split_at"):
        setattr(model, name, max(1, round(getattr(model, name) * shorter)))
    model.normal_loss_from = steps  # a film shows no normals, and they take a third of the time
    model.output_normals = False
    checkpoints = config.get_checkpoint_dir()
    config.load_dir = checkpoints if any(checkpoints.glob("step-*.ckpt")) else None
    return config


def _forget_writers() -> None:
    """nerfstudio's log writers are global, and would write into an earlier run of this process."""
    from nerfstudio.utils import writer

    for everything in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
        everything.clear()


def _tell(trainer: Any, steps: int, on_progress: _ON_PROGRESS) -> None:
    """Have training steps and denoising steps told."""
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    def trained(step: int) -> None:
        on_progress("training splats", step + 1, steps)

    panel = trainer.pipeline.datamanager.completion_panel
    show = panel.report

    def report(text: str, share: float | None = None) -> None:
        show(text, share=share) if share is not None else show(text)
        if share is not None:
            on_progress(text.partition(", step ")[0].lower(), round(1000 * share), 1000)

    panel.report = report
    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN_ITERATION], trained))
