"""Generation starts from what the splats show where they are firm, else from noise."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from helpers.plugin.datamanagers import (
    GreyFiller,
    ToySplats,
    generated,
    make,
    options,
    stand_in_model,  # noqa: F401
)

from fb_core.completion.results.completed_views import CompletedViews
from fb_core.views import Views


@pytest.fixture()
def starts(monkeypatch) -> list[tuple[Views | None, float]]:
    """What each generation starts from, and its strength; the stand-in answers as ever."""
    given, complete = [], GreyFiller.complete

    def watched(self, views, *, sampling, current=None, **options):
        given.append((current, sampling.strength))
        return complete(self, views, sampling=sampling, **options)

    monkeypatch.setattr(GreyFiller, "complete", watched)
    return given


def test_generation_starts_from_what_the_splats_show_where_they_are_firm(tiny_capture: Path, starts):
    """Their left half is a grey wall; latents at its edge are told wholly, everything else is left to noise."""
    generated(make(tiny_capture, options(at_step=200, start="render", strength=0.4)), step=200)
    (anchors, strength), (densified, _) = starts
    assert strength == 0.4 and len(anchors) == 3 + 4 and len(densified) == 3 + 4 + 2
    new = anchors[[3, 4, 5, 6]]
    assert bool((new.image_known[..., :12] == 1).all()) and not bool(new.image_known[..., 12:].any())
    assert torch.allclose(new.images[..., :12], torch.tensor(0.5), atol=1 / 255)
    assert not bool(anchors[[0, 1, 2]].image_known.all()), "the margins of fitted photos are not told"


@pytest.mark.parametrize(
    ("options_of_start", "step"),
    [({"start": "noise"}, 200), ({"start": "render", "strength": 1.0}, 200), ({"start": "render"}, 0)],
)
def test_generation_starts_from_noise_when_asked_at_strength_one_and_before_anything_is_trained(
    tiny_capture: Path, starts, options_of_start, step
):
    generated(make(tiny_capture, options(at_step=step, **options_of_start)), step=step)
    assert starts == [(None, 1.0)] * 2


def test_fog_and_emptiness_leave_generation_to_noise(tiny_capture: Path, starts, monkeypatch):
    """To the bit: what the model is given does not differ, nor do the views."""
    shown = ToySplats.get_outputs_for_camera
    wanted = generated(
        make(tiny_capture, options(at_step=200, start="noise", match_colors=False)), step=200
    ).pipeline.datamanager.generated_views
    for opacity in (0.0, 0.7):
        fog = {"accumulation": torch.full((16, 16, 1), opacity), "rgb": torch.rand(16, 16, 3)}
        monkeypatch.setattr(
            ToySplats,
            "get_outputs_for_camera",
            lambda self, one, fog=fog: shown(self, one) | (fog if int(one.width) == 16 else {}),
        )
        starts.clear()
        got = generated(
            make(tiny_capture, options(at_step=200, start="render", match_colors=False)), step=200
        ).pipeline.datamanager
        assert starts == [(None, 1.0)] * 2
        assert torch.equal(got.generated_views.images, wanted.images)


def test_a_run_that_goes_on_starts_its_rounds_where_the_whole_run_did(tiny_capture: Path, tmp_path: Path, starts):
    whole = make(tiny_capture, options(at_step=200, start="render"))
    generated(whole, tmp_path, step=200)
    state = whole.state_dict()
    kept = CompletedViews.from_state(state["_extra_state"]["views"]).of_round(0)
    state["_extra_state"] |= {"views": kept.state(), "finished": False}
    resumed = make(tiny_capture, options(at_step=200, start="render"))
    resumed.load_state_dict(state, strict=False)
    generated(resumed, tmp_path, step=200)
    assert len(starts) == 3
    for field in dataclasses.fields(Views):
        assert torch.equal(getattr(starts[2][0], field.name)[-2:], getattr(starts[1][0], field.name)[-2:])
