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
from helpers.scenes.random_cameras import random_cameras
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from fb_core.data import media
from fb_core.data.capture.captures import (
    FrameToWrite,
    Points,
    read_capture,
    validate_capture,
    write_capture,
    write_transforms,
)
from fb_core.data.capture.frames import Capture
from fb_core.data.capture.transforms_json import camera_entry, camera_from
from fb_core.files.ownership import MARK_NAME


def edited(folder: Path, change) -> Path:
    """The capture after ``change(meta)``; a returned value replaces the whole JSON object."""
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    result = change(meta)
    path.write_text(json.dumps(meta if result is None else result))
    return folder


def frame_edit(**values):
    """A change of the third frame; None removes the key."""

    def change(meta: dict) -> None:
        for key, value in values.items():
            meta["frames"][2].pop(key, None)
            if value is not None:
                meta["frames"][2][key] = value

    return change


def assert_same(one: Capture, two: Capture) -> None:
    """Bit-equal numbers, the same files, the same extras."""
    assert len(one) == len(two)
    for a, b in zip(one.frames, two.frames, strict=True):
        for name in ("camera_to_world", "focal", "principal"):
            assert getattr(b.camera, name).dtype == torch.float64
            assert torch.equal(getattr(a.camera, name), getattr(b.camera, name))
        assert (a.camera.width, a.camera.height, a.distortion, a.camera_model) == (
            b.camera.width,
            b.camera.height,
            b.distortion,
            b.camera_model,
        )
        assert a.image_path.resolve() == b.image_path.resolve()
        assert (a.mask_path and a.mask_path.resolve()) == (b.mask_path and b.mask_path.resolve())
        assert a.extra == b.extra
    assert one.extra == two.extra
    assert (one.points_path and one.points_path.resolve()) == (two.points_path and two.points_path.resolve())


def one_frame(name: str = "a", **changes) -> FrameToWrite:
    camera = random_cameras(1, count=1, width=16, height=12)
    return dataclasses.replace(FrameToWrite(name=name, image=torch.rand(3, 12, 16), camera=camera), **changes)


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


# ---- orientation ----------------------------------------------------------------------------------------------------


def save_lying(path: Path, upright: np.ndarray) -> None:
    """Stored as a phone does in portrait: turned by a quarter, with the tag that says so."""
    tags = Image.Exif()
    tags[0x0112] = 6
    Image.fromarray(np.rot90(upright)).save(path, exif=tags)


def test_a_picture_lying_on_its_side_is_turned_when_only_that_fits(tiny_capture: Path) -> None:
    frame = read_capture(tiny_capture).frames[0]
    expected = frame.load_image()
    save_lying(frame.image_path, (expected * 255).round().byte().permute(1, 2, 0).numpy())
    assert media.image_size(frame.image_path, apply_orientation=False) == (48, 32)
    assert torch.equal(frame.load_image(), expected)
    with pytest.raises(ValueError, match="EXIF orientation"):
        validate_capture(tiny_capture)


def test_posed_pictures_are_counted_in_stored_pixels(tmp_path: Path) -> None:
    """nerfstudio and COLMAP ignore the tag: where the stored size fits the camera, the tag is ignored here too."""
    capture = write_capture(tmp_path / "capture", [one_frame()])
    frame = capture.frames[0]
    stored = (frame.load_image() * 255).round().byte().permute(1, 2, 0).numpy()
    for tag in (3, 6):
        tags = Image.Exif()
        tags[0x0112] = tag
        Image.fromarray(stored).save(frame.image_path, exif=tags)
        assert torch.equal(frame.load_image(), torch.from_numpy(stored).permute(2, 0, 1) / 255)
        validate_capture(tmp_path / "capture")


# ---- lenses ---------------------------------------------------------------------------------------------------------


