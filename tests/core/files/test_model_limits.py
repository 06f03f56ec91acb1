"""Sizes beyond all use in a model's configuration, in released checkpoints and in options: one sentence, soon."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.quick_refusals import HUGE_INTEGER, refused

from fb_core.checkpoint import image_size_of, load, read_config
from fb_core.completion.options import CompletionConfig
from fb_core.data import media
from fb_core.files import limits
from fb_core.inpainter import BUNDLED_MODEL
from fb_core.networks.weights import require_plain
from fb_core.sampling.options import SamplingConfig
from fb_core.training.run.options import LoopConfig
from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.train_options import TrainOptions

# ---- models ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """The bundled model's folder, its weights linked, its configuration free to be changed."""
    folder = tmp_path / "model"
    folder.mkdir()
    for path in BUNDLED_MODEL.iterdir():
        if path.suffix == ".safetensors":
            (folder / path.name).symlink_to(path)
    (folder / "config.json").write_text((BUNDLED_MODEL / "config.json").read_text())
    return folder


def changed(folder: Path, section: str, key: str, value: str) -> None:
    content = json.loads((folder / "config.json").read_text())
    content[section][key] = 987654321
    (folder / "config.json").write_text(json.dumps(content).replace("987654321", value))


SIZES = [
    ("transformer", "depth", "10000000"),
    ("transformer", "depth", HUGE_INTEGER),
    ("transformer", "depth", "1e400"),
    ("transformer", "depth", "NaN"),
    ("transformer", "heads", "1073741824"),
    ("transformer", "head_dim", "1073741824"),
    ("transformer", "mlp_ratio", "1073741824"),
    ("transformer", "text_width", "1073741824"),
    ("transformer", "in_channels", "1073741824"),
    ("transformer", "patch", "1073741824"),
    ("image_vae", "widths", "[1073741824, 64, 64, 64]"),
    ("image_vae", "encoder_resnets", "10000000"),
    ("raymap_vae", "decoder_resnets", "10000000"),
    ("raymap_vae", "latent_channels", "1073741824"),
    ("raymap_vae", "scaling", "1e400"),
    ("image_vae", "scaling", "NaN"),
    ("info", "image_size", "1e400"),
    ("info", "image_size", "1000000000"),
    ("info", "image_size", '"large"'),
    ("info", "sampling", "[3]"),
    ("info", "sampling", '{"steps": 1000000000}'),
    ("info", "sampling", '{"steps": "many"}'),
    ("info", "sampling", '{"guidance_unknown": NaN}'),
    ("info", "sampling", '{"guidance": {"no such": 1}}'),
]


@pytest.mark.parametrize(("section", "key", "value"), SIZES)
def test_a_model_s_configuration_is_refused_before_anything_is_built(
    model: Path, monkeypatch: pytest.MonkeyPatch, shapes_unchecked: None, section: str, key: str, value: str
):
    changed(model, section, key, value)

    def read() -> None:
        info = read_config(model)[1]
        image_size_of(info)
        SamplingConfig.from_dict(info.get("sampling", {}))

    sentence = refused(read)
    assert any(word in sentence for word in (key, section, "sampling", "guidance"))
    if section != "info":
        monkeypatch.setattr("fb_core.checkpoint.without_weights", lambda build: pytest.fail("nothing may be built"))
        assert key in refused(lambda: load(model))


LARGEST = [("transformer", "depth", "512"), ("image_vae", "widths", "[16384, 16384, 16384, 16384]")]


@pytest.mark.parametrize(("section", "key", "value"), LARGEST)
def test_the_largest_configuration_that_is_built_is_refused_by_its_weights(
    model: Path, section: str, key: str, value: str
):
    """It occupies no memory, and the headers of the weights' files tell that they are others."""
    changed(model, section, key, value)
    sentence = refused(lambda: load(model))
    assert "safetensors" in sentence and "expected" in sentence


def test_the_released_model_and_the_bundled_one_are_within_the_limits():
    from dataclasses import asdict

    from fb_core.networks.transformer.dit import DiTConfig
    from fb_core.networks.vae import IMAGE_VAE, RAYMAP_VAE

    for config in (DiTConfig(), IMAGE_VAE, RAYMAP_VAE):
        limits.require_model_sizes(asdict(config))
    assert image_size_of(read_config(BUNDLED_MODEL)[1]) >= 16


