"""The canonical frame of a completion: decided by known rays alone, whatever the size of the views and whatever stands in unknown rays."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from tiny_models import tiny_model

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.known_rays import frame_of_known_rays
from fb_core.geometry.raymap import CanonicalFrame
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.views import Views

QUICK = SamplingConfig(steps=1, guidance_unknown=1.0, guidance_known=1.0)
SIZES = (*range(16, 36), 47, 48, 49, 63, 64, 65, 70)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Fillerbuster:
    return tiny_model(tmp_path_factory.mktemp("tiny"))


def some_cameras(width: int, height: int, *, moved: float = 0.0, unit: float = 1.0) -> Pinholes:
    """Three cameras around a corner, in a world that may be moved and measured in another unit."""
    places = torch.tensor([[0.0, 0.0, 1.0], [0.5, -0.25, 1.25], [-0.5, 0.5, 1.0]])
    aims = torch.tensor([[1.0, 0.0, 1.0], [1.5, 0.5, 1.0], [0.5, 1.5, 0.75]])
    shift = torch.tensor([moved, -moved, moved / 2])
    up = torch.tensor([0.0, 0.0, 1.0])
    return Pinholes.looking_at(unit * places + shift, unit * aims + shift, up=up, fov_degrees=70.0, width=width, height=height)


def some_views(cameras: Pinholes) -> Views:
    """Two known views and one to be generated."""
    images = torch.rand(2, 3, cameras.height, cameras.width, generator=torch.Generator().manual_seed(1))
    return Views.cat([Views.known(images, cameras[[0, 1]]), Views.unknown(cameras[[2]])])


@pytest.mark.parametrize("size", SIZES)
def test_every_size_has_the_frame_of_its_cameras(size):
    cameras = some_cameras(size, size + size % 5)
    views = some_views(cameras)
    frame, expected = frame_of_known_rays(views.raymaps, views.rays_known), CanonicalFrame.of(cameras)
    assert frame is not None
    torch.testing.assert_close(frame.rotation, expected.rotation, atol=1e-5, rtol=0)
    torch.testing.assert_close(frame.center, expected.center, atol=1e-6, rtol=0)
    assert frame.scale == pytest.approx(expected.scale, rel=1e-5)


@pytest.mark.parametrize("garbage", [float("nan"), float("inf"), 0.0, 1e30])
@pytest.mark.parametrize("size", [17, 33, 48])
def test_what_stands_in_unknown_rays_changes_nothing(model, size, garbage):
    views = some_views(some_cameras(size, size))
    known = views.rays_known.clone()
    known[1] = 0  # a photo without a camera
    known[0, :, : size // 3] = 0  # part of the reference's rays
    known[2, :, :, -2:] = 0
    answers = []
    for values in (views.raymaps, torch.where(known > 0, views.raymaps, torch.full_like(views.raymaps, garbage))):
        asked = dataclasses.replace(views, raymaps=values, rays_known=known)
        answers.append(model.complete(asked, generator=torch.Generator().manual_seed(0), sampling=QUICK))
    assert torch.equal(answers[0].images, answers[1].images) and torch.equal(answers[0].raymaps, answers[1].raymaps)


@pytest.mark.parametrize("size", [16, 17, 22, 33, 40])
def test_a_moved_world_in_another_unit_changes_nothing_but_the_world(model, size):
    here, there = some_views(some_cameras(size, size)), some_views(some_cameras(size, size, moved=16.0, unit=2.0))
    answers = [model.complete(views, generator=torch.Generator().manual_seed(0), sampling=QUICK).images for views in (here, there)]
    torch.testing.assert_close(answers[0], answers[1], atol=2e-4, rtol=0)