def bent_frame(folder: Path, camera_model: str, distortion: dict[str, float], *, mask: np.ndarray | None = None):
    """A capture whose picture is a ramp in stored pixels: red = x / width, green = y / height (16 bit)."""
    height, width = 90, 160
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width, indexing="ij")
    media.write_image(folder / "a.png", torch.stack([x, y, torch.zeros_like(x)]), bits=16)
    pose = torch.eye(4).tolist()
    frame = {
        "file_path": "a.png",
        "transform_matrix": pose,
        "fl_x": 110.0,
        "fl_y": 120.0,
        "cx": 83.0,
        "cy": 41.0,
        "w": width,
        "h": height,
    }
    if mask is not None:
        Image.fromarray(mask).save(folder / "m.png")
        frame["mask_path"] = "m.png"
    (folder / "transforms.json").write_text(
        json.dumps({"camera_model": camera_model, "frames": [{**frame, **distortion}]})
    )
    return validate_capture(folder).frames[0]


def brown(
    x: torch.Tensor, y: torch.Tensor, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0
) -> tuple[torch.Tensor, torch.Tensor]:
    """The radial and tangential model on the plane z = 1, written from its definition."""
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def equidistant(x: torch.Tensor, y: torch.Tensor, k1=0.0, k2=0.0, k3=0.0, k4=0.0) -> tuple[torch.Tensor, torch.Tensor]:
    radius = (x * x + y * y).sqrt()
    angle = radius.atan()
    bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    return x * bent / radius, y * bent / radius


@pytest.mark.parametrize(
    ("camera_model", "distortion"),
    [
        ("OPENCV", {"k1": -0.12, "k2": 0.03, "p1": 0.004, "p2": -0.003}),
        ("OPENCV", {"k1": 0.06, "k2": -0.08, "k3": 0.01}),
        ("SIMPLE_RADIAL", {"k1": -0.1}),
        ("OPENCV_FISHEYE", {"k1": -0.02, "k2": 0.004, "k3": 0.001, "k4": -0.001}),
    ],
)
def test_undistortion_follows_the_lens_model(tmp_path: Path, camera_model: str, distortion: dict[str, float]) -> None:
    """Each straight pixel's ray, bent by the model's definition, must lead to the place in the stored ramp that it
    shows.
    """
    frame = bent_frame(tmp_path, camera_model, distortion)
    image, mask, camera = frame.load_undistorted()
    assert image.shape == (3, 90, 160) and (camera.width, camera.height) == (160, 90)
    assert torch.equal(camera.camera_to_world, frame.camera.camera_to_world) and camera.focal.dtype == torch.float64
    plane = (camera.pixel_centers() - camera.principal) / camera.focal
    x, y = (equidistant if camera_model == "OPENCV_FISHEYE" else brown)(plane[..., 0], plane[..., 1], **distortion)
    expected_x = x * 110.0 + 83.0
    expected_y = y * 120.0 + 41.0
    known = mask[0] > 0
    assert known.double().mean() > 0.97, "hardly anything of the straight picture lies outside the bent one"
    assert (image[0] * 160 - expected_x)[known].abs().max() < 0.03, (
        "within a thirtieth of a pixel (OpenCV's table of weights)"
    )
    assert (image[1] * 90 - expected_y)[known].abs().max() < 0.03
    outside = (expected_x < 0) | (expected_x > 160) | (expected_y < 0) | (expected_y > 90)
    assert not (outside & known).any()


def test_unknown_pixels_do_not_leak_through_undistortion(tmp_path: Path) -> None:
    mask = np.full((90, 160), 255, dtype=np.uint8)
    mask[30:60, 50:100] = 0
    frame = bent_frame(tmp_path, "OPENCV", {"k1": -0.12}, mask=mask)
    _, known, camera = frame.load_undistorted()
    assert set(known.unique().tolist()) == {0.0, 1.0}
    plane = (camera.pixel_centers() - camera.principal) / camera.focal
    x, y = brown(plane[..., 0], plane[..., 1], k1=-0.12)
    x, y = x * 110.0 + 83.0, y * 120.0 + 41.0
    near = (x > 49.6) & (x < 100.4) & (y > 29.6) & (y < 60.4)
    assert not (near & (known[0] > 0)).any(), "a pixel that blends an unknown one is unknown"
    assert (known[0][(x > 102) & (x < 158) & (y > 2) & (y < 88)] == 1).all()


