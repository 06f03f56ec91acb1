"""`fillerbuster bench poses` in miniature, and its readable twin."""

import dataclasses
import json

import pytest
import torch
from helpers.scenes.pose_scenes import rotation_degrees, scattered

from fb_core.geometry.pose_solver.solver import recover_cameras
from fb_core.geometry.raymap import raymaps_of
from method_configs.benchmarks.poses import damaged_raymaps as benchmark_poses
from method_configs.benchmarks.poses.plain_pose_fit import fit_cameras_plainly
from method_configs.commands import command_line as commands


def test_the_plain_fit_comes_to_the_same_cameras() -> None:
    """From near enough (it starts unturned); taking pixels from 0 costs it half a pixel's angle."""
    cameras = scattered(2, width=8, height=8, fov_degrees=(70.0, 80.0))
    near = torch.eye(3, dtype=torch.float64) + 0.1 * torch.randn(2, 3, 3, dtype=torch.float64)
    left, _, right = torch.linalg.svd(near)
    pose = torch.cat([left @ right, cameras.camera_to_world[:, :, 3:]], dim=2)
    cameras = dataclasses.replace(cameras, camera_to_world=pose)
    raymaps = raymaps_of(cameras)
    plain = fit_cameras_plainly(raymaps, steps=400)
    assert rotation_degrees(plain, cameras).max() < 1.0
    assert rotation_degrees(plain, recover_cameras(raymaps).cameras).max() < 1.0
    original = fit_cameras_plainly(raymaps, steps=400, half_pixel=False)
    assert rotation_degrees(original, cameras).median() > 2 * rotation_degrees(plain, cameras).median()


def test_poses_in_miniature(tmp_path, monkeypatch, capsys) -> None:
    small = dataclasses.replace(benchmark_poses.QUICK, size=24, plain_steps=2, views=2, chi_square_views=20)
    monkeypatch.setattr(benchmark_poses, "QUICK", small)
    commands.main(
        ["bench", "poses", "--quick", "--json", str(tmp_path / "p.json"), "--figure", str(tmp_path / "p.png")]
    )
    content = json.loads((tmp_path / "p.json").read_text())
    rows = {row["case"]: row for row in content["rows"] if row["part"] == "poses"}
    assert set(rows) == {case.name for case in benchmark_poses.CASES}
    assert rows["clean"]["rotation_degrees_max"] < 1e-5 and rows["clean"]["trusted_share"] == 1
    assert rows["clean crop"]["size"] == 12 and rows["clean crop"]["rotation_degrees_max"] < 1e-4
    assert rows["clean"]["plain_cpu_seconds"] > 0 and len(content["bars"]) == 5
    assert (tmp_path / "p.png").stat().st_size > 1000 and "chi-square" in capsys.readouterr().out


def test_without_the_plain_fit(monkeypatch) -> None:
    monkeypatch.setattr(benchmark_poses, "CASES", benchmark_poses.CASES[:6])
    report = benchmark_poses.run_poses(
        dataclasses.replace(benchmark_poses.QUICK, size=16, views=1, plain_steps=0, chi_square_views=4)
    )
    assert not any(name.startswith("plain") for row in report.rows for name in row)


@pytest.mark.parametrize("nonsense", [{"views": 0}, {"draws": 0}, {"size": 4}, {"plain_steps": -1}])
def test_nonsense_is_refused(nonsense) -> None:
    with pytest.raises(ValueError, match="poses benchmark"):
        benchmark_poses.PosesBenchmark(**nonsense)
