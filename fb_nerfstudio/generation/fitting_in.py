"""How generated views are fitted into a training: colours that meet the splats', masks of what is new, Gaussians where
there are none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Bool
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.pixel_trust import Curve
from fb_core.completion.planning.plan import CompletionPlan
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.shell import Shell
from fb_nerfstudio.capture.unseen import (
    SOLID,
    coarse,
    find_unseen,
    render_geometry,
    unseen_gaussians,
    with_matched_colors,
    with_unseen_masks,
)
from fb_nerfstudio.generation.trusted_views import with_pixel_trust

_LEAST_UNSEEN = 0.02  # of a view's pixels: with fewer to train on it is not generated


def fitted_in(
    views: CompletedViews,
    splats: Any,
    optimizers: Optimizers | None,
    config: CompletionConfig,
    *,
    shell: Shell,
    captured: Sequence[Pinholes],
    known: Sequence[Bool[Tensor, "_h _w"] | None],
    trained: bool,
    holes_only: bool = False,
    curve: Curve | None = None,
) -> tuple[CompletedViews, int]:
    """Match colours, mask, and place Gaussians for what the capture has not seen.

    Args:
        views: as they were generated.
        splats: the model that is trained; Gaussians are added if it can take some.
        optimizers: its optimizers.
        config: which of all this is wanted.
        shell: where the surface is guessed to be.
        captured: the capture's cameras.
        known: of each captured picture its known part.
        trained: whether the splats' depth and opacity are to be believed.
        holes_only: place Gaussians only where no splats are.
        curve: from what speaks for and against a pixel to its trust; None leaves the trust of the views as it is.

    Returns the views as they are to be trained on, and the number of new Gaussians.
    """
    if (
        config.task == "inpaint"
    ):  # the capture's own cameras: masks and colours are right already, and depth is nobody's business
        return views, 0
    places = config.seed_gaussians and hasattr(splats, "add_gaussians")
    if not places and config.generated_pixels == "all" and curve is None:
        return views, 0
    rendered = render_geometry(splats, coarse(views.cameras)) if trained else None
    unseen = find_unseen(views.cameras, captured, shell, rendered, known)
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
    points, colors = unseen_gaussians(
        views, unseen, limit=_room(splats, config.max_seed_gaussians), generator=generator
    )
    return views, splats.add_gaussians(points, colors, optimizers) if len(points) else 0


def _room(splats: Any, most: int) -> int:
    """How many Gaussians generated views may get: half of what the cap leaves free. The other half is for what the
    capture still grows.
    """
    cap = getattr(getattr(splats, "config", None), "max_gaussians", None)
    return most if cap is None else min(most, max(0, cap - splats.num_points) // 2)


def needed_by_splats(
    plan: CompletionPlan, splats: Any, captured: Sequence[Pinholes], known: Sequence[Bool[torch.Tensor, "_h _w"] | None]
) -> CompletionPlan:
    """The plan without the views of which the capture shows all, as far as trained splats tell: nothing of them would
    be trained on.
    """
    useless = []
    for planned in plan.rounds:
        unseen = find_unseen(
            planned.cameras, captured, plan.shell, render_geometry(splats, coarse(planned.cameras)), known
        )
        useless.append(unseen.mask.flatten(1).float().mean(dim=1) < _LEAST_UNSEEN)
    return plan.without(useless)
