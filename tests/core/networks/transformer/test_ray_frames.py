"""Attention in frames of known rays: its laws, its twin, its gradient."""

from __future__ import annotations

import dataclasses
import math

import jaxtyping
import pytest
import torch
import torch.nn.functional as F
from einops import rearrange
from helpers.tiny_models import network_of
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import raymaps_of
from fb_core.networks.transformer.attention import Attention
from fb_core.networks.transformer.dit import DiTConfig, TokenFacts
from fb_core.networks.transformer.ray_frames import RayFrames, frames_of_rays, transformed

CONFIG = DiTConfig(
    heads=2, head_dim=16, depth=2, in_channels=10, out_channels=4, text_width=0, ray_frames=True, index="none"
)
VIEWS, SIDE, SIZE = 4, 16, 32


def some_cameras(seed: int = 0) -> Pinholes:
    """Cameras at random places of the cube that look at random points."""
    generator = torch.Generator().manual_seed(seed)
    places, aims = (torch.rand(VIEWS, 3, generator=generator, dtype=torch.float64) * 2 - 1 for _ in range(2))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Pinholes.looking_at(places, aims, up=up, fov_degrees=70.0, width=SIZE, height=SIZE)


def moved(raymaps: Tensor, seed: int = 5) -> Tensor:
    """All rays moved rigidly."""
    generator = torch.Generator().manual_seed(seed)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    rotation = rotation * torch.linalg.det(rotation)
    shift = torch.randn(3, 1, 1, generator=generator, dtype=torch.float64)
    origins, directions = (torch.einsum("ij,njhw->nihw", rotation, part) for part in (raymaps[:, :3], raymaps[:, 3:]))
    return torch.cat([origins + shift, directions], dim=1)


def everywhere(raymaps: Tensor) -> Tensor:
    return torch.ones_like(raymaps[:, :1])


def latents(seed: int = 2) -> Tensor:
    return torch.randn(
        1, VIEWS, 10, SIZE // 8, SIZE // 8, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


def test_frames_are_those_of_the_cameras():
    cameras = some_cameras()
    frames = frames_of_rays(raymaps_of(cameras), everywhere(raymaps_of(cameras)), SIDE)
    rotations = frames[..., :3, :3]
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    torch.testing.assert_close(rotations.mT @ rotations, identity)
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(VIEWS, 2, 2, dtype=torch.float64))
    torch.testing.assert_close(frames[..., :3, 3], cameras.centers[:, None, None].expand(-1, 2, 2, -1))
    centre = raymaps_of(cameras)[:, 3:, 7:9, 7:9].mean(dim=(2, 3))
    assert float((F.normalize(centre, dim=1) * rotations[:, 0, 0, :, 2]).sum(dim=1).min()) > math.cos(math.radians(0.7))
    # a whole view as one patch looks along its camera's axes
    torch.testing.assert_close(
        frames_of_rays(raymaps_of(cameras), everywhere(raymaps_of(cameras)), SIZE)[:, 0, 0, :3, :3], cameras.rotations
    )


def test_a_patch_cut_by_the_border_has_the_frame_of_the_whole():
    rays = raymaps_of(some_cameras())
    known = everywhere(rays)
    known[..., 20:] = 0
    whole, cut = frames_of_rays(rays, everywhere(rays), SIDE), frames_of_rays(rays, known, SIDE)
    assert float((whole - cut).abs().max()) < 0.03


@pytest.mark.parametrize("columns", [0, 1])
def test_rays_that_tell_no_axes_are_the_identity(columns):
    rays = raymaps_of(some_cameras())
    known = torch.zeros_like(rays[:, :1])
    known[..., :columns] = 1
    frames = frames_of_rays(rays, known, SIDE)
    assert torch.equal(frames, torch.eye(4, dtype=torch.float64).expand_as(frames))


@pytest.mark.parametrize("garbage", [float("nan"), float("inf"), 1e30])
def test_what_stands_in_unknown_rays_reaches_nothing(garbage):
    rays = raymaps_of(some_cameras())
    known = everywhere(rays)
    known[1] = 0
    known[2, :, :, 10:] = 0
    spoiled = torch.where(known > 0, rays, torch.full_like(rays, garbage))
    assert torch.equal(frames_of_rays(spoiled, known, SIDE), frames_of_rays(rays, known, SIDE))


