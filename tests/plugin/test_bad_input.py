"""Bad input at the level of ``ns-train fillerbuster``: one clear sentence, exit code not 0, nothing half written.

The sentences are made in fb_core and tested there in detail (test_captures, test_media, test_checkpoint,
test_inpainter); here each kind of damage goes through nerfstudio's own command.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.plugin.bad_input import Started, config_for, edit
from helpers.processes.ns_train import ns_train
from helpers.tiny_models import save_tiny_model
from safetensors.torch import load_file, save_file

from fb_core.data import media
from fb_core.data.capture.captures import FrameToWrite, write_capture
from fb_core.files.faults import Refused
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.refusal import _refuse_prompt
from fb_nerfstudio.trainer import FillerbusterTrainer, FillerbusterTrainerConfig
from method_configs.splats import fillerbuster, fillerbuster_masked, fillerbuster_none, nerfiller_grid


@pytest.fixture(autouse=True)
def training_only_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is accepted gets as far as building the pipeline, and no further."""

    def start(self, *_):
        raise Started

    monkeypatch.setattr(FillerbusterTrainer, "setup", start)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_model(tmp_path_factory.mktemp("good") / "model")


def refusal(config: FillerbusterTrainerConfig) -> str:
    """The sentence that ``ns-train`` ends with, checked for its form and for leaving nothing behind."""
    with pytest.raises(SystemExit) as ended:
        ns_train.main(config)
    sentence = ended.value.code  # a text: Python prints it on stderr and exits with 1
    assert isinstance(sentence, str) and isinstance(ended.value, ValueError) and isinstance(ended.value, Refused)
    assert sentence and "\n" not in sentence and len(sentence) < 500
    assert not config.output_dir.exists()
    return sentence


def set_pose(value: float) -> Callable[[Path], None]:
    """Every number of one camera's rotation becomes this."""

    def change(content: dict) -> None:
        for row in content["frames"][2]["transform_matrix"][:3]:
            row[:3] = [value] * 3

    return lambda folder: edit(folder, change)


def cut(name: str, bytes_kept: int) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:bytes_kept])


BAD_CAPTURES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no transforms.json": (lambda folder: (folder / "transforms.json").unlink(), r"no transforms\.json in this folder"),
    "empty transforms.json": (
        lambda folder: (folder / "transforms.json").write_text(""),
        r"transforms\.json: the file is empty",
    ),
    "no JSON": (
        lambda folder: (folder / "transforms.json").write_text("frames: []"),
        r"transforms\.json: not a JSON file",
    ),
    "no cameras": (
        lambda folder: edit(folder, lambda content: content.update(frames=[])),
        "at least one camera, got no frames",
    ),
    "image missing": (lambda folder: (folder / "images" / "view_003.png").unlink(), r"view_003\.png: no such file"),
    "image truncated": (cut("images/view_003.png", 200), r"view_003\.png: the file is truncated"),
    "image of no bytes": (cut("images/view_003.png", 0), r"view_003\.png: the file is empty"),
    "mask of another size": (
        lambda folder: media.write_image(folder / "masks" / "view_001.png", torch.ones(1, 16, 24)),
        r"mask .*view_001\.png: expected 48 x 32 pixels as its camera says, got 24 x 16",
    ),
    "singular pose": (set_pose(0.5), r"frame 2 .*pose .* is singular"),
    "NaN pose": (set_pose(float("nan")), r"frame 2 .*pose .* holds NaN"),
}


@pytest.mark.parametrize("kind", BAD_CAPTURES)
def test_a_bad_capture_is_refused(kind: str, tiny_capture: Path, model: Path, tmp_path: Path):
    damage, expected = BAD_CAPTURES[kind]
    damage(tiny_capture)
    sentence = refusal(config_for(tiny_capture, model, tmp_path / "out"))
    assert re.search(expected, sentence), sentence


