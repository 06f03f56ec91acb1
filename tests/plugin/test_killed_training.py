"""SIGKILL at any moment of a generation loses at most the round under way: real child processes, and what goes on from
their remains.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.processes.killed_training import MOMENTS, ROUNDS, kill_config
from helpers.processes.ns_train import run_ns_train
from helpers.tiny_models import save_tiny_model

from fb_core.data.capture.captures import validate_capture
from fb_core.data.rooms.room_captures import rooms
from fb_core.inpainter import Fillerbuster
from fb_nerfstudio import datamanager

SIDE = 32
LEFT = {
    "inside_the_second_round": 2,
    "while_a_checkpoint_is_written": 2,
    "while_the_capture_of_the_views_is_written": 1,
}
"""Rounds that are still to be generated after the kill: those that had not begun, and the one under way."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("killed")
    rooms(3, folder / "room", family="narrow", views=6, size=SIDE, held_out=2, ground_truth=False)
    return folder / "room", save_tiny_model(folder / "model", image_size=SIDE)


@pytest.fixture(scope="module")
def whole(inputs, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The state of the bank of a run that nothing interrupts."""
    output = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)
        run_ns_train(kill_config(inputs[0], output, inputs[1], "whole"))
    return bank_of(output / inputs[0].name / "fillerbuster" / "whole")


def bank_of(run: Path) -> dict[str, Any]:
    (checkpoint,) = (run / "nerfstudio_models").glob("*.ckpt")
    return torch.load(checkpoint, weights_only=True)["pipeline"]["datamanager._extra_state"]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_kill_loses_at_most_the_round_under_way(inputs, whole, tmp_path: Path, monkeypatch, moment: str):
    here = Path(__file__).resolve().parents[1]
    command = [
        sys.executable,
        str(here / "helpers" / "processes" / "killed_training.py"),
        moment,
        str(inputs[0]),
        str(tmp_path),
        str(inputs[1]),
    ]
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(here), str(here.parent)]),
        "CUDA_VISIBLE_DEVICES": "",
    }
    child = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert child.returncode == -signal.SIGKILL, child.stderr[-2000:]
    killed = tmp_path / inputs[0].name / "fillerbuster" / "killed"
    remains = bank_of(killed)
    assert (
        not remains["finished"]
        and len({origin["round"] for origin in remains["views"]["origins"]}) == ROUNDS - LEFT[moment]
    )
    assert not (killed / "completion").exists(), "nothing half written"

    calls: list[int] = []
    complete = Fillerbuster.complete
    monkeypatch.setattr(
        Fillerbuster, "complete", lambda *args, **options: calls.append(1) or complete(*args, **options)
    )
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(
        datamanager, "start_points", lambda *args, **options: pytest.fail("the photos are triangulated a second time")
    )
    config = kill_config(inputs[0], tmp_path, inputs[1], "resumed")
    config.load_dir = killed / "nerfstudio_models"
    run_ns_train(config)

    resumed = bank_of(killed.with_name("resumed"))
    assert len(calls) == LEFT[moment] and resumed["finished"]
    assert len(validate_capture(killed.with_name("resumed") / "completion", decode=True)) == len(
        whole["views"]["origins"]
    )
    assert resumed["views"]["origins"] == whole["views"]["origins"]
    for name in ("images", "masks", "camera_to_world"):
        assert torch.equal(resumed["views"][name], whole["views"][name]), name
    assert torch.equal(resumed["start_points"], whole["start_points"]), (
        "the same points, although nothing was triangulated"
    )