# ---- released checkpoints -------------------------------------------------------------------------------------------


PLAIN = torch.ones(4, 4)
FOREIGN = {
    "integers": (torch.ones(4, 4, dtype=torch.int64), "floating-point numbers, got int64"),
    "truth values": (torch.ones(4, 4, dtype=torch.bool), "floating-point numbers, got bool"),
    "complex": (torch.ones(4, 4, dtype=torch.complex64), "floating-point numbers, got complex64"),
    "sparse": (PLAIN.to_sparse(), "dense tensor, got a sparse_coo one"),
    "sparse rows": (PLAIN.to_sparse_csr(), "dense tensor, got a sparse_csr one"),
    "without numbers": (torch.empty(4, 4, device="meta"), "has a shape but no numbers"),
    "repeated": (torch.ones(1, 1).expand(2**20, 2**20), "repeats the same numbers"),
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_tensors_that_are_no_weights(kind: str):
    value, told = FOREIGN[kind]
    assert told in refused(lambda: require_plain("file.ckpt", {"good": PLAIN, "bad": value}))
    require_plain("file.ckpt", {"good": PLAIN, "half": PLAIN.half(), "part": torch.ones(8, 8)[2:4]})


# ---- options --------------------------------------------------------------------------------------------------------


OPTIONS: dict[str, Callable[[], Any]] = {
    "sampling steps": lambda: SamplingConfig(steps=10**9),
    "sampling steps beyond all": lambda: SamplingConfig(steps=10**400),
    "rounds": lambda: SamplingConfig(rounds=10**9),
    "shift": lambda: SamplingConfig(shift=float("inf")),
    "guidance": lambda: SamplingConfig(guidance_unknown=float("nan")),
    "training steps": lambda: LoopConfig(steps=10**12),
    "complete: steps": lambda: CompleteOptions(steps=10**9),
    "complete: views": lambda: CompleteOptions(views=10**6),
    "complete: size": lambda: CompleteOptions(size=10**6),
    "complete: sequence": lambda: CompleteOptions(sequence=10**9),
    "completion: steps": lambda: CompletionConfig(steps=10**9),
    "completion: anchors": lambda: CompletionConfig(anchor_views=10**6),
    "completion: rounds times views": lambda: CompletionConfig(densify_rounds=1000, densify_views=1000),
    "completion: image size": lambda: CompletionConfig(image_size=10**6),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_beyond_all_use(name: str):
    sentence = refused(OPTIONS[name])
    assert "expected" in sentence


def test_training_steps_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from method_configs.commands.command_line import main

    assert "steps: expected" in refused(lambda: TrainOptions(steps=10**15))
    with pytest.raises(SystemExit) as ended:
        main(["train", "rooms-tiny", "--output", str(tmp_path / "out"), "--steps", str(10**15)])
    assert ended.value.code == 1 and "Error: steps: expected" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["complete", "{photos}", "--output", "{out}", "--steps", "1000000000"], "steps: expected"),
        (["complete", "{photos}", "--output", "{out}", "--model", "{model}"], "depth: expected at most 512"),
        (["convert", "{checkpoints}", "--output", "{out}"], "floating-point numbers, got int64"),
    ],
)
def test_commands_answer_with_a_sentence_and_a_code(tmp_path: Path, model: Path, arguments: list[str], told: str):
    (tmp_path / "photos").mkdir()
    for number in range(2):
        media.write_image(tmp_path / "photos" / f"{number}.png", torch.rand(3, 40, 40))
    changed(model, "transformer", "depth", "10000000")
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for name, key in (
        ("transformer", "transformer_state_dict"),
        ("image-vae", "vae_state_dict"),
        ("pose-vae", "vae_state_dict"),
    ):
        torch.save(
            {key: {"pos_embed.proj.weight": torch.ones(8, 66, 2, 2, dtype=torch.int64)}}, folder / f"{name}.ckpt"
        )
    places = {"{photos}": tmp_path / "photos", "{out}": tmp_path / "out", "{model}": model, "{checkpoints}": folder}
    command = [sys.executable, "-m", "method_configs.commands", *(str(places.get(one, one)) for one in arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode not in (0, -9) and told in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
