"""What a capture or a run from somebody else names is copied only where it lies in the capture and is what it claims to
be.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.folders.runs import changed, export, generated_views, make_run, refusal

from fb_core.completion.results.completed_views import CompletedViews
from fb_core.data import media
from fb_core.data.capture.captures import read_capture
from fb_core.data.capture.own_files import is_ply, lies_inside
from fb_core.data.capture.point_cloud import Points
from fb_core.data.capture.points import read_points, write_points
from fb_core.data.photos.collection import read_photos
from method_configs.commands.complete import command as complete_command

SECRET = b"-----BEGIN PRIVATE KEY-----"


@pytest.fixture
def run(tiny_capture: Path, tmp_path: Path) -> Path:
    return make_run(tmp_path / "run", tiny_capture, generated_views())


def all_bytes(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file())


def _secret(capture: Path) -> Path:
    path = capture.parent / "secret"
    path.write_bytes(SECRET)
    return path


def _cloud_elsewhere(capture: Path) -> Path:
    path = capture.parent / "elsewhere.ply"
    write_points(path, Points(positions=torch.full((9, 3), 7.0), colors=torch.zeros(9, 3)))
    return path


def _linked(capture: Path) -> Path:
    (capture / "cloud.ply").symlink_to(_cloud_elsewhere(capture))
    return capture / "cloud.ply"


def _text_inside(capture: Path) -> Path:
    (capture / "cloud.ply").write_bytes(b"ply\nformat ascii 1.0\n" + SECRET + b"\nend_header\n")
    return capture / "cloud.ply"


CLOUDS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a secret by its absolute name": (_secret, "outside of the capture"),
    "a cloud elsewhere": (_cloud_elsewhere, "outside of the capture"),
    "a link to it": (_linked, "outside of the capture"),
    "a text that is none": (_text_inside, "no PLY file by its header"),
}


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("relative", [False, True])
def test_points_from_elsewhere_or_of_another_kind_are_left_out(
    run: Path, tiny_capture: Path, caplog, name: str, relative: bool
):
    make, sentence = CLOUDS[name]
    path = make(tiny_capture)
    told = f"images/../../{tiny_capture.name}/../{path.relative_to(tiny_capture.parent)}" if relative else str(path)
    changed(tiny_capture, lambda meta: meta.update(ply_file_path=told))
    for format in ("nerfstudio", "colmap"):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            folder = export(run, format)
        assert (
            f"left out: ply_file_path names {tiny_capture}" in caplog.text.replace(str(path), str(tiny_capture))
            and sentence in caplog.text
        )
        assert SECRET not in all_bytes(folder)
    points = read_points(run / "export-nerfstudio" / "points3D.ply")  # the run's Gaussians stand in
    assert 0 < len(points) <= 30 and float(points.positions.abs().max()) < 7
    assert complete_command._world_of(tiny_capture).points_path is None


def test_the_captures_own_cloud_is_copied_byte_for_byte(run: Path, tiny_capture: Path):
    cloud = tiny_capture / "cloud.ply"
    write_points(cloud, Points(positions=torch.rand(9, 3), colors=torch.rand(9, 3)))
    changed(tiny_capture, lambda meta: meta.update(ply_file_path="images/../cloud.ply"))
    assert (export(run, "nerfstudio") / "points3D.ply").read_bytes() == cloud.read_bytes()
    world = complete_command._world_of(tiny_capture)
    assert world.points_path is not None and world.points_path.samefile(cloud)


@pytest.mark.parametrize("way", ["absolute", "..", "link", "mask"])
def test_pictures_from_elsewhere_are_left_out_of_what_is_written(tiny_capture: Path, tmp_path: Path, caplog, way: str):
    private = tmp_path / "private"
    private.mkdir()
    first = read_capture(tiny_capture).frames[0]
    moved = (first.mask_path if way == "mask" else first.image_path) or first.image_path
    elsewhere = moved.rename(private / moved.name)
    media.write_image(elsewhere, torch.rand(1 if way == "mask" else 3, *media.image_size(elsewhere)))  # like no other
    key = "mask_path" if way == "mask" else "file_path"
    if way == "link":
        moved.symlink_to(elsewhere)
    else:
        told = str(elsewhere) if way == "absolute" else f"../{elsewhere.relative_to(tiny_capture.parent)}"
        changed(tiny_capture, lambda meta: meta["frames"][0].update({key: told}))
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    with caplog.at_level(logging.WARNING):
        folder = export(run, "nerfstudio")
        photos = read_photos(tiny_capture)
    assert "left out: 1 of 6 pictures" in caplog.text and "outside of the capture" in caplog.text
    assert sum(not frame.generated for frame in read_capture(folder).frames) == 5 == len(photos)
    assert elsewhere.read_bytes() not in [path.read_bytes() for path in folder.rglob("*") if path.is_file()]


def test_a_capture_of_nothing_but_files_from_elsewhere_is_refused(tiny_capture: Path, tmp_path: Path, capsys):
    (tiny_capture / "images").rename(tmp_path / "elsewhere")
    (tiny_capture / "images").symlink_to(tmp_path / "elsewhere")
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    told = refusal(capsys, run, "--format", "nerfstudio")
    assert "none of its pictures lies in its folder" in told and not (run / "export-nerfstudio").exists()


def test_a_capture_behind_a_link_is_itself_no_stranger(tiny_capture: Path, tmp_path: Path):
    (tmp_path / "link").symlink_to(tiny_capture)
    run = make_run(tmp_path / "run", tmp_path / "link", generated_views())
    assert sum(not frame.generated for frame in read_capture(export(run, "nerfstudio")).frames) == 6


def test_what_is_no_picture_is_not_copied(run: Path, tiny_capture: Path, capsys):
    read_capture(tiny_capture).frames[2].image_path.write_bytes(SECRET)
    told = refusal(capsys, run, "--format", "nerfstudio")
    assert "not readable as an image" in told and not (run / "export-nerfstudio").exists()


def test_other_files_that_frames_name_are_never_copied(run: Path, tiny_capture: Path):
    secret = _secret(tiny_capture)
    changed(
        tiny_capture,
        lambda meta: [frame.update(depth_file_path=str(secret), note_path="../secret") for frame in meta["frames"]],
    )
    for format in ("nerfstudio", "colmap"):
        assert SECRET not in all_bytes(export(run, format))
    assert "depth_file_path" not in (run / "export-nerfstudio" / "transforms.json").read_text()


@pytest.mark.parametrize("role", ["../../../outside", "/outside", "a/b", "", "a" * 300, "a\nb"])
def test_names_in_a_run_lead_nowhere(tiny_capture: Path, tmp_path: Path, capsys, role: str):
    """Generated pictures are named after what a checkpoint says of them."""
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    (path,) = (run / "nerfstudio_models").iterdir()
    state = torch.load(path, weights_only=True)
    state["pipeline"]["datamanager._extra_state"]["views"]["origins"][0]["role"] = role
    torch.save(state, path)
    before = sorted(tmp_path.rglob("*"))
    assert "expected a role of letters" in refusal(capsys, run, "--format", "nerfstudio")
    assert sorted(tmp_path.rglob("*")) == before
    with pytest.raises(ValueError, match="expected a role of letters"):
        CompletedViews.from_state(state["pipeline"]["datamanager._extra_state"]["views"])


def test_headers_of_ply_files(tmp_path: Path):
    good = (
        b"ply\r\nformat ascii 1.0\r\ncomment made by hand\r\nelement vertex 1\r\nproperty float "
        b"x\r\nend_header\r\n0\r\n"
    )
    whole = {
        b"": False,
        b"ply": False,
        SECRET: False,
        good: True,
        good[:-20]: False,
        b"x" + good: False,
        b"version https://git-lfs": False,
    }
    for content, wanted in whole.items():
        (tmp_path / "a.ply").write_bytes(content)
        assert is_ply(tmp_path / "a.ply") is wanted, content
    assert not is_ply(tmp_path) and not is_ply(tmp_path / "none.ply")
    assert lies_inside(tmp_path / "b" / ".." / "a", tmp_path) and not lies_inside(tmp_path / "..", tmp_path)


def test_the_frame_lists_of_an_export_name_its_own_files(run: Path, tiny_capture: Path):
    meta = json.loads((export(run, "nerfstudio") / "transforms.json").read_text())
    named = [frame[key] for frame in meta["frames"] for key in ("file_path", "mask_path") if key in frame]
    assert named and all(not Path(name).is_absolute() and ".." not in Path(name).parts for name in named)
