"""Every bad capture is one clear sentence that names the file, the frame and what to do."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.captures import edited, frame_edit

from fb_core.data import media
from fb_core.data.capture.captures import (
    read_capture,
    validate_capture,
)

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
