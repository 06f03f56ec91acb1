"""`fillerbuster bench photos`: stages that add up, threads that change nothing, COLMAP named where it is missing."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.textured_box import cameras_on_an_arc, save_photos

from method_configs.benchmarks.photos.colmap import camera_of
from method_configs.benchmarks.photos.command import Photos
from method_configs.benchmarks.photos.stages import STAGES, between


def test_stages_last_from_one_beginning_to_the_next():
    marks = [(1.0, 0.5), (3.0, 2.5), None, (10.0, 4.0)]
    assert between(marks) == {"features": (2.0, 2.0), "matches": (7.0, 1.5), "cameras": (0.0, 0.0)}


def test_a_folder_is_measured_on_one_thread_and_on_all_and_colmap_is_named(tmp_path: Path, monkeypatch, caplog):
    save_photos(tmp_path / "photos", cameras_on_an_arc(4))
    monkeypatch.setattr("fb_core.machine.resources.usable_cores", lambda: 2)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    Photos(source=tmp_path / "photos", json=tmp_path / "photos.json", figure=tmp_path / "photos.png").run()
    rows = json.loads((tmp_path / "photos.json").read_text())["rows"]
    assert [(row["method"], row["threads"]) for row in rows] == [("fillerbuster", 1), ("fillerbuster", 2)]
    for row in rows:
        assert row["equal_to_one_thread"] is True and row["found_share"] == 1
        assert row["cpu_seconds"] == pytest.approx(sum(row[f"{stage}_cpu_seconds"] for stage in STAGES))
        assert all(row[f"{stage}_seconds"] > 0 for stage in STAGES)
        assert row["rotation_degrees"] is None, "photos without cameras tell no errors"
    assert "pycolmap is not installed, so COLMAP is left out" in caplog.text
    assert (tmp_path / "photos.png").stat().st_size > 1000


def test_a_camera_of_colmap_is_turned_into_ours():
    ours = cameras_on_an_arc(3)[[1]].to("cpu", torch.float64)
    from_world = ours.world_to_camera[0, :3].numpy()
    image = SimpleNamespace(cam_from_world=lambda: SimpleNamespace(matrix=lambda: from_world))
    lens = SimpleNamespace(
        focal_length_x=float(ours.focal[0, 0]), focal_length_y=float(ours.focal[0, 1]),
        principal_point_x=float(ours.principal[0, 0]), principal_point_y=float(ours.principal[0, 1]),
        width=ours.width, height=ours.height,
    )  # fmt: skip
    got = camera_of(image, lens)
    torch.testing.assert_close(got.camera_to_world, ours.camera_to_world, rtol=0, atol=1e-6)
    torch.testing.assert_close(got.focal, ours.focal)
