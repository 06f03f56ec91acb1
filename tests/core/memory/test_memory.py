"""The estimate against the allocator, the cut that a budget makes, and what is said when nothing fits."""

import dataclasses
import re

import pytest
import torch
from helpers.scenes.mixed_views import mixed_views, seeded
from helpers.tiny_models import tiny_model

from fb_core.checkpoint import ModelConfig
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.memory.budget import GIB, available_bytes, bound, estimate, uncut
from fb_core.memory.live_bytes import LiveBytes
from fb_core.networks.transformer.dit import DiTConfig
from fb_core.networks.vae import IMAGE_VAE, RAYMAP_VAE, VAEConfig
from fb_core.views import Views

QUICK = SamplingConfig(steps=2)
RELEASED = ModelConfig(transformer=DiTConfig(), image_vae=IMAGE_VAE, raymap_vae=RAYMAP_VAE)
_VAE = VAEConfig(widths=(32, 64, 128, 128), encoder_resnets=1, decoder_resnets=1)
MEDIUM = ModelConfig(
    transformer=DiTConfig(heads=8, depth=4, text_width=0),
    image_vae=_VAE,
    raymap_vae=dataclasses.replace(_VAE, in_channels=6, norm="none", padding="replicate"),
)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Fillerbuster:
    return tiny_model(tmp_path_factory.mktemp("memory"))


def all_to_do(count: int, width: int, height: int) -> Views:
    """Nothing is known but the first view's rays, so that every view goes through every network."""
    views = mixed_views(count, 0, 0, width, height)
    posed = views.rays_known.clone()
    posed[1:] = 0
    return dataclasses.replace(views, image_known=torch.zeros_like(posed), rays_known=posed)


def allocated(job) -> int:
    """Most bytes that torch's CPU allocator held for `job`, from its own record (which sees the scratch of convolutions
    too).
    """
    from torch.profiler import ProfilerActivity, profile

    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        job()
    events = [event for event in record.profiler.kineto_results.events() if event.name() == "[memory]"]
    now = peak = 0
    for event in sorted(events, key=lambda event: event.start_ns()):
        now += event.nbytes()
        peak = max(peak, now)
    return peak


# Counting ----------------------------------------------------------------------------------------------------------


def test_live_bytes_count_what_lives_at_once():
    kept = torch.zeros(1000)
    with LiveBytes() as live:
        first = kept + 1  # 4000 bytes
        view = first[10:]  # none of its own
        del first
        assert live.now == 4000
        del view
        assert live.now == 0
        second = (kept * 2).double()  # 4000 while it becomes 8000
        assert (live.now, live.peak) == (8000, 12000)
        second.add_(1)
    assert live.peak == 12000


def test_meta_tensors_count_like_real_ones():
    def job(device: str) -> torch.Tensor:
        x = torch.ones(2, 8, 16, 16, device=device)
        tokens = torch.nn.functional.group_norm(x, 4).flatten(2).transpose(1, 2)[:, None].contiguous()
        return torch.nn.functional.scaled_dot_product_attention(tokens, tokens, tokens).sum()

    peaks = []
    for device in ("cpu", "meta"):
        with LiveBytes() as live:
            job(device)
        peaks.append(live.peak)
    assert peaks[1] == pytest.approx(peaks[0], rel=0.06)  # the real kernel also keeps one sum per query


# Estimate ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("views", "width", "height", "sampling"),
    [
        (3, 96, 90, QUICK),
        (6, 40, 56, dataclasses.replace(QUICK, views_at_once=1)),
        (5, 24, 32, dataclasses.replace(QUICK, steps=40, solver="euler")),
        (4, 40, 40, dataclasses.replace(QUICK, window=2)),
    ],
)
def test_estimate_equals_the_allocators_peak_within_a_fifth(model, views, width, height, sampling):
    """Without the tests' shape checks, which keep arguments alive for longer, it is within 2 percent."""
    short = dataclasses.replace(sampling, steps=min(sampling.steps, 4))
    expected = model.estimate(views, (height, width), short)
    measured = allocated(lambda: model.complete(all_to_do(views, width, height), generator=seeded(), sampling=short))
    assert expected.working == pytest.approx(measured, rel=0.2)


def test_the_quick_bound_lies_above_the_estimate(model):
    for views, size, config, prompted in (
        (1, (16, 16), model.config, False),
        (9, (48, 64), model.config, False),
        (40, (128, 128), MEDIUM, False),
        (4, (64, 64), RELEASED, True),
    ):
        expected = estimate(views, size, model=config, sampling=QUICK, prompted=prompted)
        assert expected.working <= bound(views, size, model=config, sampling=QUICK, prompted=prompted)[1]
        quick = uncut(views, size, None, model=config, sampling=QUICK, prompted=prompted)
        assert quick is None or quick == expected.cut


def test_the_released_model_s_weights():
    """645,917,824 + 83,821,011 parameters in the asked precision and 5,287,030 in float32; float16 leaves the
    autoencoder in float32.
    """
    full = estimate(1, (64, 64), torch.float32, model=RELEASED)
    assert full.weights == 4 * (645_917_824 + 83_821_011 + 5_287_030)
    half = estimate(1, (64, 64), torch.bfloat16, model=RELEASED)
    assert half.weights == 2 * (645_917_824 + 83_821_011) + 4 * 5_287_030
    assert estimate(1, (64, 64), torch.float16, model=RELEASED).weights == half.weights + 2 * 83_821_011


