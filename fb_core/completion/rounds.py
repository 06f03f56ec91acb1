"""Running a completion (paper, section 3.2): generate the planned views round by round.

Anchors are conditioned on the capture, densified views on the capture and the anchors. Nothing here knows nerfstudio.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.duration import duration_in_words
from fb_core.completion.options import CompletionConfig, PlacementConfig
from fb_core.completion.planning.plan import CompletionPlan, PlannedRound, plan_completion
from fb_core.completion.results.cache import CompletionCache
from fb_core.completion.results.completed_views import ANCHOR, CompletedViews, Origin
from fb_core.completion.samples import Inpainter, Question, Samples, draw
from fb_core.data.media import resize
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.square_fit import SquareFit
from fb_core.inpainter import SamplingConfig
from fb_core.masks import wholly_known
from fb_core.views import Views

__all__ = [
    "CapturedView",
    "CompletedViews",
    "CompletionConfig",
    "CompletionPlan",
    "PlacementConfig",
    "announcement_of_rounds",
    "fitted_view",
    "plan_completion",
    "run_completion",
]


@runtime_checkable
class Forecasting(Protocol):
    """An inpainter that knows beforehand what its work will take."""

    def expected(
        self, *, views: int, known: int, size: int, sampling: SamplingConfig, prompted: bool = False
    ) -> tuple[float, int]:
        """Seconds, about, and bytes, at most, that completing square views takes, so many of them known."""
        ...


@runtime_checkable
class Named(Protocol):
    """An inpainter that is no model of ours, and says what it is."""

    name: str
    """What a person calls it."""
    weight_free: bool
    """Whether it imagines nothing."""


@dataclass(frozen=True, kw_only=True)
class CapturedView:
    """One captured picture with its camera, as far as it is known."""

    image: Float[Tensor, "3 h w"]
    """RGB in [0, 1]."""
    known: Float[Tensor, "1 h w"]
    """1 where the pixel is given."""
    camera: Pinholes
    """One camera of the picture's size."""


def run_completion(
    plan: CompletionPlan,
    context: Sequence[CapturedView],
    model: Inpainter,
    config: CompletionConfig,
    *,
    done: CompletedViews | None = None,
    first_guess: Callable[[Pinholes], Views | None] | None = None,
    on_step: Callable[[PlannedRound, int, int], None] | None = None,
    on_found: Callable[[PlannedRound], None] | None = None,
) -> Iterator[CompletedViews]:
    """Generate the planned rounds one after the other; yields the new views of each.

    Every round sees the context views (fitted to the model's size) and, if it is no anchor round, all anchors. The same
    plan, context, model and options give the same views whatever happened before: each round has its own seed. With
    ``config.cache_dir`` a round that was ever generated from the same inputs is loaded instead.

    Args:
        plan: what to generate.
        context: the captured views ``plan.context``, in that order.
        model: the diffusion model.
        config: sampling options.
        done: views of rounds that an interrupted run has generated; these rounds are skipped.
        first_guess: gives what new cameras see as far as that is known; generation starts from there at
            ``config.strength``, or is told of it, as ``config.guess`` says.
        on_step: called with (round, denoising steps done, steps in all).
        on_found: called with a round that is loaded from the cache.

    Raises ValueError when the cache's folder is a file, and as the model does.
    """
    maker = RoundMaker(model=model, config=config, cache=open_cache(config), on_step=on_step, on_found=on_found)
    fitted = Views.cat([fitted_view(view, plan.size) for view in context])
    finished = [] if done is None else done.rounds
    anchors = (
        None if done is None else _as_views(done[[i for i, origin in enumerate(done.origins) if origin.role == ANCHOR]])
    )
    ignored = config.strength == 1 and config.sampling(model.recommended_sampling).guess == "start"
    for planned in plan.rounds:
        if planned.number in finished:
            continue
        captured = fitted[list(plan.context_of(planned))]
        known = [captured] if planned.role == ANCHOR or anchors is None else [captured, anchors]
        sequence = Views.cat([*known, Views.unknown(planned.cameras)])
        guess = None if ignored or first_guess is None else first_guess(planned.cameras)
        current = None if guess is None else Views.cat([*known, guess])
        views = _completed(planned, maker.samples(sequence, planned, current), model.model_hash)
        if planned.role == ANCHOR:
            anchors = _as_views(views)
        yield views


def _completed(planned: PlannedRound, samples: Samples, model_hash: str) -> CompletedViews:
    """The views of a round, with where they came from; margins beside its aspect are not trained on."""
    origin = Origin(
        role=planned.role,
        round=planned.number,
        seed=planned.seed,
        prompt=planned.prompt,
        model_hash=model_hash,
        aspect=planned.aspect,
    )
    return CompletedViews(
        images=samples.images,
        masks=_shown(planned.aspect, samples.images.shape[1]).expand(len(samples.images), -1, -1, -1).contiguous(),
        cameras=planned.cameras,
        origins=(origin,) * len(planned.cameras),
        deviation=samples.deviation,
    )


def open_cache(config: CompletionConfig) -> CompletionCache | None:
    """The cache that is asked for. Raises ValueError when its folder is a file."""
    return None if config.cache_dir is None else CompletionCache(config.cache_dir)


