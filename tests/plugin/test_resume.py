"""A resumed run goes on to the same bits: losses, Gaussians, optimizers, draws, and the refinement that was under way
(on a CPU).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.plugin.states import leaves
from helpers.processes.ns_train import run_ns_train, toy_config
from helpers.tiny_models import save_tiny_model

from fb_core.data.rooms.room_captures import rooms
from fb_nerfstudio.generation.surroundings import own_randomness
from fb_nerfstudio.trainer import FillerbusterTrainer

SAVED, LAST = 10, 13
"""Step of the checkpoint, and the last step. A refinement falls between them, and counts what was seen on both
sides.
"""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A room capture and a tiny model."""
    folder = tmp_path_factory.mktemp("resume")
    rooms(3, folder / "room", family="narrow", views=6, size=24, held_out=2, ground_truth=False)
    return folder / "room", save_tiny_model(folder / "model", image_size=24)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_resumed_run_repeats_the_run_that_was_not_interrupted(inputs, tmp_path: Path, monkeypatch, strategy: str):
    losses: dict[str, dict[int, float]] = {"whole": {}, "resumed": {}}
    run = "whole"
    iterate = FillerbusterTrainer.train_iteration

    def recorded(self: FillerbusterTrainer, step: int):
        result = iterate(self, step)
        losses[run][step] = float(result[0].detach())
        return result

    monkeypatch.setattr(FillerbusterTrainer, "train_iteration", recorded)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    config = toy_config(inputs[0], tmp_path, inputs[1], "whole")
    config.save_only_latest_checkpoint, config.steps_per_save, config.max_num_iterations = False, SAVED, LAST + 1
    model: Any = config.pipeline.model
    model.strategy, model.warmup_length, model.refine_every = strategy, 0, 3
    model.random_init, model.num_random, model.max_gaussians = True, 600, 1200  # room to grow
    model.densify_grad_thresh = (
        1e-9  # whatever has a gradient grows, so that the running sums and the splits' draws matter
    )
    folder = tmp_path / inputs[0].name / "fillerbuster"
    run_ns_train(config)

    run = "resumed"
    config.timestamp, config.max_num_iterations = "resumed", LAST - SAVED
    config.load_dir, config.load_step = folder / "whole" / "nerfstudio_models", SAVED
    torch.rand(100)  # another state of the global generator than the first run's
    run_ns_train(config)

    assert list(losses["resumed"]) == list(range(SAVED + 1, LAST + 1))
    assert losses["resumed"] == {step: losses["whole"][step] for step in losses["resumed"]}, (
        "losses bit for bit, the next step's first"
    )
    name = f"nerfstudio_models/step-{LAST:09d}.ckpt"
    whole, resumed = (leaves(torch.load(folder / one / name, weights_only=True)) for one in ("whole", "resumed"))
    assert set(whole) == set(resumed)
    for path, value in whole.items():
        same = torch.equal(value, resumed[path]) if isinstance(value, torch.Tensor) else value == resumed[path]
        assert same, path
    saved = torch.load(folder / "whole" / f"nerfstudio_models/step-{SAVED:09d}.ckpt", weights_only=True)["pipeline"]
    assert len(saved["_model.gauss_params.means"]) != len(whole["/pipeline/_model.gauss_params.means"]), (
        "nothing was refined"
    )


def test_what_a_generation_draws_is_decided_by_seed_and_step_alone():
    """The turns of placed Gaussians among it: a run that goes on after a kill places the very same ones."""
    drawn = []
    for before in (3, 4):
        torch.manual_seed(before)
        expected = torch.rand(5, generator=torch.Generator().manual_seed(before))
        with own_randomness("cpu", seed=7, step=2):
            drawn.append(torch.rand(5))
        assert torch.equal(torch.rand(5), expected), "training goes on as if nothing had been drawn"
    with own_randomness("cpu", seed=7, step=3):
        assert torch.equal(*drawn) and not torch.equal(drawn[0], torch.rand(5))
