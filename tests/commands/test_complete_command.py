"""``fillerbuster complete`` from end to end in miniature: every kind of input, everything that it leaves, and every way
to refuse.
"""

from __future__ import annotations

import json
from pathlib import Path

import av
import numpy as np
import pytest
import torch
from helpers.folders.camera_paths import write_path
from helpers.folders.films import write_film
from helpers.processes.complete_commands import _folder, complete, posed, refusal
from helpers.small_figures import draw_small
from helpers.textured_box import cameras_on_an_arc, render, save_photos
from helpers.tiny_models import save_tiny_model
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from PIL import Image

from fb_core.data import media
from fb_core.data.capture.captures import FrameToWrite, read_capture, validate_capture, write_capture
from fb_core.data.capture.points import read_points
from fb_core.evaluation.metrics.pose_metrics import pose_errors
from fb_core.files.ownership import MARK_NAME
from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_model(tmp_path_factory.mktemp("tiny") / "model", image_size=16)


@pytest.fixture(autouse=True)
def small_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_small(monkeypatch)


# ---- what comes out --------------------------------------------------------------------------------------------------


def test_a_posed_capture_becomes_a_completed_one(tmp_path: Path, model: Path):
    source = posed(tmp_path / "capture", cameras_on_an_arc(9, width=40, height=30), points=True)
    report = complete(source, tmp_path / "out", model, "--photos", 3, "--seed", 4)
    before, after = read_capture(source), validate_capture(tmp_path / "out", decode=True)
    photos = [frame for frame in after.frames if not frame.extra["generated"]]
    new = [frame for frame in after.frames if frame.extra["generated"]]
    assert (len(photos), len(new)) == (9, 5)
    for old, kept in zip(before.frames, photos, strict=True):
        assert torch.equal(old.camera.camera_to_world, kept.camera.camera_to_world)
        assert old.image_path.read_bytes() == kept.image_path.read_bytes()
    assert {(f.extra["seed"], f.extra["model_hash"] != "", f.extra["role"], f.camera.width) for f in new} == {
        (4, True, "fly-through", 16)
    }
    assert after.extra["applied_scale"] == 2.0 and len(read_points(tmp_path / "out" / "points3D.ply")) == 20
    assert report["cameras"]["method"] == "known" and report["passes"] == [5] and len(report["context"]) == 3
    assert set(report["seconds"]) >= {"reading", "cameras", "new views", "writing"} and report["peak_memory_gib"] > 0
    names = {path.name for path in (tmp_path / "out").iterdir()}
    wanted = {"transforms.json", "images", "points3D.ply", "fly-through.mp4", "sheet.png", "cameras.png", "report.json"}
    assert names == wanted | {MARK_NAME} and [path for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    with av.open(str(tmp_path / "out" / "fly-through.mp4")) as film:
        assert len(list(film.decode(video=0))) == 5
    stock, ours = (
        reader(NerfstudioDataParserConfig(data=tmp_path / "out")) for reader in (Nerfstudio, NerfstudioWithoutOpen3d)
    )
    for split, photos, generated in (
        ("train", 8, 5),
        ("val", 1, 0),
        ("test", 1, 0),
    ):  # ours has another place for generated frames
        names = [path.stem for path in stock.get_dataparser_outputs(split).image_filenames]
        assert (sum(name.startswith("photo") for name in names), len(names)) == (photos, photos + generated)
        assert len(ours.get_dataparser_outputs(split).image_filenames) == photos
    again = complete(tmp_path / "out", tmp_path / "again", model)  # generated views are no photos
    assert again["cameras"]["photos"] == 9


def test_photos_alone_get_cameras_by_features_where_the_model_knows_none(tmp_path: Path, model: Path, caplog):
    truth = cameras_on_an_arc(4)
    save_photos(tmp_path / "photos", truth)
    with caplog.at_level("INFO"):
        report = complete(tmp_path / "photos", tmp_path / "out", model, "--path", "orbit", "--check")
    assert (
        report["cameras"]["trusted_by_method"] == {"model": 0, "features": 4}
        and report["cameras"]["method"] == "features"
    )
    capture = read_capture(tmp_path / "out")
    errors = pose_errors(
        [frame.camera for frame in capture.frames[:4]], [truth[index].to(torch.float64) for index in range(4)]
    )
    assert errors["rotation_degrees"] < 0.5 and errors["center"] < 0.03 and errors["focal_percent"] < 4
    assert capture.extra["orientation_override"] == "none"
    told = report["self_consistency"]
    assert (told["method"], told["photos"], told["new_views"]) == ("features", 4, 5) and "rotation_degrees" in told
    rays = media.read_exr(tmp_path / "out" / "raymaps" / "photo_000.exr")
    assert set(rays) == {f"{kind}.{axis}" for kind in ("origin", "direction") for axis in "xyz"}
    first = caplog.messages[0]
    for part in (
        "5 new views along the orbit of 16x16 pixels in 1 pass of 1 steps over up to 9 views",
        "4 of 4 photos",
        "GiB",
    ):
        assert part in first, first
    assert "The model is sure of 0 of 4 cameras, features of 4" in caplog.text


def test_poses_only_needs_no_model_for_features_and_generates_nothing(tmp_path: Path):
    save_photos(tmp_path / "photos", cameras_on_an_arc(4))  # of one wall three would not tell whether one was zoomed
    report = complete(
        tmp_path / "photos", tmp_path / "out", tmp_path / "no model", "--poses-only", "--cameras", "features"
    )
    assert report["model"] is None and report["cameras"]["trusted"] == 4
    assert [frame.extra["generated"] for frame in read_capture(tmp_path / "out").frames] == [False] * 4
    assert not (tmp_path / "out" / "fly-through.mp4").exists() and (tmp_path / "out" / "cameras.png").exists()


def test_cameras_are_never_made_up(tmp_path: Path, model: Path, capsys):
    """A random model knows none: report, sheet and raymaps are there, a capture is not, and what may help is said."""
    save_photos(tmp_path / "photos", cameras_on_an_arc(3, width=24, height=20))
    told = refusal(capsys, tmp_path / "photos", tmp_path / "out", model, "--cameras", "model")
    assert (
        "expected at least two that can be trusted, got 0" in told
        and "try --cameras features" in told
        and "None was made up" in told
    )
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"report.json", "sheet.png", "raymaps", MARK_NAME}
    assert [one["used"] for one in json.loads((tmp_path / "out" / "report.json").read_text())["photos"]] == [False] * 3
    told = refusal(
        capsys, tmp_path / "photos", tmp_path / "out", model, "--overwrite"
    )  # features find none either at this size
    assert "--known-poses" in told


