"""`fillerbuster bench inference`: what is measured, what is reckoned, and the paper's column."""

from __future__ import annotations

import dataclasses
import json
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.tiny_models import save_tiny_model, tiny_model
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from fb_core import checkpoint
from fb_core.inpainter import Fillerbuster
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import IMAGE_VAE, RAYMAP_VAE
from method_configs.benchmarks import inference as inference_benchmark
from method_configs.benchmarks.inference import Cell, Inference, reckoned_seconds


def test_times_are_reckoned_along_a_line():
    assert reckoned_seconds({2: 5.0, 4: 6.0}, 50) == pytest.approx(4 + 50 * 0.5)
    assert reckoned_seconds({2: 5.0, 4: 4.9}, 50) == 5.0, "a busy moment makes no negative times"
    assert reckoned_seconds({2: 5.0, 4: 6.0}, 1) == 5.0


def test_every_cell_is_measured_once_and_told(tmp_path: Path, monkeypatch):
    folder, asked = save_tiny_model(tmp_path / "model"), []
    real = inference_benchmark.timed

    def counted(model, views, size, steps, seed, clock):
        asked.append((views, size, steps))
        return real(model, views, size, steps, seed, clock)

    monkeypatch.setattr(inference_benchmark, "timed", counted)
    suffixes = {"json": "json", "csv": "csv", "markdown": "md", "figure": "png"}
    files = {name: tmp_path / f"table.{suffix}" for name, suffix in suffixes.items()}
    shared = {"model": folder, "views": (1, 4), "sizes": (32,), "device": "cpu", "keep": tmp_path / "kept"}
    Inference(**shared, steps=(50, 1), **files).run()
    rows = json.loads(files["json"].read_text())["rows"]
    few = [(views, 32, steps) for views in (1, 4) for steps in (1, 4, 12)]
    assert asked == few, "on CPUs few steps are measured, and one before them sets up what is needed"
    assert [(row["views"], row["steps"], row["how"]) for row in rows] == [
        (views, steps, "reckoned from 4 and 12 steps") for views in (1, 4) for steps in (50, 1)
    ]
    assert all(row["seconds"] > 0 and row["paper_a100_seconds"] is None for row in rows)
    assert all(path.stat().st_size > 100 for path in files.values())
    Inference(**shared, steps=(24,)).run()
    assert len(asked) == 6, "what is kept is not measured again"
    Inference(**shared | {"keep": None, "views": (1,)}, steps=(3,), reckoned=False).run()
    assert asked[6:] == [(1, 32, 1), (1, 32, 3)]


def test_the_released_architecture_is_reckoned_from_one_step_without_weights(tmp_path: Path, monkeypatch):
    """Its sizes are the released ones; here they are shrunk, but for the measure, and so is what counts as long."""
    with torch.device("meta"):
        assert sum(weight.numel() for weight in DiT(DiTConfig()).parameters()) > 600e6
    small = save_tiny_model(tmp_path / "model")
    monkeypatch.setattr(inference_benchmark, "_LONG", 0)
    monkeypatch.setattr(
        inference_benchmark, "untrained", lambda sizes, seed, device: Fillerbuster(checkpoint.load(small))
    )
    shared = {"released_architecture": True, "views": (2,), "sizes": (32,), "device": "cpu"}
    Inference(**shared, keep=tmp_path / "kept", json=tmp_path / "table.json").run()
    rows = json.loads((tmp_path / "table.json").read_text())["rows"]
    assert [(row["steps"], row["how"]) for row in rows] == [
        (steps, "reckoned from 1 and 2 steps") for steps in (50, 24)
    ]
    (file,) = (tmp_path / "kept" / "random-weights").glob("32-2-*.json")
    kept = json.loads(file.read_text())["measured"]
    assert list(kept) == ["1", "2"] and "random weights" in rows[0]["part"]
    assert rows[0]["seconds"] == pytest.approx(kept["1"] + 49 * max(0, kept["2"] - kept["1"]))
    with pytest.raises(ValueError, match="expected --model or --released-architecture, got both"):
        Inference(**shared, model=small).run()


