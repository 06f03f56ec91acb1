"""Ctrl-C in whole processes, as a terminal sends it to a group of its own: one line, exit code 130, nothing half
written.

No process is forked here, and none of the product's commands forks: a fork of a process that has threads (torch's,
OpenCV's) may die of a segmentation fault by itself. The slow part was last run on 2026-11-28, to its end; all passed.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
from helpers.tiny_models import save_tiny_model

from fb_core.data.rooms.room_captures import rooms
from fb_core.machine.interruption import signals_given_back
from method_configs.benchmarks.poses.command import Poses
from method_configs.entrance import main
from method_configs.evaluations.designs.command import Designs
from method_configs.evaluations.rooms import Rooms
from method_configs.evaluations.trust import Trust

ROOT = Path(__file__).resolve().parents[2]
SIDE = 32
FAULTS = ("Traceback", "Exception ignored", "Error:", "core dumped", "Segmentation")

AT_IMPORT = """
import os, signal, sys
left = int(sys.argv.pop(1))
def hook(event, arguments):
    global left
    if event == "import":
        left -= 1
        if left == 0:
            os.killpg(0, signal.SIGINT)
from fb_core.machine import interruption
from method_configs.benchmarks.poses.command import Poses
from method_configs.entrance import main
from method_configs.evaluations.designs.command import Designs
from method_configs.evaluations.rooms import Rooms
from method_configs.evaluations.trust import Trust
sys.addaudithook(hook)
main()
"""
PLAIN = "from method_configs.entrance import main\nmain()"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture and a model."""
    folder = tmp_path_factory.mktemp("inputs")
    rooms(3, folder / "room", family="narrow", views=4, size=SIDE, held_out=2, ground_truth=False)
    return folder / "room", save_tiny_model(folder / "model", image_size=SIDE)


def commands(inputs: tuple[Path, Path]) -> dict[str, list[str]]:
    capture, model = map(str, inputs)
    return {
        "complete": [
            "complete",
            capture,
            "--model",
            model,
            "--views",
            "3",
            "--steps",
            "2",
            "--no-check",
            "--device",
            "cpu",
            "--output",
            "out",
        ],
        "train": ["train", "rooms-tiny", "--device", "cpu", "--output", "out"],
        "bench": ["bench", "poses"],
        "eval": ["eval", "rooms", "--model", model],
        "export": ["export", capture, "--format", "colmap", "--output", "out"],
    }


def started(program: str, arguments: Sequence[str], folder: Path) -> subprocess.Popen[str]:
    """In a process group of its own, so that what is sent there reaches nobody else."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "CUDA_VISIBLE_DEVICES": "",
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "1000",
    }
    command = [sys.executable, "-c", program, *arguments]
    return subprocess.Popen(
        command,
        cwd=folder,
        env=environment,
        text=True,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def assert_one_line(code: int, said: str) -> None:
    assert code == 130, f"code {code}: {said[-1500:]}"
    assert not [fault for fault in FAULTS if fault in said], said[-1500:]
    lines = [line for line in said.splitlines() if "Stopped" in line or "stopped by signal" in line]
    assert len(lines) == 1 and said.rstrip().endswith(lines[0].rstrip()), said[-1500:]


@pytest.mark.parametrize("number", [40, 250])
@pytest.mark.parametrize("name", ["complete", "train", "bench", "eval", "export"])
def test_while_a_command_imports(name: str, number: int, inputs: tuple[Path, Path], tmp_path: Path):
    child = started(AT_IMPORT, [str(number), *commands(inputs)[name]], tmp_path)
    out, said = child.communicate(timeout=300)
    assert out == ""
    assert_one_line(child.returncode, said)
    assert not list(tmp_path.iterdir())


ANEW = "Nothing was kept; the same command begins anew."
MEASURING: dict[str, tuple[type, list[str], str]] = {
    "bench poses": (Poses, [], ANEW),
    "eval rooms": (Rooms, [], ANEW),
    "eval trust": (Trust, [], "Nothing was kept; with --keep FOLDER the same command goes on where it was."),
    "eval trust --keep": (
        Trust,
        ["--keep", "kept"],
        "What was measured is kept in kept; the same command goes on from there.",
    ),
    "eval designs": (
        Designs,
        ["--output", "kept", "--designs", "base", "--batches", "2"],
        "What is whole is kept in kept; the same command goes on from there.",
    ),
}
MOMENTS = (0.02, 0.5)
AFTER_PROCESSOR_SECONDS = """
import os, signal, sys
from importlib import import_module
from fb_core.machine.interruption import signals_given_back
from method_configs.entrance import main
module, name, *moments = sys.argv.pop(1).split()
kind = getattr(import_module(module), name)
run = kind.run
for moment in map(float, moments):
    def begun(self):
        signal.setitimer(signal.ITIMER_PROF, moment)
        run(self)
    kind.run = begun
    signal.signal(signal.SIGPROF, lambda number, frame: os.kill(os.getpid(), signal.SIGINT))
    try:
        with signals_given_back():
            main()
    except SystemExit as stopped:
        print("code", stopped.code, file=sys.stderr, flush=True)
    signal.setitimer(signal.ITIMER_PROF, 0)
