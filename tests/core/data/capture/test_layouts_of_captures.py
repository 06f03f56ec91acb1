"""Captures of Blender, captures of which only smaller pictures lie there, and where captures are looked for."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.colmap_files import colmap_capture
from helpers.folders.parsed import files_of, outputs
from PIL import Image

from fb_core.data.capture.captures import read_capture, validate_capture
from fb_core.data.capture.frames import Capture
from fb_core.data.capture.layouts import layouts_below
from fb_core.data.photos.collection import read_photos
from fb_nerfstudio.capture.pictures import CapturePictures

# ---- Blender ---------------------------------------------------------------------------------------------------------


def blender_capture(folder: Path, capture: Capture) -> Path:
    """Blender's layout: a file for each split, names without suffixes, one angle for all, transparent pixels."""
    per = {"train": capture.frames[:3], "val": capture.frames[3:4], "test": capture.frames[4:]}
    for split, frames in per.items():
        (folder / split).mkdir(parents=True)
        entries = []
        for index, frame in enumerate(frames):
            pixels = np.array(Image.open(frame.image_path).convert("RGB"))
            alpha = np.full((*pixels.shape[:2], 1), 255, dtype=np.uint8)
            alpha[:4] = 0
            Image.fromarray(np.concatenate([pixels, alpha], axis=2)).save(folder / split / f"r_{index}.png")
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3] = frame.camera.camera_to_world[0] * torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
            entries.append({"file_path": f"./{split}/r_{index}", "rotation": 0.012, "transform_matrix": pose.tolist()})
        angle = 2 * np.arctan(frames[0].camera.width / 2 / float(frames[0].camera.focal[0, 0]))
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": entries}))
    return folder


def test_blenders_splits_are_one_capture(tiny_capture: Path, tmp_path: Path) -> None:
    theirs = read_capture(tiny_capture)
    folder = blender_capture(tmp_path / "lego", theirs)
    before = files_of(folder)
    capture = validate_capture(folder, decode=True)
    assert torch.allclose(capture.poses, theirs.poses) and torch.allclose(
        capture.cameras.focal[:, 0], theirs.cameras.focal[:, 0]
    )
    counts = {split: len(outputs(folder, split).image_filenames) for split in ("train", "val", "test")}
    assert counts == {"train": 3, "val": 1, "test": 2}
    picture = CapturePictures(outputs(folder), 1.0).get_data(0, "uint8")["image"]
    assert picture.shape[-1] == 4 and not bool(picture[:4, :, 3].any()) and bool((picture[4:, :, 3] == 255).all())
    photos = read_photos(folder)
    assert len(photos) == 6 and not bool(photos[0].load_mask()[:, :4].any())
    assert files_of(folder) == before
    (folder / "transforms_val.json").unlink()
    assert len(outputs(folder, "val").image_filenames) == 2, "test stands in for val"


# ---- smaller pictures alone ------------------------------------------------------------------------------------------


def only_small(folder: Path, factor: int, masks: bool = True) -> Path:
    """DL3DV: transforms.json speaks of images/..., and of these only images_4 (or 2, 8) is there."""
    for kind in ("images", *(["masks"] if masks else [])):
        (folder / f"{kind}_{factor}").mkdir()
        for path in (folder / kind).iterdir():
            picture = Image.open(path)
            picture.resize((picture.width // factor, picture.height // factor)).save(
                folder / f"{kind}_{factor}" / path.name
            )
        shutil.rmtree(folder / kind)
    return folder


@pytest.mark.parametrize("asked", [None, 1, 2])
def test_smaller_pictures_alone_are_read_with_or_without_their_factor(tiny_capture: Path, asked: int | None) -> None:
    full = read_capture(tiny_capture)
    large = outputs(tiny_capture).cameras
    only_small(tiny_capture, 2)
    capture = validate_capture(tiny_capture, decode=True)
    assert (
        torch.equal(capture.frames[0].camera.focal, full.frames[0].camera.focal / 2)
        and capture.frames[0].camera.width == 24
    )
    parsed = outputs(tiny_capture, downscale_factor=asked)
    assert all(path.is_file() for path in [*parsed.image_filenames, *(parsed.mask_filenames or [])])
    assert torch.equal(parsed.cameras.fx, large.fx / 2) and torch.equal(
        parsed.cameras.camera_to_worlds, large.camera_to_worlds
    )
    assert CapturePictures(parsed, 1.0).get_data(0, "uint8")["image"].shape == (16, 24, 3)
    assert len(read_photos(tiny_capture)) == 6


def test_still_smaller_copies_beside_the_small_ones(tiny_capture: Path) -> None:
    full = outputs(tiny_capture).cameras
    only_small(tiny_capture, 2)
    (tiny_capture / "images_4").mkdir()
    for path in (tiny_capture / "images_2").iterdir():
        Image.open(path).resize((12, 8)).save(tiny_capture / "images_4" / path.name)
    parsed = outputs(tiny_capture, downscale_factor=4)
    assert torch.equal(parsed.cameras.fx, full.fx / 4) and int(parsed.cameras.width[0]) == 12
    assert parsed.image_filenames[0].parent.name == "images_4"


def test_copies_whose_sides_were_rounded_up_have_cameras_of_their_size(tiny_capture: Path) -> None:
    """Mip-NeRF 360: 4946 pixels become 1237 in images_4, not 1236."""
    (tiny_capture / "images_5").mkdir()
    for path in (tiny_capture / "images").iterdir():
        Image.open(path).resize((10, 7)).save(tiny_capture / "images_5" / path.name)  # 48 x 32
    parsed = outputs(tiny_capture, downscale_factor=5)
    frame = read_capture(tiny_capture).frames[0]
    assert (int(parsed.cameras.width[0]), int(parsed.cameras.height[0])) == (10, 7)
    assert float(parsed.cameras.fx[0]) == pytest.approx(float(frame.camera.focal[0, 0]) * 10 / 48)
    assert CapturePictures(parsed, 1.0).get_data(0, "uint8")["image"].shape == (7, 10, 3)


# ---- where captures lie ----------------------------------------------------------------------------------------------


def test_captures_of_every_layout_are_found_once(tiny_capture: Path, tmp_path: Path) -> None:
    theirs = read_capture(tiny_capture)
    root = tmp_path / "data"
    colmap_capture(root / "mipnerf360/garden", theirs)
    blender_capture(root / "nerf_synthetic/lego", theirs)
    shutil.copytree(tiny_capture, root / "nerfstudio/poster")
    colmap_capture(root / "old", theirs, place="colmap/sparse/0")
    shutil.copytree(root / "old/colmap", root / "nerfstudio/poster/colmap")
    names = [str(path.relative_to(root)) for path in layouts_below(root)]
    assert names == ["mipnerf360/garden", "nerf_synthetic/lego", "nerfstudio/poster", "old"]
    for name in names:
        assert len(read_capture(root / name)) == len(theirs)
