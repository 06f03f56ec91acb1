"""Laws of time grids, solvers and trajectories: closed-form ends, orders of convergence, bounds at few steps, exact
resumption.
"""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fb_core.sampling import SOLVERS, SamplingConfig, SamplingInterrupted, evaluations, integrate, time_grid
from method_configs.benchmarks.sampler.solvable_flows import Mixture, fine_endpoint, gaussian_endpoint, guided_flow

ORDERS = {"euler": 1, "heun": 2, "ab2": 2, "corrected": 2}


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def mixture_flow(guidance: float):
    everything = Mixture.drawn(6, 24, generator=seeded(3))
    return guided_flow(everything, everything.of(range(2)), guidance), torch.randn(
        4, 24, generator=seeded(4), dtype=torch.float64
    )


# Grids -------------------------------------------------------------------------------------------------------------


@given(st.integers(1, 200), st.floats(0.05, 20), st.sampled_from(["even", "reference"]), st.floats(0.001, 1))
@settings(max_examples=100)
def test_any_grid_descends_from_its_start_to_zero(steps, shift, grid, start):
    times = time_grid(steps, shift=shift, grid=grid, start=start)
    assert times[0] == pytest.approx(start) and times[-1] == 0.0
    assert all(later < earlier for earlier, later in itertools.pairwise(times))
    assert len(times) <= steps + 2


def test_a_later_start_keeps_the_later_times_and_makes_no_sliver():
    assert time_grid(4, start=0.6) == [0.6, 0.25, 0.0], "0.6 to 0.5 would be a sliver"
    assert time_grid(4, start=0.7) == [0.7, 0.5, 0.25, 0.0]
    assert time_grid(4, start=0.1) == [0.1, 0.0] and time_grid(4, start=1.0) == [1.0, 0.75, 0.5, 0.25, 0.0]


@pytest.mark.parametrize("nonsense", [{"grid": "cosine"}, {"start": 0.0}, {"start": 1.5}, {"shift": math.nan}])
def test_nonsense_grids_are_refused(nonsense):
    with pytest.raises(ValueError, match="expected"):
        time_grid(4, **nonsense)


# Solvers -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("guidance", [1.0, 3.0])
def test_guided_gaussians_end_where_the_closed_form_says(solver, guidance):
    generator = seeded(1)
    variance, condition = (0.2 + torch.rand(32, generator=generator, dtype=torch.float64) for _ in range(2))

    def law(spread: torch.Tensor) -> Mixture:
        return Mixture(
            means=torch.zeros(1, 32, dtype=torch.float64),
            variances=spread[None],
            log_weights=torch.zeros(1, dtype=torch.float64),
        )

    start = torch.randn(5, 32, generator=generator, dtype=torch.float64)
    field, wanted = (
        guided_flow(law(variance), law(condition), guidance),
        gaussian_endpoint(start, variance, condition, guidance),
    )
    assert torch.allclose(fine_endpoint(field, start, steps=60), wanted, atol=1e-5)
    errors = [
        float((integrate(field, start, time_grid(steps), solver=solver) - wanted).abs().max())
        for steps in (32, 64, 128)
    ]
    assert math.log2(errors[1] / errors[2]) > ORDERS[solver] - 0.3 and errors[2] < errors[1] < errors[0]


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("shift", [0.5, 1.0, 3.0])
def test_solvers_converge_with_their_order_on_uneven_grids(solver, shift):
    """A state that turns by one and a half times three radians, unevenly in time."""
    turn = torch.tensor([[0.0, 3.0], [-3.0, 0.0]], dtype=torch.float64)
    start = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    wanted, errors = start @ torch.matrix_exp(-1.5 * turn).T, []
    for steps in (128, 256):
        end = integrate(
            lambda state, time: (1 + time) * state @ turn.T, start, time_grid(steps, shift=shift), solver=solver
        )
        errors.append(float((end - wanted).abs().max()))
    assert math.log2(errors[0] / errors[1]) > ORDERS[solver] - 0.35


@pytest.mark.parametrize("solver", SOLVERS)
def test_straight_ways_are_exact_in_one_step(solver):
    data, noise = torch.randn(2, 3, 32, 4, 4, generator=seeded())
    for steps in (1, 2, 5):
        assert torch.allclose(
            integrate(lambda *_: noise - data, noise, time_grid(steps), solver=solver), data, atol=1e-5
        )


