"""Views that a training generates by itself: the rounds that are due, and those that the capture brings along."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

from nerfstudio.utils.rich_utils import CONSOLE

from fb_core.completion.brought_views import brought_views, takes_brought
from fb_core.completion.inpainting import announcement_of_inpainting, plan_inpainting, run_inpainting
from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import CompletionPlan, plan_completion
from fb_core.completion.requests import merged
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.rounds import CapturedView, announcement_of_rounds, open_cache, run_completion
from fb_core.completion.samples import Inpainter
from fb_core.completion.trust import Trust, measured_trust
from fb_core.data.capture.frames import Frame
from fb_core.machine.precision import precision_in_words
from fb_nerfstudio.generation import surroundings
from fb_nerfstudio.generation.bank import without_requested
from fb_nerfstudio.generation.first_guess import first_guess
from fb_nerfstudio.generation.fitting_in import needed_by_splats
from fb_nerfstudio.generation.generation import Generation
from fb_nerfstudio.generation.next_round import due_after, former_of, in_turn
from fb_nerfstudio.generation.scene import TrainedScene
from fb_nerfstudio.generation.surroundings import Bars, refusing, say_found
from fb_nerfstudio.generation.trusted_views import surroundings_of
from fb_nerfstudio.viewer import views_in_words


def complete(generation: Generation, brought: Sequence[Frame], step: int) -> None:
    """Bring all generated views together: those that the capture brings along, and what is to be generated.

    Args:
        generation: the training.
        brought: generated frames of the capture, with cameras in the world of the splats.
        step: of the training.
    """
    completion = generation.completion
    taken = brought if takes_brought(completion) else []
    if not taken or completion.on_completed_capture == "extend":
        while (due := generate_due(generation, step)) is not None:
            if due > step:  # the splats are trained on this round before the next one is planned
                return generation.save_checkpoint(step)
    if taken:  # last, in one step with the end: a run that goes on takes them once
        take_brought(generation, taken, step)
    generation.state.finished = True
    generation.save_checkpoint(step)


def take_brought(generation: Generation, frames: Sequence[Frame], step: int) -> None:
    """Put generated views that the capture brings along into the bank as a round of their own."""
    state, bank = generation.state, generation.state.views
    number = 1 + max([generation.completion.densify_rounds, *state.round_numbers])
    with refusing():
        views = brought_views(list(frames), number=number, size=None if bank is None else bank.cameras.width)
    scene = generation.scene(step)
    survey = scene.survey(generation.completion, size=views.cameras.width)
    views, added = generation.fitted_in(views, scene, survey.shell)
    state.set_views(merged(bank, (), views))
    generation.save_views()
    count = views_in_words(len(views), "generated ")
    CONSOLE.print(f"{count} of the capture taken, {added} Gaussians placed in unseen regions.")


def generate_due(generation: Generation, step: int) -> int | None:
    """Generate the rounds that are due and missing; each is kept in the bank, in the run's folder and in a checkpoint
    at once.

    Returns the step before which the next round is due, None where there is none. Raises Refused with one sentence as
    the model does.
    """
    started, config, state = time.perf_counter(), generation.completion, generation.state
    scene = generation.scene(step)
    plan = _with_model(generation, scene)
    surroundings.release_memory()
    generation.panel.coverage.generated()
    turns = in_turn(config)
    new, other = _to_fit_in(state.views, state.automatic_views, plan if turns else None)
    added = 0
    if new is not None:
        new, added = generation.fitted_in(new, scene, plan.shell)
        state.set_views(
            new
            if other is None
            else CompletedViews.cat([*([other] if turns else []), new, *([] if turns else [other])])
        )
    due = None
    if turns:
        due = due_after(config, state.rounds, plan, state.trust, step=step, last=generation.last_step)
        state.rounds = state.rounds.after(plan, step=step, due=step if due is None else due)
    if new is not None:
        folder = generation.save_views()
        where = "" if folder is None else f", saved in {folder}"
        seconds = time.perf_counter() - started
        CONSOLE.print(
            f"{len(new)} generated views in {seconds:.0f} s, {added} Gaussians placed in unseen regions{where}."
        )
    return due


def _with_model(generation: Generation, scene: TrainedScene) -> CompletionPlan:
    """Plan and generate; the model is gone with this function's frame."""
    config, state = generation.completion, generation.state
    model = generation.load_inpainter()
    inpaints, size = config.task == "inpaint", config.image_size or model.size
    if inpaints:
        points = scene.seen_points(scene.planned_from)
        plan, announce = plan_inpainting(scene.cameras, points, config, size=size), announcement_of_inpainting
    else:
        plan = _plan(generation, scene, size=size)
        announce = partial(announcement_of_rounds, done=state.automatic_views)
    generation.panel.coverage.show(plan)
    if not plan.rounds and plan.covered is not None:
        CONSOLE.print(announcement_of_rounds(plan, config, model))
    if plan.rounds:
        with refusing():
            CONSOLE.print(announce(plan, config, model))
        if config.inpainter == "diffusion":
            CONSOLE.print(
                f"The model's matrix products: {precision_in_words(config.precision, generation.captured.device)}."
            )
        _generate(generation, scene, plan, model)
    return plan


