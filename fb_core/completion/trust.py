"""How far a model is to be believed on a capture: a few captured views are hidden, generated from the others, and
compared.

A model knows some scenes and not others. What it makes of pictures that can be looked up says more than any list of
what it was trained on, and costs one pass.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.pixel_trust import LEAST, Curve, evidence_of, fitted_curve
from fb_core.completion.results.cache import CompletionCache
from fb_core.completion.rounds import CapturedView, fitted_view
from fb_core.completion.samples import Inpainter, Question, Samples, draw, in_8_bits, variance_of
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.carry_over import Carried, carried_over
from fb_core.geometry.square_fit import SquareFit
from fb_core.views import Views

_FEWEST = 4  # context views: of fewer, none can be spared
_MOST_HIDDEN = 4
# Least share of what is hidden that no view shows: of less, nothing could be learned about what nobody has seen
_UNSEEN = 0.15
_SEED = 7919  # added to the completion's: other noise than any round's


@dataclass(frozen=True, kw_only=True)
class Trust:
    """Mean squared errors (colours in [0, 1]) at the known pixels of hidden captured views."""

    hidden: int
    """Views that were hidden; 0 where the capture has too few to spare any."""
    model: float
    """Of what the model generated there, from noise."""
    mean: float
    """Of the mean colour of the views that were told."""
    nearest: float
    """Of the told view that looks most the same way."""
    splats: float = math.nan
    """Of the splats' render, which has been trained on these photos; NaN before any training."""
    curve: Curve | None = None
    """From what speaks for and against a pixel to its trust; None where nothing could be measured."""

    def state(self) -> dict[str, Any]:
        """Numbers and lists alone, for checkpoints and reports; what is not known is None."""
        errors = {name: getattr(self, name) for name in ("model", "mean", "nearest", "splats")}
        errors = {name: value if math.isfinite(value) else None for name, value in errors.items()}
        curve = (
            None
            if self.curve is None
            else {name: list(value) if isinstance(value, tuple) else value for name, value in vars(self.curve).items()}
        )
        return {"hidden": self.hidden, **errors, "curve": curve}

    @staticmethod
    def from_state(state: dict[str, Any]) -> Trust:
        """The inverse of :meth:`state`."""
        errors = {
            name: math.nan if state[name] is None else float(state[name])
            for name in ("model", "mean", "nearest", "splats")
        }
        curve_state = state["curve"]
        curve = None
        if curve_state is not None:
            curve = Curve(
                weights=tuple(curve_state["weights"]),
                usual=tuple(curve_state["usual"]),
                baseline=float(curve_state["baseline"]),
            )
        return Trust(hidden=int(state["hidden"]), curve=curve, **errors)

    @staticmethod
    def restored(state: dict[str, Any] | None, value: float | None) -> Trust | None:
        """What a checkpoint holds; one of an earlier version knows the value alone."""
        if state is not None:
            return Trust.from_state(state)
        return None if value is None else Trust(hidden=1, model=1 - float(value), mean=1.0, nearest=1.0)

    @property
    def value(self) -> float:
        """Share of the better baseline's error that the model does away with, from `LEAST` to 1; 1 where nothing could
        be measured.
        """
        if not self.hidden:
            return 1.0
        return min(1.0, max(LEAST, 1 - self.model / max(min(self.mean, self.nearest), 1e-12)))

    @property
    def in_words(self) -> str:
        """One sentence for a person, with what to do where the model is of no use."""
        if not self.hidden:
            return (
                "The capture has too few views to hide any, so nobody knows how good the model is here; its "
                "views count in full."
            )
        against = (
            f"{_decibels(self.mean, self.model)} than the mean colour, {_decibels(self.nearest, self.model)} "
            "than the nearest photo"
        )
        if math.isfinite(self.splats):
            against += f", {_decibels(self.splats, self.model)} than the splats' render (trained on these photos)"
        words = (
            f"On {self.hidden} hidden views of your capture the model is {against}: its views count "
            f"{self.value:.2f} of a photo."
        )
        if self.value > LEAST:
            return words
        return (
            f"{words} It knows no scenes like this one; a model that does (fillerbuster convert, train) fills it "
            "better."
        )


class Surroundings(NamedTuple):
    """What new cameras see as far as anybody can tell."""

    depth: Float[Tensor, "n h w"]
    """z-depth; infinite where it is not known."""
    colors: Float[Tensor, "n 3 h w"] | None
    """The splats' colours; None before any training."""


