"""Options of the dataparser that a capture cannot meet, and Ctrl-C while it is read."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.plugin.bad_input import Started, config_for
from helpers.plugin.going_on import refusal
from helpers.processes.ns_train import ns_train
from helpers.tiny_models import save_tiny_model

from fb_core.data import media
from fb_nerfstudio.trainer import FillerbusterTrainer


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_model(tmp_path_factory.mktemp("model") / "model")


@pytest.fixture
def only_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is accepted gets as far as building the pipeline, and no further."""

    def start(self, *_):
        raise Started

    monkeypatch.setattr(FillerbusterTrainer, "setup", start)


def test_smaller_pictures_that_nobody_has_made_are_made_in_memory(tiny_capture: Path, model: Path, tmp_path: Path):
    """The same as from a folder images_2, and masks follow."""

    def cached(factor: int | None) -> Any:
        config = config_for(tiny_capture, model, tmp_path / "out").pipeline.datamanager
        config.data, config.dataparser.downscale_factor = tiny_capture, factor
        manager = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
        return manager.cached_train, manager.train_cameras

    whole, cameras = cached(None)
    small, small_cameras = cached(2)
    for large, data in zip(whole, small, strict=True):
        assert data["image"].shape == (16, 24, 3)
        mean = torch.nn.functional.avg_pool2d(large["image"].float().movedim(-1, 0)[None], 2)[0].movedim(0, -1)
        assert float((data["image"].float() - mean).abs().mean()) < 3
        assert ("mask" in data) == ("mask" in large) and ("mask" not in data or data["mask"].shape == (16, 24, 1))
    assert torch.equal(small_cameras.fx * 2, cameras.fx) and int(small_cameras.width[0]) == 24
    folder = tiny_capture / "images_2"
    folder.mkdir()
    for path in (tiny_capture / "images").iterdir():
        media.write_image(folder / path.name, torch.zeros(3, 16, 24))
    copies, _ = cached(2)
    assert all(int(data["image"].max()) == 0 for data in copies), "copies that are there are read"


def test_a_second_datamanager_of_a_process_moves_what_the_first_moved(tiny_capture: Path, model: Path, tmp_path: Path):
    """``ns-render dataset`` makes two; nerfstudio takes names out of a list that they share."""
    config = config_for(tiny_capture, model, tmp_path / "out").pipeline.datamanager
    config.data, config.masks_on_gpu, config.images_on_gpu = tiny_capture, True, True
    for mode in ("inference", "test"):
        manager = config.setup(device="cpu", test_mode=mode, world_size=1, local_rank=0)
        assert manager.exclude_batch_keys_from_device == []


def test_a_split_that_leaves_nothing_and_data_of_another_format_are_one_sentence(
    tiny_capture: Path, model: Path, tmp_path: Path, only_starts
):
    from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig

    config = config_for(tiny_capture, model, tmp_path / "out")
    config.timestamp, config.pipeline.datamanager.dataparser = "run", BlenderDataParserConfig()
    assert "BlenderDataParserConfig cannot read it" in refusal(config)
    config = config_for(tiny_capture, model, tmp_path / "out")
    config.timestamp, config.pipeline.datamanager.dataparser.eval_mode = "run", "filename"
    assert re.search("cannot read it|leave no photo", refusal(config))


def test_ctrl_c_while_the_capture_is_read_is_no_bad_capture(
    tiny_capture: Path, model: Path, tmp_path: Path, monkeypatch, capsys
):
    from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setattr(
        NerfstudioWithoutOpen3d, "_generate_dataparser_outputs", lambda *_, **__: os.kill(os.getpid(), signal.SIGINT)
    )
    try:
        with pytest.raises(SystemExit) as stopped:
            ns_train.main(config_for(tiny_capture, model, tmp_path / "out"))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert stopped.value.code == 130 and capsys.readouterr().err == "\nStopped; nothing was saved yet.\n"
    assert not (tmp_path / "out").exists()


def test_too_small_pictures_name_the_option(tiny_capture: Path, model: Path, tmp_path: Path, only_starts):
    config = config_for(tiny_capture, model, tmp_path / "out")
    config.timestamp, config.pipeline.datamanager.dataparser.downscale_factor = "run", 3
    assert "got 16 x 10 after --downscale-factor 3" in refusal(config)
