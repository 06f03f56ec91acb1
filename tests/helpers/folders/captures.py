"""Captures that a test changes, and frames to write."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import torch
from helpers.scenes.random_cameras import random_cameras

from fb_core.data.capture.captures import FrameToWrite
from fb_core.data.capture.frames import Capture


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
