"""Captures that bring generated views along: these are trained on as generated views, and count as photos nowhere."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.folders.runs import make_run
from helpers.plugin.datamanagers import GreyFiller, attributes, draws, run_callbacks
from helpers.plugin.datamanagers import options as small_completion
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.utils.rich_utils import CONSOLE

from fb_core.completion.brought_views import brought_views
from fb_core.completion.requests import RemoveView, key_of
from fb_core.completion.results.completed_views import BROUGHT, round_title
from fb_core.data.capture.captures import FrameToWrite, read_capture, split_lists, write_capture, write_transforms
from fb_core.files.faults import Refused
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.capture.dataparser import without_open3d
from fb_nerfstudio.datamanager import FillerbusterDataManager, FillerbusterDataManagerConfig
from fb_nerfstudio.generation import surroundings
from method_configs.commands import command_line as commands

PHOTOS, GENERATED = 9, 2
HELD_OUT = "photo_007"


@pytest.fixture(autouse=True)
def stand_in_model(monkeypatch: pytest.MonkeyPatch):
    """No test here loads real weights; the number of loads is counted."""
    GreyFiller.loads = GreyFiller.calls = 0

    def load(self):
        GreyFiller.loads += 1
        return GreyFiller()

    monkeypatch.setattr(FillerbusterDataManager, "load_inpainter", load)
    monkeypatch.setattr(FillerbusterDataManager, "check_inpainter", lambda self: None)
    monkeypatch.setattr(surroundings, "release_memory", lambda: None)


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a person reads in the terminal."""
    lines: list[str] = []
    monkeypatch.setattr(CONSOLE, "print", lambda line, **_: lines.append(line))
    return lines


