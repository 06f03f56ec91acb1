"""Laws of the sampler: exact answers on solvable flows, guidance, and tiling that keeps everything attached to its
views.
"""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fb_core.conditioning import CONDITIONING_CHANNELS, Conditioning
from fb_core.sampling import (
    branches,
    evaluated_by,
    guidance_map,
    guided,
    integrate,
    random_orders,
    tiled,
    time_grid,
    windows,
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_conditioning(views: int, seed: int = 0) -> Conditioning:
    channels = torch.rand(views, CONDITIONING_CHANNELS, 4, 6, generator=seeded(seed))
    channels[:, -2:] = channels[:, -2:].round()
    return Conditioning(channels=channels)


def per_view_network(sequence: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """A network that treats views independently (so that windows cannot matter) and depends on state, conditioning and
    time.
    """
    return (
        torch.tanh(sequence[:, :, :32]) * time[:, None, None, None, None]
        + sequence[:, :, 32:64]
        - sequence[:, :, 64:65]
    )


@pytest.mark.parametrize("shift", [0.5, 1.0, 3.0])
def test_time_grid_goes_from_one_to_zero(shift):
    times = time_grid(7, shift=shift)
    assert times[0] == 1.0 and times[-1] == 0.0 and len(times) == 8
    assert all(later < earlier for earlier, later in itertools.pairwise(times))


@pytest.mark.parametrize(("steps", "shift"), [(0, 1.0), (-3, 1.0), (4, 0.0)])
def test_time_grid_refuses_nonsense(steps, shift):
    with pytest.raises(ValueError, match="expected"):
        time_grid(steps, shift=shift)


@pytest.mark.parametrize("solver", ["euler", "ab2"])
def test_straight_paths_are_integrated_exactly(solver):
    data, noise = torch.randn(2, 3, 32, 4, 4, generator=seeded())
    field = lambda state, time: noise - data  # noqa: E731
    assert torch.allclose(integrate(field, noise, time_grid(3, shift=2.0), solver=solver), data, atol=1e-5)


@pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("ab2", 2)])
def test_solvers_converge_with_their_order(solver, order):
    start = torch.ones(1, 32, 1, 1)
    error = []
    for steps in (32, 64):
        end = integrate(
            lambda state, time: state * math.cos(3 * time), start, time_grid(steps, shift=1.5), solver=solver
        )
        error.append(float((end - math.exp(-math.sin(3) / 3)).abs().max()))
    assert math.log2(error[0] / error[1]) > order - 0.25


def test_unknown_solver_is_refused():
    with pytest.raises(ValueError, match="expected one of euler, heun, ab2, corrected, got 'magic'"):
        integrate(lambda state, time: state, torch.zeros(1, 32, 1, 1), [1.0, 0.0], solver="magic")


def test_every_step_is_reported():
    seen = []
    integrate(
        lambda state, time: state,
        torch.zeros(1, 32, 1, 1),
        time_grid(3),
        on_step=lambda done, of: seen.append((done, of)),
    )
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_guidance_of_scale_one_is_the_conditional_prediction_and_costs_one_branch():
    conditioning, null = random_conditioning(3), random_conditioning(3, seed=1)
    calls = []

    def counting(sequence, time):
        calls.append(len(sequence))
        return per_view_network(sequence, time)

    state, scale = torch.randn(3, 32, 4, 6, generator=seeded()), torch.ones(3, 32, 4, 6)
    got = guided(evaluated_by(counting, branches(conditioning, null, scale)), scale)(state, 0.5)
    wanted = per_view_network(torch.cat([state, conditioning.channels], dim=1)[None], torch.tensor([0.5]))[0]
    assert torch.equal(got, wanted) and calls == [1]


def test_guidance_extrapolates_from_null_through_the_conditional_prediction():
    conditioning, null = random_conditioning(3), random_conditioning(3, seed=1)
    state = torch.randn(3, 32, 4, 6, generator=seeded())
    scale = torch.rand(3, 32, 4, 6, generator=seeded(2)) * 7
    got = guided(evaluated_by(per_view_network, branches(conditioning, null, scale)), scale)(state, 0.3)
    u, c = (
        per_view_network(torch.cat([state, x.channels], dim=1)[None], torch.tensor([0.3]))[0]
        for x in (null, conditioning)
    )
    assert torch.allclose(got, u + scale * (c - u), atol=1e-6)


def test_guidance_map_has_the_known_scale_where_known_per_modality():
    conditioning = random_conditioning(2)
    scale = guidance_map(conditioning, known=1.1, unknown=7.0)
    image, rays = scale[:, :16], scale[:, 16:]
    assert torch.allclose(image, torch.where(conditioning.image_known > 0, 1.1, 7.0).expand_as(image))
    assert torch.allclose(rays, torch.where(conditioning.rays_known > 0, 1.1, 7.0).expand_as(rays))


@given(st.permutations(range(5)), st.sampled_from([None, 2, 3, 5]))
@settings(max_examples=25, deadline=None)
def test_guidance_map_follows_its_views_under_any_permutation(order, window):
    """The whole sampler is equivariant when the network is: known scales never land on unknown views."""
    conditioning, null = random_conditioning(5), random_conditioning(5, seed=1)
    noise = torch.randn(5, 32, 4, 6, generator=seeded(3))

    def sample(views: list[int]) -> torch.Tensor:
        chosen = Conditioning(channels=conditioning.channels[views])
        scale = guidance_map(chosen, known=1.1, unknown=7.0)
        predict = evaluated_by(per_view_network, branches(chosen, Conditioning(channels=null.channels[views]), scale))
        field = guided(tiled(predict, window=window, rounds=2, orders=random_orders(4)), scale)
        return integrate(field, noise[views], time_grid(4), solver="ab2")

    assert torch.allclose(sample(list(order)), sample([0, 1, 2, 3, 4])[list(order)], atol=1e-4)


@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_windows_are_full_have_no_repeats_and_visit_every_view(count, size, seed):
    order = torch.randperm(count, generator=seeded(seed))
    pieces = windows(count, size, order=order)
    assert set(torch.cat(pieces).tolist()) == set(range(count))
    for piece in pieces:
        assert len(piece) == min(size, count) and len(set(piece.tolist())) == len(piece)


def test_a_window_that_holds_everything_is_one_call_in_the_given_order():
    state = torch.randn(5, 32, 4, 6, generator=seeded())
    seen = []

    def predict(part, time, views):
        seen.append((part, views))
        return part[None]

    tiled(predict, window=8, rounds=3, orders=random_orders(0))(state, 1.0)
    assert len(seen) == 1 and torch.equal(seen[0][0], state) and seen[0][1] is None


@pytest.mark.parametrize("window", [1, 2, 3, 7])
def test_tiling_does_not_change_a_network_that_treats_views_independently(window):
    state = torch.randn(7, 32, 4, 6, generator=seeded())
    predict = evaluated_by(per_view_network, [random_conditioning(7), random_conditioning(7, seed=1)])
    tiles = tiled(predict, window=window, rounds=3, orders=random_orders(0))(state, 0.5)
    assert torch.allclose(tiles, predict(state, 0.5), atol=1e-6)


@pytest.mark.parametrize("arguments", [{"window": 0}, {"window": 2, "rounds": 0}])
def test_tiling_refuses_nonsense(arguments):
    with pytest.raises(ValueError, match="at least 1"):
        tiled(evaluated_by(per_view_network, [random_conditioning(2)]), **arguments)
