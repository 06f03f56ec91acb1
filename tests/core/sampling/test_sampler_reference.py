"""`reference_compatible` sampling against the original's own trajectories, its flaws F1 and F2 included, and what the
flaws change.
"""

import dataclasses

import numpy as np
import pytest
import torch

from fb_core.conditioning import decode_in_chunks, encode_in_chunks, encode_known, encode_null, split, unsplit
from fb_core.flow import at_time, velocity
from fb_core.masks import to_latent_grid
from fb_core.networks.released import read_released
from fb_core.sampling import SamplingConfig, given_order, reference_field, reference_grid, reference_started, time_grid
from fb_core.sampling.denoising import Denoising

CASES = (
    "sampler_cfg",
    "sampler_cfg_text",
    "sampler_multidiffusion_ordered",
    "sampler_random_order_full",
    "sampler_image_strength",
)
OPTIONS = {"sampler_multidiffusion_ordered": {"window": 2}, "sampler_image_strength": {"strength": 0.9}}


def arrays(shared_path, name: str) -> dict[str, torch.Tensor]:
    with np.load(shared_path(f"golden/reference/{name}.npz")) as file:
        return {key: torch.from_numpy(file[key]) for key in file.files}


@pytest.fixture(scope="module")
def networks(shared_path):
    return read_released(shared_path("golden/reference/transformer.ckpt").parent)


def golden_denoising(networks, golden: dict[str, torch.Tensor], name: str) -> Denoising:
    golden = {key: value.float() if value.is_floating_point() else value for key, value in golden.items()}
    vaes = {"image_vae": networks.image_vae, "raymap_vae": networks.raymap_vae}
    rays01 = torch.cat([golden["origins"][0], golden["directions"][0]], dim=1)
    conditioning = encode_known(golden["image"][0], golden["image_mask"][0], rays01, golden["rays_mask"][0], **vaes)
    current = None
    if "current_image" in golden:
        image = encode_in_chunks(networks.image_vae, golden["current_image"][0], 4)
        current = unsplit(image, encode_in_chunks(networks.raymap_vae, rays01, 4))
    sampling = SamplingConfig(steps=4, reference_compatible=True, **OPTIONS.get(name, {}))
    places = {time: step for step, time in enumerate(sampling.times)}
    drawn = golden["perms"]
    return Denoising(
        dit=networks.dit,
        conditioning=conditioning,
        null=encode_null(conditioning, **vaes, pixels=(64, 64)),
        noise=golden["noise"][0],
        orders=(lambda time, number, views: drawn[places[time]]) if drawn.numel() else given_order,
        sampling=sampling,
        text=torch.cat(
            [golden["uncond_text"], golden["text"]] if name == "sampler_cfg_text" else [golden["uncond_text"]]
        ),
        current=current,
    )


@pytest.mark.parametrize("name", CASES)
@torch.no_grad()
def test_every_state_is_the_original_s(shared_path, networks, name):
    golden = arrays(shared_path, name)
    states, slopes = [], []

    def look(trajectory):
        states.append(trajectory.point.state)
        slopes.append(trajectory.point.last.velocity)

    final = golden_denoising(networks, golden, name).run(on_trajectory=look)
    for step in range(4):
        assert (states[step] - golden["traj"][step, 0]).abs().max() <= 1e-4
        assert (slopes[step] - golden["pred"][step, 0]).abs().max() <= 1e-4
    assert (final - golden["final"][0, :, :32]).abs().max() <= 1e-4
    image, rays = split(final)
    assert (decode_in_chunks(networks.image_vae, image, 4) - golden["decoded_image"][0]).abs().max() <= 1e-3
    # Random weights without norms: this decoder multiplies differences by about a thousand.
    assert (decode_in_chunks(networks.raymap_vae, rays, 4) - golden["decoded_rays"][0]).abs().max() <= 1e-2


@torch.no_grad()
def test_the_guidance_map_that_stays_with_its_views_gives_something_else(shared_path, networks):
    """F1: without the flaw one window is one deterministic order, and the answer differs by about half of its range."""
    golden = arrays(shared_path, "sampler_random_order_full")
    flawed = golden_denoising(networks, golden, "sampler_random_order_full")
    ours = dataclasses.replace(
        flawed,
        sampling=dataclasses.replace(
            flawed.sampling, reference_compatible=False, solver="euler", grid="reference", shift=1.0
        ),
    )
    assert (ours.run() - golden["final"][0, :, :32]).abs().max() > 1
    straight = arrays(shared_path, "sampler_cfg")  # the same task in the given order
    assert (ours.run() - straight["final"][0, :, :32]).abs().max() <= 1e-4


@pytest.mark.parametrize("steps", [4, 20, 24, 50])
def test_time_grids_are_the_original_s(shared_path, steps):
    golden = arrays(shared_path, "scheduler_and_masks")
    times = torch.tensor(reference_grid(steps))
    assert (times - golden[f"sigmas_{steps}"]).abs().max() <= 1e-6
    assert (1000 * times[:-1] - golden[f"timesteps_{steps}"]).abs().max() <= 1e-3
    assert time_grid(steps, grid="reference") == reference_grid(steps)


def test_noising_target_and_masks_are_the_original_s(shared_path):
    golden = arrays(shared_path, "scheduler_and_masks")
    noised = at_time(golden["z"], golden["eps"], golden["tt"] / 1000)
    assert (noised - golden["noised"]).abs().max() <= 1e-6
    assert (velocity(golden["z"], golden["eps"]) - golden["target"]).abs().max() <= 1e-6
    assert (to_latent_grid(golden["mask"][0]) - golden["mask_down8"][0]).abs().max() <= 1e-6
    assert (torch.arange(1000, 0, -1) / 1000 - golden["train_sigmas"]).abs().max() <= 1e-6


@pytest.mark.parametrize(("strength", "nearest"), [(0.9, 1.0), (0.8, 0.667), (0.5, 0.334), (0.1, 0.001)])
def test_the_original_s_strength_changes_the_image_channels_alone(strength, nearest):
    """F2: they start at the grid's nearest time although the loop starts at 1."""
    current, noise = torch.randn(2, 3, 32, 4, 4, generator=torch.Generator().manual_seed(0))
    start = reference_started(current, noise, strength=strength, steps=4)
    assert torch.allclose(start[:, :16], ((1 - nearest) * current + nearest * noise)[:, :16], atol=1e-6)
    assert torch.equal(start[:, 16:], noise[:, 16:])
    assert SamplingConfig(steps=4, strength=strength, reference_compatible=True).times == reference_grid(4)


def test_windows_that_do_not_divide_the_views_are_refused_as_the_original_would_crash():
    scale = torch.ones(5, 32, 2, 2)
    field = reference_field(lambda state, time, views: state[None], scale, window=2, orders=given_order)
    with pytest.raises(ValueError, match="needs a divisor of its 5 views, got 2"):
        field(torch.zeros(5, 32, 2, 2), 1.0)


def test_where_views_land_in_the_original_s_order():
    """Predictions come back to their views, but meet the scales of the places where they stood."""
    scale = torch.arange(4.0).reshape(4, 1, 1, 1).expand(4, 32, 2, 2)
    order = torch.tensor([2, 0, 3, 1])
    field = reference_field(
        lambda state, time, views: torch.stack([torch.zeros_like(state), torch.ones_like(state)]),
        scale,
        orders=lambda time, number, views: order,
    )
    assert field(torch.zeros(4, 32, 2, 2), 1.0)[:, 0, 0, 0].tolist() == [1.0, 3.0, 0.0, 2.0]