def test_some_known_poses_hold_the_others(tmp_path: Path, model: Path, capsys):
    truth = cameras_on_an_arc(4)
    save_photos(tmp_path / "photos", truth)
    known = posed(tmp_path / "known", truth[[0, 3]])
    (known / "images" / "photo_001.png").rename(known / "images" / "photo_003.png")
    content = (known / "transforms.json").read_text().replace("photo_001", "photo_003")
    (known / "transforms.json").write_text(content)
    report = complete(
        tmp_path / "photos", tmp_path / "out", model, "--known-poses", known, "--cameras", "features", "--poses-only"
    )
    assert [one["verdict"] for one in report["photos"]] == ["known", "ok", "ok", "known"]
    for frame, camera in zip(read_capture(tmp_path / "out").frames, (truth[index] for index in range(4)), strict=True):
        assert torch.allclose(frame.camera.centers.float(), camera.centers, atol=0.06), frame.image_path.name
    other = posed(tmp_path / "other", truth[[0, 3]], name="else")
    told = refusal(capsys, tmp_path / "photos", tmp_path / "out2", model, "--known-poses", other)
    assert "none of its pictures has the file name of a photo" in told


def test_a_camera_path_of_ones_own(tmp_path: Path, model: Path, capsys):
    source = posed(tmp_path / "capture", cameras_on_an_arc(3, width=32, height=32))
    file = write_path(tmp_path / "path.json", 9)
    report = complete(source, tmp_path / "out", model, "--path", file, "--views", 4)
    assert report["passes"] == [4]
    new = [frame.camera.centers[0, 0] for frame in read_capture(tmp_path / "out").frames if frame.extra["generated"]]
    assert torch.stack(new).tolist() == pytest.approx([0, 3.375, 5.625, 9], abs=1.2) and float(
        new[-1]
    ) == pytest.approx(9)
    assert "expected ellipse, orbit, spiral" in refusal(capsys, source, tmp_path / "other", model, "--path", "loop")
    assert "not a JSON file" in refusal(
        capsys, source, tmp_path / "other", model, "--path", _text(tmp_path / "bad.json")
    )