"""


@pytest.mark.parametrize("name", MEASURING)
def test_while_a_command_measures(name: str, tmp_path: Path):
    """After so much processor time: the line says whether the same command goes on. In a process of its own, as an
    interruption at any moment may leave something behind in torch.
    """
    kind, options, kept = MEASURING[name]
    when = " ".join([kind.__module__, kind.__name__, *map(str, MOMENTS)])
    child = started(AFTER_PROCESSOR_SECONDS, [when, *name.split()[:2], *options], tmp_path)
    _, said = child.communicate(timeout=300)
    ended = re.findall(r"(.*?)^code (\d+)$", said, re.DOTALL | re.MULTILINE)
    assert child.returncode == 0 and len(ended) == len(MOMENTS), said
    for text, code in ended:
        assert_one_line(int(code), text)
        assert text.rstrip().splitlines()[-1] == f"Stopped. {kept}", text
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")], "half written"


def test_a_training_within_a_measurement_hands_the_interruption_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """A design's training saves its step and ends with a code alone, after which nothing was said."""

    def stopped_in_training(self: object) -> None:
        raise SystemExit(128 + signal.SIGINT)

    monkeypatch.setattr(Designs, "run", stopped_in_training)
    monkeypatch.setattr(sys, "argv", ["fillerbuster", "eval", "designs"])
    with signals_given_back(), pytest.raises(SystemExit) as stopped:
        main()
    assert_one_line(stopped.value.code, capsys.readouterr().err)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", ["complete", "train", "bench", "eval"])
def test_at_many_moments(name: str, inputs: tuple[Path, Path], tmp_path: Path):
    """By the clock, from the first imports to the end or to 30 s of processor time; then the same command goes on."""
    failed, moment = [], 0.5  # before, Python is not in our hands
    while moment < 30:
        folder = tmp_path / f"{moment:.2f}"
        folder.mkdir()
        child = started(PLAIN, commands(inputs)[name], folder)
        while child.poll() is None and processor_seconds(child.pid) < moment:
            time.sleep(0.01)
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGINT)
        _, said = child.communicate(timeout=300)
        if child.returncode == 0 or (child.returncode == -signal.SIGINT and (folder / "out").exists()):
            break  # all is done; in the second case only Python's own end was interrupted
        try:
            assert_one_line(child.returncode, said)
            assert name == "train" or not (folder / "out").exists(), "half written"
        except AssertionError as error:
            failed.append(f"{moment:.2f} s: {error}")
        moment *= 1.35
    assert not failed, "\n".join(failed)


def processor_seconds(number: int) -> float:
    """What a process has used; the clock of a busy machine says little."""
    import psutil

    try:
        times = psutil.Process(number).cpu_times()
    except psutil.Error:
        return float("inf")
    return times.user + times.system
