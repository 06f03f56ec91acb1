"""How far the cameras of photos and new views, looked for once more, are from those that were used."""

from __future__ import annotations

from typing import Any

import torch

from fb_core.completion.fly_through import FoundCameras
from fb_core.data.photos.photo import Photo
from fb_core.evaluation.self_consistency import self_consistency
from fb_core.geometry.viewpoints.paths import strided_subset
from fb_core.inpainter import Fillerbuster
from method_configs.commands.complete.options import CHECKED, CompleteOptions
from method_configs.commands.complete.output import NewViews
from method_configs.commands.complete.plan import pose_sampling

_SIDE = 512  # pixels of the longer side of photos whose cameras are looked for once more


def agreement(
    photos: list[Photo],
    found: FoundCameras,
    context: list[int],
    new: NewViews,
    model: Fillerbuster,
    options: CompleteOptions,
) -> dict[str, Any]:
    """Poses, views, poses: how far the cameras of some photos and new views, looked for once more, are from those that
    were used.
    """
    method = "features" if found.method == "features" else "model"
    images, cameras = [], []
    for index in context[:CHECKED]:
        images.append(photos[index].load(_SIDE))
        cameras.append(found.camera(index).scaled(images[-1].shape[2], images[-1].shape[1]))
    for view in strided_subset(len(new.images), CHECKED):
        images.append(new.images[view])
        cameras.append(new.cameras[view])
    cameras = [camera.to(torch.float64) for camera in cameras]
    sampling = pose_sampling(model, options)
    errors = self_consistency(images, cameras, method=method, model=model, seed=options.seed, sampling=sampling)
    return {
        "method": method,
        "photos": min(len(context), CHECKED),
        "new_views": len(images) - min(len(context), CHECKED),
        **errors,
    }
