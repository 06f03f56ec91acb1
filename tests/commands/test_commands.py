"""The ``fillerbuster`` command: its parser, its errors, and each subcommand in miniature."""

from __future__ import annotations

import dataclasses
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from fb_core.checkpoint import load, read_config
from fb_core.data.capture.captures import read_capture
from fb_core.data.training.sequences import PoolConfig, TaskConfig
from fb_core.networks.transformer.dit import DiTConfig
from fb_core.networks.vae import VAEConfig
from fb_core.training.recipe import Recipe
from fb_core.training.run.options import LoopConfig
from fb_core.training.stages.dit_stage import DiTLossConfig
from fb_core.training.stages.vae_stage import VAELossConfig
from method_configs import environment
from method_configs.commands import command_line as commands


def run(*arguments: object) -> None:
    commands.main([str(argument) for argument in arguments])


def refusal(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """The one sentence with which a command refuses."""
    with pytest.raises(SystemExit) as stopped:
        run(*arguments)
    told = capsys.readouterr().err.strip()
    assert stopped.value.code == 1
    assert "Traceback" not in told and "\n" not in told
    return told


# ---- the command itself ----------------------------------------------------------------------------------------------


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as stopped:
        run("--help")
    told = capsys.readouterr().out
    assert stopped.value.code == 0
    assert all(f"• {name}" in told for name in commands.COMMANDS)


def test_help_imports_nothing_heavy():
    question = (
        "import sys, method_configs.commands; print(sorted({'torch', 'nerfstudio', 'numpy', 'cv2'} & set(sys.modules)))"
    )
    answer = subprocess.run([sys.executable, "-c", question], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


def test_rooms_has_the_defaults_of_what_it_calls():
    from fb_core.data.rooms.room_captures import rooms

    theirs = {name: p.default for name, p in inspect.signature(rooms).parameters.items() if p.default is not p.empty}
    ours = {name: p.default for name, p in inspect.signature(commands.rooms).parameters.items() if name in theirs}
    assert ours == theirs


@pytest.mark.parametrize(
    ("error", "code", "sentence"),
    [
        (ValueError("size: expected\n  16, got 3"), 1, "Error: size: expected 16, got 3"),
        (FloatingPointError("the loss became nan"), 1, "Error: the loss became nan"),
        (OSError(28, "No space left on device"), 1, "Error: [Errno 28] No space left on device"),
        (KeyboardInterrupt(), 130, "Stopped."),
    ],
)
def test_an_error_is_one_sentence_and_a_code(error, code, sentence, monkeypatch, capsys):
    def fails() -> None:
        """Fails."""
        raise error

    monkeypatch.setitem(commands.COMMANDS, "check", fails)
    monkeypatch.delenv(commands.DEBUG_VARIABLE, raising=False)
    with pytest.raises(SystemExit) as stopped:
        run("check")
    assert (stopped.value.code, capsys.readouterr().err.strip()) == (code, sentence)
    monkeypatch.setenv(commands.DEBUG_VARIABLE, "1")
    with pytest.raises(type(error)):
        run("check")


def test_an_unknown_option_ends_with_a_code(capsys):
    with pytest.raises(SystemExit) as stopped:
        run("rooms", "--output", "x", "--seeed", "1")
    assert stopped.value.code != 0


# ---- rooms -----------------------------------------------------------------------------------------------------------


def test_rooms_in_miniature(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv(commands.DEBUG_VARIABLE, raising=False)
    small = ("rooms", "--output", tmp_path / "room", "--views", 4, "--size", 16, "--held-out", 2)
    run(*small)
    assert len(read_capture(tmp_path / "room")) == 6
    capsys.readouterr()
    assert "exists and is not empty" in refusal(capsys, *small)


# ---- train -----------------------------------------------------------------------------------------------------------

_LOOP = LoopConfig(steps=3, warmup_steps=1, save_every=2)
_VAE = VAEConfig(widths=(8, 8, 8, 8), encoder_resnets=1, decoder_resnets=1, norm_groups=2)
TOY = Recipe(
    name="toy",
    image_vae=_VAE,
    raymap_vae=dataclasses.replace(_VAE, in_channels=6, norm="none"),
    dit=DiTConfig(heads=1, head_dim=16, depth=1, text_width=0),
    pool=PoolConfig(families=("narrow",), rooms=4, views=3, image_size=16, supersample=1),
    vae_pool=PoolConfig(families=("narrow",), rooms=4, views=3, image_size=16, supersample=1),
    image_vae_loop=_LOOP,
    raymap_vae_loop=_LOOP,
    dit_loop=_LOOP,
    image_vae_loss=VAELossConfig(batch=2),
    raymap_vae_loss=VAELossConfig(batch=2),
    dit_loss=DiTLossConfig(batch=1, task=TaskConfig(views=3)),
)


@pytest.fixture
def toy_preset(monkeypatch):
    from method_configs import presets as ablations

    monkeypatch.setitem(ablations.PRESETS, "toy", TOY)
    monkeypatch.delenv(commands.DEBUG_VARIABLE, raising=False)


def steps_of(folder: Path, stage: str) -> int:
    return torch.load(folder / stage / "checkpoint.pt", weights_only=True)["step"]


def test_train_in_miniature_ends_in_a_model_and_goes_on_where_it_ended(toy_preset, tmp_path):
    run("train", "toy", "--output", tmp_path, "--device", "cpu", "--steps", 2)
    config, info = read_config(tmp_path / "model")
    assert config.transformer == TOY.dit and info["preset"] == "toy"
    assert load(tmp_path / "model").dit.config == TOY.dit
    assert next(load(tmp_path / "model").dit.parameters()).dtype == torch.float16
    before = (tmp_path / "image-vae" / "log.jsonl").read_text()
    run("train", "toy", "--output", tmp_path, "--device", "cpu", "--no-half")  # one more step of each stage
    assert (tmp_path / "image-vae" / "log.jsonl").read_text().startswith(before)
    assert [steps_of(tmp_path, stage) for stage in ("image-vae", "raymap-vae", "dit")] == [3, 3, 3]
    assert next(load(tmp_path / "model").dit.parameters()).dtype == torch.float32
    spread = (tmp_path / "image-vae" / "spread.json").read_text()
    run("train", "toy", "--output", tmp_path, "--device", "cpu")  # nothing is left to do
    assert (tmp_path / "image-vae" / "spread.json").read_text() == spread


def test_train_of_one_stage_makes_no_model_yet(toy_preset, tmp_path):
    run("train", "toy", "--output", tmp_path, "--device", "cpu", "--stage", "image-vae")
    assert (tmp_path / "image-vae" / "spread.json").exists()
    assert not (tmp_path / "model").exists()


def test_train_stops_when_the_time_is_up_and_begins_no_further_stage(toy_preset, tmp_path):
    run("train", "toy", "--output", tmp_path, "--device", "cpu", "--minutes", 1e-6)
    assert not (tmp_path / "raymap-vae").exists() and not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nothing",), "preset: expected one of"),
        (("toy", "--steps", 0), "steps: expected a positive number, got 0"),
        (("toy", "--minutes", -1), "minutes: expected a positive number, got -1.0"),
        (
            ("toy", "--device", "toaster"),
            "device: expected one that this machine has, such as cpu, cuda or cuda:N, got",
        ),
        (
            ("toy", "--device", "meta"),
            "device: expected one that this machine has, such as cpu, cuda or cuda:N, got",
        ),
        (("toy", "--images", "missing"), "images: preset 'toy' learns nothing from captioned pictures"),
        (("toy", "--lpips", "missing"), "lpips: preset 'toy' learns nothing from LPIPS"),
        (("toy", "--text-encoder", "missing"), "text_encoder: preset 'toy' learns nothing from text"),
        (("paper",), "preset 'paper' reads text: give a folder with the CLIP text model"),
        (("paper", "--text-encoder", "missing"), "text: "),
        (("paper", "--text-encoder", ".", "--lpips", "missing"), "lpips: expected torchvision's weights"),
        (("paper", "--text-encoder", ".", "--images", "missing"), "images: expected WebDataset shards"),
        (("toy", "--captures", "missing"), "captures: expected folders with a transforms.json"),
        (("toy", "--meshes", "missing"), "meshes: expected files of"),
    ],
)
def test_train_refuses_nonsense_before_it_works(toy_preset, tmp_path, capsys, monkeypatch, arguments, sentence):
    """Also what a later stage alone would have stumbled on, after days of the first."""
    from method_configs.commands import training

    monkeypatch.setattr(training, "run_stage", lambda *_, **__: pytest.fail("a stage was begun"))
    assert sentence in refusal(capsys, "train", *arguments, "--output", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_train_refuses_a_stage_whose_earlier_ones_are_missing(toy_preset, tmp_path, capsys):
    assert "train that stage first" in refusal(capsys, "train", "toy", "--stage", "dit", "--output", tmp_path)


@pytest.mark.parametrize("seed", [-1, 2**32, 2**70])
@pytest.mark.parametrize(
    "command",
    [("rooms", "--output", "new"), ("complete", ".", "--output", "new"), ("demo", "--output", "new"),
     ("eval", "rooms"), ("bench", "networks"), ("bench", "inference")],
)  # fmt: skip
def test_a_seed_that_nothing_can_be_drawn_with_is_told_at_once(tmp_path, capsys, monkeypatch, command, seed):
    monkeypatch.chdir(tmp_path)
    assert re.search("seed.* at least 0|seed: expected 0 to 4.29", refusal(capsys, *command, "--seed", seed))
    assert list(tmp_path.iterdir()) == []


def test_train_refuses_a_gpu_that_is_not_there(toy_preset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "torch finds no GPU" in refusal(capsys, "train", "toy", "--output", tmp_path, "--device", "cuda")


# ---- convert ---------------------------------------------------------------------------------------------------------


def test_convert_in_miniature(shared_path, tmp_path):
    run("convert", shared_path("golden/reference"), "--output", tmp_path / "model")
    assert read_config(tmp_path / "model")[1]["license"] == "CC BY-NC 4.0"


def test_convert_refuses_a_folder_without_checkpoints(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv(commands.DEBUG_VARIABLE, raising=False)
    assert "transformer.ckpt" in refusal(capsys, "convert", tmp_path / "nothing", "--output", tmp_path / "model")
    assert not (tmp_path / "model").exists()


# ---- check -----------------------------------------------------------------------------------------------------------


def test_opencv_is_the_contrib_build():
    assert environment.has_contrib(), "run: fillerbuster check --mend"


def test_each_missing_thing_is_one_sentence_that_names_it(monkeypatch):
    monkeypatch.setattr(environment, "has_contrib", lambda: False)
    monkeypatch.setattr(
        environment.shutil, "which", lambda name: "/usr/bin/nvidia-smi" if name == "nvidia-smi" else None
    )
    monkeypatch.setattr(environment.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setattr(environment.Path, "exists", lambda path: False)
    lacks = environment.lacks()
    assert [lack.name for lack in lacks] == ["OpenCV's contrib modules", "ffmpeg", "libusb-1.0", "C++ compiler", "nvcc"]
    assert all(lack.name.removeprefix("a ") in lack.sentence and "\n" not in lack.sentence for lack in lacks)


def test_mending_that_does_not_help_says_what_to_run(monkeypatch):
    """What pip is told is recorded instead of run: the test must not change the environment it runs in."""
    asked = []

    def record(command, **options):
        asked.append(command)
        return subprocess.CompletedProcess(command, 1)

    monkeypatch.setattr(environment.subprocess, "run", record)
    with pytest.raises(ValueError, match="OpenCV could not be mended; run: "):
        environment.check(mend=True)
    install = next(command for command in asked if "pip" in command)
    assert {"--force-reinstall", "--no-deps"} <= set(install) and install[-1].startswith(environment.CONTRIB + "==")


def test_check_runs():
    run("check")
    assert json.dumps([dataclasses.asdict(lack) for lack in environment.lacks()])


# ---- eval ------------------------------------------------------------------------------------------------------------


def test_eval_in_miniature(tmp_path):
    from helpers.tiny_models import save_tiny_model

    from fb_core.evaluation.completion import METHODS, likeliest_of, mean_of, started_at

    arguments = [
        "--model",
        str(save_tiny_model(tmp_path / "model")),
        "--rooms",
        "1",
        "--views",
        "3",
        "--known",
        "2",
        "--guidance",
        "1",
        "2",
        "--strengths",
        "0.5",
        "--samples",
        "2",
    ]
    commands.main(
        ["eval", "rooms", *arguments, "--json", str(tmp_path / "eval.json"), "--sheet", str(tmp_path / "sheet.png")]
    )
    rows = json.loads((tmp_path / "eval.json").read_text())["rows"]
    assert [row["method"] for row in rows] == [*METHODS, started_at(0.5), mean_of(2), likeliest_of(2)] * 2
    assert [row["guidance"] for row in rows[:: len(rows) // 2]] == [1.0, 2.0]
    assert [row["strength"] for row in rows if row["method"].startswith("model")] == [1.0, 0.5] * 2
    assert (tmp_path / "sheet.png").stat().st_size > 1000
