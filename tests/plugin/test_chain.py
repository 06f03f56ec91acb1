"""The whole chain as a user walks it, in one process at toy size: ns-train, a kill, going on, ns-eval, ns-render,
ns-export, ns-viewer.

nerfstudio's own commands are called with their own config objects; only the command line is left out. The diffusion
model is a tiny random one, and it cannot be loaded any more once the run has been killed.
"""

from __future__ import annotations

import ctypes.util
import json
import shutil
import socket
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import yaml
from helpers.processes.ns_train import ANCHORS, DENSIFIED, STEPS_AFTER_RESUME, run_ns_train, toy_config
from helpers.tiny_models import save_tiny_model
from nerfstudio.utils.eval_utils import eval_setup

from fb_core.data import media
from fb_core.data.capture.captures import validate_capture
from fb_core.data.rooms.room_captures import rooms
from fb_core.files.faults import Refused
from fb_core.inpainter import Fillerbuster
from fb_nerfstudio import datamanager as datamanager_module
from fb_nerfstudio.datamanager import FillerbusterDataManager
from fb_nerfstudio.runs.finished_run import load_run
from fb_nerfstudio.runs.run_config import read_run_config
from fb_nerfstudio.splats.splat_model import FillerbusterSplatModel
from fb_nerfstudio.trainer import FillerbusterTrainer, FillerbusterTrainerConfig

VIEWS, HELD_OUT, SIDE = 8, 2, 32

needs_ffmpeg = pytest.mark.skipif(
    shutil.which("ffmpeg") is None, reason="ns-render makes videos with ffmpeg: apt-get install ffmpeg"
)
needs_libusb = pytest.mark.skipif(
    ctypes.util.find_library("usb-1.0") is None,
    reason="ns-export imports open3d, which needs libusb: apt-get install libusb-1.0-0",
)


class Killed(BaseException):
    """Stands for SIGKILL: nothing of the training catches it."""


@dataclass
class Chain:
    """What is left of a run that was killed right after generation, and of the run that went on."""

    killed: Path
    """Folder of the first run."""
    resumed: Path
    """Folder of the second run."""
    trainer: FillerbusterTrainer
    """Of the second run, as it ended."""
    calls: dict[str, list[int]]
    """How often the model was loaded and used, in each of the two runs."""
    said: list[str]
    """What the first run told the user about the generation."""

    @property
    def config_file(self) -> Path:
        return self.resumed / "config.yml"

    def checkpoint(self, run: Path) -> dict[str, Any]:
        (path,) = (run / "nerfstudio_models").iterdir()
        return torch.load(path, weights_only=True)


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chain]:
    folder = tmp_path_factory.mktemp("chain")
    rooms(3, folder / "room", family="narrow", views=VIEWS, size=SIDE, held_out=HELD_OUT, ground_truth=False)
    model = save_tiny_model(folder / "model", image_size=SIDE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)  # what the commands below choose their device by
        calls: dict[str, list[int]] = {"loads": [0, 0], "completions": [0, 0]}
        run = 0

        def counted(name: str, function):
            def call(*args, **kwargs):
                calls[name][run] += 1
                return function(*args, **kwargs)

            return call

        patch.setattr(Fillerbuster, "from_pretrained", staticmethod(counted("loads", Fillerbuster.from_pretrained)))
        patch.setattr(Fillerbuster, "complete", counted("completions", Fillerbuster.complete))
        said: list[str] = []
        patch.setattr(datamanager_module.CONSOLE, "print", lambda *texts, **_: said.extend(map(str, texts)))

        def killed(self, step):
            raise Killed

        with patch.context() as first:
            first.setattr(FillerbusterDataManager, "next_train", killed)
            with pytest.raises(Killed):
                run_ns_train(toy_config(folder / "room", folder / "out", model, "killed"))

        run = 1
        shutil.rmtree(model)  # from here on nothing may need the diffusion model
        trainers: list[FillerbusterTrainer] = []
        setup = FillerbusterTrainer.setup
        patch.setattr(FillerbusterTrainer, "setup", lambda self, *args: (trainers.append(self), setup(self, *args))[1])
        config = toy_config(folder / "room", folder / "out", model, "resumed")
        runs = folder / "out" / "room" / "fillerbuster"
        config.load_dir = runs / "killed" / "nerfstudio_models"
        run_ns_train(config)

        def refuse(*_, **__):
            raise AssertionError("an evaluation command loaded the diffusion model")

        patch.setattr(Fillerbuster, "from_pretrained", staticmethod(refuse))
        yield Chain(killed=runs / "killed", resumed=runs / "resumed", trainer=trainers[0], calls=calls, said=said)


# ---- training, kill, going on ---------------------------------------------------------------------------------------


