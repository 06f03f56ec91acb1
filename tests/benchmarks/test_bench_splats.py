"""The splat benchmarks in miniature: their scenes, the peers against ours, the report, the fit."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
import torch
from helpers.scenes.rasterizer_scenes import relative

from fb_core.splatting.footprint import rotations, unit_quaternions
from fb_core.splatting.rasterizer import rasterization
from method_configs.benchmarks.fit import Fit
from method_configs.benchmarks.splats import speed_and_error as benchmark_splat
from method_configs.benchmarks.splats.peers import gsplat_torch, tile_loop
from method_configs.benchmarks.splats.scenes import LEAVES, capture_scene, room_scene
from method_configs.benchmarks.splats.speed_and_error import SECONDS, SplatBenchmark, run_splat
from method_configs.commands import command_line as commands


def test_a_room_scene_is_the_same_every_time_and_mostly_in_the_picture():
    first, again, other = room_scene(500, 48), room_scene(500, 48), room_scene(500, 48, seed=1)
    for name in LEAVES:
        assert torch.equal(getattr(first, name), getattr(again, name)), name
        assert not torch.equal(getattr(first, name), getattr(other, name)), name
    _, alphas, meta = rasterization(**first.inputs())
    assert float((meta["radii"] > 0).float().mean()) > 0.5 and float(alphas.mean()) > 0.3
    assert first.name == "500@48" and room_scene(2000, 32).name == "2k@32"


def test_gaussians_lie_flat_on_the_surfaces():
    """Most surfaces of a room are vertical or horizontal: so are the thin axes."""
    scene = room_scene(2000, 32)
    thin = rotations(unit_quaternions(scene.quats)[0])[:, 2].T
    assert torch.allclose(thin.norm(dim=-1), torch.ones(2000), atol=1e-5)
    upright = (thin[:, 2].abs() < 1e-3) | (thin[:, 2].abs() > 0.999)
    assert float(upright.float().mean()) > 0.8
    assert float((scene.scales[:, 2] < scene.scales[:, :2].amax(dim=1)).float().mean()) > 0.9


def test_a_capture_scene_comes_from_a_file(tmp_path):
    points = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    content = dict(
        means3d=points + np.float32(4), colors=np.full((60, 3), 128, np.uint8),
        viewmats=np.eye(4, dtype=np.float32)[None],
        Ks=np.array([[[40, 0, 20], [0, 40, 16], [0, 0, 1]]], np.float32), width=np.int64(40), height=np.int64(32),
    )  # fmt: skip
    np.savez(tmp_path / "test_plants.npz", **content)
    scene = capture_scene(tmp_path / "test_plants.npz")
    assert scene.name == "plants, 0k@40x32" and scene.means.dtype == torch.float32
    assert rasterization(**scene.inputs())[1].shape == (1, 32, 40, 1)
    content.pop("Ks")
    np.savez(tmp_path / "less.npz", **content)
    with pytest.raises(ValueError, match=r"lacks Ks"):
        capture_scene(tmp_path / "less.npz")
    with pytest.raises(ValueError, match="capture: expected an npz file"):
        capture_scene(tmp_path / "nothing.npz")


@pytest.mark.parametrize("peer", [gsplat_torch, tile_loop])
def test_peers_draw_the_same_picture_with_the_same_gradients(peer):
    scene = room_scene(400, 40)
    got, expected = scene.inputs(gradients=True), scene.inputs(gradients=True)
    pictures = peer(**got), rasterization(**expected, render_mode="RGB+D")[:2]
    assert (pictures[0][0] - pictures[1][0]).abs().max() < 1e-4 and (pictures[0][1] - pictures[1][1]).abs().max() < 1e-5
    for images, alphas in pictures:
        (images.square().sum() + alphas.square().sum()).backward()
    assert max(relative(got[name].grad, expected[name].grad) for name in LEAVES) < 1e-3


def test_gsplat_is_left_as_it_was():
    import nerfacc
    from gsplat.cuda import _wrapper

    before = _wrapper.rasterize_to_indices_in_range, nerfacc.render_weight_from_alpha
    gsplat_torch(**room_scene(20, 16).inputs())
    assert before == (_wrapper.rasterize_to_indices_in_range, nerfacc.render_weight_from_alpha)


def test_the_row_of_gsplats_kernels_in_miniature(monkeypatch):
    """No kernel runs here: ours stands in for gsplat's function, so the row must say that both are equal."""
    from gsplat import rendering

    def stand_in(**arguments):
        assert arguments["packed"] is False
        return rasterization(**arguments)

    monkeypatch.setattr(rendering, "rasterization", stand_in)
    scene = room_scene(100, 24)
    exact = benchmark_splat._picture_and_gradients(benchmark_splat.draw_torch, scene, torch.float64)
    row = benchmark_splat._kernels(scene, exact, "cpu", 1)
    assert (
        row["mean_error"] < 1e-6 and row["gradient_error"] < 1e-4 and row["both_seconds"] > row["forward_seconds"] > 0
    )


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU and gsplat's kernels")
@pytest.mark.slow
@pytest.mark.parametrize(("count", "size"), [(10_000, 256), (50_000, 512)])
def test_gsplats_kernels_agree_with_ours(count: int, size: int):
    """Means over pixels and norms of gradients: at a handful of pixels float32 decides a threshold the other way."""
    scene = room_scene(count, size)
    exact = benchmark_splat._picture_and_gradients(benchmark_splat.draw_torch, scene, torch.float64)
    row = benchmark_splat._kernels(scene, exact, "cuda", 1)
    assert row["mean_error"] < 1e-5 and row["gradient_error"] < 1e-2


