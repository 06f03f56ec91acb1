"""Captures as nerfstudio gets them: its own reader's outputs where that reads rightly, and what is meant where it does
not.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.plugin.parsed_captures import edited, outputs, without
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio

from fb_core.data.capture.captures import read_capture, validate_capture
from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d


def at_the_top(meta: dict[str, Any]) -> None:
    """The lens at the top instead of in every frame."""
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        meta[key] = next(iter([frame.pop(key) for frame in meta["frames"]]))


SAME: dict[str, Callable[[dict[str, Any]], Any]] = {
    "as it is": lambda meta: None,
    "one lens at the top": at_the_top,
    "lens that bends": lambda meta: meta.update(k1=-0.1, k2=0.02, p1=0.001),
    "fisheye": lambda meta: meta.update(k1=0.05, k2=0.01, camera_model="OPENCV_FISHEYE", fisheye_crop_radius=9.0),
    "no orientation": lambda meta: meta.update(orientation_override="none"),
    "principal axes": lambda meta: meta.update(orientation_override="vertical"),
    "applied transform": lambda meta: meta.update(applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0.5]]),
    "frames in another order": lambda meta: meta["frames"].reverse(),
}


@pytest.mark.parametrize("name", SAME)
@pytest.mark.parametrize(
    "options", [{}, {"eval_mode": "interval", "eval_interval": 3}, {"auto_scale_poses": False, "scale_factor": 2.0}]
)
def test_what_nerfstudio_reads_rightly_is_the_same_to_the_bit(tiny_capture: Path, name: str, options: dict) -> None:
    edited(tiny_capture, SAME[name])
    for split in ("train", "val", "test"):
        stock, ours = (
            outputs(tiny_capture, split, reader, **options) for reader in (Nerfstudio, NerfstudioWithoutOpen3d)
        )
        assert ours.image_filenames == stock.image_filenames and ours.mask_filenames == stock.mask_filenames
        for field in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height", "camera_type"):
            assert torch.equal(getattr(ours.cameras, field), getattr(stock.cameras, field)), field
        bends = stock.cameras.distortion_params
        assert torch.equal(ours.cameras.distortion_params, bends.expand_as(ours.cameras.distortion_params))
        assert torch.allclose(ours.dataparser_transform, stock.dataparser_transform, atol=1e-7)
        assert ours.dataparser_scale == stock.dataparser_scale and torch.equal(
            ours.scene_box.aabb, stock.scene_box.aabb
        )
        assert ours.cameras.metadata == stock.cameras.metadata


def kept(folder: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    """The change leaves poses and lenses as they were."""
    before = outputs(folder)
    after = outputs(edited(folder, change))
    validate_capture(folder)
    for field in ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height"):
        assert torch.allclose(getattr(after.cameras, field), getattr(before.cameras, field), rtol=1e-6), field


def as_angle(meta: dict[str, Any]) -> None:
    width, focal = (meta.get(key, meta["frames"][0].get(key)) for key in ("w", "fl_x"))
    without("fl_x", "fl_y", "cx", "cy", "w", "h")(meta)
    meta["camera_angle_x"] = 2 * math.atan(width / 2 / focal)


def single_precision_rows(meta: dict[str, Any]) -> None:
    for frame in meta["frames"]:
        frame["transform_matrix"][3] = [0.0, 0.0, 0.0, 0.99999994]


def three_rows(meta: dict[str, Any]) -> None:
    for frame in meta["frames"]:
        frame["transform_matrix"] = frame["transform_matrix"][:3]


def without_suffixes(meta: dict[str, Any]) -> None:
    for frame in meta["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")


def depth_in_some(meta: dict[str, Any]) -> None:
    meta["frames"][0]["depth_file_path"] = "depth/0.png"


def middle(meta: dict[str, Any]) -> None:
    for frame in meta["frames"]:
        frame.update(cx=frame["w"] / 2, cy=frame["h"] / 2, fl_y=frame["fl_x"])


@pytest.mark.parametrize(
    "change",
    [
        without("w", "h"),
        without("cx", "cy"),
        without("fl_y"),
        as_angle,
        single_precision_rows,
        three_rows,
        without_suffixes,
        depth_in_some,
    ],
)
def test_dialects_of_other_tools_mean_the_same(tiny_capture: Path, change: Callable) -> None:
    edited(tiny_capture, middle)
    kept(tiny_capture, change)


def test_a_byte_order_mark_is_none_of_anybodys_business(tiny_capture: Path) -> None:
    before = outputs(tiny_capture).cameras.camera_to_worlds
    path = tiny_capture / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert torch.equal(outputs(tiny_capture).cameras.camera_to_worlds, before)


@pytest.mark.parametrize("angle", [0.0, -1.0, math.pi, 4.0])
def test_an_impossible_angle_is_one_sentence(tiny_capture: Path, angle: float) -> None:
    edited(tiny_capture, as_angle)
    edited(tiny_capture, lambda meta: meta.update(camera_angle_x=angle))
    with pytest.raises(ValueError, match="camera_angle_x between 0 and pi radians"):
        read_capture(tiny_capture)


def test_a_geo_referenced_capture_keeps_its_shape_and_is_scaled_like_any_other(tiny_capture: Path) -> None:
    """UTM: some metres wide, five thousand kilometres off the origin."""
    before = outputs(tiny_capture, load_3D_points=True)
    far = np.array([5.2e5, 4.6e6, 310.0])

    def moved(meta: dict[str, Any]) -> None:
        for frame in meta["frames"]:
            for axis in range(3):
                frame["transform_matrix"][axis][3] += far[axis]
        meta.pop("ply_file_path", None)

    after = outputs(edited(tiny_capture, moved))
    assert torch.allclose(after.cameras.camera_to_worlds, before.cameras.camera_to_worlds, atol=1e-5)
    assert after.dataparser_scale == pytest.approx(before.dataparser_scale, rel=1e-5)
    assert float(after.cameras.camera_to_worlds[:, :, 3].abs().max()) <= 1.0
    capture = read_capture(tiny_capture)
    place = {frame.image_path: frame.camera.centers[0] for frame in capture.frames}
    theirs = torch.stack([place[path] for path in after.image_filenames])
    there = (theirs @ after.dataparser_transform[:, :3].T + after.dataparser_transform[:, 3]) * after.dataparser_scale
    assert torch.allclose(there, after.cameras.camera_to_worlds[:, :, 3].double(), atol=1e-5), (
        "the way back is exact, too"
    )


def test_applied_scale_moves_cameras_and_points_alike(tiny_capture: Path) -> None:
    """The key says what an earlier tool has done; nobody does it again."""
    before = outputs(tiny_capture, load_3D_points=True)
    after = outputs(edited(tiny_capture, lambda meta: meta.update(applied_scale=0.25)), load_3D_points=True)
    assert torch.equal(after.metadata["points3D_xyz"], before.metadata["points3D_xyz"])
    assert torch.equal(after.cameras.camera_to_worlds, before.cameras.camera_to_worlds)
    assert after.dataparser_scale == pytest.approx(before.dataparser_scale * 0.25)


def test_a_fisheye_lens_is_one_wherever_it_is_said(tiny_capture: Path) -> None:
    for change in (
        lambda meta: meta.update(camera_model="OPENCV_FISHEYE", k1=0.0, k2=0.0),
        lambda meta: (meta.pop("camera_model"), meta.update(is_fisheye=True)),
        lambda meta: (
            meta.pop("is_fisheye"),
            [frame.update(camera_model="OPENCV_FISHEYE") for frame in meta["frames"]],
        ),
    ):
        cameras = outputs(edited(tiny_capture, change)).cameras
        assert bool((cameras.camera_type == CameraType.FISHEYE.value).all())
        assert bool((cameras.distortion_params != 0).any(dim=-1).all()), "nerfstudio takes all zeros for a pinhole"
        frame = read_capture(tiny_capture).frames[0]
        _, _, straight = frame.load_undistorted()
        assert float(straight.focal[0, 0]) != float(frame.camera.focal[0, 0])


def test_listed_coefficients_are_those_of_the_named_keys(tiny_capture: Path) -> None:
    edited(tiny_capture, lambda meta: meta.update(distortion_params=[-0.1, 0.02, 0.0, 0.0, 0.001, 0.002]))
    assert read_capture(tiny_capture).frames[0].distortion == {
        "k1": -0.1,
        "k2": 0.02,
        "k3": 0.0,
        "k4": 0.0,
        "p1": 0.001,
        "p2": 0.002,
    }
    assert torch.allclose(
        outputs(tiny_capture).cameras.distortion_params[0], torch.tensor([-0.1, 0.02, 0.0, 0.0, 0.001, 0.002])
    )
    edited(tiny_capture, lambda meta: meta.update(distortion_params=[1, 2]))
    with pytest.raises(ValueError, match="distortion_params as six numbers"):
        read_capture(tiny_capture)


def test_incomplete_split_lists_are_completed_and_foreign_names_are_left_out(tiny_capture: Path, caplog) -> None:
    names = [frame["file_path"] for frame in json.loads((tiny_capture / "transforms.json").read_text())["frames"]]
    lists = {"train_filenames": [*names[:-2], "images/gone.png"], "test_filenames": names[-2:]}
    edited(tiny_capture, lambda meta: (without("val_filenames")(meta), meta.update(lists)))
    found = {
        split: [path.name for path in outputs(tiny_capture, split).image_filenames]
        for split in ("train", "val", "test")
    }
    assert sorted(found["train"]) == sorted(Path(name).name for name in names[:-2]) and found["val"] == found["test"]
    assert "gone.png, which no frame is" in caplog.text
    edited(tiny_capture, without("train_filenames"))
    assert len(outputs(tiny_capture).image_filenames) == len(names) - 2


def test_frames_marked_as_bad_are_left_out(tiny_capture: Path) -> None:
    edited(tiny_capture, lambda meta: meta["frames"][1].update(is_bad=True))
    assert len(outputs(tiny_capture, eval_mode="all").image_filenames) == len(read_capture(tiny_capture).photos) == 5


def test_frames_marked_as_bad_decide_nothing_of_the_world(tiny_capture: Path) -> None:
    """A scan's software marks frames whose pose it has lost; that pose may lie anywhere."""
    edited(tiny_capture, lambda meta: meta["frames"][1].update(is_bad=True))
    before = outputs(tiny_capture, eval_mode="all")

    def lost(meta: dict) -> None:
        for row in meta["frames"][1]["transform_matrix"][:3]:
            row[3] = 4e4

    edited(tiny_capture, lost)
    after = outputs(tiny_capture, eval_mode="all")
    assert torch.equal(after.cameras.camera_to_worlds, before.cameras.camera_to_worlds)
    assert float(after.cameras.camera_to_worlds[:, :, 3].abs().max()) == pytest.approx(1, abs=1e-5)


def test_points_that_are_not_finite_are_left_out(tiny_capture: Path) -> None:
    capture = read_capture(tiny_capture)
    assert capture.points_path is not None
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    capture.points_path.write_text(header + "0 0 1\nnan 0 1\n1 1 1\n")
    assert len(outputs(tiny_capture, load_3D_points=True).metadata["points3D_xyz"]) == 2
    capture.points_path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n")
    with pytest.raises(ValueError, match="Git LFS keeps"):
        validate_capture(tiny_capture)


def test_an_unknown_orientation_is_one_sentence(tiny_capture: Path) -> None:
    edited(tiny_capture, lambda meta: meta.update(orientation_override="upwards"))
    with pytest.raises(ValueError, match="orientation_override as one of"):
        validate_capture(tiny_capture)


def test_a_lens_that_no_pinhole_camera_can_replace_is_one_sentence(tiny_capture: Path) -> None:
    for lens in ({"k1": -44.85}, {"k1": -44.85, "k2": 1017.4, "p1": 0.62, "p2": 0.94}):
        edited(tiny_capture, lambda meta, lens=lens: meta.update(lens))
        with pytest.raises(ValueError, match="cannot be undistorted"):
            validate_capture(tiny_capture)
