"""The demo: progress of its trainings, measuring held-out views, its promises and its picture; the whole of it at toy
size when slow.
"""

from __future__ import annotations

import json
import os
import stat
import sys
from pathlib import Path

import pytest
import torch
from helpers.plugin.held_out import held_out

from fb_core.data.capture.captures import read_capture
from fb_nerfstudio.runs.held_out_views import HeldOutViews
from fb_nerfstudio.runs.training_process import TrainingProcess
from method_configs.commands import demo
from method_configs.commands.demo_report import write_report

GENERATION = """Completing the scene with model tiny
\x1b[2K\rAnchors: 24 views \x1b[38;5;197m━━━━\x1b[0m\x1b[38;5;237m━━━\x1b[0m 6/24 0:00:10
\x1b[2K\rAnchors: 24 views ━━━━━━━ 24/24 0:00:00\nRound 1: 24 views ━━━ 3/24 0:00:09
"""
STEPS = (
    "0 (0.00%)           1 s, 383.271 ms      4 m, 36 s\n10 (5.00%)          571.611 ms           1 m, 48 "
    "s\n199 (99.50%)\n"
)


@pytest.fixture
def pretend_ns_train(tmp_path, monkeypatch):
    """A console script named ns-train beside a pretended interpreter, which prints what it is told and ends with a
    code.
    """

    def install(text: str, code: int = 0) -> None:
        (tmp_path / "said.txt").write_text(text, encoding="utf-8")
        script = tmp_path / "ns-train"
        script.write_text(f"#!/bin/sh\ncat '{tmp_path}/said.txt'\nexit {code}\n")
        script.chmod(script.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))

    return install


def start(tmp_path: Path, reports: list) -> TrainingProcess:
    def report(*one) -> None:
        reports.append(one)

    return TrainingProcess(["fillerbuster"], log=tmp_path / "log", iterations=200, rounds=4, threads=1, report=report)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (GENERATION, ("generate", 27, 96)),
        (STEPS, ("train", 200, 200)),
        (STEPS + GENERATION, ("generate", 27, 96)),  # views may be generated in the middle of a training
        (GENERATION + STEPS, ("train", 200, 200)),
    ],
)
def test_progress_is_read_from_what_ns_train_prints(text, expected, pretend_ns_train, tmp_path):
    pretend_ns_train(text)
    reports: list = []
    process = start(tmp_path, reports)
    process.finish()
    assert reports[-1] == expected
    assert "\x1b" not in (tmp_path / "log").read_text() and not process.running


def test_a_failed_training_is_told_by_its_last_line(pretend_ns_train, tmp_path):
    pretend_ns_train("much ado\ncapture nowhere: no such folder; check the path\n\n", code=3)
    with pytest.raises(ValueError, match="ns-train fillerbuster ended with code 3: capture nowhere: no such folder"):
        start(tmp_path, []).finish()


def test_both_trainings_get_options_that_ns_train_knows(tmp_path):
    """And they differ in nothing but the method and the completion's own options."""
    import tyro
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    both = {
        name: demo.training_arguments(tmp_path, method, seed=5, iterations=70, model=tmp_path / "model")
        for name, method in demo.METHODS.items()
    }
    config = tyro.cli(AnnotatedBaseConfigUnion, args=both["with"])
    assert config.method_name == "fillerbuster" and config.max_num_iterations == 70
    assert config.pipeline.datamanager.completion.model == tmp_path / "model"
    assert config.get_base_dir() == demo.run_folder(tmp_path, "fillerbuster")
    assert tyro.cli(AnnotatedBaseConfigUnion, args=both["without"]).method_name == "fillerbuster-none"
    rest = both["with"][1 : len(both["without"])]
    assert rest == both["without"][1:]
    assert all("completion" in name for name in both["with"][len(both["without"]) :: 2])


def test_quality_is_told_apart_for_covered_and_uncovered_views():
    quality = held_out(error=0.1, holes=0.75).quality()
    assert quality["covered"]["psnr"] == pytest.approx(40.0, abs=1e-3) and quality["covered"]["hole_share"] == 0.0
    assert quality["uncovered"]["psnr"] == pytest.approx(20.0, abs=1e-3) and quality["uncovered"]["hole_share"] == 0.75


