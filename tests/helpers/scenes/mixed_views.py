"""Views of which some are known, some partly and some not."""

import dataclasses

import torch

from fb_core.geometry.cameras import Pinholes
from fb_core.views import Views


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def cameras(count: int, width: int = 32, height: int = 32) -> Pinholes:
    generator = seeded(7)
    centers = torch.rand(count, 3, generator=generator) * 2 - 1
    targets = centers + torch.randn(count, 3, generator=generator)
    return Pinholes.looking_at(
        centers, targets, up=torch.tensor([0.0, 0.0, 1.0]), fov_degrees=60.0, width=width, height=height
    )


def mixed_views(known: int = 2, partial: int = 1, unknown: int = 2, width: int = 32, height: int = 32) -> Views:
    count = known + partial + unknown
    views = Views.known(torch.rand(count, 3, height, width, generator=seeded(1)), cameras(count, width, height))
    mask = torch.zeros(count, 1, height, width)
    mask[:known] = 1
    mask[known : known + partial, ..., : width // 2] = 1
    return dataclasses.replace(views, image_known=mask)
