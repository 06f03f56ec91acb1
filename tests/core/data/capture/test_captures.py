"""Captures: nothing is lost between disk and memory, nerfstudio reads what we write, and every bad input is one clear
sentence.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import shared_path
from helpers.folders.captures import assert_same, edited, one_frame
from helpers.scenes.random_cameras import random_cameras
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from fb_core.data.capture.captures import (
    FrameToWrite,
    Points,
    read_capture,
    validate_capture,
    write_capture,
    write_transforms,
)
from fb_core.data.capture.transforms_json import camera_entry, camera_from

# ---- axes -----------------------------------------------------------------------------------------------------------


def test_opengl_in_the_file_becomes_opencv(tmp_path: Path) -> None:
    """A camera with the identity matrix looks along -z of the world with y up; ours looks along its third axis with y
    down.
    """
    meta = {
        "fl_x": 10,
        "fl_y": 10,
        "cx": 8,
        "cy": 6,
        "w": 16,
        "h": 12,
        "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    camera = read_capture(tmp_path).frames[0].camera
    pixels, depth = camera.project(
        torch.tensor([[0.0, 0.0, -5.0], [0.0, 1.0, -5.0], [1.0, 0.0, -5.0]], dtype=torch.float64)
    )
    assert depth[0].tolist() == [5, 5, 5]
    assert pixels[0].tolist() == [[8, 6], [8, 4], [10, 6]], "world up is up in the picture, world right is right"


@given(seed=st.integers(0, 1000), exponent=st.integers(-6, 6))
def test_every_bit_of_a_camera_survives_json(seed: int, exponent: int) -> None:
    for camera in (
        random_cameras(seed, count=1, scale=10.0**exponent),
        random_cameras(seed, count=1).to(torch.float32),
    ):
        entry = json.loads(json.dumps(camera_entry(camera)))
        found = camera_from("test", Path("none"), entry, {})
        assert torch.equal(found.camera_to_world, camera.camera_to_world.double())
        assert torch.equal(found.focal, camera.focal.double()) and torch.equal(
            found.principal, camera.principal.double()
        )
        assert (found.width, found.height) == (camera.width, camera.height)


# ---- round trips ----------------------------------------------------------------------------------------------------


def test_reading_and_writing_keeps_everything(tiny_capture: Path, tmp_path: Path) -> None:
    def enrich(meta: dict) -> None:
        meta["applied_transform"] = [[1.0, 0, 0, 0.1], [0, 0, 1.0, 1 / 3], [0, -1.0, 0, 0]]
        meta["orientation_override"] = "none"
        meta["nested"] = {"list": [1, None, "é", 1e-320, 0.1 + 0.2]}
        meta["frames"][2].update(colmap_im_id=7, sharpness=1 / 3, k1=1e-3, k2=-2e-5, p1=0.0)

    capture = read_capture(edited(tiny_capture, enrich))
    assert capture.extra["nested"] == {"list": [1, None, "é", 1e-320, 0.1 + 0.2]}
    assert capture.frames[2].extra == {"colmap_im_id": 7, "sharpness": 1 / 3}
    assert capture.frames[2].distortion == {"k1": 1e-3, "k2": -2e-5, "p1": 0.0} and capture.frames[0].distortion == {}
    again = read_capture(write_transforms(capture, tmp_path / "elsewhere"))
    assert_same(capture, again)
    for one, two in zip(capture.frames, again.frames, strict=True):
        assert torch.equal(one.load_mask(), two.load_mask()) and torch.equal(one.load_image(), two.load_image())
    assert_same(again, read_capture(write_transforms(again, tmp_path / "elsewhere", overwrite=True)))
    with pytest.raises(ValueError, match="exists already"):
        write_transforms(capture, tmp_path / "elsewhere")


def test_shared_intrinsics_are_kept_too(tmp_path: Path) -> None:
    capture = read_capture(shared_path("data/fox"))
    assert_same(capture, read_capture(write_transforms(capture, tmp_path)))


def test_names_of_files_among_the_extras_move_with_the_capture(tiny_capture: Path, tmp_path: Path) -> None:
    def enrich(meta: dict) -> None:
        names = [frame["file_path"] for frame in meta["frames"]]
        meta["train_filenames"], meta["test_filenames"] = names[:4], names[4:]
        for frame in meta["frames"]:
            frame["depth_file_path"] = "depth/" + Path(frame["file_path"]).name

    capture = read_capture(edited(tiny_capture, enrich))
    same = json.loads(write_transforms(capture, tiny_capture, overwrite=True).read_text())
    assert same["train_filenames"] == [f"images/view_{index:03d}.png" for index in range(4)]
    assert same["frames"][0]["depth_file_path"] == "depth/view_000.png"
    moved = json.loads(write_transforms(capture, tmp_path / "a" / "b").read_text())
    assert moved["train_filenames"] == [frame["file_path"] for frame in moved["frames"][:4]]
    for name in (*moved["test_filenames"], moved["frames"][0]["mask_path"], moved["ply_file_path"]):
        assert (tmp_path / "a" / "b" / name).is_file()
    assert (tmp_path / "a" / "b" / moved["frames"][0]["depth_file_path"]).resolve() == (
        tiny_capture / "depth" / "view_000.png"
    ).resolve()


def test_written_pictures_masks_cameras_and_points_come_back(tmp_path: Path) -> None:
    """Sizes differ within the capture; one frame has no mask and gets a white one, as nerfstudio needs all or none."""
    generator = torch.Generator().manual_seed(3)
    frames = []
    for index, (height, width) in enumerate(((12, 16), (20, 9), (12, 16))):
        mask = (torch.rand(1, height, width, generator=generator) > 0.4).float() if index else None
        image = (torch.rand(3, height, width, generator=generator) * 255).round() / 255
        camera = random_cameras(index, count=1, width=width, height=height)
        frames.append(
            FrameToWrite(
                name=f"v.{index}", image=image, mask=mask, camera=camera, extra={"role": "anchor", "round": index}
            )
        )
    points = Points(
        positions=torch.randn(30, 3, generator=generator) * 1e3,
        colors=(torch.rand(30, 3, generator=generator) * 255).round() / 255,
    )
    capture = write_capture(tmp_path / "new" / "capture", frames, points=points, extra={"orientation_override": "none"})
    assert_same(capture, validate_capture(tmp_path / "new" / "capture", decode=True))
    assert capture.extra == {"orientation_override": "none"}
    for given_frame, frame in zip(frames, capture.frames, strict=True):
        assert torch.equal(frame.load_image(), given_frame.image)
        assert torch.equal(
            frame.load_mask(), torch.ones_like(given_frame.image[:1]) if given_frame.mask is None else given_frame.mask
        )
        assert torch.equal(frame.camera.camera_to_world, given_frame.camera.camera_to_world)
        assert frame.extra == given_frame.extra and frame.camera_model == "OPENCV"
    assert capture.sizes == [(12, 16), (20, 9), (12, 16)]
    assert capture.poses.shape == (3, 3, 4)
    with pytest.raises(ValueError, match="share one image size"):
        _ = capture.cameras
    trimesh = pytest.importorskip("trimesh")
    cloud = trimesh.load(capture.points_path)
    assert np.array_equal(np.asarray(cloud.vertices, dtype=np.float32), points.positions.numpy())
    assert np.array_equal(np.asarray(cloud.colors)[:, :3], (points.colors * 255).round().byte().numpy())


def test_no_mask_files_without_masks(tmp_path: Path) -> None:
    capture = write_capture(tmp_path / "capture", [one_frame()])
    assert not (tmp_path / "capture" / "masks").exists()
    assert capture.frames[0].mask_path is None and capture.points_path is None
    assert (capture.frames[0].load_mask() == 1).all()


def test_cameras_of_one_size_are_one_batch(tiny_capture: Path) -> None:
    capture = validate_capture(tiny_capture, decode=True)
    assert len(capture.cameras) == len(capture) == 6
    assert torch.equal(capture.cameras.camera_to_world, capture.poses)
    depth = capture.cameras.project(torch.zeros(1, 3, dtype=torch.float64))[1]
    assert (depth > 0).all(), "the fixture's cameras look at the centre"


def test_a_json_file_instead_of_a_folder(tiny_capture: Path) -> None:
    (tiny_capture / "transforms.json").rename(tiny_capture / "cameras.json")
    assert len(read_capture(tiny_capture / "cameras.json")) == 6
    with pytest.raises(ValueError, match=r"no transforms\.json"):
        read_capture(tiny_capture)


# ---- intrinsics -----------------------------------------------------------------------------------------------------


def test_angle_of_view_instead_of_focal_lengths(tiny_capture: Path) -> None:
    def change(meta: dict) -> None:
        for frame in meta["frames"]:
            for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
                del frame[key]
        meta["camera_angle_x"] = 0.8

    camera = validate_capture(edited(tiny_capture, change)).frames[0].camera
    assert (camera.width, camera.height) == (48, 32), "taken from the picture"
    assert camera.focal.tolist() == [[24 / math.tan(0.4)] * 2]
    assert camera.principal.tolist() == [[24, 16]]


def test_intrinsics_at_the_top_win_as_in_nerfstudio(tiny_capture: Path) -> None:
    def change(meta: dict) -> None:
        meta.update(fl_x=100.0, k1=0.1)
        meta["frames"][0]["k2"] = 0.5

    frame = read_capture(edited(tiny_capture, change)).frames[0]
    assert frame.camera.focal[0, 0] == 100 and frame.camera.focal[0, 1] != 100
    assert frame.distortion == {"k1": 0.1}


# ---- masks ----------------------------------------------------------------------------------------------------------


def test_alpha_and_mask_are_both_respected(tiny_capture: Path) -> None:
    frame = read_capture(tiny_capture).frames[1]
    mask = frame.load_mask()
    rgba = np.zeros((32, 48, 4), dtype=np.uint8)
    rgba[..., :3], rgba[:, 24:, 3] = 90, 255
    Image.fromarray(rgba).save(frame.image_path)
    both = frame.load_mask()
    assert (both[..., :24] == 0).all() and torch.equal(both[..., 24:], mask[..., 24:])
    assert torch.allclose(frame.load_image(), torch.tensor(90 / 255)), "transparent pixels keep their colour"
    assert torch.equal(
        dataclasses.replace(frame, mask_path=None).load_mask()[0], torch.from_numpy(rgba[..., 3] / 255).float()
    )


def test_masks_are_read_as_zero_or_one(tiny_capture: Path) -> None:
    frame = read_capture(tiny_capture).frames[1]
    grey = np.tile(np.array([0, 100, 127, 128, 200, 255], dtype=np.uint8), (32, 8))
    Image.fromarray(grey).save(frame.mask_path)
    assert torch.equal(frame.load_mask()[0, 0, :6], torch.tensor([0.0, 0, 0, 1, 1, 1]))


# ---- real data and nerfstudio ---------------------------------------------------------------------------------------


def test_the_fox(tmp_path: Path) -> None:
    capture = validate_capture(shared_path("data/fox"))
    assert len(capture) == 50 and set(capture.sizes) == {(1920, 1080)}
    frame = capture.frames[0]
    assert frame.distortion == {"k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575}
    image, mask, camera = frame.load_undistorted()
    assert image.shape == (3, 1920, 1080) and 0 <= image.min() and image.max() <= 1
    assert mask.mean() > 0.995
    assert camera.focal[0].tolist() == pytest.approx([1375, 1374], rel=0.05)
    shutil.copytree(shared_path("data/fox/images"), tmp_path / "images", copy_function=shutil.copy)
    (tmp_path / "transforms.json").write_bytes((capture.root / "transforms.json").read_bytes())
    victim = tmp_path / "images" / "0014.jpg"
    victim.chmod(0o644)
    victim.write_bytes(victim.read_bytes()[:200_000])
    with pytest.raises(ValueError, match=r"0014\.jpg: the file is truncated"):
        validate_capture(tmp_path)


def parsed_by_nerfstudio(folder: Path, **options):
    pytest.importorskip("nerfstudio", reason="nerfstudio is not installed")
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    plain = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "eval_mode": "all"}
    return NerfstudioDataParserConfig(data=folder, **plain, **options).setup().get_dataparser_outputs(split="train")


def test_nerfstudio_reads_what_we_write(tiny_capture: Path) -> None:
    """Its own data parser, its own pixels: poses up to float32, intrinsics, masks."""
    from nerfstudio.data.datasets.base_dataset import InputDataset

    outputs = parsed_by_nerfstudio(tiny_capture)
    capture = read_capture(tiny_capture)
    opengl = capture.poses * torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    assert torch.equal(outputs.cameras.camera_to_worlds, opengl.float())
    assert torch.equal(outputs.cameras.fx[:, 0], capture.cameras.focal[:, 0].float())
    assert torch.equal(outputs.cameras.cy[:, 0], capture.cameras.principal[:, 1].float())
    assert outputs.cameras.width.unique().tolist() == [48] and outputs.cameras.height.unique().tolist() == [32]
    dataset = InputDataset(outputs)
    for index, frame in enumerate(capture.frames):
        data = dataset.get_data(index, image_type="float32")
        assert torch.allclose(data["image"].permute(2, 0, 1), frame.load_image(), atol=1e-7)
        assert torch.equal(data["mask"].permute(2, 0, 1).float(), frame.load_mask())


def test_nerfstudio_reads_our_points(tiny_capture: Path) -> None:
    pytest.importorskip("open3d", reason="open3d needs the system library libusb-1.0", exc_type=ImportError)
    metadata = parsed_by_nerfstudio(tiny_capture, load_3D_points=True).metadata
    generator = torch.Generator().manual_seed(0)
    assert torch.equal(metadata["points3D_xyz"], torch.randn(50, 3, generator=generator))
    colors = (torch.rand(50, 3, generator=generator) * 255).round()
    assert (metadata["points3D_rgb"].float() - colors).abs().max() <= 1, "nerfstudio truncates"
