"""`fillerbuster bench costs`: powers of known laws, and a miniature of every curve."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from fb_core.files.ownership import require_own_or_new
from method_configs.benchmarks.costs import curves
from method_configs.benchmarks.costs.command import Costs, exponent, exponents


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_law_is_its_power(power):
    sizes = [10, 20, 50, 100, 2000]
    assert exponent(sizes, [3e-4 * size**power for size in sizes]) == pytest.approx(power, abs=1e-12)


def test_the_exponent_leaves_out_what_was_not_measured():
    assert exponent([1, 2, 4], [0.0, 2.0, 4.0]) == pytest.approx(1.0)
    assert exponent([1, 2, 4], [math.nan, 2.0, 8.0]) == pytest.approx(2.0)
    assert math.isnan(exponent([1, 2], [math.nan, 2.0])) and math.isnan(exponent([5, 5], [1.0, 2.0]))


def test_a_beginning_that_costs_something_shows_in_all_sizes_and_not_in_the_larger_half():
    sizes = (1, 10, 1000, 10_000)
    rows = [
        {"part": "p", "curve": "c", "of": "o", "size": size, "cpu_seconds": 5 + size, "peak_mb": 2 * size}
        for size in sizes
    ]
    (found,) = exponents(rows)
    assert (found["from"], found["to"]) == (1, 10_000)
    assert found["cpu_seconds_exponent"] < 0.9 < found["cpu_seconds_exponent_of_larger_half"] < 1.0
    assert found["peak_mb_exponent"] == pytest.approx(1.0)
    assert found["peak_mb_exponent_of_larger_half"] == pytest.approx(1.0)


def test_of_shares_known_the_plain_ratio_is_said():
    rows = [
        {"part": "p", "curve": "c", "of": "share known", "size": share, "cpu_seconds": seconds, "peak_mb": 4.0}
        for share, seconds in ((0.0, 3.0), (0.5, 2.0), (0.95, 0.5))
    ]
    (found,) = exponents(rows)
    assert found["cpu_seconds_first_over_last"] == 6.0 and found["peak_mb_first_over_last"] == 1.0
    assert "cpu_seconds_exponent" not in found


def test_every_curve_is_measured_told_and_kept(tmp_path: Path, monkeypatch):
    files = {"json": tmp_path / "costs.json", "figure": tmp_path / "costs.png", "keep": tmp_path / "kept"}
    Costs(quick=True, **files).run()
    rows = json.loads(files["json"].read_text())["rows"]
    measured = [row for row in rows if "size" in row]
    sizes = curves.QUICK
    wanted = {
        "captured views": sizes.views, "share known": sizes.shares, "Gaussians": sizes.gaussians,
        "pixels": tuple(side**2 for side in sizes.sides),
    }  # fmt: skip
    for of, expected in wanted.items():
        for curve in {row["curve"] for row in measured if row["of"] == of}:
            assert tuple(row["size"] for row in measured if (row["of"], row["curve"]) == (of, curve)) == expected
    assert {row["of"] for row in measured} == set(wanted)
    assert len({row["curve"] for row in measured if row["of"] == "captured views"}) == 3
    assert all(row["cpu_seconds"] > 0 for row in measured)
    assert len(rows) - len(measured) == 6, "one summary for each curve"
    assert files["figure"].stat().st_size > 1000
    require_own_or_new(files["figure"])  # so that the same command may draw it again

    def again(*_):
        raise AssertionError("what is kept is not measured again")

    monkeypatch.setattr("fb_core.evaluation.results.median_seconds", again)
    Costs(quick=True, keep=files["keep"]).run()
