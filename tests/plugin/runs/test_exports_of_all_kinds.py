"""Exports of captures of all kinds, and what is refused."""

from __future__ import annotations

import dataclasses
import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.folders.runs import GENERATED, changed, export, generated_views, make_run, refusal
from helpers.plugin.exports import run_world, split_lists
from nerfstudio.data.utils import colmap_parsing_utils as colmap

from fb_core.data import media
from fb_core.data.capture.captures import FrameToWrite, read_capture, validate_capture, write_capture
from fb_core.data.capture.points import read_points
from fb_core.files.ownership import Target
from fb_core.files.whole import whole_folder
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.runs import export as export_module


@pytest.fixture
def run(tiny_capture: Path, tmp_path: Path) -> Path:
    """A run on six views, of which the last is held out."""
    changed(tiny_capture, lambda meta: meta.update(split_lists(meta)))
    return make_run(tmp_path / "run", tiny_capture, generated_views())


# ---- captures of all kinds -------------------------------------------------------------------------------------------


def test_bent_pictures_are_straightened_and_straight_ones_copied(tiny_capture: Path, tmp_path: Path):
    changed(tiny_capture, lambda meta: [frame.update(k1=-0.1, k2=0.01, p1=0.001) for frame in meta["frames"][:2]])
    folder = export(make_run(tmp_path / "run", tiny_capture, generated_views()), "nerfstudio")
    before, after = read_capture(tiny_capture), validate_capture(folder)
    for old, new in list(zip(before.frames, after.frames, strict=False))[:6]:
        assert new.distortion == {} and new.camera_model == "PINHOLE"
        image, mask, camera = old.load_undistorted()
        assert torch.equal(new.camera.camera_to_world, camera.camera_to_world) and torch.equal(
            new.camera.focal, camera.focal
        )
        assert float((new.load_image() - image).abs().max()) <= 0.5 / 255 + 1e-6 and torch.equal(new.load_mask(), mask)


def test_pictures_of_one_name_in_several_folders_get_names_of_their_own(tiny_capture: Path, tmp_path: Path):
    meta = json.loads((tiny_capture / "transforms.json").read_text())
    for index, frame in enumerate(meta["frames"]):
        moved = tiny_capture / f"cam {index}" / "my photo.png"
        moved.parent.mkdir()
        shutil.move(tiny_capture / frame["file_path"], moved)
        frame["file_path"] = str(moved.relative_to(tiny_capture))
    (tiny_capture / "transforms.json").write_text(json.dumps(meta))
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    names = [frame.image_path.name for frame in validate_capture(export(run, "nerfstudio")).frames][:6]
    assert names == [f"captured_{index:04d}_my_photo.png" for index in range(6)]
    assert len(colmap.read_images_text(export(run, "colmap") / "sparse/0/images.txt")) == 6 + GENERATED


def test_a_capture_without_points_gets_the_runs_gaussians(tiny_capture: Path, tmp_path: Path):
    changed(tiny_capture, lambda meta: meta.pop("ply_file_path"))
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    points, world = read_points(export(run, "nerfstudio") / "points3D.ply"), run_world(run)[0]
    means = torch.randn(30, 3, generator=torch.Generator().manual_seed(1))
    firm = torch.linspace(-6, 3, 30).sigmoid() > 0.05
    assert 0 < int(firm.sum()) < 30
    assert torch.allclose(world.points(points.positions), means[firm].double(), atol=1e-5)
    assert len(colmap.read_points3D_binary(export(run, "colmap") / "sparse/0/points3D.bin")) == len(points)


def test_without_masks_anywhere_there_are_none(tmp_path: Path):
    cameras = generated_views().cameras.to(torch.float64)
    frames = [FrameToWrite(name=f"v{i}", image=torch.rand(3, 16, 16), camera=cameras[i]) for i in range(GENERATED)]
    write_capture(tmp_path / "capture", frames)
    run = make_run(tmp_path / "run", tmp_path / "capture", generated_views(world_masks=False))
    folder = export(run, "nerfstudio")
    assert not (folder / "masks").exists() and all(frame.mask_path is None for frame in validate_capture(folder).frames)


def test_a_single_photo_and_held_out_views_left_away(tmp_path: Path):
    centers = torch.randn(11, 3, dtype=torch.float64)
    cameras = Pinholes.looking_at(
        centers, centers + 1, up=torch.tensor([0.0, 0, 1]), fov_degrees=60.0, width=16, height=16
    )
    for count, expected in ((1, 0), (11, 1)):  # nerfstudio holds out a tenth
        frames = [FrameToWrite(name=f"v{i}", image=torch.rand(3, 16, 16), camera=cameras[i]) for i in range(count)]
        write_capture(tmp_path / f"capture{count}", frames)
        run = make_run(tmp_path / f"run{count}", tmp_path / f"capture{count}", generated_views())
        whole = read_capture(export(run, "nerfstudio"))
        kept = read_capture(
            export(run, "nerfstudio", "--no-held-out", "--output", tmp_path / f"kept{count}")
            and tmp_path / f"kept{count}"
        )
        assert (
            sum(frame.extra.get("held_out", False) for frame in whole.frames)
            == expected
            == len(whole.extra["val_filenames"])
        )
        assert len(whole) == count + GENERATED and len(kept) == len(whole) - expected
        assert not any(frame.extra.get("held_out") for frame in kept.frames) and kept.extra["val_filenames"] == []


