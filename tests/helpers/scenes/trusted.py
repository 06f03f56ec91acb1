"""Models that know the scene or nothing of it."""

from __future__ import annotations

import dataclasses

import torch
from helpers.scenes.completions import MeanFiller, room_cameras

from fb_core.completion.options import CompletionConfig
from fb_core.completion.results.completed_views import CompletedViews, Origin
from fb_core.completion.rounds import CapturedView, fitted_view
from fb_core.views import Views

CONFIG = CompletionConfig(steps=2)


class Knows(MeanFiller):
    """Answers with the truth plus noise of a size."""

    def __init__(self, truth: list[CapturedView], noise: float = 0.0) -> None:
        super().__init__()
        self.truth, self.noise = Views.cat([fitted_view(view, 16) for view in truth]), noise

    def complete(self, views, *, generator, sampling=None, on_step=None, prompt=None, current=None) -> Views:
        self.asked.append(views)
        images = views.images.clone()
        for place in range(len(views)):
            same = (self.truth.raymaps - views.raymaps[place]).abs().amax(dim=(1, 2, 3)).argmin()
            images[place] = self.truth.images[same] + self.noise * torch.randn(3, 16, 16, generator=generator)
        return dataclasses.replace(views, images=images)


def views_of(trust: float, count: int = 3) -> CompletedViews:
    origin = Origin(role="anchor", round=0, seed=0, prompt="", model_hash="", trust=trust)
    return CompletedViews(
        images=torch.zeros(count, 16, 16, 3, dtype=torch.uint8),
        masks=torch.ones(count, 16, 16, 1, dtype=torch.bool),
        cameras=room_cameras(1)[0][[0] * count],
        origins=(origin,) * count,
    )