def test_no_distortion_is_left_alone(tiny_capture: Path) -> None:
    frame = read_capture(tiny_capture).frames[1]
    image, mask, camera = dataclasses.replace(frame, distortion={"k1": 0.0}).load_undistorted()
    assert torch.equal(image, frame.load_image()) and torch.equal(mask, frame.load_mask())
    assert camera is frame.camera


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model 'EQUIRECTANGULAR' is not supported"),
        ({"camera_model": "FISHEYE624", "distortion_params": [0.1] * 12}, "camera_model 'FISHEYE624' is not supported"),
        ({"camera_model": "OPENCV", "k1": 0.1, "k4": 0.1}, "OPENCV with k4 = 0.1"),
    ],
)
def test_unsupported_lenses_are_refused(tiny_capture: Path, changes: dict, sentence: str) -> None:
    edited(tiny_capture, lambda meta: meta.update(changes))
    capture = read_capture(tiny_capture)  # reading and writing them is fine
    assert_same(capture, read_capture(write_transforms(capture, tiny_capture, overwrite=True)))
    for action in (lambda: validate_capture(tiny_capture), capture.frames[0].load_undistorted):
        with pytest.raises(ValueError, match=sentence):
            action()


# ---- bad captures ---------------------------------------------------------------------------------------------------

EYE = np.eye(4).tolist()


def pose(**entries: float) -> list[list[float]]:
    """The identity with entries replaced, e.g. r00=2."""
    matrix = [row[:] for row in EYE]
    for key, value in entries.items():
        matrix[int(key[1])][int(key[2])] = value
    return matrix


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda meta: [], "expected a JSON object"),
        (lambda meta: {}, "at least one camera, got no frames"),
        (lambda meta: meta.update(frames=[]), "at least one camera, got no frames"),
        (lambda meta: meta.update(frames={"a": 1}), "got frames of type dict"),
        (lambda meta: meta.update(frames=["a"]), "expected an object with a 'file_path'"),
        (lambda meta: meta.update(ply_file_path=7), "file name for ply_file_path"),
        (frame_edit(file_path=None), "expected an object with a 'file_path'"),
        (frame_edit(mask_path=4), "file name for mask_path"),
        (frame_edit(transform_matrix=None), "expected transform_matrix as 4 x 4"),
        (frame_edit(transform_matrix=[[1, 2], [3, 4]]), "expected transform_matrix as 4 x 4"),
        (frame_edit(transform_matrix=[[1, 2], [3]]), "expected transform_matrix as 4 x 4"),
        (frame_edit(transform_matrix=[["a"] * 4] * 4), "expected transform_matrix as 4 x 4"),
        (frame_edit(transform_matrix=pose(r03=math.nan)), "holds NaN or infinity"),
        (frame_edit(transform_matrix=pose(r11=math.inf)), "holds NaN or infinity"),
        (frame_edit(transform_matrix=pose(r22=0.0)), "is singular"),
        (frame_edit(transform_matrix=pose(r22=-1.0)), "is mirrored"),
        (frame_edit(transform_matrix=pose(r00=2.0, r11=2.0, r22=2.0)), "is scaled or sheared"),
        (frame_edit(transform_matrix=pose(r01=0.01)), "is scaled or sheared"),
        (frame_edit(transform_matrix=pose(r32=1.0)), "last row"),
        (frame_edit(fl_x=None), "intrinsics are missing, expected fl_x"),
        (frame_edit(fl_x="wide"), "finite number for fl_x, got 'wide'"),
        (frame_edit(fl_y=math.nan), "finite number for fl_y"),
        (frame_edit(fl_x=0.0), "focal lengths above 0"),
        (frame_edit(fl_y=-5.0), "focal lengths above 0"),
        (frame_edit(fl_y=0.0), "focal lengths above 0"),
        (frame_edit(cx=math.inf), "finite number for cx"),
        (frame_edit(w=0), "whole pixels"),
        (frame_edit(h=32.5), "whole pixels"),
        (frame_edit(k1=True), "finite number for k1"),
    ],
)
def test_bad_json_is_one_sentence(tiny_capture: Path, change, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence) as error:
        read_capture(edited(tiny_capture, change))
    message = str(error.value)
    assert str(tiny_capture) in message and "\n" not in message and len(message) < 400
    with pytest.raises(ValueError, match=sentence):
        validate_capture(tiny_capture)