@pytest.mark.parametrize("method", [fillerbuster, fillerbuster_none], ids=lambda method: method.config.method_name)
def test_a_folder_that_is_not_there_is_refused(method, model: Path, tmp_path: Path):
    assert "no such folder" in refusal(config_for(tmp_path / "nowhere", model, tmp_path / "out", method))


def blank_masks(folder: Path, value: float) -> None:
    """All masks of one value, for all pictures."""

    def name_masks(content: dict) -> None:
        for frame in content["frames"]:
            frame["mask_path"] = frame["file_path"].replace("images", "masks")
            media.write_image(folder / frame["mask_path"], torch.full((1, 32, 48), value))

    edit(folder, name_masks)


def test_black_masks_are_refused_by_every_method(tiny_capture: Path, model: Path, tmp_path: Path):
    blank_masks(tiny_capture, 0.0)
    for method in (fillerbuster, fillerbuster_none, fillerbuster_masked):
        assert "the masks are black everywhere" in refusal(config_for(tiny_capture, model, tmp_path / "out", method))


def test_white_masks_leave_nothing_to_inpaint_and_are_good_otherwise(tiny_capture: Path, model: Path, tmp_path: Path):
    blank_masks(tiny_capture, 1.0)
    for method in (fillerbuster_masked, nerfiller_grid):
        assert "no picture has unknown pixels to inpaint" in refusal(
            config_for(tiny_capture, model, tmp_path / "out", method)
        )
    with pytest.raises(Started):
        ns_train.main(config_for(tiny_capture, model, tmp_path / "out", fillerbuster))


def test_masked_captures_are_good_input_of_the_masked_protocol(tiny_capture: Path, model: Path, tmp_path: Path):
    for method in (fillerbuster_masked, nerfiller_grid):
        with pytest.raises(Started):
            ns_train.main(config_for(tiny_capture, model, tmp_path / method.config.method_name, method))


def test_panoramas_are_refused(tiny_capture: Path, model: Path, tmp_path: Path):
    edit(tiny_capture, lambda content: content.update(camera_model="EQUIRECTANGULAR"))
    assert "camera_model 'EQUIRECTANGULAR' is not supported" in refusal(
        config_for(tiny_capture, model, tmp_path / "out")
    )


