"""What a training refuses before it begins, and options that survive nerfstudio's files."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from helpers.plugin.datamanagers import (
    attributes,
    make,
    options,
    stand_in_model,  # noqa: F401
)

from fb_core.completion.options import CompletionConfig
from fb_core.data.capture.captures import validate_capture
from fb_nerfstudio.datamanager import FillerbusterDataManager, FillerbusterDataManagerConfig, Refused


def test_several_processes_are_refused(tiny_capture: Path):
    with pytest.raises(ValueError, match="one process, got 2"):
        FillerbusterDataManagerConfig(data=tiny_capture).setup(device="cpu", world_size=2)


def test_a_broken_capture_is_refused_before_anything_is_loaded(tiny_capture: Path):
    next((tiny_capture / "images").iterdir()).unlink()
    with pytest.raises(Refused, match=r"view_\d+"):
        make(tiny_capture)
    with pytest.raises(ValueError, match="no such folder"):
        make(tiny_capture / "nowhere")
    (tiny_capture / "transforms.json").write_text("{")
    with pytest.raises(ValueError, match="JSON"):
        make(tiny_capture)


def test_a_refusal_ends_a_command_with_its_sentence_and_code_one():
    # The class itself, without the seconds that importing nerfstudio takes.
    program = "class Refused(SystemExit, ValueError): pass\nraise Refused('the capture is empty')"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (1, "the capture is empty\n")
    assert issubclass(Refused, SystemExit) and issubclass(Refused, ValueError)


def test_a_bad_model_folder_is_refused_before_training(tiny_capture: Path, tmp_path: Path, monkeypatch):
    monkeypatch.undo()
    manager = make(tiny_capture, options(model=tmp_path / "absent", at_step=1000))
    with pytest.raises(Refused, match="absent"):
        manager.get_training_callbacks(attributes(manager))


def test_points_of_the_capture_come_without_open3d(tiny_capture: Path):
    manager = make(tiny_capture)
    outputs = manager.train_dataparser_outputs
    points, colors = outputs.metadata["points3D_xyz"], outputs.metadata["points3D_rgb"]
    assert points.shape == colors.shape == (50, 3) and colors.dtype == torch.uint8 and points.dtype == torch.float32
    # Cameras and points went through one similarity: their distances keep their ratios.
    before, after = validate_capture(tiny_capture), manager.train_dataset.cameras.camera_to_worlds[:, :, 3]
    import trimesh

    original = torch.from_numpy(trimesh.load(before.points_path).vertices.copy()).float()
    names = [path.name for path in outputs.image_filenames]
    place = {frame.image_path.name: frame.camera.centers[0].float() for frame in before.frames}
    centers = torch.stack([place[name] for name in names])
    ratio = torch.cdist(after, points) / torch.cdist(centers, original)
    assert torch.allclose(ratio, torch.full_like(ratio, outputs.dataparser_scale), rtol=1e-4)


def test_images_are_not_pinned_without_a_driver(tiny_capture: Path, monkeypatch):
    def pinned(_):
        raise RuntimeError("no driver")

    monkeypatch.setattr(torch.Tensor, "pin_memory", pinned)
    manager = make(tiny_capture, cache_images="cpu")  # what nerfstudio switches to beyond 500 images
    assert len(manager.cached_train) == 6
    manager.next_train(0)


def test_the_config_survives_nerfstudios_yaml(tiny_capture: Path):
    config = FillerbusterDataManagerConfig(data=tiny_capture, completion=options(model=Path("weights"), seed=7))
    back = yaml.load(yaml.dump(config), Loader=yaml.Loader)
    assert dataclasses.asdict(back.completion) == dataclasses.asdict(config.completion)
    assert back._target is FillerbusterDataManager


def test_every_option_is_a_flag_with_a_description(capsys):
    import tyro

    parsed = tyro.cli(
        CompletionConfig, args=["--anchor-views", "3", "--placement.radius", "0.5", "--model", "somewhere"]
    )
    assert parsed.anchor_views == 3 and parsed.placement.radius == 0.5 and parsed.model == Path("somewhere")
    with pytest.raises(SystemExit):
        tyro.cli(CompletionConfig, args=["--help"])
    text = " ".join(capsys.readouterr().out.split())
    for field in dataclasses.fields(CompletionConfig):
        assert field.name == "placement" or f"--{field.name.replace('_', '-')}" in text
    assert "Views generated together in the first round" in text