def test_the_sentence_names_the_frame(tiny_capture: Path) -> None:
    with pytest.raises(ValueError, match=r"frame 2 \(images/view_002\.png\)"):
        read_capture(edited(tiny_capture, frame_edit(fl_x=None)))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "file is empty"),
        (b" \n", "file is empty"),
        (b"{frames:", "not a JSON file"),
        (b"\xff\xfe\x00\x81", "not a JSON file"),
    ],
)
def test_files_that_are_not_json(tiny_capture: Path, content: bytes, sentence: str) -> None:
    (tiny_capture / "transforms.json").write_bytes(content)
    with pytest.raises(ValueError, match=sentence) as error:
        validate_capture(tiny_capture)
    assert "\n" not in str(error.value)


def test_missing_folder_and_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such folder"):
        validate_capture(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"no transforms\.json in this folder"):
        validate_capture(tmp_path)


def damage(kind: str, folder: Path) -> None:
    image, mask = folder / "images" / "view_003.png", folder / "masks" / "view_001.png"
    if kind == "missing image":
        image.unlink()
    elif kind == "empty image":
        image.write_bytes(b"")
    elif kind == "truncated image":
        image.write_bytes(image.read_bytes()[:-40])
    elif kind == "text image":
        image.write_text("not a picture at all, but words")
    elif kind == "another size":
        media.write_image(image, torch.zeros(3, 16, 24))
    elif kind == "missing mask":
        mask.unlink()
    elif kind == "mask of another size":
        media.write_image(mask, torch.ones(1, 32, 47))
    elif kind == "truncated mask":
        mask.write_bytes(mask.read_bytes()[:30])
    elif kind == "missing points":
        (folder / "points3D.ply").unlink()
    elif kind == "some masks":
        edited(folder, frame_edit(mask_path=None))


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("missing image", r"view_003\.png: no such file"),
        ("empty image", r"view_003\.png: the file is empty"),
        ("truncated image", r"view_003\.png: the file is truncated"),
        ("text image", r"view_003\.png: not readable as an image"),
        ("another size", r"view_003\.png: expected 48 x 32 pixels as its camera says, got 24 x 16"),
        ("missing mask", r"view_001\.png: no such file"),
        ("mask of another size", r"mask .*view_001\.png: expected 48 x 32 pixels as its camera says, got 47 x 32"),
        ("truncated mask", r"view_001\.png: the file is truncated"),
        ("missing points", r"points3D\.ply, which is missing"),
        ("some masks", "mask_path in all frames or in none, got 5 of 6"),
    ],
)
def test_validation_finds_bad_files(tiny_capture: Path, kind: str, sentence: str) -> None:
    validate_capture(tiny_capture, decode=True)
    damage(kind, tiny_capture)
    with pytest.raises(ValueError, match=sentence) as error:
        validate_capture(tiny_capture)
    assert "\n" not in str(error.value)
    if "image" in kind or "size" in kind:
        frame = read_capture(tiny_capture).frames[1 if "mask" in kind else 3]
        with pytest.raises(ValueError, match=sentence):
            frame.load_mask()


def test_decoding_finds_damage_inside(tiny_capture: Path) -> None:
    """The header and the end are whole, the middle is not: only ``decode=True`` pays for seeing it."""
    image = tiny_capture / "images" / "view_003.png"
    data = bytearray(image.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 40] = bytes(40)
    image.write_bytes(bytes(data))
    validate_capture(tiny_capture)
    with pytest.raises(ValueError, match=r"view_003\.png: damaged"):
        validate_capture(tiny_capture, decode=True)


# ---- writing --------------------------------------------------------------------------------------------------------


