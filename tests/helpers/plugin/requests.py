"""Requests as a person makes them, and what comes of them."""

from __future__ import annotations

import math
from types import SimpleNamespace

import torch
from helpers.plugin.datamanagers import (
    ToySplats,
    toy_viewer,
)

from fb_core.completion.results.completed_views import CompletedViews, Origin
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.paths import sphere_directions
from fb_nerfstudio.viewer import CompletionPanel

UP = torch.tensor([0.0, 0.0, 1.0])


def ring(
    count: int = 8, radius: float = 1.0, *, outward: bool = True, width: int = 32, height: int = 24
) -> list[Pinholes]:
    """Cameras at equal angles that look away from the middle, or at it."""
    angles = torch.arange(count) * 2 * math.pi / count
    centers = radius * torch.stack([angles.cos(), angles.sin(), torch.zeros(count)], dim=1)
    targets = 3 * centers if outward else torch.zeros_like(centers)
    cameras = Pinholes.looking_at(centers, targets, up=UP, fov_degrees=60.0, width=width, height=height)
    return [cameras[index] for index in range(count)]


def bank_of(*rounds: tuple[str, int, int], size: int = 8) -> CompletedViews:
    """Views of (role, number, count), each with a grey of its own."""
    groups = []
    for role, number, count in rounds:
        cameras = Pinholes.cat(ring(count, 0.5 + 0.1 * number, width=size, height=size))
        origin = Origin(role=role, round=number, seed=100 + number, prompt="", model_hash="m")
        grey = torch.arange(count, dtype=torch.uint8)[:, None, None, None] + 10 * number
        images = grey.expand(count, size, size, 3).contiguous()
        masks = torch.ones(count, size, size, 1, dtype=torch.bool)
        groups.append(CompletedViews(images=images, masks=masks, cameras=cameras, origins=(origin,) * count))
    return CompletedViews.cat(groups)


def ask_for(manager, request) -> None:
    manager.completion_panel.requests.put(request)


def said(manager) -> str:
    return manager.completion_panel._message


class TrackedSplats(ToySplats):
    """Gaussians all around that can be taken away."""

    def __init__(self) -> None:
        super().__init__()
        self.means = 30 * sphere_directions(500, like=torch.zeros(1))

    def remove_gaussians(self, chosen, optimizers) -> int:
        self.means = self.means[~chosen]
        return int(chosen.sum())


def opened_panel(bank: CompletedViews) -> tuple[CompletionPanel, SimpleNamespace]:
    panel, viewer = CompletionPanel(), toy_viewer()
    panel._setup(viewer)
    panel.show(bank)
    panel.training_begins()
    return panel, viewer