def _plan(generation: Generation, scene: TrainedScene, *, size: int) -> CompletionPlan:
    """Context and cameras of the rounds to generate; of the next one alone where they are planned one after the
    other.
    """
    config, state = generation.completion, generation.state
    points = scene.seen_points(scene.planned_from)
    former = free = None
    if in_turn(config):
        former = former_of(state.automatic_views, scene.trained_splats, state.rounds.number)
        free = scene.free_space()
    plan = plan_completion(scene.cameras, points, config, size=size, known=scene.known, former=former, free=free)
    return needed_by_splats(plan, scene) if plan.covered is not None and scene.is_trained else plan


def _generate(generation: Generation, scene: TrainedScene, plan: CompletionPlan, model: Inpainter) -> None:
    """Let the model be tried where that is asked for, then generate round after round; each is kept at once."""
    config, state, done = generation.completion, generation.state, generation.state.automatic_views
    context = generation.context(scene, plan.context)
    inpaints = config.task == "inpaint"
    guess = None
    if config.start != "noise" and scene.is_trained:
        guess = partial(first_guess, scene.splats, soft=config.start == "soft")
    run = run_inpainting if inpaints else partial(run_completion, first_guess=guess)
    left = sum(done is None or one.number not in done.rounds for one in plan.rounds)
    with Bars(generation.panel, len(plan.rounds)) as bars, refusing():
        if config.trust == "measured" and not inpaints and state.trust is None:
            state.trust = _tried(config, scene, plan, [*context], model, bars)
            CONSOLE.print(state.trust.in_words)
            if state.trust.hidden:  # a kill in the first round costs that round, not the trial too
                generation.save_checkpoint(scene.step)
        for views in run(plan, context, model, config, done=done, on_step=bars.step, on_found=say_found):
            left -= 1
            state.set_views(merged(state.views, (), state.believed(views)))
            if left > 0:
                generation.save_checkpoint(scene.step)


def _tried(
    config: CompletionConfig,
    scene: TrainedScene,
    plan: CompletionPlan,
    context: list[CapturedView],
    model: Inpainter,
    bars: Bars,
) -> Trust:
    """How far the model is to be believed on this capture: hidden captured views, generated and compared."""
    return measured_trust(
        context,
        model,
        config,
        size=plan.size,
        cache=open_cache(config),
        on_step=bars.trial,
        surroundings=surroundings_of(plan.shell, scene.trained_splats),
    )


def _to_fit_in(
    views: CompletedViews | None, automatic: CompletedViews | None, planned: CompletionPlan | None
) -> tuple[CompletedViews | None, CompletedViews | None]:
    """The generated views that are new to the splats, and all others: those of a plan of rounds in turn, else all
    automatic ones.
    """
    if views is None or automatic is None:
        return None, None
    if planned is None:
        return without_requested(views)
    numbers = {one.number for one in planned.rounds}
    new = [place for place, origin in enumerate(views.origins) if origin.round in numbers]
    rest = [place for place in range(len(views)) if place not in set(new)]
    return (views[new] if new else None), (views[rest] if rest else None)
