"""Pixels carried over into other views, and the guesses that training makes of them."""

from __future__ import annotations

import dataclasses
from functools import partial

import pytest
import torch

from fb_core.conditioning import with_guess
from fb_core.data.training.sequences import PoolConfig, RoomPool
from fb_core.data.training.task import Sequences, TaskConfig
from fb_core.evaluation.completion import unseen_room
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.carry_over import BELIEF_BY_DIRECTION, BELIEF_OF_RENDERS, carried_over
from fb_core.geometry.raymap import raymaps_of
from fb_core.training.run.stage import row_generator
from fb_core.training.stages.guesses import guesses_of

TASK = TaskConfig(views=6, ray_task=0.0, dropout=0.0, partial_share=0.0, known_share=(0.5, 0.5), guess=1.0)


def everywhere(raymaps):
    return torch.ones_like(raymaps[:, :1])


def wall(raymaps):
    """What rays from anywhere see of a smooth painted sphere at infinity."""
    return 0.5 + 0.5 * raymaps[:, 3:]


def turning(count: int, size: int = 24) -> Pinholes:
    """Cameras in one place that look all round."""
    angles = torch.arange(count) * (2 * torch.pi / count)
    aims = torch.stack([angles.cos(), angles.sin(), 0.2 * angles.sin()], dim=1)
    return Pinholes.looking_at(
        torch.zeros(count, 3), aims, up=torch.tensor([0.0, 0.0, 1.0]), fov_degrees=80.0, width=size, height=size
    )


@pytest.mark.parametrize("crop", [False, True])
def test_what_lies_infinitely_far_is_carried_over_exactly(crop):
    cameras = turning(12)
    if crop:  # principal points off the middle
        cameras = cameras.cropped(3, 5, 16, 18)
    rays = raymaps_of(cameras)
    guess = carried_over(wall(rays[::2]), everywhere(rays[::2]), rays[::2], rays[1::2])
    assert float(guess.there.mean()) > 0.9
    error = (guess.images - wall(rays[1::2])).abs() * guess.there
    assert float(error.max()) < 0.02  # of interpolation


def test_a_view_is_carried_into_itself():
    rays = raymaps_of(turning(3))
    images = torch.rand(3, 3, 24, 24, generator=torch.Generator().manual_seed(0))
    guess = carried_over(images, everywhere(rays), rays, rays)
    assert torch.equal(guess.there, torch.ones_like(guess.there))
    torch.testing.assert_close(guess.images, images, atol=1e-4, rtol=0)


def test_unknown_pixels_are_never_carried_over():
    rays = raymaps_of(turning(2))
    images, known = torch.full((2, 3, 24, 24), float("nan")), torch.zeros(2, 1, 24, 24)
    images[:, :, :12], known[:, :, :12] = 0.25, 1
    guess = carried_over(images, known, rays, rays)
    assert bool(torch.isfinite(guess.images).all())
    assert torch.equal(guess.there[:, :, 12:], torch.zeros_like(guess.there[:, :, 12:]))
    torch.testing.assert_close(guess.images[:, :, :11], torch.full((2, 3, 11, 24), 0.25))


def test_nothing_known_and_nothing_wanted():
    rays = raymaps_of(turning(2))
    assert not bool(carried_over(torch.zeros(0, 3, 24, 24), torch.zeros(0, 1, 24, 24), rays[:0], rays).there.any())
    assert carried_over(torch.zeros(2, 3, 24, 24), everywhere(rays), rays, rays[:0]).images.shape == (0, 3, 24, 24)


def test_by_true_distance_rooms_are_carried_over():
    room = unseen_room(family="narrow", seed=1, number=0, views=8, size=32)
    rays = raymaps_of(room.cameras)
    cosine = (rays[:, 3:] * room.cameras.rotations[:, :, 2, None, None]).sum(dim=1)
    distance = (room.depth / cosine)[:, None]
    guess = carried_over(
        room.images[:5], everywhere(rays[:5]), rays[:5], rays[5:], distance=distance[5:], known_distance=distance[:5]
    )
    by_direction = carried_over(room.images[:5], everywhere(rays[:5]), rays[:5], rays[5:])

    def error(carried) -> float:
        return float(
            ((carried.images - room.images[5:]).abs().mean(dim=1, keepdim=True) * carried.there).sum()
            / carried.there.sum()
        )

    assert error(guess) < 0.01 < error(by_direction)


def batch(task: TaskConfig, rows: range = range(4)) -> tuple[Sequences, RoomPool]:
    pool = RoomPool(
        PoolConfig(rooms=4, views=6, image_size=32), seed=0, encode=lambda images: torch.zeros(len(images), 16, 4, 4)
    )
    pool.advance(0)
    return pool.sequences(rows, task, partial(row_generator, 0, 0)), pool


@pytest.mark.parametrize("by_depth, middle", [(0.0, BELIEF_BY_DIRECTION), (1.0, BELIEF_OF_RENDERS)])
def test_guesses_are_told_in_unknown_views_alone_and_believed_in_part(by_depth, middle):
    task = dataclasses.replace(TASK, guess_by_depth=by_depth)
    sequences, _ = batch(task)
    guess = guesses_of(sequences, range(4), task, partial(row_generator, 0, 0, stream=3))
    unknown = sequences.image_known.flatten(2).amax(dim=-1) == 0
    assert bool((guess.belief[~unknown] == 0).all()) and bool((guess.images[~unknown] == 0).all())
    told = guess.belief[guess.belief > 0]
    assert told.numel() > 100 and float((told - middle).abs().max()) <= 0.1 + 1e-6
    assert (
        bool(torch.isfinite(guess.images).all()) and 0 <= float(guess.images.min()) and float(guess.images.max()) <= 1
    )


def test_a_row_s_guess_depends_on_that_row_alone():
    sequences, _ = batch(TASK)
    draw = partial(row_generator, 0, 0, stream=3)
    together = guesses_of(sequences, range(4), TASK, draw)
    fields = {field.name: getattr(sequences, field.name) for field in dataclasses.fields(Sequences)}
    one = Sequences(**{name: value if value is None else value[2:3] for name, value in fields.items()})
    alone = guesses_of(one, range(2, 4, 4), TASK, draw)
    assert torch.equal(together.images[2:3], alone.images) and torch.equal(together.belief[2:3], alone.belief)


def test_no_guess_without_known_rays_and_none_unless_asked():
    sequences, _ = batch(TASK)
    draw = partial(row_generator, 0, 0, stream=3)
    blind = dataclasses.replace(sequences, rays_known=torch.zeros_like(sequences.rays_known))
    assert not bool(guesses_of(blind, range(4), TASK, draw).belief.any())
    assert guesses_of(sequences, range(4), dataclasses.replace(TASK, guess=0.0), draw) is None


def test_a_guess_never_replaces_what_is_known():
    told, known = torch.full((1, 3, 8, 8), 0.3), torch.ones(1, 1, 8, 8)
    known[..., 4:] = 0
    known[..., 2:4] = 0.5
    images, mask = with_guess(told, known, torch.full((1, 3, 8, 8), 0.9), torch.full((1, 1, 8, 8), 0.7))
    assert torch.equal(images[..., :4], told[..., :4]) and torch.equal(mask[..., :4], known[..., :4])
    assert bool((images[..., 4:] == 0.9).all()) and bool((mask[..., 4:] == 0.7).all())
