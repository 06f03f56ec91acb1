"""Captured cameras in a box, and a model that fills in means."""

from __future__ import annotations

import math

import torch

from fb_core.completion.options import CompletionConfig
from fb_core.completion.rounds import CapturedView
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import SamplingConfig
from fb_core.views import Views

UP = torch.tensor([0.0, 0.0, 1.0])


class MeanFiller:
    """Fills every unknown pixel with the mean of the known ones plus the generator's first number; remembers what it
    was given.
    """

    size = 16
    model_hash = "0123456789abcdef"

    def __init__(self) -> None:
        self.asked: list[Views] = []
        self.sampling: list[SamplingConfig] = []

    recommended_sampling = SamplingConfig()

    def complete(
        self, views, *, generator, sampling=SamplingConfig(), on_step=None, prompt=None, current=None
    ) -> Views:
        self.asked.append(views)
        self.sampling.append(sampling)
        for step in range(sampling.steps):
            if on_step is not None:
                on_step(step + 1, sampling.steps)
        known = views.image_known > 0
        mean = torch.where(known, views.images, 0.0).sum(dim=(0, 2, 3)) / known.sum().clamp(min=1)
        filling = mean[None, :, None, None] + 0.1 * torch.rand(1, generator=generator)
        images = torch.where(known, views.images, filling.expand_as(views.images))
        ones = torch.ones_like(views.image_known)
        return Views(images=images, image_known=ones, raymaps=views.raymaps, rays_known=ones)


def room_cameras(count: int = 6, size: int = 16) -> list[Pinholes]:
    """Cameras near the origin that look along +x, spread over 90 degrees."""
    angle = torch.linspace(-math.pi / 4, math.pi / 4, count)
    forward = torch.stack([angle.cos(), angle.sin(), torch.zeros(count)], dim=1)
    centers = 0.3 * torch.randn(count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([1.0, 1.0, 0.2])
    both = Pinholes.looking_at(centers, centers + forward, up=UP, fov_degrees=60.0, width=size, height=size)
    return [both[index] for index in range(count)]


def box_points(count: int = 600) -> torch.Tensor:
    """Points on the seen half (x > 0) of the walls of a room."""
    unit = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    points = unit * (torch.tensor([3.0, 3.0, 1.5]) / unit.abs()).min(dim=1, keepdim=True).values
    return points[points[:, 0] > 0]


def captured(cameras: list[Pinholes]) -> list[CapturedView]:
    return [
        CapturedView(
            image=torch.full((3, camera.height, camera.width), 0.2 + 0.1 * index),
            known=torch.ones(1, camera.height, camera.width),
            camera=camera,
        )
        for index, camera in enumerate(cameras)
    ]


def small(**options) -> CompletionConfig:
    return CompletionConfig(
        **{"context_views": 4, "anchor_views": 5, "densify_rounds": 2, "densify_views": 3, "steps": 2, **options}
    )
