"""How far a model is to be believed on a capture: a few captured views are hidden, generated from the others, and compared.

A model knows some scenes and not others. What it makes of pictures that can be looked up says more than any list of what it was trained
on, and costs one pass.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.views import Views
from fb_nerfstudio.completion import CapturedView, Inpainter, fitted_view, in_8_bits
from fb_nerfstudio.completion_cache import CompletionCache, round_key
from fb_nerfstudio.completion_config import CompletionConfig

LEAST = 0.05
"""Trust in a model that knows nothing of the capture: it still fills what nobody has seen, and moves nothing else."""
_FEWEST = 4  # context views: of fewer, none can be spared
_MOST_HIDDEN = 4
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

    @property
    def value(self) -> float:
        """Share of the better baseline's error that the model does away with, from `LEAST` to 1; 1 where nothing could be measured."""
        if not self.hidden:
            return 1.0
        return min(1.0, max(LEAST, 1 - self.model / max(min(self.mean, self.nearest), 1e-12)))

    @property
    def in_words(self) -> str:
        """One sentence for a person, with what to do where the model is of no use."""
        if not self.hidden:
            return "The capture has too few views to hide any, so nobody knows how good the model is here; its views count in full."
        against = f"{_decibels(self.mean, self.model)} than the mean colour, {_decibels(self.nearest, self.model)} than the nearest photo"
        told = f"On {self.hidden} hidden views of your capture the model is {against}: its views count {self.value:.2f} of a photo."
        if self.value > LEAST:
            return told
        return f"{told} It knows no scenes like this one; a model that does (fillerbuster convert, train) fills it better."


def measured_trust(
    context: Sequence[CapturedView],
    model: Inpainter,
    config: CompletionConfig,
    *,
    size: int,
    cache: CompletionCache | None = None,
    on_step: Callable[[int, int], None] | None = None,
) -> Trust:
    """Hide a quarter of the context views (at most 4, never the first, which is the frame's), generate them from the others, compare.

    Args:
        context: captured views, the most level first.
        model: the diffusion model.
        config: how to sample, and the seed.
        size: side of the views in pixels.
        cache: of generated rounds; what was ever generated from the same inputs is taken from there, else kept there.
        on_step: called with (denoising steps done, steps in all).
    """
    count = min(_MOST_HIDDEN, len(context) // _FEWEST)
    if count == 0:
        return Trust(hidden=0, model=math.nan, mean=math.nan, nearest=math.nan)
    places = torch.linspace(1, len(context) - 1, count + 2)[1:-1].round().long().tolist() if count > 1 else [len(context) // 2]
    hidden = Views.cat([fitted_view(context[place], size) for place in places])
    told = Views.cat([fitted_view(view, size) for place, view in enumerate(context) if place not in set(places)])
    asked = dataclasses.replace(hidden, images=torch.zeros_like(hidden.images), image_known=torch.zeros_like(hidden.image_known))
    generated = _as_kept(_generated(Views.cat([told, asked]), count, model, config, cache, on_step)).to(hidden.images)
    truth = _as_kept(in_8_bits(hidden.images)).to(hidden.images)
    known = (hidden.image_known >= 1).to(hidden.images)
    mean = (told.images * told.image_known).sum(dim=(0, 2, 3)) / told.image_known.sum().clamp(min=1)
    looks = [context[place].camera for place in range(len(context)) if place not in set(places)]
    nearest = told.images[[_nearest(context[place].camera, looks) for place in places]]
    return Trust(
        hidden=count,
        model=_error(generated, truth, known),
        mean=_error(mean[None, :, None, None].expand_as(generated), truth, known),
        nearest=_error(nearest, truth, known),
    )


def _generated(
    sequence: Views,
    count: int,
    model: Inpainter,
    config: CompletionConfig,
    cache: CompletionCache | None,
    on_step: Callable[[int, int], None] | None,
) -> UInt8[Tensor, "n h w 3"]:
    """The last views of the sequence, in 8 bits: a picture from the cache and one that is new are the same."""
    sampling = dataclasses.replace(config.sampling(model.recommended_sampling), guess="start")
    seed, key, found = (config.seed + _SEED) % 2**63, "", None
    if cache is not None:
        key = round_key(sequence, seed=seed, sampling=sampling, model_hash=model.model_hash)
        found = cache.find(key, views=count, size=sequence.size[0])
    if found is None:
        done = model.complete(sequence, generator=torch.Generator().manual_seed(seed), sampling=sampling, on_step=on_step)
        found = in_8_bits(done.images[-count:])
        if cache is not None:
            cache.keep(key, found)
    return found


def _as_kept(pictures: UInt8[Tensor, "n h w 3"]) -> Float[Tensor, "n 3 h w"]:
    return pictures.permute(0, 3, 1, 2).float() / 255


def _error(pictures: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"], known: Float[Tensor, "n 1 h w"]) -> float:
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
