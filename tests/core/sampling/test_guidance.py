"""Laws of guidance: two scales, its variants, its interval, and known latents that are re-imposed."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fb_core.conditioning import CONDITIONING_CHANNELS, Conditioning
from fb_core.sampling import (
    SOLVERS,
    GuidanceVariant,
    SamplingConfig,
    combined,
    guidance_map,
    guided,
    imposed,
    integrate,
    known_channels,
    random_orders,
    started,
    time_grid,
)
from fb_core.sampling.randomness import noise_of, posterior_generators


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=seeded(seed))


# Variants ----------------------------------------------------------------------------------------------------------


def test_the_defaults_are_the_paper_s_guidance():
    velocities, scale = drawn(2, 3, 32, 4, 4), 7 * torch.rand(3, 32, 4, 4, generator=seeded(1))
    plain = velocities[0] + scale * (velocities[1] - velocities[0])
    assert torch.equal(combined(velocities, scale), plain)


@given(st.floats(1, 20), st.floats(0, 1), st.integers(0, 1000))
@settings(max_examples=100)
def test_rescaling_brings_the_spread_of_each_view_and_modality_back(scale, share, seed):
    velocities, scales = drawn(2, 3, 32, 4, 4, seed=seed), torch.full((3, 32, 4, 4), scale)
    plain, rescaled = combined(velocities, scales), combined(velocities, scales, variant=GuidanceVariant(rescale=share))
    for part in (slice(0, 16), slice(16, 32)):
        spread, wanted, got = (x[:, part].flatten(1).std(dim=1, correction=0) for x in (plain, velocities[1], rescaled))
        assert torch.allclose(got, (1 - share) * spread + share * wanted, rtol=1e-4)


def test_the_optimized_scale_makes_parallel_branches_agree():
    """If the null velocity is a multiple of the conditional one there is nothing to guide away from."""
    conditional = drawn(3, 32, 4, 4)
    velocities = torch.stack([0.3 * conditional, conditional])
    got = combined(velocities, torch.full((3, 32, 4, 4), 7.0), variant=GuidanceVariant(optimized_scale=True))
    assert torch.allclose(got, conditional, atol=1e-5)


@given(st.integers(0, 1000))
@settings(max_examples=50)
def test_the_optimized_scale_is_the_nearest_multiple(seed):
    null, conditional = drawn(2, 2, 32, 4, 4, seed=seed)
    fitted = combined(
        torch.stack([null, conditional]), torch.zeros(2, 32, 4, 4), variant=GuidanceVariant(optimized_scale=True)
    )
    for part in (slice(0, 16), slice(16, 32)):
        left = ((conditional - fitted) * null)[:, part].flatten(1).sum(dim=1)
        assert left.abs().max() < 1e-3, "what remains is orthogonal to the null velocity"


def test_zero_init_stands_still_at_the_noisy_start_and_costs_nothing():
    calls = []
    field = guided(
        lambda state, time, views: calls.append(time) or state[None],
        torch.ones(1, 32, 2, 2),
        variant=GuidanceVariant(zero_init=0.3),
    )
    start = drawn(1, 32, 2, 2)
    seen = []
    integrate(field, start, time_grid(4), on_trajectory=lambda at: seen.append(at.point.state))
    assert torch.equal(seen[0], start) and torch.equal(seen[1], start) and not torch.equal(seen[2], start)
    assert calls == [0.5, 0.25], "times 1 and 0.75 are in the first 30 %"


def test_a_limited_interval_evaluates_the_conditional_branch_alone_outside():
    calls = []

    def predict(state, time, views):
        calls.append(("both", time))
        return torch.stack([state, 2 * state])

    def conditional(state, time, views):
        calls.append(("one", time))
        return 2 * state[None]

    scale, state = torch.full((1, 32, 2, 2), 3.0), drawn(1, 32, 2, 2)
    variant = GuidanceVariant(begin=0.8, end=0.3)
    field = guided(predict, scale, variant=variant, unguided=conditional)
    plain = guided(predict, scale, variant=variant)
    for time, wanted in ((1.0, 2 * state), (0.8, 4 * state), (0.5, 4 * state), (0.3, 4 * state), (0.2, 2 * state)):
        assert torch.allclose(field(state, time), wanted) and torch.equal(plain(state, time), field(state, time))
    assert {time for name, time in calls if name == "one"} == {1.0, 0.2}


@pytest.mark.parametrize(
    "nonsense",
    [
        {"rescale": 1.5},
        {"rescale": -0.1},
        {"zero_init": 2.0},
        {"begin": 0.2, "end": 0.5},
        {"begin": 1.5},
        {"end": -0.5},
    ],
)
def test_nonsense_variants_are_refused(nonsense):
    with pytest.raises(ValueError, match="expected"):
        GuidanceVariant(**nonsense)


# Hard cases --------------------------------------------------------------------------------------------------------

VARIANTS = (
    GuidanceVariant(),
    GuidanceVariant(rescale=0.7),
    GuidanceVariant(optimized_scale=True, zero_init=0.04),
    GuidanceVariant(begin=0.8),
)
VELOCITIES = {
    "zeros": lambda: torch.zeros(2, 3, 32, 4, 4),
    "constants": lambda: torch.ones(2, 3, 32, 4, 4),
    "equal branches": lambda: drawn(1, 3, 32, 4, 4).repeat(2, 1, 1, 1, 1),
    "tiny": lambda: 1e-30 * drawn(2, 3, 32, 4, 4),
    "huge": lambda: 1e12 * drawn(2, 3, 32, 4, 4),
    "one branch zero": lambda: torch.stack([torch.zeros(3, 32, 4, 4), drawn(3, 32, 4, 4)]),
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", VELOCITIES)
def test_hard_velocities_are_finite_in_values_and_gradients(name, variant):
    velocities = VELOCITIES[name]().requires_grad_()
    for scale in (1.0, 7.0, 20.0):
        velocities.grad = None
        got = combined(velocities, torch.full((3, 32, 4, 4), scale), variant=variant)
        got.sum().backward()
        assert bool(torch.isfinite(got).all()) and bool(torch.isfinite(velocities.grad).all())


# Known latents -----------------------------------------------------------------------------------------------------


def conditioning_of(*known: float) -> Conditioning:
    """One view per value: image mask of that value, ray mask 1."""
    channels = torch.rand(len(known), CONDITIONING_CHANNELS, 4, 4, generator=seeded())
    channels[:, 32] = torch.tensor(known)[:, None, None]
    channels[:, 33] = 1.0
    return Conditioning(channels=channels)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("start", [1.0, 0.6])
def test_imposed_latents_are_seen_with_just_the_noise_of_each_time_and_end_as_given(solver, start):
    conditioning = conditioning_of(1.0, 0.5, 0.0)
    known, mask, noise = conditioning.channels[:, :32], known_channels(conditioning), drawn(3, 32, 4, 4)
    assert mask[0].min() == 1 and mask[1:, :16].max() == 0 and mask[:, 16:].min() == 1, (
        "a partly known latent is not imposed"
    )
    seen = []
    field = imposed(lambda state, time: seen.append((time, state)) or 100 * state, known, noise, mask)
    end = integrate(field, started(known, noise, start), time_grid(5, start=start), solver=solver)
    assert torch.allclose(end[mask > 0], known[mask > 0], atol=1e-5) and bool(
        (end[mask == 0] != known[mask == 0]).any()
    )
    for time, state in seen:
        assert torch.allclose(state[mask > 0], ((1 - time) * known + time * noise)[mask > 0], atol=1e-5)


@pytest.mark.parametrize("known", [0.0, 1.0])
def test_the_guidance_map_of_all_or_nothing_known_is_one_number(known):
    scale = guidance_map(conditioning_of(known, known), known=1.1, unknown=7.0)
    assert torch.allclose(scale[:, :16], torch.tensor(1.1 if known else 7.0))


# Randomness --------------------------------------------------------------------------------------------------------


@given(st.integers(0, 2**62), st.integers(1, 12), st.integers(1, 12))
@settings(max_examples=50)
def test_draws_of_a_view_do_not_depend_on_the_others(seed, few, many):
    few, many = min(few, many), max(few, many)
    assert torch.equal(noise_of(seed, many, (2, 2))[:few], noise_of(seed, few, (2, 2)))
    first, second = (torch.randn(4, generator=posterior_generators(seed, count)[few - 1]) for count in (few, many))
    assert torch.equal(first, second)
    order = random_orders(seed)
    longer = [view for view in order(0.5, 1, many).tolist() if view < few]
    assert longer == order(0.5, 1, few).tolist(), "more views leave the order of the others as it is"
    assert sorted(order(0.5, 0, many).tolist()) == list(range(many))


def test_orders_differ_between_evaluations_rounds_and_seeds_and_do_not_depend_on_what_ran_before():
    order = random_orders(1)
    drawn_orders = [order(time, number, 12).tolist() for time in (1.0, 0.999, 0.5) for number in (0, 1)] + [
        random_orders(2)(1.0, 0, 12).tolist()
    ]
    assert len({tuple(one) for one in drawn_orders}) == len(drawn_orders)
    assert random_orders(1)(0.5, 1, 12).tolist() == drawn_orders[5]


def test_every_place_in_an_order_is_equally_likely():
    orders = torch.stack([random_orders(seed)(0.5, 0, 4) for seed in range(400)])
    for view in range(4):
        share = (orders == view).float().mean(dim=0)
        assert (share - 0.25).abs().max() < 0.08


# Options -----------------------------------------------------------------------------------------------------------


def test_options_survive_a_model_folder():
    import dataclasses
    import json

    sampling = SamplingConfig(solver="heun", steps=9, guidance=GuidanceVariant(rescale=0.5, end=0.1))
    assert SamplingConfig.from_dict(json.loads(json.dumps(dataclasses.asdict(sampling)))) == sampling
    assert SamplingConfig.from_dict({}) == SamplingConfig()
    with pytest.raises(ValueError, match="sampling options: magic unknown to this version"):
        SamplingConfig.from_dict({"magic": 1})


def test_raymaps_have_a_smaller_budget():
    poses = SamplingConfig().for_poses()
    assert poses.steps < SamplingConfig().steps and poses.window == 8
    assert SamplingConfig(steps=3, window=5).for_poses() == SamplingConfig(steps=3, window=5)