def test_more_of_anything_needs_more():
    few, many = (estimate(views, (64, 64), model=MEDIUM) for views in (4, 16))
    assert few.denoising < many.denoising and few.decoding < many.decoding and few.peak < many.peak
    assert estimate(4, (96, 64), model=MEDIUM).working > few.working
    unguided = SamplingConfig(guidance_known=1.0, guidance_unknown=1.0)
    assert estimate(4, (64, 64), model=MEDIUM, sampling=unguided).denoising < few.denoising


def test_memory_that_is_free_can_be_asked_for():
    free = available_bytes(torch.device("cpu"))
    assert free is None or 2**20 < free < 2**50
    assert available_bytes(torch.device("meta")) is None


# Budget ------------------------------------------------------------------------------------------------------------


def test_a_smaller_budget_cuts_finer_and_stays_inside_it():
    free = estimate(8, (128, 128), model=MEDIUM)
    budgets = [free.peak, free.weights + free.working // 2]
    found = [
        estimate(8, (128, 128), model=MEDIUM, sampling=SamplingConfig(memory_budget_bytes=budget)) for budget in budgets
    ]
    assert all(one.peak <= budget for one, budget in zip(found, budgets, strict=True))
    assert found[0].cut.views_decoded == 8 > found[1].cut.views_decoded


def test_large_views_are_decoded_in_tiles_and_branches_one_after_the_other():
    large = estimate(1, (1024, 1024), model=RELEASED)
    assert large.cut.tile is not None, "one whole view would take more than the autoencoders' usual share"
    many = estimate(64, (128, 128), model=MEDIUM)
    budget = many.weights + many.denoising * 3 // 4
    tight = estimate(64, (128, 128), model=MEDIUM, sampling=SamplingConfig(memory_budget_bytes=budget))
    assert (many.cut.branches, tight.cut.branches) == (2, 1) and tight.peak <= budget


def test_the_cut_changes_nothing_but_rounding(model):
    views = mixed_views(1, 1, 3, 72, 48)
    whole = model.complete(views, generator=seeded(), sampling=QUICK)
    expected = model.estimate(5, (48, 72), QUICK)
    tight = dataclasses.replace(QUICK, memory_budget_bytes=expected.weights + expected.working * 7 // 10)
    assert model.estimate(5, (48, 72), tight).cut.views_encoded < 5
    done = model.complete(views, generator=seeded(), sampling=tight)
    assert torch.allclose(done.images, whole.images, atol=1e-4) and torch.allclose(
        done.raymaps, whole.raymaps, atol=1e-4
    )


def test_tiles_and_single_branches_give_the_same_views(model, monkeypatch):
    from fb_core import inpainter
    from fb_core.memory.budget import Cut

    views = mixed_views(1, 1, 1, 72, 48)
    whole = model.complete(views, generator=seeded(), sampling=QUICK)
    monkeypatch.setattr(inpainter, "uncut", lambda *_, **__: Cut(views_encoded=1, views_decoded=1, tile=16, branches=1))
    done = model.complete(views, generator=seeded(), sampling=QUICK)
    assert torch.allclose(done.images, whole.images, atol=1e-4) and torch.allclose(
        done.raymaps, whole.raymaps, atol=1e-4
    )


def test_too_little_memory_says_what_would_fit():
    """And what it offers does fit, while one view more would not."""
    limited = SamplingConfig(memory_budget_bytes=GIB // 8)
    with pytest.raises(
        ValueError, match=r"8 views of 128x128 in float32 need at least \d\.\d\d GiB, got 0\.12 GiB; what would fit: "
    ) as told:
        estimate(8, (128, 128), model=MEDIUM, sampling=limited)
    count, side = re.search(r"fit: (\d+) views of this size, or 8 views of (\d+)x\2", str(told.value)).groups()
    assert 1 < int(count) < 8 and 16 < int(side) < 128
    assert estimate(int(count), (128, 128), model=MEDIUM, sampling=limited).peak <= GIB // 8
    assert estimate(8, (int(side), int(side)), model=MEDIUM, sampling=limited).peak <= GIB // 8
    with pytest.raises(ValueError, match="memory budget"):
        estimate(int(count) + 1, (128, 128), model=MEDIUM, sampling=limited)


def test_nothing_would_fit():
    with pytest.raises(ValueError, match="not even one view of 16x16 would fit; use a smaller model"):
        estimate(1, (16, 16), torch.bfloat16, model=MEDIUM, sampling=SamplingConfig(memory_budget_bytes=2**20))


def test_half_precision_is_offered():
    full = estimate(1, (32, 32), model=MEDIUM)
    with pytest.raises(ValueError, match="the same in bfloat16"):
        estimate(1, (32, 32), model=MEDIUM, sampling=SamplingConfig(memory_budget_bytes=full.weights))


def test_a_machine_without_memory_is_told_before_anything_runs(model, monkeypatch):
    from fb_core import inpainter

    monkeypatch.setattr(inpainter, "available_bytes", lambda device: 2**16)
    monkeypatch.setattr(model.dit, "forward", lambda *_: pytest.fail("the network ran"))
    with pytest.raises(ValueError, match="memory budget: 5 views of 32x32 in float32 need at least"):
        model.complete(mixed_views(), generator=seeded(), sampling=QUICK)


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="expected at least one view"):
        estimate(0, (16, 16), model=RELEASED)
    for field in ("memory_budget_bytes", "views_at_once", "window"):
        with pytest.raises(ValueError, match=f"{field}: expected at least 1, got 0"):
            SamplingConfig(**{field: 0})
