"""Completion that starts from current views, goes on after an interruption and tells of its progress."""

import dataclasses

import pytest
import torch
from helpers.scenes.mixed_views import cameras, mixed_views, seeded
from helpers.tiny_models import tiny_model

from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.sampling import SOLVERS, Point, integrate
from fb_core.views import Views

QUICK = SamplingConfig(steps=2, guidance_unknown=3.0)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Fillerbuster:
    return tiny_model(tmp_path_factory.mktemp("inpainter"))


def current_views() -> Views:
    """Whole views that are not those of `mixed_views`."""
    return Views.known(torch.rand(5, 3, 32, 32, generator=seeded(11)), cameras(5))


def test_the_same_call_gives_the_same_bits_whatever_ran_before(model):
    views, sampling = mixed_views(2, 1, 2), dataclasses.replace(QUICK, window=3, rounds=2, sample_posterior=True)
    wanted = model.complete(views, generator=seeded(), sampling=sampling)
    torch.randn(7)
    model.complete(mixed_views(1, 0, 3), generator=seeded(5), sampling=QUICK)
    torch.manual_seed(99)
    got = model.complete(views, generator=seeded(), sampling=sampling)
    assert torch.equal(got.images, wanted.images) and torch.equal(got.raymaps, wanted.raymaps)


def test_a_view_more_leaves_the_others_alone_when_views_do_not_see_each_other(model):
    """Windows of one view: noise, posterior and prediction of a view depend on nothing else. (The last view has nothing
    known.)
    """
    views, sampling = mixed_views(2, 1, 2), dataclasses.replace(QUICK, window=1, sample_posterior=True)
    fewer = model.complete(views[:4], generator=seeded(), sampling=sampling).images
    assert torch.allclose(model.complete(views, generator=seeded(), sampling=sampling).images[:4], fewer, atol=1e-5)


def test_a_low_strength_stays_near_the_current_views_and_a_high_one_does_not(model):
    views, current = mixed_views(1, 0, 4), current_views()

    def done(strength: float) -> torch.Tensor:
        sampling = SamplingConfig(steps=6, guidance_unknown=1.0, strength=strength)
        return model.complete(views, generator=seeded(), sampling=sampling, current=current).images

    through_the_autoencoder = done(1e-6)
    distances = [float((done(strength) - through_the_autoencoder)[1:].abs().mean()) for strength in (0.003, 0.3, 0.9)]
    assert distances[0] < 0.2 * distances[2] and distances[0] < distances[1] < distances[2]
    assert torch.equal(done(0.3)[0], views.images[0]), "known views stay as given"


def test_strength_costs_only_the_steps_that_are_left(model):
    seen = []
    sampling = SamplingConfig(steps=10, strength=0.5, shift=1.0)
    model.complete(
        mixed_views(),
        generator=seeded(),
        sampling=sampling,
        current=current_views(),
        on_step=lambda *at: seen.append(at),
    )
    assert seen[-1] == (5, 5)


def partly_current(views: Views) -> Views:
    """Of the last view the left half, of all others what is known anyway; loud numbers where nothing is told."""
    current, told = current_views(), views.image_known.clone()
    told[-1, ..., :16] = 1
    return dataclasses.replace(current, images=torch.where(told > 0, current.images, torch.nan), image_known=told)


def test_current_views_that_tell_nothing_new_leave_pure_noise_to_the_bit(model):
    views, sampling = mixed_views(2, 1, 2), dataclasses.replace(QUICK, strength=0.5)
    current = current_views()
    loud = torch.where(views.image_known > 0, current.images, torch.nan)
    nothing = dataclasses.replace(current, images=loud, image_known=views.image_known)
    wanted = model.complete(views, generator=seeded(), sampling=QUICK)
    assert torch.equal(
        model.complete(views, generator=seeded(), sampling=sampling, current=nothing).images, wanted.images
    )
    whole = dataclasses.replace(QUICK, strength=1.0)
    assert torch.equal(
        model.complete(views, generator=seeded(), sampling=whole, current=partly_current(views)).images, wanted.images
    )


