"""Benchmarks in miniature: the two ways agree, the report has its form, and the command writes it."""

import dataclasses
import json

import pytest
import torch
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from fb_core.evaluation.results import Bar, Report, hardware, median_seconds, relative_difference
from fb_core.networks.transformer.dit import DiTConfig, TokenFacts
from fb_core.networks.transformer.prepared import Prepared
from method_configs.benchmarks import networks as benchmark_networks
from method_configs.benchmarks import precision as benchmark_precision
from method_configs.benchmarks.networks import SMALL, NetworksBenchmark, random_model, step_flops
from method_configs.commands import command_line as commands

MINIATURE = NetworksBenchmark(cells=((2, 16),), steps=2, runs=1, full_size=None)
PRECISION = dataclasses.replace(benchmark_precision.QUICK, guidance=(20.0,), views=(3,))


def test_bars_hold_or_not_and_nan_never_does():
    def bar(value, sense):
        return Bar(name="x", value=value, limit=2.0, sense=sense).holds

    assert bar(2.0, "<=") and bar(2.0, ">=") and not bar(2.1, "<=") and not bar(1.9, ">=")
    assert not bar(float("nan"), "<=") and not bar(float("nan"), ">=")


def test_a_report_is_json_with_the_agreed_entries(tmp_path):
    report = Report(
        seed=3,
        rows=[{"part": "x", "seconds": 0.5, "error": float("nan")}],
        bars=[Bar(name="b", value=1.0, limit=2.0, sense="<=")],
    )
    content = json.loads(report.write(tmp_path / "new" / "x.json", command="fillerbuster bench x").read_text())
    assert content["bars"] == [{"name": "b", "value": 1.0, "limit": 2.0, "sense": "<=", "holds": True}]
    assert content["rows"] == [{"part": "x", "seconds": 0.5, "error": None}]
    assert list(content) == ["command", "commit", "hardware", "seed", "rows", "bars"]
    assert content["seed"] == 3 and content["hardware"] == hardware() and torch.__version__ in hardware()


def test_medians_are_of_interleaved_runs():
    order = []
    seconds = median_seconds({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 2)
    assert order == list("ababab") and seconds.keys() == {"a", "b"} and min(seconds.values()) >= 0


def test_relative_difference():
    assert relative_difference(torch.tensor([1.0, -4.5]), torch.tensor([1.0, -4.0])) == 0.125


@pytest.mark.parametrize("text_width", [0, 8])
@torch.no_grad()
def test_floating_point_operations_are_those_that_torch_counts(text_width):
    transformer = DiTConfig(heads=2, head_dim=8, depth=2, text_width=text_width)
    dit = random_model(dataclasses.replace(SMALL, transformer=transformer), 0).dit
    prepared = Prepared(
        dit, torch.randn(2, 3, 34, 4, 6), [1.0], text=torch.randn(1, 77, text_width) if text_width else None
    )
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        prepared(torch.randn(3, 32, 4, 6), 1.0)
    assert step_flops(transformer, 3 * 2 * 3, 2) == counter.get_total_flops()


@torch.no_grad()
def test_known_tokens_that_stand_apart_cost_no_step_but_to_be_looked_at():
    transformer = DiTConfig(heads=2, head_dim=8, depth=2, text_width=0, known_tokens="apart")
    dit = random_model(dataclasses.replace(SMALL, transformer=transformer), 0).dit
    known = torch.zeros(1, 3, 2, 3, dtype=torch.bool)
    known[:, 0] = True
    prepared = Prepared(dit, torch.randn(1, 3, 34, 4, 6), [1.0], facts=TokenFacts(known=known))
    state = torch.randn(3, 32, 4, 6)
    prepared(state, 1.0)  # what is known is computed at first use
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False) as counter:
        prepared(state, 1.0)
    assert step_flops(transformer, 3 * 2 * 3, 1, apart=2 * 3) == counter.get_total_flops()


def test_networks_in_miniature(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(benchmark_networks, "QUICK", MINIATURE)
    commands.main(
        ["bench", "networks", "--quick", "--json", str(tmp_path / "n.json"), "--figure", str(tmp_path / "n.png")]
    )
    content = json.loads((tmp_path / "n.json").read_text())
    sampling = content["rows"][0]
    assert (sampling["part"], sampling["views"], sampling["size"], sampling["steps"]) == ("sampling", 2, 16, 2)
    assert all(row["relative_difference"] < 1e-4 for row in content["rows"])
    assert next(row["saving"] for row in content["rows"] if row["part"] == "saving") == "three passes"
    assert {row["part"] for row in content["rows"]} == {"sampling", "saving", "floor"}
    assert (tmp_path / "n.png").stat().st_size > 1000
    assert "whole sampling, times faster" in capsys.readouterr().out


def test_precision_in_miniature(tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark_precision, "QUICK", PRECISION)
    commands.main(
        ["bench", "precision", "--quick", "--json", str(tmp_path / "p.json"), "--figure", str(tmp_path / "p.png")]
    )
    content = json.loads((tmp_path / "p.json").read_text())
    (row,) = content["rows"]
    assert row["finite"] and 0 < row["image_mean_error"] < 0.1 and content["bars"][0]["holds"]
    assert (tmp_path / "p.png").exists()


@pytest.mark.parametrize(
    "nonsense", [{"cells": ()}, {"cells": ((0, 16),)}, {"cells": ((4, 20),)}, {"steps": 0}, {"runs": 0}]
)
def test_nonsense_is_refused(nonsense):
    with pytest.raises(ValueError, match="expected at least one"):
        NetworksBenchmark(**nonsense)
