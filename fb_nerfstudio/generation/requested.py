"""What a person asks for in the viewer, done between two iterations, whole or not at all."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.planning.plan import CompletionPlan, plan_completion
from fb_core.completion.requests import (
    CompleteFrom,
    CompleteMissing,
    PlannedRequest,
    RegenerateRound,
    RemoveView,
    Request,
    merged,
    place_of,
    plan_request,
    without_view,
)
from fb_core.completion.results.completed_views import REQUESTED, CompletedViews, round_title
from fb_core.completion.rounds import run_completion
from fb_core.geometry.shell import Shell
from fb_nerfstudio.capture.unseen import seen_by_nobody_else
from fb_nerfstudio.generation import surroundings
from fb_nerfstudio.generation.fitting_in import needed_by_splats
from fb_nerfstudio.generation.generation import Generation
from fb_nerfstudio.generation.next_round import former_of
from fb_nerfstudio.generation.scene import TrainedScene
from fb_nerfstudio.generation.surroundings import Bars, say_found
from fb_nerfstudio.splats.all_or_nothing import undone_on_error
from fb_nerfstudio.viewer import views_in_words

_logger = logging.getLogger(__name__)


def serve(generation: Generation, request: Request, step: int) -> str:
    """Change bank and splats as asked, in the checkpoint and the run's folder too, or not at all; returns what was
    done.

    Raises ValueError with a sentence for what cannot be done, and as the model does.
    """
    with _unchanged_on_error(generation):
        if isinstance(request, RemoveView):
            answer = _remove(generation, request, step)
        else:
            answer = _generate(generation, request, step)
        generation.save_views()
        generation.save_checkpoint(step)
    return answer


@contextmanager
def _unchanged_on_error(generation: Generation) -> Iterator[None]:
    """Bank, Gaussians and what is outdated are as they were where the block ends with an error, in the run's folder
    too.
    """
    state = generation.state
    views, bank, outdated = state.views, state.bank, list(state.outdated)
    try:
        with undone_on_error(generation.splats, generation.optimizers):
            yield
    except BaseException:
        changed, state.bank, state.outdated = state.bank is not bank, bank, outdated
        if changed:
            try:
                generation.panel.show(views)
                generation.save_views()
            except Exception:  # of drawing or of the disk: the checkpoint has the views
                _logger.warning("The run's folder or the viewer may show views that were given up again", exc_info=True)
        raise


def _remove(generation: Generation, request: RemoveView, step: int) -> str:
    """Take a view out of the bank, and the Gaussians that only it shows."""
    before, place = generation.state.views, place_of(generation.state.views, request.key)
    after = without_view(before, request.key)
    assert before is not None and place is not None  # without_view has raised otherwise
    gone = _forget(generation.scene(step), before[[place]], after)
    generation.state.set_views(after)
    left = views_in_words(len(after or ()))
    return f"1 view removed, with {gone} Gaussians that no other view shows; {left} left."


def _forget(scene: TrainedScene, leaving: CompletedViews, staying: CompletedViews | None) -> int:
    """Take away the Gaussians that only these views had a say in; returns how many."""
    gone = seen_by_nobody_else(scene.splats.means, leaving, staying, scene.cameras, scene.known)
    return scene.splats.remove_gaussians(gone, scene.optimizers)


def _generate(generation: Generation, request: CompleteFrom | CompleteMissing | RegenerateRound, step: int) -> str:
    """Views from where a person stands, or a round anew, fitted into the bank as automatic ones are."""
    started, state, scene = time.perf_counter(), generation.state, generation.scene(step)
    planned, new, shell = _with_model(generation, scene, request)
    surroundings.release_memory()
    if state.views is not None and planned.replaces:
        _forget(scene, state.views[planned.replaces], planned.done)
    new, added = generation.fitted_in(state.believed(new), scene, shell, holes_only=True)
    state.set_views(merged(state.views, planned.replaces, new))
    origin, seconds = new.origins[0], time.perf_counter() - started
    if isinstance(request, RegenerateRound):
        state.generated_anew(request)
    follow = f" To be generated anew from the new anchors: {len(state.outdated)} rounds." if state.outdated else ""
    return (
        f"{round_title(origin.role, origin.round)}: {views_in_words(len(new))} in {seconds:.0f} s with seed "
        f"{origin.seed}, {added} Gaussians placed in holes.{follow}"
    )


def _with_model(
    generation: Generation, scene: TrainedScene, request: CompleteFrom | CompleteMissing | RegenerateRound
) -> tuple[PlannedRequest, CompletedViews, Shell]:
    """Plan and generate; the model is gone with this function's frame."""
    config, bank, model = generation.completion, generation.state.views, generation.load_inpainter()
    survey = scene.survey(config, size=config.image_size or model.size)
    if isinstance(request, CompleteMissing):
        planned = plan_missing(request, survey, bank, scene, config)
    else:
        planned = plan_request(request, survey, bank, scene.cameras, config, scene.known)
    context = [*generation.context(scene, planned.plan.context)]
    with Bars(generation.panel, 1) as bars:
        (new,) = run_completion(
            planned.plan, context, model, config, done=planned.done, on_step=bars.step, on_found=say_found
        )
    return planned, new, survey.shell


def plan_missing(
    request: CompleteMissing,
    survey: CompletionPlan,
    bank: CompletedViews | None,
    scene: TrainedScene,
    config: CompletionConfig,
) -> PlannedRequest:
    """One round of the views that show most of what nobody has seen, like one of an automatic completion.

    Args:
        request: how many views at most, seed and prompt.
        survey: shape, shell, context and size, as an automatic completion finds them.
        bank: the generated views so far.
        scene: capture and splats.
        config: the completion's options.

    Raises ValueError with a sentence where no view would be worth its while.
    """
    size = survey.size if bank is None else bank.cameras.width
    numbers = {"densify_rounds": 1, "densify_views": request.views, "least_round_gain": 0.0}
    options = dataclasses.replace(config, anchor_views=None, camera_path=None, context_choice="spread", **numbers)
    former = former_of(bank, scene.trained_splats, 1)
    points = scene.seen_points(scene.surveyed)
    plan = plan_completion(scene.cameras, points, options, size=size, known=scene.known, former=former)
    if scene.is_trained and plan.rounds:
        plan = needed_by_splats(plan, scene)
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
    context = nearest_context(scene.cameras, new, survey.shell, config.context_views, scene.known)
    return PlannedRequest(plan=dataclasses.replace(plan, context=tuple(context), rounds=(one,)), replaces=(), done=bank)
