"""``fillerbuster bench methods``: the captures that it makes, what each run is asked for, its table and bars (a real
miniature is slow).
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
import tyro
from helpers.plugin.held_out import held_out
from nerfstudio.engine.trainer import TrainerConfig

from fb_core.data.capture.captures import read_capture, validate_capture
from fb_core.evaluation.metrics.lazy_lpips import LazyLpips
from fb_nerfstudio.runs import held_out_views
from method_configs import splats
from method_configs.benchmarks import methods as methods_benchmark
from method_configs.benchmarks.methods import (
    MASKED,
    NEW_VIEWS,
    Methods,
    arguments_of,
    bars_of,
    cut_blocks,
    means_of,
    run_methods,
    shows_cube,
)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from fb_core.data.rooms.room_captures import rooms

    folder = tmp_path_factory.mktemp("rooms") / "plain"
    rooms(0, folder, views=3, size=32, held_out=2)
    return folder


def test_a_block_is_cut_out_of_captured_pictures_only(plain: Path, tmp_path: Path):
    cut_blocks(plain, tmp_path / "cut", share=0.5)
    whole, cut = validate_capture(plain), validate_capture(tmp_path / "cut", decode=True)
    for before, after in zip(whole.frames, cut.frames, strict=True):
        mask = after.load_mask()
        captured = before.image_path.name.startswith("captured")
        assert int((mask == 0).sum()) == (16 * 16 if captured else 0)
        if captured:
            assert bool((mask[:, 8:24, 8:24] == 0).all()) and float(after.load_image()[:, 8:24, 8:24].max()) == 0.0
        assert torch.allclose(after.load_image() * mask, before.load_image() * mask, atol=1e-6)
    assert read_capture(tmp_path / "cut").points_path is not None


def test_one_cube_of_the_room_is_cut_out_of_the_pictures_that_show_it(tmp_path: Path):
    from fb_core.data.rooms.room_captures import rooms

    plain = tmp_path / "plain"
    rooms(0, plain, views=6, size=64, held_out=2)
    cut_blocks(plain, tmp_path / "cut", share=0.3, block_in="world")
    whole, cut = validate_capture(plain), validate_capture(tmp_path / "cut", decode=True)
    cut_out = [frame.load_mask()[0] == 0 for frame in cut.frames]
    captured = [frame.image_path.name.startswith("captured") for frame in whole.frames]
    assert any(bool(mask.any()) for mask, one in zip(cut_out, captured, strict=True) if one)
    assert not any(bool(mask.any()) for mask, one in zip(cut_out, captured, strict=True) if not one)
    assert not any(bool(mask.all()) for mask in cut_out)


def test_pixels_that_look_at_a_cube():
    from fb_core.geometry.cameras import Pinholes

    origin, ahead, up = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([0.0, 0.0, 1.0])
    camera = Pinholes.looking_at(origin, ahead, up=up, fov_degrees=90.0, width=100, height=100)
    mask = shows_cube(camera, torch.tensor([2.0, 0.0, 0.0]), 1.0)
    rows, columns = mask.nonzero().T
    half = 50 * 0.5 / 1.5  # the near face is 1.5 away and 1 wide; a pixel's centre decides
    assert (
        (int(rows.min()), int(rows.max()))
        == (int(columns.min()), int(columns.max()))
        == (round(50 - half), round(49 + half))
    )
    assert bool(mask[34:66, 34:66].all()), "and it is filled"
    assert not bool(shows_cube(camera, torch.tensor([-2.0, 0.0, 0.0]), 1.0).any()), "behind the camera"
    assert bool(shows_cube(camera, torch.zeros(3), 1.0).all()), "the camera stands inside"


@pytest.mark.parametrize("method", dict.fromkeys([*NEW_VIEWS, *MASKED]))
@pytest.mark.parametrize("quick", [False, True])
def test_nerfstudio_accepts_what_each_run_is_asked_for(method: str, quick: bool, tmp_path: Path):
    config = Methods(quick=quick, iterations=90, completion={"start": "render", "strength": "0.75"})
    own = getattr(splats, method.replace("-", "_")).config
    name, *arguments = arguments_of(method, tmp_path, 3, config)
    dataparser = arguments.index("--data")  # ns-train's own option, which the bare config has too
    assert name == method and arguments[dataparser + 1] == str(tmp_path / "capture")
    parsed = tyro.cli(tyro.conf.FlagConversionOff[TrainerConfig], default=own, args=arguments)
    completion, before = parsed.pipeline.datamanager.completion, own.pipeline.datamanager.completion
    assert (completion.start, completion.strength) == ("render", 0.75)
    assert completion.seed == 3 and completion.at_step == min(before.at_step, 30) and completion.task == before.task
    assert quick or (completion.anchor_views, completion.densify_rounds) == (before.anchor_views, before.densify_rounds)
    assert parsed.max_num_iterations == 90 and parsed.experiment_name == "room"


def measured(part: str, method: str, room: int, psnr: float, holes: float, consistency: float | None = None) -> dict:
    row = {"part": part, "method": method, "room": room, "uncovered_psnr": psnr, "uncovered_hole_share": holes}
    return row | ({"consistency_psnr": consistency} if part == "masked" else {})


def test_means_and_bars():
    rows = [measured("new views", "fillerbuster-none", room, 10.0 + room, 0.3) for room in (0, 1)]
    rows += [measured("new views", "fillerbuster", room, 13.0 + room, 0.02) for room in (0, 1)]
    rows += [
        measured("masked", "fillerbuster-none", 0, 10.0, 0.3, None),
        measured("masked", "nerfiller-grid", 0, 10.0, 0.3, 25.6),
    ]
    rows += [measured("masked", "fillerbuster-masked", 0, 10.0, 0.3, 29.6)]
    means = means_of(rows)
    assert (
        means[0]["uncovered_psnr"] == 10.5
        and means[0]["part"] == "new views, mean of 2 rooms"
        and means[0]["room"] == "all"
    )
    assert means[2]["consistency_psnr"] is None
    values = {bar.name: (round(bar.value, 3), round(bar.limit, 3), bar.holds) for bar in bars_of(rows)}
    assert values["PSNR gained on uncovered views (dB)"] == (3.0, 1.0, True)
    assert values["hole share on uncovered views"] == (0.02, 0.1, True)
    assert (29.6, 25.6, True) in values.values()
    assert bars_of([]) == []


@pytest.mark.parametrize("weights", [True, False])
def test_lpips_stands_in_the_row_where_its_weights_are_at_hand(weights: bool, monkeypatch: pytest.MonkeyPatch):
    views = held_out(error=0.1, holes=0.5)
    monkeypatch.setattr(held_out_views, "render_held_out", lambda run, capture: views)
    monkeypatch.setattr(
        LazyLpips, "__call__", lambda self, first, second: float((first - second).abs().mean()) if weights else None
    )
    row = methods_benchmark.quality_of(Path("run"), Path("capture"))
    assert row["covered_psnr"] == pytest.approx(40, abs=1e-3) and ("covered_lpips" in row) is weights
    if weights:
        assert row["covered_lpips"] == pytest.approx(0.01, abs=1e-4) and row["uncovered_lpips"] == pytest.approx(
            0.1, abs=1e-4
        )


def test_every_method_runs_on_every_room_and_a_second_benchmark_only_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """With stand-ins for training and rendering."""
    asked: list[tuple[str, str, int]] = []

    def train(method, folder, room, config):
        asked.append((folder.name, method, room))
        methods_benchmark.run_folder(folder, method).mkdir(parents=True)
        return {"seconds": 1.0, "generate_seconds": 0.5, "peak_gib": 1.0}

    monkeypatch.setattr(methods_benchmark, "trained", train)
    quality = {"uncovered_psnr": 12.0, "uncovered_hole_share": 0.1}
    monkeypatch.setattr(methods_benchmark, "quality_of", lambda run, capture: dict(quality))
    monkeypatch.setattr(methods_benchmark, "consistency_of", lambda run, plain: {"consistency_psnr": 20.0})
    config = Methods(rooms=(0, 1), views=2, size=32, held_out=2, output=tmp_path / "out")
    report = run_methods(config)
    assert [(method, room) for name, method, room in asked if "masked" in name] == [
        (method, room) for room in (0, 1) for method in MASKED
    ]
    assert len(asked) == 2 * (len(NEW_VIEWS) + len(MASKED)) and len(report.rows) == len(asked) + len(NEW_VIEWS) + len(
        MASKED
    )
    asked.clear()
    again = run_methods(config)
    assert asked == [] and again.rows == report.rows
    written = json.loads(report.write(tmp_path / "report.json", command="fillerbuster bench methods").read_text())
    assert written["rows"][0]["method"] == "fillerbuster-none"


def test_a_block_of_everything_is_refused():
    with pytest.raises(ValueError, match="block: expected a part"):
        run_methods(Methods(block=1.0))


@pytest.mark.slow
def test_a_real_miniature(tmp_path: Path):
    config = Methods(
        quick=True, new_views=("fillerbuster-cat3d-size",), masked=MASKED[1:], output=tmp_path / "out"
    ).miniature()
    report = run_methods(config)
    rows = {row["method"]: row for row in report.rows if row["room"] == 0}
    assert rows["fillerbuster-cat3d-size"]["generated"] == 2 and rows["fillerbuster-masked"]["generated"] == 4
    for method in MASKED[1:]:
        assert (
            rows[method]["consistency_psnr"] > 0 and rows[method]["block_psnr"] > 0 and rows[method]["peak_gib"] > 0.1
        )
