"""Several samples of one round: each is what the model would give alone, what they become is nearer to the truth, and
how far they differ counts against them.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from helpers.scenes.completions import MeanFiller, box_points, captured, room_cameras, small
from helpers.scenes.mixed_views import mixed_views, seeded
from helpers.scenes.trusted import CONFIG, Knows, views_of
from helpers.tiny_models import tiny_model

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import plan_completion
from fb_core.completion.results.cache import CompletionCache
from fb_core.completion.results.completed_views import UNSAMPLED, CompletedViews
from fb_core.completion.rounds import CapturedView, run_completion
from fb_core.completion.samples import Question, draw, likeliest, made_of, variance_of
from fb_core.completion.trust import measured_trust
from fb_core.inpainter import BUNDLED_MODEL, Fillerbuster, SamplingConfig
from fb_core.networks.transformer.dit import DiT
from fb_core.views import Views

QUICK = SamplingConfig(steps=2, guidance_unknown=3.0)


class Noisy(MeanFiller):
    """The mean colour, and noise that the generator decides."""

    def complete(self, views, *, generator, sampling, on_step, prompt=None, current=None) -> Views:
        done = super().complete(views, generator=generator, sampling=sampling, on_step=on_step, prompt=prompt)
        noise = 0.1 * torch.randn(done.images.shape, generator=generator)
        return dataclasses.replace(done, images=(done.images + (1 - views.image_known) * noise).clamp(0, 1))


def drawn(count: int, *, seed: int = 0) -> list:
    """Pictures of one truth with independent errors, in 8 bits."""
    generator = torch.Generator().manual_seed(seed)
    truth = 0.25 + 0.5 * torch.rand(2, 24, 24, 3, generator=generator)
    each = [truth + 0.1 * torch.randn(truth.shape, generator=generator) for _ in range(count)]
    return [truth, *((one.clamp(0, 1) * 255).round().to(torch.uint8) for one in each)]


# ---- the model -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sampling",
    [
        QUICK,
        dataclasses.replace(QUICK, guidance_unknown=1.0, guidance_known=1.0),
        dataclasses.replace(QUICK, window=3),
        dataclasses.replace(QUICK, sample_posterior=True),
        dataclasses.replace(QUICK, strength=0.5),
    ],
    ids=["guided", "plain", "windows", "posterior", "started"],
)
def test_several_answers_are_what_single_calls_give_to_the_bit(tmp_path: Path, sampling: SamplingConfig) -> None:
    model, views = tiny_model(tmp_path), mixed_views()
    current = Views.cat([views[[0]]] * len(views)) if sampling.strength < 1 else None
    seeds = (3, 4, 3)
    several = model.complete_often(
        views, generators=[seeded(seed) for seed in seeds], sampling=sampling, current=current
    )
    for seed, answer in zip(seeds, several, strict=True):
        alone = model.complete(views, generator=seeded(seed), sampling=sampling, current=current)
        assert torch.equal(answer.images, alone.images) and torch.equal(answer.raymaps, alone.raymaps)


def test_known_tokens_that_stand_apart_are_computed_once_for_all_samples(monkeypatch) -> None:
    model, views, calls = Fillerbuster.from_pretrained(BUNDLED_MODEL), mixed_views(), []
    plain = DiT.run_known

    def counting(self, *arguments, **options):
        calls.append(1)
        return plain(self, *arguments, **options)

    monkeypatch.setattr(DiT, "run_known", counting)
    sampling = dataclasses.replace(model.recommended_sampling, steps=2)
    several = model.complete_often(views, generators=[seeded(1), seeded(2), seeded(3)], sampling=sampling)
    assert len(calls) == 1
    alone = model.complete(views, generator=seeded(3), sampling=sampling)
    assert torch.equal(several[2].images, alone.images)


def test_steps_are_counted_over_all_samples(tmp_path: Path) -> None:
    told = []
    tiny_model(tmp_path).complete_often(
        mixed_views(),
        generators=[seeded(1), seeded(2)],
        sampling=QUICK,
        on_step=lambda step, steps: told.append((step, steps)),
    )
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


# ---- what they become ------------------------------------------------------------------------------------------------


def test_a_single_sample_stays_as_it_is() -> None:
    _, one = drawn(1)
    made = made_of([one])
    assert torch.equal(made.images, one) and made.deviation is None


def test_equal_samples_are_themselves_and_do_not_differ() -> None:
    _, one = drawn(1)
    made = made_of([one] * 3)
    assert torch.equal(made.images, one) and made.deviation is not None and int(made.deviation.max()) == 0


def test_the_order_of_samples_means_nothing() -> None:
    _, *each = drawn(4)
    one, other = made_of(each), made_of(each[::-1])
    assert torch.equal(one.images, other.images) and torch.equal(one.deviation, other.deviation)


def test_the_likeliest_is_made_of_samples_and_nearer_to_the_truth_than_they_are() -> None:
    truth, *each = drawn(4)

    def error(images: torch.Tensor) -> float:
        return float((images.float() / 255 - truth).square().mean())

    nearest = made_of(each).images
    assert error(nearest) < 0.98 * sum(map(error, each)) / 4
    assert bool(torch.stack([(nearest == one).all(dim=-1) for one in each]).any(dim=0).all())


def test_a_neighbourhood_comes_from_one_sample() -> None:
    """Two possible rooms, a red and a blue one, and samples that are more often red: no mixture, and never blue."""
    red, blue = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.8])
    samples = torch.stack([color[None, :, None, None].expand(1, 3, 32, 32) for color in (red, blue, red)])
    assert torch.equal(likeliest(samples), samples[0])


def test_the_deviation_is_that_of_the_samples() -> None:
    _, *each = drawn(64)
    made = made_of(each)
    assert float(variance_of(made.deviation).mean()) == pytest.approx(0.1**2, rel=0.1)
    assert variance_of(None) is None


# ---- rounds, caches, checkpoints -------------------------------------------------------------------------------------


def completed(config: CompletionConfig, model) -> list[CompletedViews]:
    plan, views = plan_completion(room_cameras(), box_points(), config, size=16), captured(room_cameras())
    return list(run_completion(plan, [views[index] for index in plan.context], model, config))


def test_a_round_of_several_samples_knows_how_far_they_differ() -> None:
    (single, *_), (several, *_) = completed(small(), Noisy()), completed(small(samples=4), Noisy())
    assert single.deviation is None and several.deviation is not None
    assert float(variance_of(several.deviation).mean()) == pytest.approx(0.01, rel=0.2)
    assert all(one.seed == other.seed for one, other in zip(single.origins, several.origins, strict=True))


def test_more_samples_find_those_that_are_in_the_cache(tmp_path: Path) -> None:
    completed(small(cache_dir=tmp_path), Noisy())
    model = Noisy()
    with_cache, without = completed(small(cache_dir=tmp_path, samples=3), model), completed(small(samples=3), Noisy())
    assert len(model.asked) >= 2, "the first sample of the anchors was there, two were not"
    for one, other in zip(with_cache, without, strict=True):
        assert torch.equal(one.images, other.images) and torch.equal(one.deviation, other.deviation)
    again = Noisy()
    completed(small(cache_dir=tmp_path, samples=3), again)
    assert again.asked == []


def test_a_cached_round_is_announced_once_only_if_all_its_samples_are_there(tmp_path: Path) -> None:
    views, cache = mixed_views(), CompletionCache(tmp_path)
    question = Question(sequence=views, views=1, seed=5, sampling=QUICK)
    found = []

    def ask(samples: int) -> None:
        draw(
            question,
            Noisy(),
            samples=samples,
            cache=cache,
            on_found=lambda: found.append(samples),
        )

    for samples in (2, 2, 3, 3):
        ask(samples)
    assert found == [2, 3]


def test_the_deviation_survives_a_checkpoint_and_views_without_one_beside_it() -> None:
    several, single = completed(small(samples=3), Noisy())[0], completed(small(), Noisy())[0]
    back = CompletedViews.from_state(several.state())
    assert back.deviation is not None and torch.equal(back.deviation, several.deviation)
    both = CompletedViews.cat([single, several])
    assert both.deviation is not None and bool((both.deviation[: len(single)] == UNSAMPLED).all())
    assert bool(torch.isnan(variance_of(both.deviation[: len(single)])).all())
    assert torch.equal(both[list(range(len(single), len(both)))].deviation, several.deviation)
    assert CompletedViews.cat([single, single]).deviation is None
    old = single.state()
    del old["deviation"]
    assert CompletedViews.from_state(old).deviation is None
    assert views_of(1.0).deviation is None


def test_hidden_views_are_drawn_as_often_and_their_spread_is_a_source_of_trust() -> None:
    context = [
        CapturedView(image=view.image, known=view.known, camera=view.camera) for view in captured(room_cameras(8))
    ]
    model = Knows(context, 0.2)
    trust = measured_trust(context, model, dataclasses.replace(CONFIG, samples=3), size=16)
    assert len(model.asked) == 3 and trust.curve is not None
    alone = measured_trust(context, Knows(context, 0.2), CONFIG, size=16)
    assert trust.model < alone.model, "the likeliest of three is nearer"


@pytest.mark.parametrize("samples", [0, -1, 65])
def test_so_many_samples_are_refused_in_a_sentence(samples: int) -> None:
    with pytest.raises(ValueError, match=r"completion\.samples"):
        CompletionConfig(samples=samples)
