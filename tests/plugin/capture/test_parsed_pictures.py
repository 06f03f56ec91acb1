"""Pictures and masks of a capture as nerfstudio's datasets get them: every dialect means what it says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.plugin.parsed_captures import edited, outputs, without
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image

from fb_core.data.capture.captures import read_capture
from fb_core.geometry.rotations import flip_axes
from fb_nerfstudio.capture.pictures import CapturePictures

# ---- pictures and masks ----------------------------------------------------------------------------------------------


def first_picture(folder: Path, kind: type[InputDataset] = CapturePictures, scale: float = 1.0) -> dict[str, Any]:
    return kind(outputs(folder), scale).get_data(0, "uint8")


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_ordinary_pictures_are_read_as_nerfstudio_reads_them(
    tiny_capture: Path, mode: str, suffix: str, scale: float
) -> None:
    if mode == "RGBA" and suffix == ".jpg":
        pytest.skip("JPEG has no alpha")
    size = Image.open(read_capture(tiny_capture).frames[0].image_path).size
    noise = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 4), dtype=np.uint8)

    def change(meta: dict[str, Any]) -> None:
        for frame in meta["frames"]:
            path = (tiny_capture / frame["file_path"]).with_suffix(suffix)
            Image.fromarray(noise[..., : {"L": 1, "RGB": 3, "RGBA": 4}[mode]].squeeze()).save(path)
            frame["file_path"] = str(path.relative_to(tiny_capture))
        without("train_filenames", "val_filenames", "test_filenames")(meta)

    edited(tiny_capture, change)
    ours, stock = (first_picture(tiny_capture, kind, scale)["image"] for kind in (CapturePictures, InputDataset))
    assert ours.shape == stock.shape and ours.dtype == torch.uint8
    assert int((ours.int() - stock.int()).abs().max()) <= (1 if suffix == ".jpg" else 0)


def save_first(folder: Path, save: Callable[[Path, tuple[int, int]], Path]) -> torch.Tensor:
    """The first training picture of a capture whose pictures are all written by ``save``, [h, w, 3] in [0, 1]."""

    def change(meta: dict[str, Any]) -> None:
        for frame in meta["frames"]:
            path = save(folder / frame["file_path"], Image.open(folder / frame["file_path"]).size)
            frame["file_path"] = str(path.relative_to(folder))
        without("train_filenames", "val_filenames", "test_filenames")(meta)

    edited(folder, change)
    seen = first_picture(folder)["image"][..., :3].float() / 255
    same = read_capture(folder).frames
    loaded = next(frame for frame in same if frame.image_path == outputs(folder).image_filenames[0]).load_image()
    assert torch.allclose(seen, loaded.movedim(0, -1), atol=0.5 / 255 + 1e-6), "training and all else see the same"
    return seen


def test_palettes_16_bits_and_printers_colours_are_the_colours_that_they_mean(tiny_capture: Path) -> None:
    colour = (145, 125, 105)

    def palette(path: Path, size: tuple[int, int]) -> Path:
        Image.new("RGB", size, colour).convert("P", palette=Image.Palette.ADAPTIVE).save(path)
        return path

    def deep(path: Path, size: tuple[int, int]) -> Path:
        Image.fromarray(np.full((size[1], size[0]), 30000, dtype=np.uint16)).save(path)
        return path

    def printed(path: Path, size: tuple[int, int]) -> Path:
        path = path.with_suffix(".jpg")
        Image.new("RGB", size, colour).convert("CMYK").save(path)
        return path

    assert torch.allclose(save_first(tiny_capture, palette), torch.tensor(colour) / 255, atol=2 / 255)
    assert torch.allclose(save_first(tiny_capture, deep), torch.tensor(30000 / 65535), atol=1 / 255)
    assert torch.allclose(save_first(tiny_capture, printed), torch.tensor(colour) / 255, atol=6 / 255)


MASKS: dict[str, Callable[[np.ndarray], Image.Image]] = {
    "black and white": lambda known: Image.fromarray(known * np.uint8(255)),
    "0 and 1": lambda known: Image.fromarray(known.astype(np.uint8)),
    "grey 100 for dark": lambda known: Image.fromarray(np.where(known, 255, 100).astype(np.uint8)),
    "in colour": lambda known: Image.fromarray(known * np.uint8(255)).convert("RGB"),
    "palette": lambda known: Image.fromarray(known * np.uint8(255)).convert("P", palette=Image.Palette.ADAPTIVE),
    "16 bits": lambda known: Image.fromarray((known * 65535).astype(np.uint16)),
    "jpeg": lambda known: Image.fromarray(known * np.uint8(255)),
}


@pytest.mark.parametrize("name", MASKS)
def test_masks_mean_lighter_than_half_everywhere(tiny_capture: Path, name: str) -> None:
    capture = read_capture(tiny_capture)
    known = np.ones((capture.frames[0].camera.height, capture.frames[0].camera.width), dtype=bool)
    known[8:24, 8:24] = False

    def change(meta: dict[str, Any]) -> None:
        for index, frame in enumerate(meta["frames"]):
            path = tiny_capture / "masks" / f"mask_{index}{'.jpg' if name == 'jpeg' else '.png'}"
            path.parent.mkdir(exist_ok=True)
            MASKS[name](known).save(path)
            frame["mask_path"] = str(path.relative_to(tiny_capture))

    edited(tiny_capture, change)
    frame = read_capture(tiny_capture).frames[0]
    trained = first_picture(tiny_capture)["mask"][..., 0].numpy()
    wrong = 0 if name != "jpeg" else 8
    assert int((trained != known).sum()) <= wrong and int((frame.load_mask()[0].numpy() != known).sum()) <= wrong
    assert np.array_equal(trained, frame.load_mask()[0].numpy() > 0)


def test_masks_of_full_size_go_with_smaller_copies_of_the_pictures(tiny_capture: Path) -> None:
    capture = read_capture(tiny_capture)
    height, width = capture.frames[0].camera.height, capture.frames[0].camera.width
    known = np.zeros((height, width), dtype=bool)
    known[: height // 2] = True

    def change(meta: dict[str, Any]) -> None:
        for frame in meta["frames"]:
            path = tiny_capture / frame["file_path"]
            (tiny_capture / "images_2").mkdir(exist_ok=True)
            (tiny_capture / "masks").mkdir(exist_ok=True)
            Image.open(path).resize((width // 2, height // 2)).save(tiny_capture / "images_2" / path.name)
            Image.fromarray(known * np.uint8(255)).save(tiny_capture / "masks" / path.name)
            frame["mask_path"] = f"masks/{path.name}"

    edited(tiny_capture, change)
    mask = CapturePictures(outputs(tiny_capture, downscale_factor=2)).get_data(0, "uint8")["mask"]
    assert (
        mask.shape == (height // 2, width // 2, 1)
        and bool(mask[: height // 4].all())
        and not bool(mask[height // 4 :].any())
    )


def test_an_old_capture_with_colmap_beside_it_asks_nothing(tiny_capture: Path, monkeypatch) -> None:
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("asked a question"))
    edited(tiny_capture, without("ply_file_path"))
    (tiny_capture / "colmap" / "sparse" / "0").mkdir(parents=True)
    before = (tiny_capture / "transforms.json").read_bytes()
    assert "points3D_xyz" not in outputs(tiny_capture, load_3D_points=True).metadata
    assert (tiny_capture / "transforms.json").read_bytes() == before


def test_poses_come_back_through_the_bridge(tiny_capture: Path) -> None:
    cameras = outputs(tiny_capture).cameras
    assert torch.equal(flip_axes(flip_axes(cameras.camera_to_worlds)), cameras.camera_to_worlds)
