"""Thousands of draws over masks, conditioning, flow, sampling, views and splats: finite answers, one clear sentence for
the rest.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers.fuzz_draws import ALL, FAST, Dice, faults

from fb_core import conditioning, flow, masks
from fb_core.sampling import (
    GRIDS,
    SOLVERS,
    GuidanceVariant,
    SamplingConfig,
    combined,
    guidance_map,
    imposed,
    integrate,
    noise_of,
    random_orders,
    started,
    tiled,
    time_grid,
    windows,
)
from fb_core.splatting.rasterizer import rasterization
from fb_core.splatting.spherical_harmonics import sh_colors
from fb_core.views import Views


def mask_makers(dice: Dice) -> Any:
    height, width, count = dice.number(1, 40), dice.number(1, 40), dice.of(0, 1, 4, 9)
    mixture = masks.training_mixture(
        count,
        height,
        width,
        generator=dice.generator,
        known=dice.bad(dice.of(None, 0), 99, -1),
        unknown=dice.bad(None, 99, -3),
        in_order=dice.chance(0.5),
    )
    holes = masks.partly_known(height, width, generator=dice.generator)
    dropped = masks.drop_conditioning(dice.generator, share=dice.of(0.0, 0.5, 1.0))
    grown = masks.grow_hole(mixture, pixels=dice.of(-1, 0, 1, 5, 50)) if count else mixture
    if height % 8 or width % 8:
        height, width = dice.bad((8 * height, 8 * width), (height, width))
    grid = masks.to_latent_grid(dice.mask(count, 1, height, width))
    answer = (mixture, holes, grown, grid)
    assert all(0 <= float(one.min()) and float(one.max()) <= 1 for one in answer if one.numel()) and len(dropped) == 2
    return answer


def known_parts(dice: Dice) -> Any:
    count, height, width = dice.of(0, 1, 3), dice.number(1, 9), dice.number(1, 9)
    known = dice.mask(count, 1, height, width)
    values = torch.where(known > 0, dice.normal(count, 3, height, width), dice.of(math.nan, math.inf, 1e30))
    return conditioning.only_known(values, known), conditioning.split(dice.normal(count, 32, 2, 2))


def channels(dice: Dice) -> Any:
    count = dice.of(0, 1, 3)
    image, rays = (dice.normal(count, 16, 2, 3) for _ in range(2))
    told = conditioning.assemble(image, rays, dice.mask(count, 1, 2, 3), dice.mask(count, 1, 2, 3))
    state = dice.normal(count, 32, 2, 3)
    scale = guidance_map(told, known=dice.of(1.0, 1.1), unknown=dice.of(1.0, 7.0))
    variant = GuidanceVariant(
        rescale=dice.bad(dice.of(0.0, 0.7, 1.0), -1.0, 2.0, math.nan),
        optimized_scale=dice.chance(0.5),
        zero_init=dice.of(0.0, 0.04),
        begin=dice.bad(1.0, -1.0, 0.0, math.nan),
        end=dice.of(0.0, 0.1),
    )
    velocities = dice.of(1.0, 0.0, 1e6) * dice.normal(dice.of(1, 2), count, 32, 2, 3)
    return conditioning.join(state, told), combined(
        velocities.float(), scale.float(), variant=variant, acts=dice.chance(0.8)
    )


def flows(dice: Dice) -> Any:
    batch = dice.of(0, 1, 3)
    data, noise = dice.normal(batch, 2, 4, 3, 3), dice.normal(batch, 2, 4, 3, 3)
    time = torch.rand(batch, generator=dice.generator).double()
    state, speed = flow.at_time(data, noise, time), flow.velocity(data, noise)
    again = state - time[:, None, None, None, None] * speed
    assert torch.allclose(again, data, atol=1e-9)
    loss = flow.masked_loss(data, noise, dice.mask(batch, 2, 1, 3, 3)) if batch else torch.zeros(())
    return state, speed, loss, flow.logit_normal_times(batch, generator=dice.generator)


def time_grids(dice: Dice) -> Any:
    steps = dice.bad(dice.of(1, 2, 3, 24, 200), 0, -1)
    options: dict[str, Any] = dict(
        shift=dice.bad(dice.of(1.0, 0.1, 3.0, 1e3), 0.0, -1.0, math.nan),
        grid=dice.bad(dice.of(*GRIDS), "odd"),
        start=dice.bad(dice.of(1.0, 0.5, 1e-6, 0.999), 0.0, 1.5, math.nan),
    )
    times = time_grid(steps, **options)
    assert times[-1] == 0 and all(one > two for one, two in itertools.pairwise(times)) and times[0] == options["start"]
    return times


def sampling_options(dice: Dice) -> Any:
    config = SamplingConfig(
        steps=dice.bad(dice.number(1, 60), 0),
        solver=dice.bad(dice.of(*SOLVERS), "magic"),
        grid=dice.of(*GRIDS),
        shift=dice.bad(2.0, math.nan, -1.0),
        strength=dice.bad(dice.of(1.0, 0.3), 0.0, 2.0),
        known=dice.bad("guided", "maybe"),
        window=dice.bad(dice.of(None, 1, 5), 0),
        rounds=dice.bad(1, 0, -1),
        reference_compatible=dice.chance(0.2),
    )
    stored = dataclasses.asdict(config)
    again = SamplingConfig.from_dict(dice.bad(stored, stored | {"new": 1}))
    assert again == config
    return config.times, config.for_poses().times


def trajectories(dice: Dice) -> Any:
    count = dice.of(0, 1, 5)
    state = dice.normal(count, 32, 2, 2).to(dice.of(torch.float32, torch.float64, torch.float16))
    slope = dice.normal(count, 32, 2, 2).to(state)
    times = time_grid(dice.number(1, 9), shift=dice.of(1.0, 2.0), grid=dice.of(*GRIDS))
    window, rounds = dice.bad(dice.of(None, 1, 2, 3, 9), 0, -1), dice.bad(dice.of(1, 2), 0)
    slopes = lambda part, time, views: torch.stack([slope if views is None else slope[views]])  # noqa: E731
    predict = tiled(slopes, window=window, rounds=rounds, orders=random_orders(dice.number(0, 9)))
    field: Callable = lambda z, time: predict(z, time, None)[0]  # noqa: E731
    if dice.chance(0.3):
        field = imposed(field, state.double(), slope.double(), dice.mask(count, 32, 2, 2), until=dice.of(-1.0, 0.5))
    if count:
        parts = windows(count, dice.number(1, 6), order=torch.arange(count))
        assert sorted(set(torch.cat(parts).tolist())) == list(range(count))
    solver = dice.bad(dice.of(*SOLVERS), "magic")
    return (
        integrate(field, state, times, solver=solver),
        started(state, slope, dice.of(0.3, 1.0)),
        noise_of(3, count, (2, 2)),
    )


def sequences(dice: Dice) -> Any:
    cameras = dice.cameras(dice.of(0, 1, 3)).to(torch.float32)
    images = torch.rand(len(cameras), 3, cameras.height, cameras.width, generator=dice.generator)
    mask = dice.of(None, dice.mask(len(cameras), 1, cameras.height, cameras.width).float())
    parts = [Views.known(images, cameras, mask=mask), Views.unknown(cameras), Views.unposed(images)]
    other = Views.unposed(torch.zeros(1, 3, 99, 98))
    together = Views.cat(dice.bad(parts, [], [*parts, other]))
    return together, together[dice.of([], slice(0, 1))], together.to(torch.float64)


def pictures(dice: Dice) -> Any:
    n, cameras = dice.of(0, 1, 6), dice.of(0, 1, 2)
    degree, mode = dice.of(None, 0, 1, 4), dice.of("RGB", "D", "ED", "RGB+D", "RGB+ED")
    viewmats = torch.eye(4).double().repeat(cameras, 1, 1)
    viewmats[:, :3, 3] = dice.of(0.0, 1.0, 1e3) * dice.normal(cameras, 3) + torch.tensor([0.0, 0.0, 3.0]).double()
    focal = dice.bad(20.0, 0.0, -3.0, math.nan)
    splats: dict[str, Any] = dict(
        means=dice.places(n),
        quats=dice.of(1.0, 0.0, 1e-20, 1e15) * dice.normal(n, 4),
        scales=dice.of(1e-8, 1e-2, 1.0, 1e6, 1e9, 1e13) * torch.exp(dice.of(1.0, 4.0) * dice.normal(n, 3)),
        opacities=torch.rand(n, generator=dice.generator).double(),
        colors=dice.normal(n, 3) if degree is None else dice.normal(n, 25, 3),
        viewmats=viewmats,
        Ks=torch.tensor([[focal, 0, 8], [0, focal, 8], [0, 0, 1]]).double().repeat(cameras, 1, 1),
    )
    dtype = dice.of(torch.float32, torch.float64)
    cameras_given: dict[str, Any] = {name: dice.layout(splats.pop(name).to(dtype)) for name in ("viewmats", "Ks")}
    valid, splats = dice.valid, {name: dice.layout(values.to(dtype)) for name, values in splats.items()}
    dice.valid = valid  # Gaussians that are not finite are left out
    images, alphas, meta = rasterization(
        **splats,
        **cameras_given,
        width=dice.bad(dice.number(1, 20), 0, -1),
        height=dice.bad(dice.number(1, 20), 0),
        sh_degree=dice.bad(degree, 7, -1),
        render_mode=dice.bad(mode, "XYZ"),
        rasterize_mode=dice.bad(dice.of("classic", "antialiased"), "soft"),
        semantics=dice.bad(dice.of("1.4", "1.5", "1.6"), "9.9"),
        tile_size=dice.bad(dice.of(4, 8, 16, 20), 0, 3, -4),
        packed=dice.bad(False, True),
    )
    return images, alphas, meta["means2d"], meta["conics"]


def harmonics(dice: Dice) -> Any:
    degree, count = dice.number(0, 4), dice.of(0, 1, 9)
    directions = dice.of(1.0, 0.0, 1e-30, 1e30) * dice.normal(count, 3)
    return sh_colors(degree, directions, dice.normal(count, 25, 3))


CASES = (
    mask_makers, known_parts, channels, flows, time_grids, sampling_options, trajectories, sequences, pictures,
    harmonics,
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_a_finite_answer_or_one_sentence(case: Callable[[Dice], Any], shapes_unchecked) -> None:
    assert not faults(case, range(FAST))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_a_finite_answer_or_one_sentence_in_the_whole_fuzz(case: Callable[[Dice], Any], shapes_unchecked) -> None:
    """10 cases of 600, 6000 draws, last run on 2026-11-27 without a fault."""
    assert not faults(case, range(FAST, FAST + ALL))
