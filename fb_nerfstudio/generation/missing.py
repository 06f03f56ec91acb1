"""Views of what is still missing, asked for in the viewer: planned by what the capture and all generated views so far
have left unseen.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.planning.plan import CompletionPlan, plan_completion
from fb_core.completion.requests import CompleteMissing, PlannedRequest
from fb_core.completion.results.completed_views import REQUESTED, CompletedViews
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.generation.fitting_in import needed_by_splats
from fb_nerfstudio.generation.next_round import former_of


def plan_missing(
    request: CompleteMissing,
    scene: CompletionPlan,
    bank: CompletedViews | None,
    splats: Any,
    cameras: Sequence[Pinholes],
    points: Float[Tensor, "m 3"] | None,
    config: CompletionConfig,
    known: Sequence[Bool[Tensor, "_h _w"] | None],
    *,
    trained: bool,
) -> PlannedRequest:
    """One round of the views that show most of what nobody has seen, like one of an automatic completion.

    Args:
        request: how many views at most, seed and prompt.
        scene: shape, shell, context and size, as an automatic completion finds them.
        bank: the generated views so far.
        splats: the model that is trained.
        cameras: the capture's.
        points: seen surface points, if there are any.
        config: the completion's options.
        known: of each captured picture its known part, None for all of it.
        trained: whether the splats' depth and opacity are to be believed.

    Raises ValueError with a sentence where no view would be worth its while.
    """
    size = scene.size if bank is None else bank.cameras.width
    numbers = {"densify_rounds": 1, "densify_views": request.views, "least_round_gain": 0.0}
    options = dataclasses.replace(config, anchor_views=None, camera_path=None, context_choice="spread", **numbers)
    plan = plan_completion(
        list(cameras), points, options, size=size, known=known, former=former_of(bank, splats, 1, trained=trained)
    )
    if trained and plan.rounds:
        plan = needed_by_splats(plan, splats, cameras, known)
    if not plan.rounds:
        seen = "" if plan.covered is None else f" {plan.covered[0]:.0%}"
        raise ValueError(
            f"Capture and generated views show{seen} of what surrounds the capture; no further view would show enough "
            "of the rest."
        )
    taken = [config.densify_rounds, *([] if bank is None else bank.rounds)]
    new = plan.rounds[0].cameras
    one = dataclasses.replace(
        plan.rounds[0], number=1 + max(taken), role=REQUESTED, seed=request.seed, prompt=request.prompt
    )
    context = nearest_context(cameras, new, scene.shell, config.context_views, known)
    return PlannedRequest(plan=dataclasses.replace(plan, context=tuple(context), rounds=(one,)), replaces=(), done=bank)