def measured_trust(
    context: Sequence[CapturedView],
    model: Inpainter,
    config: CompletionConfig,
    *,
    size: int,
    cache: CompletionCache | None = None,
    on_step: Callable[[int, int], None] | None = None,
    surroundings: Callable[[Pinholes], Surroundings] | None = None,
) -> Trust:
    """Hide a quarter of the context views (at most 4, never the first, which is the frame's), generate them from the
    others, compare.

    Of as many others a half is hidden, too: these tell what it is worth that a known pixel is near. Where views overlap
    so much that others show nearly all of this, two parts of the scene are hidden from all views besides.

    Args:
        context: captured views, the most level first.
        model: the diffusion model.
        config: how to sample, and the seed.
        size: side of the views in pixels.
        cache: of generated rounds; what was ever generated from the same inputs is taken from there, else kept there.
        on_step: called with (denoising steps done, steps in all).
        surroundings: depth, and the splats' colours, of what these views show; without, pixels are carried over by
            direction alone.
    """
    count = min(_MOST_HIDDEN, len(context) // _FEWEST)
    if count == 0:
        return Trust(hidden=0, model=math.nan, mean=math.nan, nearest=math.nan)
    places = _hidden_places(count, len(context))
    others = [place for place in range(len(context)) if place not in set(places)]
    truth = Views.cat([fitted_view(context[place], size) for place in [*others, *places]])
    truth = dataclasses.replace(truth, images=_as_kept(in_8_bits(truth.images)).to(truth.images))
    cameras = Pinholes.cat([fitted_camera(context[place], size) for place in [*others, *places]])
    trial = _trial(
        truth, cameras, None if surroundings is None else surroundings(cameras), told=len(others), halves=count
    )
    drawn = _generated(trial.asked, model, config, cache, on_step)
    images = _as_kept(drawn.images).to(truth.images)
    known_views, hidden = truth[list(range(len(others)))], truth[list(range(len(others), len(truth)))]
    known = (hidden.image_known >= 1) & ~trial.gone[
        len(others) :, None
    ]  # parts that no view shows are another question
    known = (known if bool(known.any()) else hidden.image_known >= 1).to(images)
    mean = (known_views.images * known_views.image_known).sum(dim=(0, 2, 3)) / known_views.image_known.sum().clamp(
        min=1
    )
    nearest = known_views.images[
        [_nearest(context[place].camera, [context[other].camera for other in others]) for place in places]
    ]
    splats = None if trial.seen is None or trial.seen.colors is None else trial.seen.colors[len(others) :]
    trust = Trust(
        hidden=count,
        model=_error(images[len(others) :], hidden.images, known),
        mean=_error(mean[None, :, None, None].expand_as(hidden.images), hidden.images, known),
        nearest=_error(nearest, hidden.images, known),
        splats=math.nan if splats is None else _error(splats, hidden.images, known),
    )
    return dataclasses.replace(trust, curve=_curve(trial, drawn, baseline=min(trust.mean, trust.nearest)))


@dataclass(frozen=True, kw_only=True)
class _Trial:
    """What a model is asked, and what it should answer."""

    truth: Views
    """Told views first, then those that are hidden wholly."""
    asked: Views
    """The same without what is hidden."""
    cameras: Pinholes
    """Theirs."""
    seen: Surroundings | None
    """What is known of depth and splats."""
    gone: Bool[Tensor, "n h w"]
    """Parts of the scene that are hidden from all of them."""

    def carried(self) -> Carried:
        """What the others tell of each view: a view is no evidence about itself."""
        given, each = self.asked.image_known.flatten(1).any(dim=1), []
        for place in range(len(self.asked)):
            rest = self.asked[[other for other in range(len(self.asked)) if other != place and bool(given[other])]]
            away = None if self.seen is None else along_rays(self.seen.depth[place : place + 1], self.cameras[[place]])
            each.append(
                carried_over(
                    rest.images, rest.image_known, rest.raymaps, self.asked.raymaps[place : place + 1], distance=away
                )
            )
        return Carried(*(torch.cat(parts) for parts in zip(*each, strict=True)))


def _trial(truth: Views, cameras: Pinholes, seen: Surroundings | None, *, told: int, halves: int) -> _Trial:
    """Hide what stands behind the first ``told`` views, halves of some of these, and parts of the scene where that
    leaves little unseen.
    """
    known = truth.image_known.clone()
    known[told:] = 0
    half, step = truth.size[0] // 2, max(1, (told - 1) // halves)
    sides = (
        (slice(None), slice(None, half)),
        (slice(None), slice(half, None)),
        (slice(None, half),),
        (slice(half, None),),
    )
    for number, place in enumerate(list(range(1, told))[::step][:halves]):  # never of the first
        known[(place, 0, *sides[number % len(sides)])] = 0

    def without(known: Float[Tensor, "n 1 h w"], gone: Bool[Tensor, "n h w"]) -> _Trial:
        asked = dataclasses.replace(truth, images=torch.where(known > 0, truth.images, 0.0), image_known=known)
        return _Trial(truth=truth, asked=asked, cameras=cameras, seen=seen, gone=gone)

    trial = without(known, torch.zeros_like(known[:, 0], dtype=torch.bool))
    hidden = (truth.image_known >= 1) & (known < 1)
    if float((trial.carried().there[hidden] == 0).float().mean()) >= _UNSEEN:
        return trial
    gone = _hidden_parts(cameras, None if seen is None else seen.depth, [1 + (told - 1) * part // 3 for part in (1, 2)])
    return without(torch.where(gone[:, None], 0.0, known), gone)


def _hidden_parts(
    cameras: Pinholes, depth: Float[Tensor, "n h w"] | None, places: Sequence[int]
) -> Bool[Tensor, "n h w"]:
    """Pixels that show what lies within cones around the looks of these cameras, half as wide as a picture; by
    direction without depth.
    """
    middle = cameras.centers.mean(dim=0)
    towards = cameras.directions()
    if depth is not None:
        towards = F.normalize(cameras.unproject(torch.where(torch.isfinite(depth), depth, 1e6)) - middle, dim=-1)
    half = math.atan(cameras.width / 2 / float(cameras.focal.mean())) / 2
    looks = cameras.rotations[sorted({min(place, len(cameras) - 1) for place in places}), :, 2]
    return (torch.einsum("nhwc,kc->nhwk", towards, looks) > math.cos(half)).any(dim=-1)


def _curve(trial: _Trial, drawn: Samples, *, baseline: float) -> Curve:
    """The curve from evidence to trust, from all that was hidden."""
    images = _as_kept(drawn.images).to(trial.truth.images)
    given, carried = trial.asked.image_known[:, 0] >= 1, trial.carried()
    depth = torch.full_like(images[:, 0], torch.inf) if trial.seen is None else trial.seen.depth
    depth = depth.masked_fill(given, torch.inf)  # generated pixels are compared with one another, not with the truth
    there = carried.there[:, 0] > 0
    spread = variance_of(drawn.deviation)
    evidence = evidence_of(images, trial.cameras, depth, there | given, carried.images, there & ~given, spread)
    error = (images - trial.truth.images).square().mean(dim=1)
    return fitted_curve(evidence, error, (trial.truth.image_known[:, 0] >= 1) & ~given, baseline=baseline)


def _hidden_places(count: int, of: int) -> list[int]:
    """Places of hidden views among the context: equally spaced, never the first."""
    return torch.linspace(1, of - 1, count + 2)[1:-1].round().long().tolist() if count > 1 else [of // 2]


def along_rays(depth: Float[Tensor, "n h w"], cameras: Pinholes) -> Float[Tensor, "n 1 h w"]:
    """Distances along the rays of z-depths; what is infinitely far is very far."""
    finite = torch.where(
        torch.isfinite(depth),
        depth,
        1e4 * depth[torch.isfinite(depth)].max() if bool(torch.isfinite(depth).any()) else 1e4,
    )
    return (finite / cameras.cosines())[:, None]


def fitted_camera(view: CapturedView, size: int) -> Pinholes:
    """The camera of :func:`fitted_view`."""
    return SquareFit.of(view.image.shape[1], view.image.shape[2], size).camera(view.camera)


def _generated(
    sequence: Views,
    model: Inpainter,
    config: CompletionConfig,
    cache: CompletionCache | None,
    on_step: Callable[[int, int], None] | None,
) -> Samples:
    """The sequence with what is hidden generated, in 8 bits: a picture from the cache and one that is new are the
    same.
    """
    sampling = dataclasses.replace(config.sampling(model.recommended_sampling), guess="start")
    question = Question(sequence=sequence, views=len(sequence), seed=(config.seed + _SEED) % 2**63, sampling=sampling)
    return draw(question, model, samples=config.samples, cache=cache, on_step=on_step)


def _as_kept(pictures: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n 3 h w"]:
    return pictures.permute(0, 3, 1, 2).float() / 255


def _error(
    pictures: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"], known: Float[Tensor, "n 1 h w"]
) -> float:
    return float(((pictures - truth).square() * known).sum() / (3 * known.sum()).clamp(min=1))


def _nearest(camera: Pinholes, others: Sequence[Pinholes]) -> int:
    """Which of the others looks most the same way; of equals the nearer one."""
    looks = torch.cat([other.camera_to_world[:, :, 2] for other in others]).double()
    away = torch.cat([other.centers for other in others]).double() - camera.centers.double()
    cosine = looks @ camera.camera_to_world[0, :, 2].double()
    return int((cosine - 1e-6 * away.norm(dim=1) / (1e-12 + away.norm(dim=1).max())).argmax())


def _decibels(baseline: float, mine: float) -> str:
    gain = 10 * math.log10(max(baseline, 1e-12) / max(mine, 1e-12))
    return f"{abs(gain):.1f} dB {'better' if gain >= 0 else 'worse'}"
