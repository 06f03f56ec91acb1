"""How generated views are fitted into a training: colours that meet the splats', masks of what is new, Gaussians where
there are none.
"""

from __future__ import annotations

import dataclasses

import torch

from fb_core.completion.options import CompletionConfig
from fb_core.completion.pixel_trust import Curve
from fb_core.completion.planning.plan import CompletionPlan
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.geometry.shell import Shell
from fb_nerfstudio.capture.splat_renders import SOLID, coarse, render_geometry
from fb_nerfstudio.capture.unseen import find_unseen, unseen_gaussians, with_matched_colors, with_unseen_masks
from fb_nerfstudio.generation.scene import TrainedScene
from fb_nerfstudio.generation.trusted_views import with_pixel_trust

_LEAST_UNSEEN = 0.02  # of a view's pixels: with fewer to train on it is not generated


def fitted_in(
    views: CompletedViews,
    scene: TrainedScene,
    config: CompletionConfig,
    *,
    shell: Shell,
    holes_only: bool = False,
    curve: Curve | None = None,
) -> tuple[CompletedViews, int]:
    """Match colours, mask, and place Gaussians for what the capture has not seen.

    Args:
        views: as they were generated.
        scene: capture and splats; these get the Gaussians.
        config: which of all this is wanted.
        shell: where the surface is guessed to be.
        holes_only: place Gaussians only where no splats are.
        curve: from what speaks for and against a pixel to its trust; None leaves the trust of the views as it is.

    Returns the views as they are to be trained on, and the number of new Gaussians.
    """
    if (
        config.task == "inpaint"
    ):  # the capture's own cameras: masks and colours are right already, and depth is nobody's
        return views, 0
    splats, places = scene.splats, config.seed_gaussians
    if not places and config.generated_pixels == "all" and curve is None:
        return views, 0
    rendered = render_geometry(splats, coarse(views.cameras)) if scene.is_trained else None
    unseen = find_unseen(views.cameras, scene.cameras, shell, rendered, scene.known)
    unseen = unseen.without(scene.space_in_view())
    views = with_pixel_trust(views, unseen, rendered, shell, curve)
    if config.match_colors and rendered is not None:
        views = with_matched_colors(views, unseen, rendered)
    if config.generated_pixels == "unseen":
        views = with_unseen_masks(views, unseen)
    if not places:
        return views, 0
    if holes_only and rendered is not None:
        unseen = dataclasses.replace(unseen, mask=unseen.mask & (rendered.accumulation < SOLID))
    generator = torch.Generator().manual_seed(config.seed)
    limit = most_seeds(config.max_seed_gaussians, splats.room)
    points, colors = unseen_gaussians(views, unseen, limit=limit, generator=generator)
    return views, splats.add_gaussians(points, colors, scene.optimizers) if len(points) else 0


def most_seeds(asked: int, room: int | None) -> int:
    """How many Gaussians generated views may get: half of the room there is (None is room without end). The other half
    is for what the capture still grows.
    """
    return asked if room is None else min(asked, room // 2)


def needed_by_splats(plan: CompletionPlan, scene: TrainedScene) -> CompletionPlan:
    """The plan without the views of which the capture shows all, as far as trained splats tell: nothing of them would
    be trained on.
    """
    useless = []
    for planned in plan.rounds:
        rendered = render_geometry(scene.splats, coarse(planned.cameras))
        unseen = find_unseen(planned.cameras, scene.cameras, plan.shell, rendered, scene.known)
        useless.append(unseen.mask.flatten(1).float().mean(dim=1) < _LEAST_UNSEEN)
    return plan.without(useless)
