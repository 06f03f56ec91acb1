"""Latents that start in between: a mask between noise and a render says when each of them joins the sampling."""

from __future__ import annotations

import pytest
import torch
from helpers.plugin.datamanagers import ToySplats
from helpers.scenes.completions import room_cameras

from fb_core.flow import at_time
from fb_core.geometry.cameras import Pinholes
from fb_core.sampling.integration.trajectory import integrate
from fb_core.sampling.options import SamplingConfig
from fb_core.sampling.starts import imposed, joining
from fb_core.views import Views
from fb_nerfstudio.generation.first_guess import first_guess

SHARES = (0.25, 0.5, 1.0)


@pytest.mark.parametrize("solver", ["euler", "heun", "ab2", "corrected"])
def test_every_latent_starts_from_its_noised_render_at_its_own_time(solver: str) -> None:
    draw = torch.Generator().manual_seed(0)
    noise, current = torch.randn(4, 2, 3, 3, generator=draw), torch.randn(4, 2, 3, 3, generator=draw)
    config = SamplingConfig(steps=7, strength=0.4)
    counts = torch.zeros(4, 2, 3, 3)
    for view, share in enumerate(SHARES):
        counts[view] = share
    speed = torch.randn(4, 2, 3, 3, generator=draw)

    def field(state: torch.Tensor, time: float) -> torch.Tensor:  # every solver is exact for a constant velocity
        return speed

    for share in SHARES:
        field = imposed(field, current, noise, (counts == share).float(), until=config.joins_at(share))
    times = config.times_from_noise_through(SHARES)
    assert {config.joins_at(share) for share in SHARES} <= set(times) and times[0] == 1.0 and times[-1] == 0.0
    found = integrate(field, noise, times, solver=solver)
    for view, share in enumerate(SHARES):
        start = config.joins_at(share)
        begun = at_time(current[view : view + 1], noise[view : view + 1], torch.tensor([start]))[0]
        assert torch.allclose(found[view], begun - start * speed[view], atol=1e-5)
    assert torch.allclose(found[3], noise[3] - speed[3], atol=1e-5), "what nobody tells starts from noise"


def test_the_two_ends_are_what_they_always_were() -> None:
    config = SamplingConfig(steps=5, strength=0.5)
    assert config.joins_at(1.0) == 0.5 and config.joins_at(0.0) == 1.0
    assert config.times_from_noise_through([1.0]) == config.times_from_noise_too


def views(known: float, side: int = 16) -> Views:
    return Views.known(torch.zeros(1, 3, side, side), camera(side), mask=torch.full((1, 1, side, side), known))


def camera(side: int) -> Pinholes:
    return room_cameras(1, side)[0]


def test_the_least_known_pixel_of_a_latent_decides() -> None:
    current = views(1.0)
    current.image_known[:, :, :8, :8] = 0.6
    current.image_known[:, :, 3, 12] = 0.3
    current.image_known[:, :, 8, 0] = 0.0
    counts = joining(current, Views.unknown(camera(16)))
    assert counts is not None and counts[0, 0].tolist() == [[0.5, 0.25], [0.0, 1.0]]
    assert bool((counts[:, 16:] == 1).all()), "rays are known"
    assert joining(views(0.1), Views.unknown(camera(16))) is None, "too little to begin from"


def test_half_opaque_splats_are_half_a_start() -> None:
    splats = ToySplats()
    everywhere = splats.get_outputs_for_camera

    def layered(one):
        outputs = everywhere(one)
        accumulation = torch.zeros_like(outputs["accumulation"])
        accumulation[:, :40], accumulation[:, :16] = 0.6, 1.0
        return outputs | {"accumulation": accumulation}

    splats.get_outputs_for_camera = layered
    cameras = camera(64)
    hard, soft = first_guess(splats, cameras), first_guess(splats, cameras, soft=True)
    assert hard is not None and soft is not None
    row = soft.image_known[0, 0, 32]
    assert bool((row[:20] == 1).all() and (row[20:44] == 0.5).all() and (row[44:] == 0).all())
    assert torch.equal((soft.image_known == 1).float(), hard.image_known)
    splats.get_outputs_for_camera = lambda one: (
        everywhere(one) | {"accumulation": 0.6 * torch.ones(one.height, one.width, 1)}
    )
    assert first_guess(splats, cameras) is None and first_guess(splats, cameras, soft=True) is not None
