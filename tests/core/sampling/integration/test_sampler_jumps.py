"""Laws of velocities that jump: where told latents join, where zero-init lets go, and where guidance sets in or ends.

Over a jump nothing is extrapolated or averaged: the way is that of its smooth pieces, each integrated by itself, and
every solver keeps its order.
"""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from fb_core.sampling import (
    SOLVERS,
    GuidanceVariant,
    SamplingConfig,
    SamplingInterrupted,
    guided,
    imposed,
    integrate,
    time_grid,
)
from method_configs.benchmarks.sampler.solvable_flows import Mixture, fine_endpoint, guided_flow

ORDERS = {"euler": 1, "heun": 2, "ab2": 2, "corrected": 2}
EVERYTHING = Mixture.drawn(6, 24, generator=torch.Generator().manual_seed(3))
CONDITION = EVERYTHING.of(range(2))
START, TOLD = torch.randn(2, 4, 24, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
COUNTS = (torch.arange(24) < 12).double().expand(4, -1)
"""Half of each state is told."""
INTERVALS = (GuidanceVariant(begin=0.83), GuidanceVariant(end=0.27), GuidanceVariant(begin=0.77, end=0.31))


def flow(guidance: float = 3.0, variant: GuidanceVariant = GuidanceVariant()):
    return guided_flow(EVERYTHING, CONDITION, guidance, variant)


def straight_where_told(field):
    return lambda state, time: (START - TOLD).where(COUNTS > 0, field(state, time))


def by_hand(legs, start: Tensor = START, *, steps: int = 60) -> Tensor:
    """Legs (field, begin, end) one after the other, by the classical Runge-Kutta method in a time of their own that
    goes from 1 to 0.
    """
    for field, begin, end in legs:

        def own(state: Tensor, time: float, field=field, begin=begin, end=end) -> Tensor:
            return (begin - end) * field(state, end + (begin - end) * time)

        start = fine_endpoint(own, start, steps=steps)
    return start


def error(got: Tensor, wanted: Tensor) -> float:
    return float((got - wanted).norm() / wanted.norm())


def order_of(solver: str, field, wanted: Tensor, **grid) -> float:
    errors = [error(integrate(field, START, time_grid(steps, **grid), solver=solver), wanted) for steps in (32, 128)]
    return math.log(errors[0] / errors[1]) / math.log(4)


# Grids -------------------------------------------------------------------------------------------------------------


@given(
    st.integers(1, 60), st.floats(0.2, 5), st.lists(st.floats(0.01, 0.99), max_size=3, unique=True), st.floats(0.05, 1)
)
@settings(max_examples=150)
def test_a_grid_goes_through_any_times_and_from_the_last_on_as_if_it_started_there(steps, shift, through, start):
    times = time_grid(steps, shift=shift, start=start, through=through)
    inside = sorted((time for time in through if time < start), reverse=True)
    assert times[0] == start and times[-1] == 0 and set(inside) <= set(times)
    assert all(later < earlier for earlier, later in itertools.pairwise(times))
    last = [start, *inside][-1]
    assert times[times.index(last) :] == time_grid(steps, shift=shift, start=last)
    assert set(times) <= {*time_grid(steps, shift=shift), *inside, start}
    if not inside:
        assert times == time_grid(steps, shift=shift, start=start)


def test_a_time_to_go_through_takes_the_place_of_its_neighbour():
    assert time_grid(4, through=[0.6]) == [1.0, 0.75, 0.6, 0.25, 0.0], "0.6 to 0.5 would be a sliver"
    assert time_grid(4, through=[0.7]) == [1.0, 0.7, 0.5, 0.25, 0.0], "so would be 0.75 to 0.7"
    assert time_grid(4, through=[0.5]) == time_grid(4, through=[0.0, 1.0]) == time_grid(4), "it is there, or at an end"
    assert time_grid(1, through=[0.3]) == [1.0, 0.3, 0.0], "two legs have a step each"
    later = SamplingConfig(steps=16, strength=0.5)
    assert later.times_from_noise_too[-len(later.times) :] == later.times
    assert all(
        len(SamplingConfig(steps=steps, strength=0.5).times_from_noise_too) == steps + 1 for steps in range(2, 60)
    )


# Joins -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("strength", [0.05, 0.5, 0.61, 0.9])
@pytest.mark.parametrize("steps", [1, 3, 16])
def test_told_latents_join_in_two_legs_to_the_bit(solver, strength, steps):
    times = time_grid(steps, shift=2.0, through=[strength])
    upper, lower = (times[: times.index(strength) + 1], times[times.index(strength) :])
    middle = integrate(straight_where_told(flow()), START, upper, solver=solver)
    assert torch.allclose(middle[COUNTS > 0], ((1 - strength) * TOLD + strength * START)[COUNTS > 0]), (
        "until then the way is straight"
    )
    joined = integrate(imposed(flow(), TOLD, START, COUNTS, until=strength), START, times, solver=solver)
    assert torch.equal(joined, integrate(flow(), middle, lower, solver=solver))


@pytest.mark.parametrize(("strength", "guidance"), [(0.3, 3.0), (0.5, 1.0), (0.77, 7.0)])
def test_every_solver_keeps_its_order_over_the_join(strength, guidance):
    free = flow(guidance)
    wanted = by_hand([(straight_where_told(free), 1.0, strength), (free, strength, 0.0)])
    field = imposed(free, TOLD, START, COUNTS, until=strength)
    assert error(fine_endpoint(field, START, steps=120), wanted) < 1e-5
    for solver, order in ORDERS.items():
        assert order_of(solver, field, wanted, shift=2.0, through=[strength]) > order - 0.3, solver


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("stop_at", range(8))
def test_an_interruption_around_the_join_changes_no_bit_and_no_count(solver, stop_at):
    times = time_grid(8, shift=2.0, through=[0.5])
    seen, field = [], imposed(flow(), TOLD, START, COUNTS, until=0.5)

    def stop(done: int, of: int) -> None:
        seen.append((done, of))
        if done == stop_at:
            raise KeyboardInterrupt

    whole = integrate(field, START, times, solver=solver)
    resume = None
    if stop_at:
        with pytest.raises(SamplingInterrupted) as stopped:
            integrate(field, START, times, solver=solver, on_step=stop)
        resume = stopped.value.trajectory
    rest = integrate(field, START, times, solver=solver, resume=resume, on_step=lambda *at: seen.append(at))
    assert torch.equal(rest, whole) and seen == [(done, 8) for done in range(1, 9)]


def test_a_preview_at_the_join_still_shows_what_is_told():
    seen = []
    field = imposed(flow(), TOLD, START, COUNTS, until=0.5)
    integrate(
        field, START, time_grid(8, through=[0.5]), solver="corrected", on_trajectory=lambda at: seen.append(at.point)
    )
    (join,) = [point for point in seen if point.time == 0.5]
    assert torch.allclose(join.data[COUNTS > 0], TOLD[COUNTS > 0])


# Zero-init ---------------------------------------------------------------------------------------------------------


def guided_mixture(variant: GuidanceVariant, calls: list[float]):
    """`guided` on the two mixtures, whose 24 numbers stand in the first channels."""

    def predict(state: Tensor, time: float, views: Tensor | None) -> Tensor:
        calls.append(time)
        flat = state[:, :24, 0, 0].double()
        pair = torch.stack([EVERYTHING.velocity(flat, time), CONDITION.velocity(flat, time)]).float()
        return torch.cat([pair, torch.zeros(2, len(state), 8)], dim=2)[..., None, None]

    return guided(predict, torch.full((4, 32, 1, 1), 3.0), variant=variant)


NOISE = torch.cat([START, torch.zeros(4, 8)], dim=1).float()[..., None, None]


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("share", [0.04, 0.1, 0.3])
def test_after_standing_still_every_solver_sets_out_as_from_a_start(solver, share):
    """Nothing is remembered of velocities that were zeroed, nor evaluated before the end of standing still, by Heun
    neither.
    """
    calls, plain = [], guided_mixture(GuidanceVariant(), [])
    variant = GuidanceVariant(zero_init=share)
    field, times = guided_mixture(variant, calls), SamplingConfig(steps=16, guidance=variant).times
    end = integrate(field, NOISE, times, solver=solver)
    own = time_grid(16, shift=2.0, start=1 - share)
    assert torch.equal(end, integrate(plain, NOISE, own, solver=solver)) and times[-len(own) :] == own
    assert max(calls) == 1 - share, "standing still costs no evaluation"
    elsewhere = time_grid(9)
    moving = [time for time in elsewhere if time <= 1 - share]
    assert torch.equal(
        integrate(field, NOISE, elsewhere, solver=solver), integrate(plain, NOISE, moving, solver=solver)
    )


def test_every_solver_keeps_its_order_after_standing_still():
    variant = GuidanceVariant(zero_init=0.07)
    wanted, field = by_hand([(flow(), 0.93, 0.0)]), flow(variant=variant)
    assert error(fine_endpoint(field, START, steps=120), wanted) < 1e-5
    for solver, order in ORDERS.items():
        assert order_of(solver, field, wanted, shift=2.0, through=variant.jumps) > order - 0.3, solver


# Intervals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", INTERVALS)
def test_every_solver_keeps_its_order_where_guidance_sets_in_and_ends(variant):
    legs = [(flow(1.0), 1.0, variant.begin), (flow(), variant.begin, variant.end), (flow(1.0), variant.end, 0.0)]
    wanted, field = by_hand([leg for leg in legs if leg[1] > leg[2]]), flow(variant=variant)
    for solver, order in ORDERS.items():
        assert order_of(solver, field, wanted, shift=2.0, through=variant.jumps) > order - 0.3, solver
    assert SamplingConfig(guidance=variant).times == time_grid(24, shift=2.0, through=variant.jumps)


def test_guidance_jumps_where_it_changes_and_nowhere_else():
    assert GuidanceVariant().jumps == GuidanceVariant(rescale=0.7, optimized_scale=True).jumps == ()
    variant = GuidanceVariant(zero_init=0.1, begin=0.8, end=0.3)
    assert sorted(variant.jumps) == pytest.approx([0.3, 0.8, 0.9])
    for jump in variant.jumps:
        before, after = math.nextafter(jump, 1), jump
        assert (variant.acts_at(before), variant.stands_still_at(before)) != (
            variant.acts_at(after),
            variant.stands_still_at(after),
        )


def test_pieces_of_all_kinds_meet_in_one_sampling():
    """Told latents that join within an interval of guidance, after standing still: five pieces, and the right end."""
    variant = GuidanceVariant(zero_init=0.1, begin=0.8, end=0.3)
    field = imposed(flow(variant=variant), TOLD, START, COUNTS, until=0.5)
    still = straight_where_told(lambda state, time: torch.zeros_like(state))
    legs = [(still, 1.0, 0.9), (straight_where_told(flow(1.0)), 0.9, 0.8), (straight_where_told(flow()), 0.8, 0.5)]
    wanted = by_hand([*legs, (flow(), 0.5, 0.3), (flow(1.0), 0.3, 0.0)])
    sampling = SamplingConfig(steps=128, strength=0.5, guidance=variant)
    for solver in SOLVERS:
        got = integrate(field, START, sampling.times_from_noise_too, solver=solver)
        assert error(got, wanted) < (0.03 if solver == "euler" else 1e-3), solver
