"""``fillerbuster bench sampler`` in miniature: its form, its counts of passes, its figure."""

import dataclasses
import json
import math

import pytest
from helpers.tiny_models import save_tiny_model

from fb_core.inpainter import Fillerbuster
from fb_core.sampling import SOLVERS
from method_configs.benchmarks.sampler import solvers_and_grids as benchmark_sampler
from method_configs.benchmarks.sampler.solvers_and_grids import QUICK, SamplerBenchmark, run_sampler
from method_configs.benchmarks.sampler.steps_by_task import run_tasks
from method_configs.commands import command_line as commands


def test_the_command_writes_its_report_and_figure(tmp_path, monkeypatch):
    monkeypatch.setattr(
        benchmark_sampler, "QUICK", dataclasses.replace(QUICK, steps=(2,), fine_steps=4, reference_steps=2)
    )
    model = save_tiny_model(tmp_path / "model")
    files = ["--json", str(tmp_path / "s.json"), "--figure", str(tmp_path / "s.png")]
    commands.main(["bench", "sampler", "--quick", "--model", str(model), *files])
    content = json.loads((tmp_path / "s.json").read_text())
    parts = {row["part"] for row in content["rows"]}
    assert {"solvable flow", "trained model", "raymaps of views beside one that is posed"} < parts
    assert sum("another distribution" in part for part in parts) == 2
    started = [row for row in content["rows"] if "started at strength 0.5" in row["part"]]
    assert [row["solver"] for row in started] == 2 * [solver for solver in SOLVERS if solver != "heun"]
    assert all(row["passes"] == 4 and row["error"] > 0 for row in started)
    for flow in ("solvable flow", "trained model"):
        rows = [row for row in content["rows"] if row["part"] == flow]
        assert rows[0]["solver"].startswith("original") and rows[0]["passes"] == 6
        assert {row["solver"] for row in rows[1:]} == set(SOLVERS) - {"heun"}, (
            "Heun takes half of the steps, and half of 2 is too few"
        )
        assert {row["grid"] for row in rows} == {"shift 2", "reference"}
        assert all(row["passes"] == 4 and row["error"] > 0 for row in rows[1:])
    assert all(bar["limit"] == 32 and "passes of" in bar["name"] for bar in content["bars"])
    assert (tmp_path / "s.png").stat().st_size > 1000


def test_on_the_solvable_flow_the_default_holds_its_bar_and_intervals_lead_elsewhere():
    config = dataclasses.replace(
        SamplerBenchmark(), guidance=(3.0,), steps=(16,), shifts=(2.0,), problems=1, fine_steps=100, model=False
    )
    report = run_sampler(config)
    assert len(report.bars) == 2 and all(bar.holds for bar in report.bars)
    limited = [row for row in report.rows if "interval" in row]
    assert len(limited) == 2 and all(row["passes"] < row["passes_of_all"] for row in limited)
    assert all(row["distance_of_that_end"] > row["error_to_its_own_end"] for row in limited)


def test_starting_at_a_strength_costs_no_passes_and_no_order():
    """The rows of the solvable flow: four times the steps leave nearly a sixteenth of the error, of Euler's a
    quarter.
    """
    config = dataclasses.replace(
        SamplerBenchmark(), guidance=(1.0,), steps=(24, 96), shifts=(2.0,), problems=1, fine_steps=200, model=False
    )
    rows = [row for row in run_sampler(config).rows if "started at strength 0.5" in row["part"]]
    errors = {(row["solver"], row["steps"]): row["error"] for row in rows}
    assert set(errors) == {("heun", 24)} | {
        (solver, steps) for solver in SOLVERS if solver != "heun" for steps in (24, 96)
    }
    for solver, order in (("euler", 1), ("ab2", 2), ("corrected", 2)):
        assert errors[solver, 24] / errors[solver, 96] > 4 ** (order - 0.3), solver
    assert all(row["passes"] == (47 if row["solver"] == "heun" else row["steps"]) for row in rows)


@pytest.mark.parametrize(
    "nonsense", [{"views": 1}, {"steps": (0,)}, {"guidance": ()}, {"guidance": (1.0, math.nan)}, {"problems": 0}]
)
def test_nonsense_is_refused(nonsense):
    with pytest.raises(ValueError, match="at least one problem"):
        SamplerBenchmark(**nonsense)


@pytest.mark.parametrize("strength", [0.0, 1.0, 2.0])
def test_a_start_that_is_none_is_refused(strength):
    with pytest.raises(ValueError, match="expected a strength between 0 and 1"):
        SamplerBenchmark(strength=strength)


def test_without_guidance_it_measures_the_steps_of_every_task(tmp_path):
    files = ["--json", str(tmp_path / "s.json"), "--figure", str(tmp_path / "s.png")]
    commands.main(
        ["bench", "sampler", "--guidance", "--quick", "--problems", "1", "--views", "2", "--size", "32", *files]
    )
    rows = json.loads((tmp_path / "s.json").read_text())["rows"]
    assert [(row["part"].split(": ")[1], row["steps"]) for row in rows] == [
        (task, steps) for task in ("pictures (rays known)", "raymaps (pictures known)", "both") for steps in (1, 2)
    ]
    assert all(0 < row["latent_error"] < 2 for row in rows)
    assert (
        ["psnr" in row for row in rows] == ["degrees_to_exact" not in row for row in rows] == 2 * [True] + 4 * [False]
    )
    assert (tmp_path / "s.png").stat().st_size > 1000


def test_as_many_steps_as_the_exact_ones_have_no_error():
    model = Fillerbuster.from_pretrained()
    report = run_tasks(model, rooms=1, views=2, size=32, seed=0, steps=(3, 3))
    assert all(row["latent_error"] == 0 and row.get("degrees_to_exact", 0.0) < 0.05 for row in report.rows)


@pytest.mark.parametrize(
    ("options", "said"), [({"rooms": 0, "views": 2}, "one room"), ({"rooms": 1, "views": 1}, "two")]
)
def test_tasks_need_a_room_and_two_views(options, said):
    with pytest.raises(ValueError, match=said):
        run_tasks(Fillerbuster.from_pretrained(), size=32, seed=0, **options)
