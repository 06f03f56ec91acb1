"""Ctrl-C while ``ns-train`` trains and generates: no step is lost, and going on gives the bits of an undisturbed run
(on a CPU).
"""

from __future__ import annotations

import copy
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.plugin.states import leaves
from helpers.processes.ns_train import run_ns_train, toy_config
from helpers.tiny_models import save_tiny_model

from fb_core.data.rooms.room_captures import rooms
from fb_nerfstudio.checks import run_folder
from fb_nerfstudio.datamanager import FillerbusterDataManager
from fb_nerfstudio.generation import due_rounds
from fb_nerfstudio.generation.generation import Generation
from fb_nerfstudio.generation.scene import TrainedScene
from fb_nerfstudio.trainer import FillerbusterTrainer

AT_STEP, STEPS = 3, 6


@pytest.fixture(autouse=True)
def _handlers_as_before() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("stopped")
    rooms(3, folder / "room", family="narrow", views=6, size=24, held_out=2, ground_truth=False)
    return folder / "room", save_tiny_model(folder / "model", image_size=24)


def config_of(inputs: tuple[Path, Path], output: Path, timestamp: str) -> Any:
    config: Any = toy_config(inputs[0], output, inputs[1], timestamp)
    config.experiment_name = inputs[0].name
    config.max_num_iterations, config.steps_per_save, config.steps_per_eval_image = STEPS, 10**6, 2
    completion = config.pipeline.datamanager.completion
    completion.at_step, completion.steps, completion.trust = AT_STEP, 1, "full"
    return config


def last_checkpoint(config: Any) -> tuple[int, dict[str, Any]]:
    (path,) = config.get_checkpoint_dir().glob("step-*.ckpt")
    state = torch.load(path, weights_only=True)
    return state["step"], {name: value for name, value in leaves(state).items()}


@pytest.fixture(scope="module")
def undisturbed(inputs: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    config = config_of(inputs, tmp_path_factory.mktemp("whole"), "whole")
    run_ns_train(config)
    step, state = last_checkpoint(config)
    assert step == STEPS - 1
    return state


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def in_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Amid the second step, before its tensors have changed and after some have."""
    iterate = FillerbusterTrainer.train_iteration

    def train_iteration(self: FillerbusterTrainer, step: int) -> Any:
        if step == 1:
            interrupt()
        return iterate(self, step)

    monkeypatch.setattr(FillerbusterTrainer, "train_iteration", train_iteration)


def in_an_evaluation(monkeypatch: pytest.MonkeyPatch) -> None:
    def eval_iteration(self: FillerbusterTrainer, step: int) -> None:
        if step == 1:
            interrupt()

    monkeypatch.setattr(FillerbusterTrainer, "eval_iteration", eval_iteration)


def just_before_the_generation(monkeypatch: pytest.MonkeyPatch) -> None:
    """A moment in which it is noted, as in every step: the generation does not begin."""
    due = FillerbusterDataManager.complete_when_due

    def complete_when_due(self: FillerbusterDataManager, attributes: Any, step: int) -> None:
        if step == AT_STEP:
            interrupt()
            monkeypatch.setattr(due_rounds, "complete", lambda *_: pytest.fail("it generates"))
        due(self, attributes, step)

    monkeypatch.setattr(FillerbusterDataManager, "complete_when_due", complete_when_due)


def in_the_generation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before its first round; what was trained until then is saved."""
    plan = TrainedScene.seen_points

    def seen_points(self: TrainedScene, *arguments: Any) -> Any:
        interrupt()
        return plan(self, *arguments)

    monkeypatch.setattr(TrainedScene, "seen_points", seen_points)


def while_gaussians_are_placed(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the rounds: they are kept, and no Gaussian is placed twice."""
    fit = Generation.fitted_in

    def fitted_in(self: Generation, *arguments: Any, **options: Any) -> Any:
        done = fit(self, *arguments, **options)
        interrupt()
        return done

    monkeypatch.setattr(Generation, "fitted_in", fitted_in)


MOMENTS: dict[Callable[[pytest.MonkeyPatch], None], int] = {
    in_the_step: 1,
    in_an_evaluation: 1,
    just_before_the_generation: AT_STEP - 1,
    in_the_generation: AT_STEP - 1,
    while_gaussians_are_placed: AT_STEP - 1,
}


@pytest.mark.parametrize("moment", MOMENTS, ids=lambda moment: moment.__name__)
def test_no_step_is_lost(
    moment, inputs, undisturbed: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    config = config_of(inputs, tmp_path, "stopped")
    with monkeypatch.context() as here:
        moment(here)
        with pytest.raises(SystemExit) as stopped:
            run_ns_train(copy.deepcopy(config))
    assert stopped.value.code == 130
    assert capsys.readouterr().err.strip() == f"Stopped; go on with --load-dir {config.get_checkpoint_dir()}."
    step, _ = last_checkpoint(config)
    assert step == MOMENTS[moment]
    config.load_dir, config.max_num_iterations = config.get_checkpoint_dir(), STEPS - 1 - step
    run_ns_train(config)
    step, state = last_checkpoint(config)
    assert step == STEPS - 1 and state.keys() == undisturbed.keys()
    different = [name for name, value in state.items() if not _same(value, undisturbed[name])]
    assert not different, different
    run_folder.release(config.get_base_dir())


def _same(one: Any, other: Any) -> bool:
    return torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other


def test_a_second_ctrl_c_ends_it_at_once(inputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    iterate = FillerbusterTrainer.train_iteration

    def train_iteration(self: FillerbusterTrainer, step: int) -> Any:
        if step == 1:
            interrupt()
            interrupt()
        return iterate(self, step)

    monkeypatch.setattr(FillerbusterTrainer, "train_iteration", train_iteration)
    with pytest.raises(SystemExit) as stopped:
        run_ns_train(config_of(inputs, tmp_path, "twice"))
    assert stopped.value.code == 130 and "Stopped; nothing was saved yet." in capsys.readouterr().err