def cameras(count: int, size: int, start: float = 0.0) -> Pinholes:
    angles = start + torch.arange(count, dtype=torch.float64) * 2 * torch.pi / count
    centers = torch.stack([2 * angles.cos(), 2 * angles.sin(), 0.3 * angles.sin()], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Pinholes.looking_at(centers, torch.zeros_like(centers), up=up, fov_degrees=60.0, width=size, height=size)


def completed(folder: Path, *, lists: bool = True, masked: bool = False, size: int = 16) -> Path:
    """Nine photos of 24x24 pixels, of which one is held out, and two generated frames, whose names stand first in the
    alphabet.
    """
    taken, new = cameras(PHOTOS, 24), cameras(GENERATED, size, start=0.3)
    half = torch.ones(1, size, size)
    half[:, : size // 2] = 0.0
    frames = [
        FrameToWrite(
            name=f"photo_{i:03d}",
            image=torch.full((3, 24, 24), 0.5),
            camera=taken[i],
            extra={"held_out": lists and i == 7},
        )
        for i in range(PHOTOS)
    ]
    for i in range(GENERATED):
        origin = {
            "generated": True,
            "role": "fly-through",
            "round": i,
            "seed": 40 + i,
            "prompt": "",
            "model_hash": "ab",
        }
        image = torch.full((3, size, size), (i + 1) / 5)
        frames.append(
            FrameToWrite(
                name=f"generated_{i:04d}", image=image, mask=half if masked else None, camera=new[i], extra=origin
            )
        )
    capture = write_capture(folder, frames)
    if lists:
        meta = json.loads((folder / "transforms.json").read_text())
        (folder / "transforms.json").write_text(json.dumps(meta | split_lists(capture.frames, folder)))
    return folder


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return completed(tmp_path / "capture")


def make(data: Path, **options: Any) -> FillerbusterDataManager:
    config = FillerbusterDataManagerConfig(
        data=data,
        dataparser=NerfstudioDataParserConfig(),
        completion=small_completion(**options),
        cache_images_type="uint8",
        start_points=0,
    )
    return config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)


def names(dataset: Any) -> set[str]:
    return {Path(name).stem for name in dataset.image_filenames}


def test_generated_frames_are_in_the_bank_and_nowhere_else(capture: Path, tmp_path: Path, said: list[str]):
    manager = make(capture, generated_share=1.0, generated_steps="shared", generated_pixels="all")
    attrs = attributes(manager, tmp_path / "run")
    run_callbacks(manager, attrs)
    photos = {f"photo_{index:03d}" for index in range(PHOTOS)}
    assert names(manager.train_dataset) == photos - {HELD_OUT} and names(manager.eval_dataset) == {HELD_OUT}
    assert len(manager.cached_train) == len(manager.captured_cameras()) == len(manager.known_parts) == PHOTOS - 1
    bank = manager.generated_views
    assert [(one.role, one.round, one.seed, one.model_hash) for one in bank.origins] == [
        (BROUGHT, 2, 40, "ab"),
        (BROUGHT, 2, 41, "ab"),
    ]
    assert round_title(BROUGHT, 2) == "From the capture" and manager.completion_panel.views is bank
    assert bank.images[:, 3, 3, 0].tolist() == [51, 102] and bool(bank.masks.all())
    assert GreyFiller.loads == 0 and len(list((tmp_path / "run" / "completion" / "images").iterdir())) == GENERATED
    assert manager.generated_probability == pytest.approx(2 / 10)
    drawn = draws(manager, range(200))
    assert 20 < sum(isinstance(one, str) for one in drawn) < 60 and {
        one for one in drawn if isinstance(one, int)
    } == set(range(8))
    assert "brings 2 generated views" in said[0] and "none are generated beside them" in said[0]


def test_their_cameras_stand_where_nerfstudio_puts_them(capture: Path):
    """The world is the one that splatfacto trains in on the same capture."""
    config = NerfstudioDataParserConfig(data=capture)
    stock = Nerfstudio(config).get_dataparser_outputs("train")
    manager = make(capture)
    run_callbacks(manager, attributes(manager))
    assert [Path(name).stem for name in stock.image_filenames[:2]] == ["generated_0000", "generated_0001"]
    assert torch.equal(manager.generation.bank.cameras.camera_to_worlds, stock.cameras.camera_to_worlds[:2])
    assert torch.equal(manager.train_dataset.cameras.camera_to_worlds, stock.cameras.camera_to_worlds[2:])
    assert manager.generation.bank.cameras.fx[0].item() == pytest.approx(stock.cameras.fx[0].item())


def test_what_the_photos_show_is_left_to_them(capture: Path):
    """As for views that the run has generated: unseen pixels alone are trained on, Gaussians are placed there."""
    manager = make(capture)
    attrs = attributes(manager)
    run_callbacks(manager, attrs, step=500)
    share = float(manager.generated_views.masks.float().mean())
    assert 0 < share < 1 and len(attrs.pipeline.model.added) == 1


def test_a_resumed_run_holds_them_once(capture: Path, said: list[str]):
    whole = make(capture)
    run_callbacks(whole, attributes(whole))
    buffer = io.BytesIO()
    torch.save(whole.state_dict(), buffer)
    buffer.seek(0)
    said.clear()
    resumed = make(capture)
    resumed.load_state_dict(torch.load(buffer, weights_only=True), strict=False)
    run_callbacks(resumed, attributes(resumed), step=9)
    assert len(resumed.generated_views) == GENERATED and said == []
    assert torch.equal(resumed.generated_views.images, whole.generated_views.images)


def test_one_that_was_removed_in_the_viewer_stays_away(capture: Path):
    manager = make(capture)
    attrs = attributes(manager)
    run_callbacks(manager, attrs)
    for left in (1, 0):
        manager.completion_panel.requests.put(RemoveView(key=key_of(manager.generated_views, 0)))
        run_callbacks(manager, attrs)
        assert len(manager.generated_views or ()) == left
    resumed = make(capture)
    resumed.load_state_dict(manager.state_dict(), strict=False)
    run_callbacks(resumed, attributes(resumed))
    assert resumed.generated_views is None


def test_a_run_may_generate_beside_them(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Killed between two rounds, it takes them at its end, once, and what it generates does not see them."""
    manager = make(capture, on_completed_capture="extend")
    complete, calls = GreyFiller.complete, []

    def dies(*args, **kwargs):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return complete(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(GreyFiller, "complete", dies)
        with pytest.raises(KeyboardInterrupt):
            run_callbacks(manager, attributes(manager, tmp_path))
    state = torch.load(tmp_path / "nerfstudio_models" / "step-000000000.ckpt", weights_only=True)["pipeline"]
    resumed = make(capture, on_completed_capture="extend")
    resumed.load_state_dict(state, strict=False)
    run_callbacks(resumed, attributes(resumed))
    roles = [origin.role for origin in resumed.generated_views.origins]
    assert roles == ["anchor"] * 4 + ["densify"] * 2 + [BROUGHT] * 2 and resumed.generated_views.rounds == [0, 1, 2]
    left_out = make(capture, on_completed_capture="ignore")
    run_callbacks(left_out, attributes(left_out))
    assert torch.equal(left_out.generated_views.images, resumed.generated_views.images[:6])


@pytest.mark.parametrize(
    "options", [{"enabled": False}, {"on_completed_capture": "ignore", "anchor_views": 0, "densify_rounds": 0}]
)
def test_a_baseline_leaves_them_out_and_says_so(capture: Path, options: dict, said: list[str]):
    manager = make(capture, **options)
    run_callbacks(manager, attributes(manager))
    assert manager.generated_views is None and len(manager.train_dataset) == PHOTOS - 1
    assert [line for line in said if "left out, only its photos count" in line] == said[:1]


@pytest.mark.parametrize("mode", ["fraction", "interval", "all"])
def test_without_lists_nerfstudios_choice_is_made_among_the_photos(tmp_path: Path, mode: Any):
    data = completed(tmp_path / "capture", lists=False)
    config = NerfstudioDataParserConfig(data=data, eval_mode=mode, train_split_fraction=0.8)
    parser = without_open3d(config).setup()
    photos = data.parent / "photos"
    write_transforms(read_capture(data).photos, photos)
    alone = Nerfstudio(NerfstudioDataParserConfig(data=photos, eval_mode=mode, train_split_fraction=0.8))
    for split in ("train", "val", "test"):
        expected = [Path(name).stem for name in alone.get_dataparser_outputs(split).image_filenames]
        assert [Path(name).stem for name in parser.get_dataparser_outputs(split).image_filenames] == expected
    assert len(parser.generated_frames()) == GENERATED and parser.config is config


def test_their_masks_count(tmp_path: Path):
    manager = make(completed(tmp_path / "capture", masked=True), generated_pixels="all")
    run_callbacks(manager, attributes(manager))
    masks = manager.generated_views.masks
    assert not bool(masks[:, :8].any()) and bool(masks[:, 8:].all())
    assert len(manager.cached_train[0]["mask"]) == 24


def test_frames_of_several_sizes_become_squares_of_one(tmp_path: Path):
    """A frame in portrait is padded with pixels that are not trained on; its rays stay where they were."""
    small, tall = cameras(1, 12), cameras(1, 20).cropped(6, 0, 8, 20)
    frames = [
        FrameToWrite(name="small", image=torch.full((3, 12, 12), 0.2), camera=small, extra={"generated": True}),
        FrameToWrite(
            name="tall", image=torch.full((3, 20, 8), 0.4), camera=tall, extra={"generated": True, "seed": "?"}
        ),
    ]
    views = brought_views(write_capture(tmp_path / "capture", frames).frames, number=3)
    assert (
        views.images.shape == (2, 20, 20, 3) and views.masks[1].sum() == 20 * 8 and bool(views.masks[1, :, 6:14].all())
    )
    assert bool(views.masks[0].all()) and views.images[:, 10, 10, 0].tolist() == [51, 102]
    torch.testing.assert_close(views.cameras[1].directions()[:, :, 6:14].double(), tall.directions(), atol=1e-6, rtol=0)
    assert [(one.seed, one.aspect) for one in views.origins] == [(0, 1.0), (0, 0.4)]


def test_an_export_of_the_run_tells_them_apart_again(capture: Path, tmp_path: Path):
    manager = make(capture)
    run_callbacks(manager, attributes(manager))
    run = make_run(tmp_path / "run", capture, manager.generated_views)
    commands.main(["export", str(run), "--format", "nerfstudio"])
    before, after = read_capture(capture).frames, read_capture(run / "export-nerfstudio").frames
    assert [frame.extra.get("held_out") for frame in after] == [index == 7 for index in range(PHOTOS)] + [
        None
    ] * GENERATED
    assert [frame.generated for frame in after] == [False] * PHOTOS + [True] * GENERATED
    for old, new in zip(before, after, strict=True):
        torch.testing.assert_close(new.camera.camera_to_world, old.camera.camera_to_world, atol=1e-6, rtol=0)


def test_a_capture_without_photos_is_refused(tmp_path: Path):
    data = completed(tmp_path / "capture", lists=False)
    meta = json.loads((data / "transforms.json").read_text())
    meta["frames"] = [frame for frame in meta["frames"] if frame.get("generated")]
    (data / "transforms.json").write_text(json.dumps(meta))
    with pytest.raises(Refused, match="all of its 2 frames are marked as generated"):
        make(data)


def test_small_generated_views_are_no_reason_to_refuse_small_photos(capture: Path, tmp_path: Path):
    """The quickstart's scale of photos would make pictures of 2 pixels of generated views, which keep their size."""
    config = FillerbusterDataManagerConfig(
        data=capture,
        dataparser=NerfstudioDataParserConfig(),
        completion=small_completion(),
        start_points=0,
        camera_res_scale_factor=0.7,
    )
    manager = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    run_callbacks(manager, attributes(manager, tmp_path / "run"))
    assert manager.cached_train[0]["image"].shape[:2] == (16, 16) and manager.generated_views.images.shape[1:3] == (
        16,
        16,
    )
