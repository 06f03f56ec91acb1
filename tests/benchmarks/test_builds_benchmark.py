"""This build against another one: the same views for both, in turns, seconds beside error."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fb_core.files.ownership import require_own_or_new
from method_configs.benchmarks import builds
from method_configs.benchmarks.builds import Builds

ROOT = Path(__file__).resolve().parents[2]


def test_a_build_against_itself_is_as_good_to_the_last_digit(tmp_path, monkeypatch):
    monkeypatch.setattr(builds, "_ROOMS_WITH_ERROR", 1)
    Builds(
        other=ROOT, cases=("2+1", "1+1x2"), rooms=2, json=tmp_path / "builds.json", figure=tmp_path / "builds.png"
    ).run()
    rows = json.loads((tmp_path / "builds.json").read_text())["rows"]
    assert [row["case"] for row in rows] == ["2+1", "2+1", "1+1x2", "1+1x2"]
    for mine, theirs in (rows[:2], rows[2:]):
        assert mine["psnr"] == theirs["psnr"] > 10 and mine["psnr_gain"] == mine["psnr_gain_error"] == 0
        assert mine["latent_error"] == theirs["latent_error"]
        assert 0.2 < mine["times_as_fast"] < 5 and mine["cpu_seconds"] > 0
    assert 0 < rows[0]["latent_error"] < 0.5 and rows[2]["latent_error"] is None
    assert (tmp_path / "builds.png").stat().st_size > 1000
    require_own_or_new(tmp_path / "builds.png")  # so that the same command may draw it again


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"other": ROOT / "docs"}, "expected the root of a checkout"),
        ({"other": ROOT, "cases": ("16",)}, r"expected KNOWN\+UNKNOWN views such as 16\+24, got '16'"),
        ({"other": ROOT, "cases": ("0+3",)}, r"got '0\+3'"),
        ({"other": ROOT, "cases": ("2+3x0",)}, r"got '2\+3x0'"),
        ({"other": ROOT, "rooms": 0}, "at least one room"),
        ({"other": ROOT, "cases": ()}, "expected at least one case or training step, got 0 cases and 0 steps"),
        ({"other": ROOT, "training_steps": -1}, "got 2 cases and -1 steps"),
    ],
)
def test_bad_options_are_one_sentence(options, said):
    with pytest.raises(ValueError, match=said):
        Builds(**options).run()
