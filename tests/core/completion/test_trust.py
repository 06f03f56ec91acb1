"""How far a model is believed: a perfect one wholly, one that knows nothing hardly; unknown pixels count nowhere; kept
and drawn by.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers.scenes.completions import room_cameras
from helpers.scenes.trusted import CONFIG, Knows, views_of

from fb_core.completion.results.cache import CompletionCache
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.rounds import CapturedView, fitted_view
from fb_core.completion.trust import LEAST, Trust, measured_trust
from fb_nerfstudio.generation.bank import Bank


def photos(count: int = 8) -> list[CapturedView]:
    """Pictures of a smooth colourful wall, each another part of it."""
    views = []
    for index, camera in enumerate(room_cameras(count)):
        x = torch.linspace(index, index + 1, 16).expand(16, 16)
        image = torch.stack([0.5 + 0.5 * torch.sin(x * (channel + 1) / 2) for channel in range(3)])
        views.append(CapturedView(image=image, known=torch.ones(1, 16, 16), camera=camera))
    return views


def test_a_model_that_knows_the_scene_is_believed_wholly_and_one_that_knows_nothing_hardly() -> None:
    context = photos()
    good, bad = (measured_trust(context, Knows(context, noise), CONFIG, size=16) for noise in (0.0, 1.0))
    assert good.value == 1.0 and good.model < 1e-10
    assert (
        bad.value == LEAST and "worse than the mean colour" in bad.in_words and "fillerbuster convert" in bad.in_words
    )
    assert "better than the mean colour" in good.in_words and "convert" not in good.in_words


def test_trust_falls_as_errors_grow_and_is_the_share_of_the_error_that_the_model_does_away_with() -> None:
    context = photos()
    values = [
        measured_trust(context, Knows(context, noise), CONFIG, size=16).value for noise in (0.0, 0.05, 0.1, 0.2, 0.4)
    ]
    assert values == sorted(values, reverse=True) and 0.1 < values[2] < 1
    told = Trust(hidden=2, model=0.01, mean=0.04, nearest=0.05)
    assert (
        told.value == pytest.approx(0.75)
        and "6.0 dB better than the mean colour, 7.0 dB better than the nearest photo" in told.in_words
    )
    assert dataclasses.replace(told, nearest=0.02).value == pytest.approx(0.5)


@pytest.mark.parametrize(("count", "hidden"), [(1, 0), (3, 0), (4, 1), (8, 2), (16, 4), (30, 4)])
def test_a_quarter_is_hidden_but_never_the_first_view(count: int, hidden: int) -> None:
    context = photos(count)
    model = Knows(context)
    trust = measured_trust(context, model, CONFIG, size=16)
    assert trust.hidden == hidden
    if hidden == 0:
        assert trust.value == 1.0 and math.isnan(trust.model) and not model.asked and "in full" in trust.in_words
        return
    (asked,) = model.asked
    known = asked.image_known.flatten(1).amax(dim=1)
    assert len(asked) == count and int((known == 0).sum()) == hidden and bool((known[-hidden:] == 0).all())
    assert torch.equal(asked.raymaps[0], fitted_view(context[0], 16).raymaps[0]), (
        "the frame stays that of the first view"
    )
    assert float(asked.images[-hidden:].abs().sum()) == 0, "nothing of the hidden pictures is told"


def test_unknown_pixels_of_hidden_views_count_nowhere() -> None:
    context = photos()
    masked = []
    for view in context:
        known = torch.ones(1, 16, 16)
        known[:, :, :8] = 0
        masked.append(dataclasses.replace(view, known=known, image=torch.where(known > 0, view.image, torch.rand(1))))
    assert measured_trust(masked, Knows(context), CONFIG, size=16).model < 1e-10


def test_the_same_seed_measures_the_same() -> None:
    context = photos()
    first, again, other = (
        measured_trust(context, Knows(context, 0.1), dataclasses.replace(CONFIG, seed=seed), size=16)
        for seed in (0, 0, 1)
    )
    assert first == again and other.model != first.model


def test_less_believed_views_are_drawn_more_seldom_and_their_loss_counts_less() -> None:
    full, half = Bank.of(views_of(1.0), "cpu"), Bank.of(views_of(0.5), "cpu")
    assert full.share(most=1.0, captured=6) == pytest.approx(3 / 9)
    assert half.share(most=1.0, captured=6) == pytest.approx(1.5 / 7.5)
    assert half.batch(0, as_float=False)[1]["view_weight"] == pytest.approx(0.5)


def test_trust_survives_a_checkpoint_and_the_run_s_folder(tmp_path) -> None:
    views = views_of(1.0).believed(0.25)
    assert views_of(1.0).believed(None).origins[0].trust == 1.0
    assert CompletedViews.from_state(views.state()).origins[0].trust == 0.25
    capture = views.save_capture(tmp_path / "views")
    assert {frame.extra["trust"] for frame in capture.frames} == {0.25}
    with pytest.raises(ValueError, match="expected a trust from 0 to 1"):
        views.believed(1.5)


def test_with_a_cache_the_model_is_tried_once_and_means_the_same(tmp_path) -> None:
    """A run that begins anew after a kill does not generate the hidden views a second time."""
    context, cache = photos(), CompletionCache(tmp_path / "cache")
    model = Knows(context, 0.1)
    fresh = measured_trust(context, Knows(context, 0.1), CONFIG, size=16)
    first, again = (measured_trust(context, model, CONFIG, size=16, cache=cache) for _ in range(2))
    assert fresh == first == again and len(model.asked) == 1
    measured_trust(context, model, dataclasses.replace(CONFIG, seed=1), size=16, cache=cache)
    assert len(model.asked) == 2, "another seed is another trial"