def test_a_full_folder_is_not_touched(tiny_capture: Path) -> None:
    before = sorted(path.name for path in tiny_capture.rglob("*"))
    with pytest.raises(ValueError, match="not empty"):
        write_capture(tiny_capture, [one_frame()])
    assert sorted(path.name for path in tiny_capture.rglob("*")) == before
    assert len(write_capture(tiny_capture, [one_frame()], overwrite=True)) == 1
    names = sorted(path.name for path in tiny_capture.rglob("*"))
    assert names == [MARK_NAME, "a.png", "images", "transforms.json"], "nothing of the old one stays"
    assert [path.name for path in tiny_capture.parent.iterdir()] == [tiny_capture.name], "no temporary folders stay"


def test_overwrite_does_not_sweep_away_other_things(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "diary.txt").write_text("dear")
    with pytest.raises(ValueError, match="holds something else than an earlier capture"):
        write_capture(tmp_path / "home", [one_frame()], overwrite=True)
    with pytest.raises(ValueError, match="not empty"):
        write_capture(tmp_path / "home" / "diary.txt", [one_frame()])
    assert (tmp_path / "home" / "diary.txt").read_text() == "dear"


def test_an_empty_folder_is_fine(tmp_path: Path) -> None:
    (tmp_path / "capture").mkdir()
    assert len(write_capture(tmp_path / "capture", [one_frame()])) == 1


def test_a_failure_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="NaN or infinity"):
        write_capture(tmp_path / "capture", [one_frame("a"), one_frame("b", image=torch.full((3, 12, 16), torch.nan))])
    with pytest.raises(ValueError, match="plain finite JSON values"):
        write_capture(tmp_path / "capture", [one_frame()], extra={"tensor": torch.ones(2)})
    with pytest.raises(ValueError, match="plain finite JSON values"):
        write_capture(tmp_path / "capture", [one_frame(extra={"weight": math.nan})])
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_replacement_keeps_the_old_capture(tiny_capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = read_capture(tiny_capture)
    monkeypatch.setattr(
        "fb_core.data.capture.captures.write_transforms",
        lambda *args, **kwargs: (_ for _ in ()).throw(KeyboardInterrupt),
    )
    with pytest.raises(KeyboardInterrupt):
        write_capture(tiny_capture, [one_frame()], overwrite=True)
    assert_same(original, validate_capture(tiny_capture, decode=True))
    assert [path.name for path in tiny_capture.parent.iterdir()] == [tiny_capture.name]


@pytest.mark.parametrize(
    ("frames", "extra", "sentence"),
    [
        (lambda: [], {}, "at least one frame"),
        (lambda: [one_frame("a"), one_frame("a")], {}, "a file name of its own"),
        (lambda: [one_frame("../a")], {}, "a file name of its own"),
        (lambda: [one_frame("")], {}, "a file name of its own"),
        (lambda: [one_frame(image=torch.zeros(3, 12, 15))], {}, r"\(height, width\) \(12, 16\)"),
        (lambda: [one_frame(mask=torch.zeros(1, 11, 16))], {}, r"\(height, width\) \(12, 16\)"),
        (lambda: [one_frame(camera=random_cameras(count=2, width=16, height=12))], {}, "expected one camera"),
        (lambda: [one_frame(extra={"fl_x": 3})], {}, "extra must not hold"),
        (lambda: [one_frame()], {"frames": []}, "extra must not hold"),
        (
            lambda: [one_frame(camera=dataclasses.replace(one_frame().camera, focal=torch.full((1, 2), torch.nan)))],
            {},
            "finite focal above 0",
        ),
        (
            lambda: [one_frame(camera=dataclasses.replace(one_frame().camera, camera_to_world=torch.zeros(1, 3, 4)))],
            {},
            "singular",
        ),
    ],
)
def test_writing_refuses_nonsense(tmp_path: Path, shapes_unchecked: None, frames, extra: dict, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        write_capture(tmp_path / "capture", frames(), extra=extra)
    assert list(tmp_path.iterdir()) == []


def test_points_refuse_nonsense(shapes_unchecked: None) -> None:
    with pytest.raises(ValueError, match="shape"):
        Points(positions=torch.zeros(4, 3), colors=torch.zeros(5, 3))
    with pytest.raises(ValueError, match="NaN"):
        Points(positions=torch.full((4, 3), torch.nan), colors=torch.zeros(4, 3))


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
