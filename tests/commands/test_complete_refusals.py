"""``fillerbuster complete`` of bad input: one sentence, an exit code, nothing half written."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.folders.films import write_film
from helpers.processes.complete_commands import _folder, complete, posed, refusal
from helpers.small_figures import draw_small
from helpers.textured_box import cameras_on_an_arc, render, save_photos
from helpers.tiny_models import save_tiny_model

from fb_core.data import media
from fb_core.data.capture.captures import FrameToWrite, read_capture, write_capture
from fb_core.data.photos.collection import read_photos
from method_configs.commands.complete import command as complete_command
from method_configs.commands.complete import output as complete_output


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_model(tmp_path_factory.mktemp("tiny") / "model", image_size=16)


@pytest.fixture(autouse=True)
def small_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_small(monkeypatch)


def files(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ---- bad input -------------------------------------------------------------------------------------------------------


def _one_photo(folder: Path) -> Path:
    return save_photos(folder, cameras_on_an_arc(1, width=20, height=20))


def _text_as_photo(folder: Path) -> Path:
    (_one_photo(folder) / "other.jpg").write_text("I am no photo")
    return folder


def _same(folder: Path) -> Path:
    _one_photo(folder)
    for name in ("a.png", "b.png"):
        shutil.copyfile(folder / "photo_000.png", folder / name)
    return folder


def _black(folder: Path) -> Path:
    for index in range(3):
        media.write_image(_folder(folder) / f"{index}.png", torch.zeros(3, 20, 20))
    return folder


def _film(folder: Path, count: int) -> Path:
    pictures = render(cameras_on_an_arc(count, width=64, height=48))
    return write_film(
        _folder(folder) / "film.mp4", [(one * 255).to(torch.uint8).movedim(0, -1).numpy() for one in pictures]
    )


def _cut_film(folder: Path) -> Path:
    film = _film(folder, 10)
    film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    return film


BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "an empty folder": (_folder, "an empty folder"),
    "nothing": (lambda folder: folder, "no such folder or film"),
    "one photo": (_one_photo, "at least 2 photos, got 1"),
    "a text as photo": (_text_as_photo, r"other.jpg: not readable as an image"),
    "identical photos": (_same, "same picture"),
    "all black": (_black, "black"),
    "a film of one frame": (lambda folder: _film(folder, 1), "film.mp4"),
    "a truncated film": (_cut_film, "film.mp4"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_sentence_and_leaves_nothing(kind: str, tmp_path: Path, model: Path, capsys):
    make, expected = BAD[kind]
    source = make(tmp_path / "input")
    before = set(tmp_path.rglob("*"))
    assert expected in refusal(capsys, source, tmp_path / "out", model)
    assert set(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--views", 0), "views: expected at least 1, got 0"),
        (("--fps", 0), "fps: expected between 0 and 240"),
        (("--sequence", 3, "--photos", 3), "sequence: expected more than the 3 photos"),
        (("--prompt", "a sofa"), "--prompt: this model reads no text"),
    ],
)
def test_wishes_that_cannot_be_met_are_refused(tmp_path: Path, model: Path, capsys, options, sentence):
    source = posed(tmp_path / "capture", cameras_on_an_arc(3, width=20, height=20))
    assert sentence in refusal(capsys, source, tmp_path / "out", model, *options)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("frames", [("--frames", "model"), ("--frames", "scene"), ("--poses-only",)])
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--device", "toaster"), "device: expected one that this machine has, such as cpu, cuda or cuda:N, got"),
        (("--device", "meta"), "device: expected one that this machine has, such as cpu, cuda or cuda:N, got 'meta'"),
        (("--path", "loop"), "--path: expected ellipse, orbit, spiral"),
        (("--path", "missing.json"), "camera path missing.json: no such file"),
        (("--known-poses", "missing"), "missing: no such folder"),
        (("--model", "missing"), "there is no folder missing"),
        (("--prompt", "a sofa"), "--prompt: this model reads no text"),
    ],
)
def test_what_cannot_be_used_is_told_before_photos_are_read(
    tmp_path: Path, model: Path, capsys, monkeypatch, frames, options, sentence
):
    """On fifty photos a device was told after minutes only, when all cameras had been found."""
    monkeypatch.setattr(complete_command, "read_photos", lambda _: pytest.fail("photos were read"))
    assert sentence in refusal(capsys, tmp_path, tmp_path / "out", model, *frames, *options)
    assert not (tmp_path / "out").exists()


def test_only_ones_own_output_is_replaced_and_only_when_asked(tmp_path: Path, model: Path, capsys):
    source = posed(tmp_path / "capture", cameras_on_an_arc(3, width=20, height=20))
    _folder(tmp_path / "out")  # an empty folder may be there
    complete(source, tmp_path / "out", model)
    (tmp_path / "out" / "mine.txt").write_text("kept until replaced")
    assert (
        "exists already" in refusal(capsys, source, tmp_path / "out", model)
        and (tmp_path / "out" / "mine.txt").exists()
    )
    complete(source, tmp_path / "out", model, "--overwrite")
    assert not (tmp_path / "out" / "mine.txt").exists()
    (_folder(tmp_path / "home") / "thesis.txt").write_text("years of work")
    told = refusal(capsys, source, tmp_path / "home", model, "--overwrite")
    assert "--overwrite does not touch it" in told and (tmp_path / "home" / "thesis.txt").exists()
    for holds in (tmp_path / "out", tmp_path):
        assert "holds the input" in refusal(capsys, tmp_path / "out", holds, model, "--overwrite")


@pytest.mark.parametrize(
    ("owner", "name", "replaces"),
    [(media, "write_image", False), (complete_output, "write_film", True), (complete_command, "write_report", False)],
)
def test_a_full_disk_leaves_nothing_half_written(
    tmp_path: Path, model: Path, capsys, monkeypatch, owner, name, replaces
):
    source = posed(tmp_path / "capture", cameras_on_an_arc(3, width=20, height=20))
    options = ("--overwrite",) if replaces else ()
    if replaces:
        complete(source, tmp_path / "out", model)
    before = files(tmp_path)

    def full(*args, **kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, full)
        told = refusal(capsys, source, tmp_path / "out", model, *options)
    assert "No space left on device" in told and "nothing was written" in told
    assert files(tmp_path) == before
    assert {path.name for path in tmp_path.iterdir()} == ({"capture", "out"} if replaces else {"capture"})


def test_a_machine_without_graphics_keeps_all_the_rest(tmp_path: Path, model: Path, monkeypatch, caplog):
    def fails(*args, **kwargs):
        raise RuntimeError("no OpenGL here")

    monkeypatch.setattr(complete_output, "draw_cameras", fails)
    complete(posed(tmp_path / "capture", cameras_on_an_arc(3, width=20, height=20)), tmp_path / "out", model)
    assert "cameras.png is left out" in caplog.text and (tmp_path / "out" / "sheet.png").exists()


def test_a_rig_s_pictures_of_one_name_are_told_apart_by_what_they_hold(tmp_path: Path, caplog) -> None:
    """cam0/0.png and cam1/0.png are different photos: each photo gets the camera of the picture that it is, or none."""
    from method_configs.commands.complete.command import _with_known_poses

    truth = cameras_on_an_arc(4)
    rig = write_capture(tmp_path / "rig", [
        FrameToWrite(name=f"p{index}", image=torch.full((3, 16, 16), index / 8), camera=camera)
        for index, camera in enumerate(truth[one].scaled(16, 16).to(torch.float64) for one in range(4))
    ])  # fmt: skip
    meta = json.loads((rig.root / "transforms.json").read_text())
    (tmp_path / "photos").mkdir()
    for index, frame in enumerate(meta["frames"]):
        place = rig.root / "images" / f"cam{index // 2}" / f"{index % 2}.png"
        place.parent.mkdir(exist_ok=True)
        (rig.root / frame["file_path"]).rename(place)
        frame["file_path"] = str(place.relative_to(rig.root))
        if index // 2 == 0:
            (tmp_path / "photos" / place.name).write_bytes(place.read_bytes())
    (rig.root / "transforms.json").write_text(json.dumps(meta))
    found = _with_known_poses(read_photos(tmp_path / "photos"), rig.root)
    assert [one.source.parent.name for one in found] == ["cam0", "cam0"] and all(
        one.camera is not None for one in found
    )
    media.write_image(tmp_path / "photos" / "0.png", torch.rand(3, 16, 16))
    found = _with_known_poses(read_photos(tmp_path / "photos"), rig.root)
    assert found[0].camera is None and found[1].camera is not None and "none is this photo" in caplog.text


def test_a_capture_s_json_file_may_have_any_name(tmp_path: Path, model: Path) -> None:
    posed = write_capture(tmp_path / "posed", [
        FrameToWrite(name=f"p{index}", image=torch.rand(3, 16, 16), camera=camera.scaled(16, 16).to(torch.float64))
        for index, camera in enumerate(cameras_on_an_arc(4))
    ])  # fmt: skip
    (posed.root / "transforms.json").rename(posed.root / "transforms_train.json")
    report = complete(posed.root / "transforms_train.json", tmp_path / "out", model, "--poses-only")
    assert report["cameras"]["method"] == "known" and len(read_capture(tmp_path / "out")) == 4
