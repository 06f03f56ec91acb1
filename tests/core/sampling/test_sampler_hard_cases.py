"""Hard cases of sampling: every value and gradient is finite, whatever is known, however strong guidance, however few
or many views.
"""

import dataclasses

import pytest
import torch
from helpers.scenes.mixed_views import cameras, mixed_views, seeded
from helpers.tiny_models import tiny_model

from fb_core.conditioning import CONDITIONING_CHANNELS, Conditioning
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.sampling import (
    SOLVERS,
    GuidanceVariant,
    branches,
    evaluated_by,
    guidance_map,
    guided,
    imposed,
    integrate,
    known_channels,
    random_orders,
    tiled,
    time_grid,
)
from fb_core.views import Views
from method_configs.benchmarks.sampler.solvable_flows import Mixture

ALL_VARIANTS = GuidanceVariant(rescale=0.7, optimized_scale=True, zero_init=0.1, begin=0.9, end=0.1)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Fillerbuster:
    return tiny_model(tmp_path_factory.mktemp("hard"))


def assert_finite(done: Views) -> None:
    for field in dataclasses.fields(Views):
        assert bool(torch.isfinite(getattr(done, field.name)).all()), field.name


def complete(model: Fillerbuster, views: Views, **options) -> Views:
    return model.complete(views, generator=seeded(), sampling=SamplingConfig(**{"steps": 3, **options}))


@pytest.mark.parametrize("guidance", [1.0, 3.0, 7.0, 12.0, 20.0])
@pytest.mark.parametrize("solver", ["ab2", "corrected"])
def test_guidance_from_1_to_20(model, guidance, solver):
    assert_finite(
        complete(
            model, mixed_views(1, 1, 1), guidance_unknown=guidance, guidance_known=min(guidance, 1.1), solver=solver
        )
    )


@pytest.mark.parametrize("views", [1, 128])
def test_one_view_and_128_views(model, views):
    size = 16
    assert_finite(complete(model, mixed_views(views // 3, 0, views - views // 3, size, size), steps=2))
    windowed = complete(model, mixed_views(0, 0, views, size, size), steps=2, window=24)
    assert_finite(windowed)


@pytest.mark.parametrize("pixels", ["all", "none", "one"])
@pytest.mark.parametrize("rays", ["all", "none", "one"])
def test_all_known_nothing_known_and_a_single_known_pixel(model, pixels, rays):
    def mask(which: str) -> torch.Tensor:
        known = torch.full((2, 1, 16, 16), 1.0 if which == "all" else 0.0)
        if which == "one":
            known[0, 0, 5, 9] = 1.0
        return known

    whole = Views.known(torch.rand(2, 3, 16, 16, generator=seeded(1)), cameras(2, 16, 16))
    views = dataclasses.replace(whole, image_known=mask(pixels), rays_known=mask(rays))
    for options in ({}, {"known": "imposed", "solver": "corrected"}, {"guidance": ALL_VARIANTS}):
        done = complete(model, views, **options)
        assert_finite(done)
        assert torch.equal(done.images * views.image_known, whole.images * views.image_known)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_constant_black_and_white_images(model, value):
    views = mixed_views(1, 1, 1)
    views = dataclasses.replace(views, images=torch.full_like(views.images, value))
    for guidance in (GuidanceVariant(), ALL_VARIANTS):
        assert_finite(complete(model, views, guidance_unknown=20.0, guidance=guidance))


@pytest.mark.parametrize("strength", [1e-6, 0.5, 1.0])
def test_starts_at_both_ends_of_time(model, strength):
    views = mixed_views(1, 1, 1)
    done = model.complete(
        views, generator=seeded(), sampling=SamplingConfig(steps=3, strength=strength), current=mixed_views(3, 0, 0)
    )
    assert_finite(done)


@pytest.mark.parametrize("time", [0.0, 1e-8, 1 - 1e-7, 1.0])
@torch.no_grad()
def test_velocities_at_both_ends_of_time(model, time):
    sequence = torch.randn(1, 3, 66, 4, 4, generator=seeded())
    assert bool(torch.isfinite(model.dit(sequence, torch.tensor([time]))).all())
    mixture = Mixture.drawn(4, 16, generator=seeded())
    assert bool(
        torch.isfinite(mixture.velocity(torch.randn(3, 16, generator=seeded(), dtype=torch.float64), time)).all()
    )


def wholly(value: float) -> Conditioning:
    channels = torch.rand(3, CONDITIONING_CHANNELS, 4, 4, generator=seeded(2))
    channels[:, 32:] = value
    return Conditioning(channels=channels)


CONDITIONINGS = {
    "all known": lambda: wholly(1.0),
    "nothing known": lambda: wholly(0.0),
    "partly known": lambda: wholly(0.5),
    "constant latents": lambda: Conditioning(channels=torch.zeros(3, CONDITIONING_CHANNELS, 4, 4)),
}


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("name", CONDITIONINGS)
@pytest.mark.parametrize("guidance", [1.0, 20.0])
def test_gradients_through_a_whole_sampling(model, solver, name, guidance):
    """With respect to noise and conditioning, through guidance with all its variants, windows and imposed latents."""
    noise = torch.randn(3, 32, 4, 4, generator=seeded()).requires_grad_()
    given = Conditioning(channels=CONDITIONINGS[name]().channels.requires_grad_())
    null = Conditioning(channels=torch.zeros_like(given.channels))
    for variant in (GuidanceVariant(), ALL_VARIANTS):
        scale = guidance_map(given, known=min(guidance, 1.1), unknown=guidance)
        predict = tiled(evaluated_by(model.dit, branches(given, null, scale)), window=2, orders=random_orders(0))
        field = imposed(guided(predict, scale, variant=variant), given.channels[:, :32], noise, known_channels(given))
        end = integrate(field, noise, time_grid(3, shift=2.0), solver=solver)
        gradients = torch.autograd.grad(end.square().sum(), [noise, given.channels])
        assert bool(torch.isfinite(end).all()) and all(bool(torch.isfinite(gradient).all()) for gradient in gradients)


@pytest.mark.parametrize("solver", SOLVERS)
def test_gradients_where_nothing_moves(solver):
    """Zero velocities: lengths and spreads of nothing must not divide by zero."""
    start = torch.zeros(2, 32, 2, 2, requires_grad=True)
    end = integrate(lambda state, time: 0 * state, start, time_grid(4), solver=solver)
    (gradient,) = torch.autograd.grad(end.sum(), start)
    assert torch.equal(end, start) and torch.allclose(gradient, torch.ones_like(gradient))
