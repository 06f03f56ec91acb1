"""Captures are written whole or not at all; what is no capture is refused."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from helpers.folders.captures import assert_same, one_frame
from helpers.scenes.random_cameras import random_cameras

from fb_core.data.capture.captures import (
    Points,
    read_capture,
    validate_capture,
    write_capture,
)
from fb_core.files.ownership import MARK_NAME

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