@dataclass(frozen=True, kw_only=True)
class RoundMaker:
    """Makes the pictures of rounds: by the model, or from the cache where it has them."""

    model: Inpainter
    """The diffusion model."""
    config: CompletionConfig
    """Sampling options."""
    cache: CompletionCache | None
    """Where rounds are kept; None for nowhere."""
    on_step: Callable[[PlannedRound, int, int], None] | None = None
    """Called with (round, denoising steps done, steps in all)."""
    on_found: Callable[[PlannedRound], None] | None = None
    """Called with a round that is loaded from the cache."""

    def samples(self, sequence: Views, planned: PlannedRound, current: Views | None = None) -> Samples:
        """Pictures of the sequence's last views, those of the round; generated from ``current`` where that is given.

        Raises ValueError as the model does.
        """
        config, on_step, on_found = self.config, self.on_step, self.on_found
        sampling = config.sampling(self.model.recommended_sampling)
        if current is not None:
            sampling = dataclasses.replace(sampling, strength=config.strength)
        question = Question(
            sequence=sequence,
            views=len(planned.cameras),
            seed=planned.seed,
            sampling=sampling,
            prompt=planned.prompt,
            current=current,
        )
        return draw(
            question,
            self.model,
            samples=config.samples,
            cache=self.cache,
            on_step=None if on_step is None else lambda step, steps: on_step(planned, step, steps),
            on_found=None if on_found is None else lambda: on_found(planned),
        )


def fitted_view(view: CapturedView, size: int) -> Views:
    """A captured view at the model's size: the long side scaled to ``size``, the short side padded with unknown pixels.

    The camera follows exactly (a padded picture sees more to both sides). Unknown pixels neither bleed into known ones
    nor matter; a resampled pixel is known when all that it was made from is known.
    """
    _, height, width = view.image.shape
    fit = SquareFit.of(height, width, size)
    image, known = wholly_known(view.image, view.known, lambda channels: resize(channels, fit.height, fit.width))
    return Views.known(fit.framed(image)[None], fit.camera(view.camera), mask=fit.framed(known)[None])


def announcement_of_rounds(
    plan: CompletionPlan, config: CompletionConfig, model: Inpainter, *, done: CompletedViews | None = None
) -> str:
    """One sentence on what is about to be generated, and on what an interrupted run (``done``) has left; two where the
    capture decides.
    """
    shows = f"The capture and the {plan.former_views} views so far show" if plan.former_views else "The capture shows"
    if plan.covered is not None and not plan.rounds:
        if plan.covered[1] > plan.covered[0]:
            return "The splats show all that new views would show already, so no view is generated."
        more = "further " if plan.former_views else ""
        return f"{shows} {plan.covered[0]:.0%} of what surrounds it, so no {more}view is generated."
    context = max(len(plan.context_of(one)) for one in plan.rounds)
    asked = "" if context >= config.context_views else f" (asked for {config.context_views}; the capture has no more)"
    left = [one for one in plan.rounds if done is None or one.number not in done.rounds]
    sequences = [
        (len(plan.context_of(one)) + (0 if one.role == ANCHOR else _anchors(plan)), len(one.cameras)) for one in left
    ]
    there = "" if done is None else f"; {len(done)} of these views are there already"
    along = "" if config.camera_path is None else f" along {config.camera_path.name}"
    sequence = context + max(len(one.cameras) + (0 if one.role == ANCHOR else _anchors(plan)) for one in plan.rounds)
    passes = (
        f"{len(plan.rounds)} passes of {config.sampling(model.recommended_sampling).steps} steps over up to "
        f"{sequence} views"
    )
    decided = ""
    if plan.covered is not None:
        if plan.blind:
            decided = "Nobody can tell yet where surfaces are, so new cameras stand where captured ones stood. "
        decided += f"{shows} {plan.covered[0]:.0%} of what surrounds it, with the new views {plan.covered[1]:.0%}. "
    return decided + (
        f"Completing the scene with {model_name(config, model)} ({model.model_hash[:8]}): "
        f"{plan.new_views} new views{along} of {plan.size}x{plan.size} pixels in {passes}, "
        f"conditioned on {context} of {plan.captured} captured "
        f"views{asked}{there}{expectation(sequences, plan.size, config, model)}."
    )


def expectation(sequences: Sequence[tuple[int, int]], size: int, config: CompletionConfig, model: Inpainter) -> str:
    """What sequences of (known, generated) views will take, as far as the model can tell; for example ``; about 40 s,
    0.6 GiB``.
    """
    if not isinstance(model, Forecasting) or not sequences:
        return ""
    sampling, prompted = config.sampling(model.recommended_sampling), bool(config.prompt)
    each = [
        model.expected(views=known + generated, known=known, size=size, sampling=sampling, prompted=prompted)
        for known, generated in sequences
    ]
    seconds, most = config.samples * sum(one[0] for one in each), max(one[1] for one in each)
    return f"; {duration_in_words(seconds, most)}"


def _shown(aspect: float, size: int) -> Bool[Tensor, "1 h w 1"]:
    """True in the largest rectangle of an aspect (width over height) in the middle of a square."""
    fit = SquareFit.of(*((1.0, aspect) if aspect > 1 else (1 / aspect, 1.0)), size)
    return fit.framed(torch.ones(1, fit.height, fit.width, dtype=torch.bool))[..., None]


def model_name(config: CompletionConfig, model: Inpainter) -> str:
    """What a person calls the model."""
    own = "the bundled model" if config.model is None else f"model {Path(config.model).name}"
    return model.name if isinstance(model, Named) else own


def _anchors(plan: CompletionPlan) -> int:
    return sum(len(one.cameras) for one in plan.rounds if one.role == ANCHOR)


def _as_views(views: CompletedViews) -> Views | None:
    """Generated views as known ones for the next round."""
    if len(views) == 0:
        return None
    return Views.known(views.images.permute(0, 3, 1, 2).float() / 255, views.cameras)