def test_inverse():
    frames = RayFrames.of(
        frames_of_rays(raymaps_of(some_cameras()), everywhere(raymaps_of(some_cameras())), SIDE)[None]
    )
    identity = torch.eye(4, dtype=torch.float64).expand_as(frames.frame)
    torch.testing.assert_close(frames.frame @ frames.inverse, identity)


def test_a_rigid_motion_of_all_rays_changes_nothing():
    network, rays = network_of(CONFIG), raymaps_of(some_cameras())
    answers = [
        network(
            latents(), torch.tensor([0.4]), facts=TokenFacts(frames=frames_of_rays(where, everywhere(rays), SIDE)[None])
        )
        for where in (rays, moved(rays))
    ]
    torch.testing.assert_close(*answers)


def test_how_rays_lie_matters():
    network, rays = network_of(CONFIG), raymaps_of(some_cameras())
    answers = [
        network(
            latents(), torch.tensor([0.4]), facts=TokenFacts(frames=frames_of_rays(where, everywhere(rays), SIDE)[None])
        )
        for where in (rays, raymaps_of(some_cameras(1)))
    ]
    assert float((answers[0] - answers[1]).detach().abs().max()) > 1e-3


def test_without_known_rays_the_network_is_what_it_was():
    network, rays = network_of(CONFIG), raymaps_of(some_cameras())
    plain = network_of(dataclasses.replace(CONFIG, ray_frames=False))
    nothing = frames_of_rays(rays, torch.zeros_like(rays[:, :1]), SIDE)[None]
    for facts in (TokenFacts(), TokenFacts(frames=nothing)):
        torch.testing.assert_close(
            network(latents(), torch.tensor([0.4]), facts=facts), plain(latents(), torch.tensor([0.4]))
        )


def test_permuting_views_permutes_the_answer():
    network, rays = network_of(CONFIG), raymaps_of(some_cameras())
    frames, order = frames_of_rays(rays, everywhere(rays), SIDE)[None], torch.tensor([2, 0, 3, 1])
    given = network(latents(), torch.tensor([0.4]), facts=TokenFacts(frames=frames))
    permuted = network(latents()[:, order], torch.tensor([0.4]), facts=TokenFacts(frames=frames[:, order]))
    torch.testing.assert_close(permuted, given[:, order])


def slow_attention(attention: Attention, x: Tensor, frames: Tensor) -> Tensor:
    """The twin: every pair of tokens with its own matrix, the attention matrix written out."""
    queries = attention.norm_q(attention._split(attention.to_q(x)))
    keys, values = attention.keys_values(x)
    heads, tokens, width = queries.shape[1:]
    half = width // 2
    gathered = torch.zeros_like(queries)
    for head in range(heads):
        for i in range(tokens):
            scores, told = [], []
            for j in range(tokens):
                between = torch.linalg.inv(frames[i]) @ frames[j]
                moved_key, moved_value = (
                    torch.cat([(vector[:half].view(-1, 4) @ between.T).flatten(), vector[half:]])
                    for vector in (keys[0, head, j], values[0, head, j])
                )
                scores.append(queries[0, head, i] @ moved_key / width**0.5)
                told.append(moved_value)
            gathered[0, head, i] = torch.stack(scores).softmax(dim=0) @ torch.stack(told)
    return attention.to_out[0](rearrange(gathered, "b heads tokens k -> b tokens (heads k)"))


def test_attention_equals_its_slow_twin():
    torch.manual_seed(0)
    attention = Attention(32, 2, 32).double()
    for parameter in attention.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    frames = RayFrames.of(
        frames_of_rays(raymaps_of(some_cameras()), everywhere(raymaps_of(some_cameras())), SIDE)[None]
    )
    x = torch.randn(1, 4 * VIEWS, 32, dtype=torch.float64)
    torch.testing.assert_close(attention(x, None, frames), slow_attention(attention, x, frames.frame[0]))


def test_gradient_of_the_multiplication():
    x = torch.randn(1, 2, 3, 16, dtype=torch.float64, requires_grad=True)
    matrices = torch.randn(1, 3, 4, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(transformed, (x, matrices))


@pytest.mark.parametrize("change, named", [({"head_dim": 12}, "head_dim"), ({"ray_frames": 1}, "ray_frames")])
def test_refusals(change, named):
    with pytest.raises((ValueError, jaxtyping.TypeCheckError), match=named):
        dataclasses.replace(CONFIG, **change)