def test_a_run_killed_after_generation_has_its_views_in_checkpoint_and_folder(chain: Chain):
    state = chain.checkpoint(chain.killed)
    assert state["step"] == 0
    views = state["pipeline"]["datamanager._extra_state"]["views"]
    assert views["images"].shape == (ANCHORS + DENSIFIED, SIDE, SIDE, 3)
    assert len(validate_capture(chain.killed / "completion", decode=True)) == ANCHORS + DENSIFIED
    assert not list(chain.killed.glob(".unfinished*"))


def test_the_user_is_told_how_many_views_condition_the_generation(chain: Chain):
    assert any(
        f"conditioned on {VIEWS} of {VIEWS} captured views (asked for 16; the capture has no more)" in line
        for line in chain.said
    )


def test_going_on_generates_nothing_again(chain: Chain):
    assert chain.calls == {
        "loads": [1, 0],
        "completions": [3, 0],
    }  # hidden views, anchors and one round, before the kill
    before, after = (
        chain.checkpoint(run)["pipeline"]["datamanager._extra_state"]["views"] for run in (chain.killed, chain.resumed)
    )
    assert torch.equal(before["images"], after["images"]) and before["origins"] == after["origins"]


def test_going_on_moves_the_splats_that_were_saved(chain: Chain):
    before, after = chain.checkpoint(chain.killed)["pipeline"], chain.checkpoint(chain.resumed)["pipeline"]
    for name in ("means", "opacities", "scales", "quats", "features_dc"):
        old, new = before[f"_model.gauss_params.{name}"], after[f"_model.gauss_params.{name}"]
        assert old.shape == new.shape and float((old - new).abs().max()) > 0, name
    assert chain.checkpoint(chain.resumed)["step"] == STEPS_AFTER_RESUME


def test_optimizers_hold_the_parameters_of_the_model(chain: Chain):
    model = chain.trainer.pipeline.model
    for name, parameter in model.gauss_params.items():
        (held,) = chain.trainer.optimizers.optimizers[name].param_groups[0]["params"]
        assert held is parameter, name


def test_tensorboard_has_a_log_with_losses_and_pictures(chain: Chain):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    (log,) = chain.resumed.glob("events.out.tfevents.*")
    events = EventAccumulator(str(log)).Reload().Tags()
    assert "Train Loss" in events["scalars"] and events["images"], events


# ---- commands on the finished run -----------------------------------------------------------------------------------


@pytest.mark.parametrize("run", ["killed", "resumed"])
def test_ns_eval(chain: Chain, run: str, tmp_path: Path):
    from nerfstudio.scripts.eval import ComputePSNR

    ComputePSNR(load_config=getattr(chain, run) / "config.yml", output_path=tmp_path / "eval.json").main()
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert results["psnr"] > 3 and 0 <= results["ssim"] <= 1


@needs_ffmpeg
def test_ns_render_interpolate_writes_a_video(chain: Chain, tmp_path: Path):
    from nerfstudio.scripts.render import RenderInterpolated

    RenderInterpolated(
        load_config=chain.config_file, pose_source="train", interpolation_steps=1, output_path=tmp_path / "video.mp4"
    ).main()
    assert (tmp_path / "video.mp4").stat().st_size > 500


@needs_ffmpeg
def test_ns_render_camera_path_writes_pictures(chain: Chain, tmp_path: Path):
    from nerfstudio.scripts.render import RenderCameraPath

    upright = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]  # whole numbers, as a person writes them
    camera = {"camera_to_world": upright, "fov": 70, "aspect": 1}
    path = {
        "camera_type": "perspective",
        "render_height": 24,
        "render_width": 32,
        "seconds": 1,
        "camera_path": [camera, camera],
    }
    (tmp_path / "path.json").write_text(json.dumps(path))
    RenderCameraPath(
        load_config=chain.config_file,
        camera_path_filename=tmp_path / "path.json",
        output_format="images",
        output_path=tmp_path / "pictures",
        rendered_output_names=["rgb", "depth", "normal"],
    ).main()
    assert len(list((tmp_path / "pictures").iterdir())) == 2


def test_ns_render_dataset_writes_every_output_of_every_view(chain: Chain, tmp_path: Path):
    from nerfstudio.scripts.render import DatasetRender

    DatasetRender(load_config=chain.config_file, split="train+test", output_path=tmp_path).main()
    for split, count in (("train", VIEWS), ("test", HELD_OUT)):
        for output in ("gt-rgb", "rgb", "depth", "accumulation", "normal", "surface_normal"):
            assert len(list((tmp_path / split / output).iterdir())) == count, (split, output)