def test_splat_in_miniature(tmp_path):
    commands.main(["bench", "splat", "--quick", "--json", str(tmp_path / "s.json")])
    content = json.loads((tmp_path / "s.json").read_text())
    rows = {
        part: [row for row in content["rows"] if row["part"] == part] for part in ("ours", "peers", "work", "machine")
    }
    assert [row["peer"] for row in rows["peers"]] == ["gsplat torch", "tile loop"]
    assert all(row["mean_error"] < 1e-5 and row["gradient_error"] < 1e-2 for row in rows["ours"] + rows["peers"])
    work = rows["work"][0]
    assert 0 < work["drawn_pairs"] <= work["evaluated_pairs"] and 0 < work["visible"] <= work["gaussians"]
    assert rows["machine"][0]["exp_per_second"] > 1e6
    assert content["bars"] == [], "bars are for the sizes that they were set for"


def test_every_bar_has_its_cell(monkeypatch):
    cells = {f"{count // 1000}k@{size}" for count, size in SplatBenchmark().cells}
    assert set(SECONDS) | set(benchmark_splat.TIMES_FASTER) | set(benchmark_splat.MEGABYTES) <= cells
    monkeypatch.setattr(benchmark_splat, "SECONDS", {"1k@16": (1e9, 0.0)})
    report = run_splat(SplatBenchmark(cells=((1000, 16),), runs=1, peer_runs=0))
    assert [bar.holds for bar in report.bars] == [True, False]


def test_fit_in_miniature(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        commands.main(
            ["bench", "fit", "--quick", "--json", str(tmp_path / "f.json"), "--figure", str(tmp_path / "f.png")]
        )
    content = json.loads((tmp_path / "f.json").read_text())
    curves = [row for row in content["rows"] if row["part"] == "curve"]
    assert [row["step"] for row in curves] == [6, 12] * 3
    assert all(row["gaussians"] <= 400 and 0 < row["psnr"] < 60 for row in curves)
    assert (tmp_path / "f.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("config", "nonsense"),
    [
        (SplatBenchmark, {"cells": ()}),
        (SplatBenchmark, {"cells": ((0, 8),)}),
        (SplatBenchmark, {"runs": 0}),
        (Fit, {"strategies": ("adam",)}),
        (Fit, {"strategies": ()}),
        (Fit, {"steps": 0}),
        (Fit, {"size": 8}),
    ],
)
def test_nonsense_is_refused(config, nonsense):
    with pytest.raises(ValueError, match="expected"):
        config(**nonsense)
