"""Pictures that lie on their sides, and bent lenses: a straight capture with the same rays."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.captures import assert_same, edited, one_frame
from PIL import Image

from fb_core.data import media
from fb_core.data.capture.captures import (
    read_capture,
    validate_capture,
    write_capture,
    write_transforms,
)

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