@needs_libusb
def test_ns_export_gaussian_splat(chain: Chain, tmp_path: Path):
    from nerfstudio.scripts.exporter import ExportGaussianSplat

    ExportGaussianSplat(load_config=chain.config_file, output_dir=tmp_path).main()
    header = (tmp_path / "splat.ply").read_bytes().split(b"end_header")[0].decode()
    assert f"element vertex {chain.trainer.pipeline.model.num_points}" in header


@needs_libusb
def test_ns_export_of_nothing_and_of_rays_is_one_sentence(chain: Chain, tmp_path: Path):
    """An empty box; and the exports that ask a model for single rays, which no splats answer."""
    from nerfstudio.scripts import exporter

    far = exporter.ExportGaussianSplat(
        load_config=chain.config_file,
        output_dir=tmp_path,
        obb_center=(99.0, 99.0, 99.0),
        obb_rotation=(0.0, 0.0, 0.0),
        obb_scale=(1.0, 1.0, 1.0),
    )
    with pytest.raises(Refused, match="no Gaussian is left to write; choose a larger box"):
        far.main()
    with pytest.raises(Refused, match="answer no single rays; ns-export has gaussian-splat"):
        exporter.ExportPointCloud(load_config=chain.config_file, output_dir=tmp_path, num_points=10).main()
    assert not list(tmp_path.iterdir())


def test_ns_viewer_shows_the_generated_views(chain: Chain, monkeypatch: pytest.MonkeyPatch):
    from nerfstudio.scripts.viewer import run_viewer

    opened = []
    viewer = run_viewer.ViewerState
    monkeypatch.setattr(
        run_viewer, "ViewerState", lambda *args, **kwargs: opened.append(viewer(*args, **kwargs)) or opened[0]
    )

    def first_sleep(_):  # ns-viewer has set everything up and would now wait for ever
        raise KeyboardInterrupt

    monkeypatch.setattr(run_viewer, "time", SimpleNamespace(sleep=first_sleep))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = run_viewer.ViewerConfigWithoutNumRays(websocket_host="127.0.0.1", websocket_port=port)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_viewer.RunViewer(load_config=chain.config_file, viewer=options).main()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=20) as page:
            assert page.status == 200
        panel = opened[0].pipeline.datamanager.completion_panel
        assert panel.is_open and len(panel.views) == ANCHORS + DENSIFIED
    finally:
        for one in opened:
            one.viser_server.stop()


def test_our_reading_of_config_yml_is_nerfstudios_own(chain: Chain):
    """Equal options, down to the text that they are written as; and the same splats as by nerfstudio's eval_setup."""
    text = chain.config_file.read_text()
    config = read_run_config(chain.config_file)
    assert config == yaml.load(text, Loader=yaml.Loader) and yaml.dump(config) == text
    ours, theirs = load_run(chain.resumed).state_dict(), eval_setup(chain.config_file, test_mode="test")[1].state_dict()
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours if isinstance(ours[name], torch.Tensor))


def test_the_saved_run_is_ours(chain: Chain):
    config, pipeline, _, step = eval_setup(chain.config_file, test_mode="inference")
    assert isinstance(config, FillerbusterTrainerConfig) and isinstance(pipeline.model, FillerbusterSplatModel)
    assert step == STEPS_AFTER_RESUME and len(pipeline.datamanager.generated_views) == ANCHORS + DENSIFIED


@pytest.mark.parametrize("run", ["killed", "resumed"])
@pytest.mark.parametrize("format", ["nerfstudio", "colmap"])
def test_fillerbuster_export(chain: Chain, run: str, format: str, tmp_path: Path):
    from method_configs.commands.export import export_run

    folder = export_run(getattr(chain, run), format=format, output=tmp_path / "completed")  # type: ignore[arg-type]
    assert len(list((folder / "images").iterdir())) == VIEWS + HELD_OUT + ANCHORS + DENSIFIED
    if format == "nerfstudio":
        frames = validate_capture(folder, decode=True).frames
        assert sum(frame.extra["generated"] for frame in frames) == ANCHORS + DENSIFIED
        assert sum(frame.extra.get("held_out", False) for frame in frames) == HELD_OUT


def test_a_sheet_of_the_run(chain: Chain, tmp_path: Path):
    from method_configs.commands.sheet import write_sheet

    write_sheet(chain.resumed, tmp_path / "new" / "sheet.png")
    height, width = media.image_size(tmp_path / "new" / "sheet.png")
    assert width > 1000 and height > 1000
    write_sheet(chain.resumed, tmp_path / "both.png", before=chain.resumed)
    assert media.image_size(tmp_path / "both.png")[0] > 1.2 * height
    with pytest.raises(ValueError, match=r"no config\.yml there"):
        write_sheet(tmp_path, tmp_path / "sheet.png")