def test_latents_that_count_go_straight_until_the_strength_and_all_others_start_as_noise(model):
    sampling, generator = SamplingConfig(steps=6, guidance_unknown=3.0), seeded(3)
    plain = model.denoising(mixed_views(2, 1, 2), seed=0, sampling=sampling)
    current, counts = torch.randn(5, 32, 4, 4, generator=generator), torch.zeros(5, 32, 4, 4)
    counts[3, :, :2] = 1
    started = dataclasses.replace(
        plain, sampling=dataclasses.replace(sampling, strength=0.4), current=current, counts=counts
    )
    points = [Point(state=started.start(), time=1.0)]
    started.run(on_trajectory=lambda at: points.append(at.point))
    assert torch.equal(points[0].state, plain.noise) and [point.time for point in points] == started.times
    assert 0.4 in started.times and abs(len(started.times) - len(sampling.times)) <= 1, (
        "they join at the strength, in as many steps"
    )
    waiting = [point for point, before in zip(points[1:], points, strict=False) if before.time > 0.4]
    assert len(waiting) >= 3
    for point in waiting:
        straight = (1 - point.time) * current + point.time * plain.noise
        assert torch.allclose(point.state[3, :, :2], straight[3, :, :2], atol=1e-5)
        assert not torch.allclose(point.state[3, :, 2:], straight[3, :, 2:], atol=1e-2)
    assert not torch.allclose(points[-1].state[3, :, :2], current[3, :, :2], atol=1e-2), (
        "the network has moved it since"
    )


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(
    "options", [{}, {"guidance_unknown": 1.0, "guidance_known": 1.0}, {"known": "imposed"}, {"window": 2}]
)
def test_latents_that_join_make_two_legs_that_know_nothing_of_each_other(model, solver, options):
    """Down to the strength the told latents' straight way beside the plain velocity; from there the times of views that
    are told wholly.
    """
    sampling = SamplingConfig(**{"steps": 7, "guidance_unknown": 3.0, "solver": solver} | options)
    plain = model.denoising(mixed_views(2, 1, 2), seed=0, sampling=sampling)
    current, counts = torch.randn(5, 32, 4, 4, generator=seeded(3)), torch.zeros(5, 32, 4, 4)
    counts[3:, :, :2] = 1
    later = dataclasses.replace(sampling, strength=0.4)
    joined = dataclasses.replace(plain, sampling=later, current=current, counts=counts)
    free, straight, upper = plain.field(), plain.noise - current, [time for time in joined.times if time >= 0.4]
    middle = integrate(
        lambda state, time: straight.where(counts > 0, free(state, time)), plain.noise, upper, solver=solver
    )
    assert torch.allclose(joined.run(), integrate(free, middle, later.times, solver=solver), atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("stop_at", [3, 4, 5])
def test_a_completion_interrupted_around_the_join_goes_on_to_the_same_bits(model, solver, stop_at):
    views, sampling = mixed_views(2, 1, 2), SamplingConfig(steps=6, guidance_unknown=3.0, solver=solver, strength=0.45)
    times, current, seen = sampling.times_from_noise_too, partly_current(views), []
    assert times.index(0.45) == 4 and len(times) == 7

    def stop(done, of):
        seen.append((done, of))
        if done == stop_at:
            raise KeyboardInterrupt

    whole = model.complete(views, generator=seeded(), sampling=sampling, current=current)
    with pytest.raises(KeyboardInterrupt, match=f"stopped after {stop_at} of 6 steps") as stopped:
        model.complete(views, generator=seeded(), sampling=sampling, current=current, on_step=stop)
    rest = {"current": current, "resume": stopped.value, "on_step": lambda done, of: seen.append((done, of))}
    resumed = model.complete(views, generator=seeded(77), sampling=sampling, **rest)
    assert seen == [(done, 6) for done in range(1, 7)] and torch.equal(resumed.images, whole.images)


def test_bad_current_views_are_refused(model):
    sampling = SamplingConfig(steps=2, strength=0.5)
    with pytest.raises(ValueError, match="needs views to start from"):
        model.complete(mixed_views(), generator=seeded(), sampling=sampling)
    with pytest.raises(ValueError, match="current: expected 5 views of 32x32"):
        model.complete(mixed_views(), generator=seeded(), sampling=sampling, current=current_views()[:3])
    broken = dataclasses.replace(current_views(), images=torch.full((5, 3, 32, 32), torch.nan))
    with pytest.raises(ValueError, match="current: pixels or rays are NaN"):
        model.complete(mixed_views(), generator=seeded(), sampling=sampling, current=broken)


@pytest.mark.parametrize(
    "options", [{"solver": "corrected"}, {"window": 3, "rounds": 2}, {"reference_compatible": True}]
)
def test_an_interrupted_completion_goes_on_to_the_same_bits(model, options):
    views, sampling = mixed_views(), dataclasses.replace(QUICK, steps=4, **options)

    def stop(done, of):
        if done == 2:
            raise KeyboardInterrupt

    whole = model.complete(views, generator=seeded(), sampling=sampling)
    with pytest.raises(KeyboardInterrupt, match="stopped after 2 of 4 steps") as stopped:
        model.complete(views, generator=seeded(), sampling=sampling, on_step=stop)
    rest = []
    resumed = model.complete(
        views, generator=seeded(77), sampling=sampling, resume=stopped.value, on_step=lambda done, of: rest.append(done)
    )
    assert rest == [3, 4] and torch.equal(resumed.images, whole.images) and torch.equal(resumed.raymaps, whole.raymaps)
    assert torch.equal(model.complete(views, generator=seeded(), sampling=sampling).images, whole.images), (
        "the model is as it was"
    )