def test_promises_hold_or_not():
    metrics = {"without": held_out(0.1, 0.75).quality(), "with": held_out(0.05, 0.25).quality()}
    metrics |= {"seconds": {"total": 599.0}, "peak_memory_gib": 6.5}
    told = {what: holds for what, *_, holds in demo.bars_of(metrics)}
    assert list(told.values()) == [True, True, True, True, False]
    metrics["with"] = held_out(0.095, 0.3125).quality()
    assert [holds for *_, holds in demo.bars_of(metrics)][:2] == [False, False]


def test_report_shows_captured_generated_and_held_out_views(tiny_capture, tmp_path):
    output = tmp_path / "demo"
    output.mkdir()
    tiny_capture.rename(output / "capture")
    pictures = tuple((role, torch.rand(3, 8, 8)) for role in ("anchor", "densify", "densify"))
    views = {name: held_out(0.1, 0.5) for name in demo.METHODS}
    views["with"] = HeldOutViews(**{**vars(views["with"]), "generated": pictures})
    write_report(output, views, {name: view.quality() for name, view in views.items()}, seed=0)
    from fb_core.data.media import image_size

    height, width = image_size(output / "report.png")
    assert height > 1000 and width > 1000


def test_only_an_earlier_demo_is_cleared_away(tmp_path, capsys):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(ValueError, match="holds something else than an earlier demo"):
        demo._clear(tmp_path)
    demo._clear(tmp_path / "new" / "demo")
    (tmp_path / "new" / "demo" / "report.png").touch()
    demo._clear(tmp_path / "new" / "demo")
    assert [path.name for path in (tmp_path / "new" / "demo").iterdir()] == [demo.MARKER]


def test_a_demo_whose_training_failed_can_be_run_again(pretend_ns_train, tmp_path, monkeypatch):
    for name, value in {"VIEWS": 4, "SIZE": 16, "HELD_OUT": 2}.items():
        monkeypatch.setattr(demo, name, value)
    pretend_ns_train("out of memory", code=3)
    for _ in range(2):
        with pytest.raises(ValueError, match="ended with code 3: out of memory"):
            demo.run_demo(tmp_path / "demo", iterations=10)
        said = [log.read_text().strip() for log in (tmp_path / "demo" / "runs").glob("*.log")]
        assert "out of memory" in said  # the other training is stopped, and may not have said anything yet


@pytest.mark.parametrize(
    ("options", "sentence"),
    [({"iterations": 0}, "at least 1, got 0"), ({"model": Path("nowhere")}, "no folder nowhere")],
)
def test_nonsense_is_refused_before_anything_is_made(options, sentence, tmp_path):
    with pytest.raises(ValueError, match=sentence):
        demo.run_demo(tmp_path / "demo", **options)
    assert not (tmp_path / "demo").exists()


def test_peak_memory_counts_children_too():
    import subprocess
    import time

    hungry = "import time; x = bytearray(200 << 20); x[::4096] = b'x' * len(x[::4096]); time.sleep(2.5)"
    with demo._peak_memory() as alone:
        time.sleep(0.8)
    with demo._peak_memory() as together:
        subprocess.run([sys.executable, "-c", hungry], check=True)
    assert together["gib"] > alone["gib"] + 0.19


@pytest.mark.slow
def test_the_whole_demo_at_toy_size(tmp_path, monkeypatch):
    """Two real trainings with a tiny random model: all files appear, in the promised form, and the numbers are
    finite.
    """
    from helpers.tiny_models import save_tiny_model

    monkeypatch.setattr(demo, "VIEWS", 6)
    monkeypatch.setattr(demo, "SIZE", 32)
    monkeypatch.setattr(demo, "HELD_OUT", 4)
    model = save_tiny_model(tmp_path / "model", image_size=32)
    demo.run_demo(tmp_path / "demo", seed=1, iterations=20, model=model)
    metrics = json.loads((tmp_path / "demo" / "metrics.json").read_text())
    assert list(metrics) == ["without", "with", "seconds", "peak_memory_gib"]
    for name in ("without", "with"):
        assert list(metrics[name]) == ["covered", "uncovered"]
        assert all(list(values) == ["psnr", "ssim", "hole_share"] for values in metrics[name].values())
    assert {"capture", "generate", "train_with", "train_without", "render", "report", "total"} <= set(
        metrics["seconds"]
    )
    assert 0.1 < metrics["peak_memory_gib"] < 16
    assert (tmp_path / "demo" / "report.png").stat().st_size > 10_000
    assert len(read_capture(demo.run_folder(tmp_path / "demo", "fillerbuster") / "completion")) == 96
    assert os.listdir(demo.run_folder(tmp_path / "demo", "fillerbuster-none") / "nerfstudio_models")