def test_a_prompt_that_nobody_reads_is_refused(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out")
    config.pipeline.datamanager.completion.prompt = "a red sofa"
    assert re.search(r"completion\.prompt: this model reads no text; leave the prompt out", refusal(config))
    with pytest.raises(
        ValueError, match=r"completion\.prompt: 'a red sofa' needs a text encoder; .*completion\.text_encoder"
    ):
        _refuse_prompt(config.pipeline.datamanager.completion, reads_text=True)


def test_a_camera_path_of_another_tool_is_refused(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out")
    config.pipeline.datamanager.completion.camera_path = tiny_capture / "transforms.json"
    assert "expected a path of nerfstudio's viewer" in refusal(config)


def test_weights_of_the_2d_inpainter_that_are_not_there_are_refused(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out", nerfiller_grid)
    config.pipeline.datamanager.completion.inpainter_weights = tmp_path / "nowhere"
    assert "no model_index.json there" in refusal(config)


def misshape(folder: Path) -> None:
    path = folder / "transformer.safetensors"
    weights = load_file(path)
    name = next(name for name, value in weights.items() if value.ndim == 2)
    weights[name] = weights[name][:-1].contiguous()
    save_file(weights, path)


BAD_MODELS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no config": (
        lambda folder: (folder / "config.json").unlink(),
        r"is not a model folder because it has no config\.json",
    ),
    "no weights": (
        lambda folder: (folder / "image-vae.safetensors").unlink(),
        r"is incomplete because it has no image-vae\.safetensors",
    ),
    "wrong shapes": (misshape, r"transformer\.safetensors"),
    "truncated weights": (cut("transformer.safetensors", 5000), r"transformer\.safetensors: truncated"),
    "weights of no bytes": (cut("raymap-vae.safetensors", 0), r"raymap-vae\.safetensors: truncated"),
}


@pytest.mark.parametrize("kind", BAD_MODELS)
def test_a_bad_model_folder_is_refused(kind: str, tiny_capture: Path, tmp_path: Path):
    damage, expected = BAD_MODELS[kind]
    damage(save_tiny_model(tmp_path / "model"))
    sentence = refusal(config_for(tiny_capture, tmp_path / "model", tmp_path / "out"))
    assert re.search(expected, sentence), sentence


def test_no_model_folder_is_refused_but_not_missed_without_completion(tiny_capture: Path, tmp_path: Path):
    assert "no folder" in refusal(config_for(tiny_capture, tmp_path / "absent", tmp_path / "out"))
    with pytest.raises(Started):
        ns_train.main(config_for(tiny_capture, tmp_path / "absent", tmp_path / "out", fillerbuster_none))


def test_no_checkpoint_to_go_on_from_is_refused(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out")
    config.load_dir = tmp_path / "nowhere"
    assert "no checkpoint" in refusal(config)
    config.load_dir, config.load_checkpoint = None, tmp_path / "nothing.ckpt"
    assert "no such file" in refusal(config)


def test_pictures_below_16_pixels_are_refused(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out")
    config.pipeline.datamanager.camera_res_scale_factor = 0.25
    assert re.search(
        r"at least 16 x 16 pixels, got 12 x 8 after --pipeline\.datamanager\.camera-res-scale-factor 0\.25",
        refusal(config),
    )


def test_several_devices_are_refused(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out")
    config.machine.num_devices = 2
    assert "trains in one process, got 2" in refusal(config)


def test_what_is_good_starts(tiny_capture: Path, model: Path, tmp_path: Path):
    config = config_for(tiny_capture, model, tmp_path / "out")
    with pytest.raises(Started):
        ns_train.main(config)
    assert (config.get_base_dir() / "config.yml").is_file()


@pytest.mark.parametrize("count", [1, 3])
def test_one_photo_and_a_pure_rotation_are_good_input(count: int, tmp_path: Path):
    """Cameras that all stand in one place: nerfstudio's own reader divides by their spread."""
    center = torch.tensor([[0.3, 0.7, -0.1]])
    looks = [torch.tensor([[math.cos(angle), math.sin(angle), 0.0]]) for angle in range(count)]
    up = torch.tensor([0.0, 0.0, 1.0])
    cameras = [
        Pinholes.looking_at(center, center + look, up=up, fov_degrees=60.0, width=32, height=24) for look in looks
    ]
    frames = [
        FrameToWrite(name=f"view_{i}", image=torch.rand(3, 24, 32), camera=camera) for i, camera in enumerate(cameras)
    ]
    write_capture(tmp_path / "capture", frames)
    config = config_for(tmp_path / "capture", None, tmp_path / "out").pipeline.datamanager
    config.data = tmp_path / "capture"
    manager = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    assert len(manager.train_dataset) == count
    assert bool(manager.train_dataset.cameras.camera_to_worlds.isfinite().all())


def test_the_command_line_refuses_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    arguments = ["fillerbuster", "--data", str(tmp_path / "nowhere"), "--output-dir", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["ns-train", *arguments])
    with pytest.raises(Refused, match="no such folder"):
        ns_train.entrypoint()
    assert not (tmp_path / "out").exists()


def test_a_size_below_16_pixels_is_refused(tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    arguments = ["fillerbuster", "--data", str(tiny_capture), "--output-dir", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["ns-train", *arguments, "--pipeline.datamanager.completion.image-size", "8"])
    with pytest.raises(SystemExit) as ended:
        ns_train.entrypoint()
    assert ended.value.code not in (0, None) and not (tmp_path / "out").exists()
    said = capsys.readouterr()
    assert "expected at least 16 pixels, got 8" in " ".join((said.out + said.err).replace("│", " ").split())