def test_what_no_step_can_be_waited_for_is_reckoned_by_operations(tmp_path: Path, monkeypatch):
    """Where seconds are proportional to operations, the reckoned ones are those that a measurement would give."""
    small = save_tiny_model(tmp_path / "model")
    model, asked = Fillerbuster(checkpoint.load(small)), []
    cells = {(views, size): Cell.of(model, size, views) for size in (32, 64) for views in (2, 4)}
    steps = {where: cell.step for where, cell in cells.items()}

    def of_this_machine(model, views, size, steps, seed, clock):
        asked.append((views, size, steps))
        cell = Cell.of(model, size, views)
        return 1e-6 * cell.once + 2e-6 * steps * cell.step

    monkeypatch.setattr(inference_benchmark, "timed", of_this_machine)
    monkeypatch.setattr(inference_benchmark, "_LONG", steps[2, 32])
    monkeypatch.setattr(inference_benchmark, "_TOO_LONG", steps[4, 32])
    table, figure = tmp_path / "table.json", tmp_path / "table.png"
    shared = {"model": small, "views": (2, 4), "sizes": (32, 64), "device": "cpu"}
    Inference(**shared, json=table, figure=figure).run()
    rows = json.loads(table.read_text())["rows"]
    assert set(asked) == {(2, 32, 1), (2, 32, 4), (2, 32, 12), (1, 32, 1), (4, 32, 1), (4, 32, 2)}
    by_operations = "reckoned by operations from 4 views of 32 pixels, 1 and 2 steps"
    assert {(row["views"], row["size"]): row["how"] for row in rows} == {
        (2, 32): "reckoned from 4 and 12 steps",
        (4, 32): "reckoned from 1 and 2 steps",
        (2, 64): by_operations,
        (4, 64): by_operations,
    }
    for row in rows:
        cell = cells[row["views"], row["size"]]
        assert row["seconds"] == pytest.approx(1e-6 * cell.once + 2e-6 * row["steps"] * cell.step, rel=1e-6)
        assert row["tera_operations"] == pytest.approx(1e-12 * (cell.once + row["steps"] * cell.step))
    monkeypatch.setattr(inference_benchmark, "_TOO_LONG", 0)
    asked.clear()
    Inference(**shared).run()
    assert {where[:2] for where in asked} == {(2, 32)}, "the smallest is measured, whatever it takes"


@pytest.mark.parametrize("weights", ["tiny", "bundled"])
def test_operations_are_those_that_torch_counts(weights, tmp_path: Path):
    """Of a whole sampling: two steps more are two steps; what comes once is right within a few percent."""
    model = tiny_model(tmp_path) if weights == "tiny" else Fillerbuster.from_pretrained(None)
    counts = {}
    inference_benchmark.timed(model, 4, 64, 1, 0)
    for steps in (2, 4):
        with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
            inference_benchmark.timed(model, 4, 64, steps, 0)
        counts[steps] = counter.get_total_flops()
    cell = Cell.of(model, 64, 4)
    assert (counts[4] - counts[2]) / 2 == pytest.approx(cell.step, rel=0.05)
    assert counts[2] - 2 * cell.step == pytest.approx(cell.once, rel=0.1)


def test_random_weights_of_a_model_that_reads_text_complete_views():
    """As the released one does, with an empty prompt; the sizes are a miniature's."""
    image_vae, raymap_vae = (
        dataclasses.replace(sizes, widths=(8, 8, 8, 8), norm_groups=4) for sizes in (IMAGE_VAE, RAYMAP_VAE)
    )
    sizes = checkpoint.ModelConfig(
        transformer=DiTConfig(heads=2, head_dim=16, depth=1), image_vae=image_vae, raymap_vae=raymap_vae
    )
    model = inference_benchmark.untrained(sizes, 0, torch.device("cpu"))
    assert model.reads_text and model.model_hash == "" and model.info["preset"] == "the released architecture"
    assert inference_benchmark.timed(model, 2, 32, 1, 0) > 0


def test_seconds_of_the_processor_leave_out_what_others_take(tmp_path: Path, monkeypatch):
    """The time that a sampling waits is no time of this process."""
    model, real = tiny_model(tmp_path), Fillerbuster.complete

    def waits(*given, **options):
        time.sleep(0.5)
        return real(*given, **options)

    monkeypatch.setattr(Fillerbuster, "complete", waits)
    inference_benchmark.timed(model, 1, 32, 1, 0)
    began = time.process_time()
    seconds = inference_benchmark.timed(model, 1, 32, 1, 0, inference_benchmark.CLOCKS["processor"])
    assert 0 < seconds <= time.process_time() - began
    assert inference_benchmark.timed(model, 1, 32, 1, 0, inference_benchmark.CLOCKS["wall"]) >= 0.5
    with pytest.raises(ValueError, match="clock: a processor's seconds say nothing of the device meta"):
        monkeypatch.setattr(
            Fillerbuster, "from_pretrained", lambda *_, **__: SimpleNamespace(device=torch.device("meta"))
        )
        Inference(clock="processor").run()


def test_the_papers_column(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(inference_benchmark, "timed", lambda *_: 1.0)
    model = save_tiny_model(tmp_path / "model")
    Inference(model=model, device="cpu", json=tmp_path / "table.json").run()
    rows = json.loads((tmp_path / "table.json").read_text())["rows"]
    assert len(rows) == 16
    said = {(row["size"], row["views"]): row["paper_a100_seconds"] for row in rows if row["steps"] == 50}
    assert said[256, 4] == 9 and said[512, 16] == 53 and said[512, 32] == 120
    assert all(row["paper_a100_seconds"] is None for row in rows if row["steps"] == 24)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"sizes": (100,)}, "multiples of 16 pixels, got 100"),
        ({"views": ()}, "expected numbers of views"),
        ({"sizes": (16000,)}, "sizes: expected 16 to 8192, got 16000"),
        ({"views": (10**6,)}, "views: expected 1 to 10000, got 1000000"),
        ({"views": (10**4,), "sizes": (8192,)}, "inference: 10000 views of 8192 pixels need .* GiB of memory, but"),
        ({"device": "moon"}, "device: expected one that this machine has, such as cpu, cuda or cuda:N, got 'moon'"),
    ],
)
def test_bad_options_are_told(options, said):
    with pytest.raises(ValueError, match=said):
        Inference(**options).run()
