"""The bank: generated views as training draws them, beside the captured ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras

from fb_core.completion.results.completed_views import BROUGHT, REQUESTED, CompletedViews
from fb_nerfstudio.bridge import to_nerfstudio


@dataclass(frozen=True, kw_only=True)
class Bank:
    """Generated views with their cameras where training needs them."""

    views: CompletedViews
    """At least one."""
    cameras: Cameras
    """Theirs, on the training's device and without ``cam_idx``."""
    shares: tuple[float, ...]
    """Of each view, the share of its pixels that is trained on, times how far it is believed."""

    @staticmethod
    def of(views: CompletedViews, device: torch.device | str) -> Bank:
        """The bank of these views."""
        if views.trust is not None:
            shares = (views.masks * (views.trust.double() / 255)).mean(dim=(1, 2, 3))
        else:
            believed = torch.tensor([origin.trust for origin in views.origins], dtype=torch.float64)
            shares = views.masks.double().mean(dim=(1, 2, 3)) * believed
        return Bank(views=views, cameras=to_nerfstudio(views.cameras, device), shares=tuple(shares.tolist()))

    def share(self, *, most: float, captured: int) -> float:
        """Of the views that are drawn, the share that comes from the bank: ``most``, or less where that would draw its
        views more often than captured ones.
        """
        generated = sum(self.shares)  # a view of which only a third is trained on counts as a third of a view
        return min(most, generated / (generated + captured))

    def drawn(self, step: int, *, seed: int, probability: float) -> int | None:
        """The view that a step draws with this probability, or None; decided by seed and step alone.

        Every view that is trained on at all is drawn equally often; what is trained on in it says what it weighs.
        """
        draws = np.random.default_rng([seed % 2**63, step])
        if draws.random() >= probability:
            return None
        return int(draws.choice(np.flatnonzero(self.shares)))

    def batch(self, index: int, *, as_float: bool) -> tuple[Cameras, dict[str, Any]]:
        """Camera and batch of one view on the training's device.

        A loss is a mean over the pixels of the mask, so ``view_weight`` is their share of the picture: a pixel counts
        no more because few of its picture are trained on (that made clouds grow before what was captured).
        ``trust`` ([h, w, 1], 0 to 1), where it is known, weighs every pixel; else that of the whole view is part of
        ``view_weight``.
        """
        device, image, mask = self.cameras.device, self.views.images[index], self.views.masks[index]
        image = (image.float() / 255 if as_float else image).to(device)
        batch: dict[str, Any] = {"image": image, "mask": mask.to(device), "view_weight": float(mask.float().mean())}
        if self.views.trust is None:
            batch["view_weight"] *= self.views.origins[index].trust
        else:
            batch["trust"] = self.views.trust[index].to(device).float() / 255
        return self.cameras[index : index + 1], batch


def without_requested(views: CompletedViews | None) -> tuple[CompletedViews | None, CompletedViews | None]:
    """The views of automatic rounds, and those that the viewer or the capture gave; None where there are none."""
    if views is None:
        return None, None
    asked = [index for index, origin in enumerate(views.origins) if origin.role in (REQUESTED, BROUGHT)]
    if not asked:
        return views, None
    other = [index for index in range(len(views)) if index not in set(asked)]
    return (views[other] if other else None), views[asked]