def test_a_run_that_was_killed_between_rounds_is_exported_with_a_warning(tiny_capture: Path, tmp_path: Path, caplog):
    run = make_run(tmp_path / "run", tiny_capture, generated_views()[[0, 1]], finished=False)
    assert len(read_capture(export(run, "nerfstudio"))) == 6 + 2
    assert "generation was interrupted" in caplog.text


# ---- refusals --------------------------------------------------------------------------------------------------------


def test_what_is_not_a_completed_run_is_refused_in_a_sentence(tiny_capture: Path, tmp_path: Path, capsys):
    assert "no config.yml there" in refusal(capsys, tmp_path, "--format", "colmap")
    none = make_run(tmp_path / "none", tiny_capture, None)
    assert "it has no generated views" in refusal(capsys, none, "--format", "colmap")
    (checkpoint,) = (none / "nerfstudio_models").iterdir()
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    assert "cannot be read" in refusal(capsys, none, "--format", "colmap")
    checkpoint.unlink()
    assert "no checkpoint yet" in refusal(capsys, none, "--format", "colmap")


def test_a_capture_that_changed_since_the_run_is_refused(run: Path, tiny_capture: Path, capsys):
    text = (tiny_capture / "transforms.json").read_text()
    asked = (run, "--format", "nerfstudio")
    (tiny_capture / "transforms.json").unlink()
    assert "no transforms.json" in refusal(capsys, *asked)
    (tiny_capture / "transforms.json").write_text(text)
    changed(tiny_capture, lambda meta: meta["frames"][0]["transform_matrix"][0].__setitem__(3, 5.0))
    shutil.move(tiny_capture / "images" / "view_001.png", tiny_capture / "images" / "other.png")
    assert "view_001.png" in refusal(capsys, *asked)
    assert not (run / "export-nerfstudio").exists()


def test_poses_that_changed_after_the_run_are_noticed(run: Path, tiny_capture: Path, capsys, monkeypatch):
    from fb_nerfstudio.runs import saved_run

    def moved(data: Path):
        capture = read_capture(data)
        camera = capture.frames[0].camera
        other = dataclasses.replace(camera, camera_to_world=camera.camera_to_world + 0.01)
        return dataclasses.replace(
            capture, frames=(dataclasses.replace(capture.frames[0], camera=other), *capture.frames[1:])
        )

    monkeypatch.setattr(saved_run, "read_capture", moved)
    assert "cameras have changed since the run" in refusal(capsys, run, "--format", "colmap")


def test_an_existing_output_is_replaced_only_when_asked(run: Path, capsys):
    folder = export(run, "nerfstudio")
    before = (folder / "transforms.json").read_text()
    (folder / "mine.txt").write_text("kept until replaced")
    assert "exists already" in refusal(capsys, run, "--format", "nerfstudio") and (folder / "mine.txt").exists()
    export(run, "nerfstudio", "--overwrite")
    assert (folder / "transforms.json").read_text() == before and not (folder / "mine.txt").exists()
    export(run, "colmap", "--output", folder, "--overwrite")
    assert (folder / "frames.json").exists() and not (folder / "transforms.json").exists()


def test_a_folder_of_something_else_is_never_swept_away(run: Path, tmp_path: Path, capsys):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("years of work")
    told = refusal(capsys, run, "--format", "colmap", "--output", tmp_path / "home", "--overwrite")
    assert "holds something else" in told and (tmp_path / "home" / "thesis.txt").read_text() == "years of work"


FULL = OSError(errno.ENOSPC, "No space left on device")


def fails_at(call: int, function: Callable) -> Callable:
    """The function, until the disk is full at its call of this number (from 0), which leaves half a file."""
    calls = []

    def write(*args, **kwargs):
        calls.append(1)
        if len(calls) > call:
            for path in args:
                if isinstance(path, Path) and not path.exists():
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(b"half")
            raise FULL
        return function(*args, **kwargs)

    return write


@pytest.mark.parametrize("replaces", [False, True])
@pytest.mark.parametrize(
    ("format", "owner", "name", "call"),
    [
        ("nerfstudio", shutil, "copyfile", 0),
        ("nerfstudio", shutil, "copyfile", 6),  # the points
        ("nerfstudio", media, "write_image", 0),
        ("nerfstudio", media, "write_image", 9),
        ("nerfstudio", export_module, "write_transforms", 0),
        ("colmap", media, "write_image", 3),
        ("colmap", export_module, "write_colmap", 0),
    ],
)
def test_a_full_disk_leaves_nothing_half_written(
    run: Path, tmp_path: Path, capsys, monkeypatch, format, owner, name, call, replaces
):
    output = tmp_path / "out" / "export"
    if replaces:
        export(run, format, "--output", output)
    before = {path: path.read_bytes() for path in output.rglob("*") if path.is_file()}
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, fails_at(call, getattr(owner, name)))
        told = refusal(capsys, run, "--format", format, "--output", output, *(["--overwrite"] if replaces else []))
    assert "No space left on device" in told and "nothing was written" in told
    assert {path: path.read_bytes() for path in output.rglob("*") if path.is_file()} == before
    assert output.exists() == replaces and [path for path in output.parent.iterdir() if path != output] == []


def test_a_folder_is_whole_or_absent_whatever_ends_the_writing(tmp_path: Path):
    for end in (KeyboardInterrupt, SystemExit, ValueError):
        with pytest.raises(end), whole_folder(Target(folder=tmp_path / "new", kind="test")) as unfinished:
            (unfinished / "file").write_text("half")
            raise end
        assert list(tmp_path.iterdir()) == []
