"""A stand-in for a model that knows every photo's raymap, and photos for it."""

from __future__ import annotations

import dataclasses
import math

import torch

from fb_core.data.photos.photo import Photo
from fb_core.evaluation.self_consistency import photo_of
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.solver import recover_cameras
from fb_core.geometry.raymap import raymaps_of
from fb_core.geometry.similarity import Similarity
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.registration.by_raymaps import Square
from fb_core.views import Views
from helpers.scenes.recovered_cameras import anywhere, each

SIDE = 32
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def ring(count: int, *, width: int = 48, height: int = 36) -> Pinholes:
    """Cameras in a circle that look outwards, slightly up and down in turn."""
    angles = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count
    out = torch.stack([angles.cos(), angles.sin(), 0.3 * (2 * angles).sin()], dim=1)
    return Pinholes.looking_at(2 * out + 5, 4 * out + 5, up=UP, fov_degrees=65.0, width=width, height=height)


def photos_of(cameras: Pinholes, *, told: bool = False) -> list[Photo]:
    """Pictures whose grey tells the oracle which they are."""
    greys = torch.linspace(0.1, 0.9, len(cameras))
    return [
        photo_of(
            greys[index].expand(3, cameras.height, cameras.width).clone(),
            name=f"photo {index}",
            device="one",
            focal=float(cameras.focal[index, 0]) if told else None,
        )
        for index in range(len(cameras))
    ]


class Oracle(Fillerbuster):
    """Knows every photo's raymap: in the world of the rays it is given, or in a world of its own, another one for every
    seed.
    """

    size = SIDE

    def __init__(self, photos: list[Photo], cameras: Pinholes, *, noise: float = 0.0):
        squares = [Square.of(photo, SIDE) for photo in photos]
        self.truth = [square.inside(camera) for square, camera in zip(squares, each(cameras), strict=True)]
        self.greys = torch.stack([square.image.mean() for square in squares])
        self.noise, self.windows = noise, list[int]()

    @property
    def recommended_sampling(self) -> SamplingConfig:
        return SamplingConfig()

    def complete(self, views: Views, *, generator: torch.Generator, **_) -> Views:
        who = (views.images.mean(dim=(1, 2, 3))[:, None] - self.greys).abs().argmin(dim=1)
        self.windows.append(len(views))
        true = Pinholes.cat([self.truth[index] for index in who.tolist()])
        given = (views.rays_known > 0).flatten(1).all(dim=1)
        world = anywhere(int(torch.randint(1000, (), generator=generator)), scale=0.2)
        if bool(given.any()):
            places = given.nonzero()[:, 0].tolist()
            shown = recover_cameras(views.raymaps[places]).cameras
            world = Similarity.between((true[places].rotations, true[places].centers), (shown.rotations, shown.centers))
        raymaps = raymaps_of(world.cameras(true)).float()
        raymaps = raymaps + self.noise * torch.randn(raymaps.shape, generator=generator)
        return dataclasses.replace(views, raymaps=torch.where(views.rays_known > 0, views.raymaps, raymaps))