def _text(path: Path) -> Path:
    path.write_text("hello")
    return path


# ---- every kind of input ---------------------------------------------------------------------------------------------


def test_twelve_photos_of_three_sizes_with_masks_and_orientations(tmp_path: Path, model: Path):
    """Known cameras, so that everything is written: landscape, portrait, square; one with alpha."""
    groups = [cameras_on_an_arc(4, width=w, height=h) for w, h in ((40, 30), (30, 40), (36, 36))]
    frames = []
    for number, group in enumerate(groups):
        pictures = render(group)
        for index in range(4):
            mask = torch.ones(1, group.height, group.width)
            mask[:, :5] = 0.0 if number == index == 1 else 1.0
            camera = group[index].to(torch.float64)
            frames.append(FrameToWrite(name=f"g{number}_{index}", image=pictures[index], mask=mask, camera=camera))
    source = write_capture(tmp_path / "capture", frames).root
    complete(source, tmp_path / "out", model)
    written = validate_capture(tmp_path / "out", decode=True)
    assert sorted({frame.camera.width for frame in written.frames}) == [16, 30, 36, 40]
    assert all(frame.mask_path is not None for frame in written.frames)
    dark = {frame.image_path.stem for frame in written.frames if float(frame.load_mask().mean()) < 1}
    assert dark == {"g1_1"}


def test_photos_that_lie_on_the_side_are_written_upright(tmp_path: Path, model: Path):
    picture = render(cameras_on_an_arc(4))  # two alone do not tell their focal length
    for index, one in enumerate(picture):
        exif = Image.Exif()
        exif[0x0112] = 6
        pixels = (one * 255).to(torch.uint8).movedim(0, -1).numpy()
        Image.fromarray(np.ascontiguousarray(np.rot90(pixels))).save(
            _folder(tmp_path / "photos") / f"{index}.jpg", exif=exif, quality=95
        )
    complete(tmp_path / "photos", tmp_path / "out", model, "--cameras", "features", "--poses-only")
    written = validate_capture(tmp_path / "out", decode=True)
    assert [(frame.camera.height, frame.camera.width) for frame in written.frames] == [(120, 160)] * 4
    stored = media.read_image(written.frames[0].image_path, apply_orientation=False)
    assert float((stored - picture[0]).abs().mean()) < 0.03


def test_a_portrait_film_with_rotation_metadata(tmp_path: Path, model: Path):
    pictures = render(cameras_on_an_arc(4, width=120, height=160, degrees=40))
    frames = [np.ascontiguousarray(np.rot90((one * 255).to(torch.uint8).movedim(0, -1).numpy())) for one in pictures]
    film = write_film(tmp_path / "film.mp4", frames, rotation=-90)
    report = complete(film, tmp_path / "out", tmp_path / "none", "--cameras", "features", "--poses-only")
    assert {(one["width"], one["height"]) for one in report["photos"]} == {(120, 160)}
    assert report["cameras"]["trusted"] >= 2 and report["photos"][1]["seconds"] > 0
    validate_capture(tmp_path / "out", decode=True)


@pytest.mark.parametrize("count", [17, pytest.param(100, marks=pytest.mark.slow)])
def test_more_photos_than_fit_come_in_windows(tmp_path: Path, model: Path, capsys, count):
    generator = torch.Generator().manual_seed(0)
    _folder(tmp_path / "photos")
    for index in range(count):
        media.write_image(
            tmp_path / "photos" / f"{index}.png",
            torch.rand(3, 8, 8, generator=generator).repeat_interleave(2, 1).repeat_interleave(2, 2),
        )
    refusal(capsys, tmp_path / "photos", tmp_path / "out", model, "--cameras", "model")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert len(report["photos"]) == count and report["cameras"]["trusted"] == 0
    assert len(list((tmp_path / "out" / "raymaps").iterdir())) >= 16