@pytest.mark.parametrize("guidance", [1.0, 3.0, 7.0, 20.0])
@pytest.mark.parametrize("shift", [0.5, 1.0, 3.0])
def test_the_corrected_solver_never_blows_up_at_few_steps(guidance, shift):
    """Others of higher order multiply the error a hundred times at few steps here; this one stays within twice
    Euler's.
    """
    field, start = mixture_flow(guidance)
    exact = fine_endpoint(field, start, steps=100)

    def error(solver: str, steps: int) -> float:
        return float(
            (integrate(field, start, time_grid(steps, shift=shift), solver=solver) - exact).norm() / exact.norm()
        )

    for steps in (2, 3, 4, 6, 8, 16):
        assert error("corrected", steps) < max(2 * error("euler", steps), error("euler", 1)), steps


@given(st.integers(0, 10**6), st.integers(1, 6), st.floats(1, 1e4))
@settings(max_examples=50)
def test_a_corrected_step_is_never_longer_than_seven_quarters_of_euler_s(seed, steps, size):
    """Whatever the velocities are: here they are noise."""
    generator = seeded(seed)
    velocities = [size * torch.randn(2, 8, generator=generator) for _ in range(steps)]
    rest = iter(velocities)
    end = integrate(lambda *_: next(rest), torch.zeros(2, 8), time_grid(steps), solver="corrected")
    most = sum(velocity.norm(dim=1) for velocity in velocities) / steps * 1.75
    assert bool((end.norm(dim=1) <= most * (1 + 1e-5)).all())


def test_the_default_needs_a_third_of_the_passes_of_the_original():
    """Guidance 3 and 7: Euler with 50 steps of three passes on the original's grid, against 16 of two."""
    for guidance in (3.0, 7.0):
        field, start = mixture_flow(guidance)
        exact = fine_endpoint(field, start, steps=100)
        original = integrate(field, start, time_grid(50, grid="reference"), solver="euler")
        ours = integrate(field, start, SamplingConfig(steps=16).times, solver=SamplingConfig().solver)
        assert (ours - exact).norm() <= (original - exact).norm()


@pytest.mark.parametrize("solver", SOLVERS)
def test_evaluations_are_counted_and_never_made_at_the_end(solver):
    seen = []
    integrate(lambda state, time: seen.append(time) or state, torch.zeros(1, 2), time_grid(5), solver=solver)
    assert len(seen) == evaluations(solver, 5) and min(seen) > 0 and seen[0] == 1.0


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_states_are_kept_in_single_precision_at_least(dtype):
    end = integrate(lambda state, time: state.to(dtype), torch.ones(1, 2, dtype=dtype), time_grid(3), solver="ab2")
    assert end.dtype == torch.promote_types(dtype, torch.float32)


# Trajectories ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("stop_at", [0, 1, 3])
def test_an_interrupted_trajectory_goes_on_with_the_same_bits(solver, stop_at):
    """Stopped by the network (a step half done is forgotten) or by a callback (a step done is kept)."""
    field, start = mixture_flow(3.0)
    times, calls = time_grid(5), itertools.count(1)

    def interrupted_field(state, time):
        if next(calls) > (2 * stop_at if solver == "heun" else stop_at):
            raise KeyboardInterrupt
        return field(state, time)

    whole = integrate(field, start, times, solver=solver)
    with pytest.raises(SamplingInterrupted) as stopped:
        integrate(interrupted_field, start, times, solver=solver)
    assert stopped.value.trajectory.step == stop_at and isinstance(stopped.value, KeyboardInterrupt)
    assert torch.equal(integrate(field, start, times, solver=solver, resume=stopped.value.trajectory), whole)


def test_a_callback_may_interrupt_and_its_step_is_kept():
    field, start = mixture_flow(3.0)

    def stop(done, of):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(SamplingInterrupted, match="after 2 of 4 steps") as stopped:
        integrate(field, start, time_grid(4), on_step=stop)
    assert stopped.value.trajectory.point.time == 0.5
    with pytest.raises(ValueError, match="along the same 9 times"):
        integrate(field, start, time_grid(8), resume=stopped.value.trajectory)


def test_a_trajectory_tells_time_and_where_it_leads():
    data, noise = torch.randn(2, 3, 32, 4, 4, generator=seeded())
    seen = []
    integrate(lambda *_: noise - data, noise, time_grid(4), on_trajectory=seen.append)
    assert [at.step for at in seen] == [1, 2, 3, 4] and [at.point.time for at in seen] == [0.75, 0.5, 0.25, 0.0]
    for at in seen:
        assert torch.allclose(at.point.data, data, atol=1e-5)
