"""One or several samples of a round, and what is made of them.

A sample shows one of many possible scenes. Where nobody knows what is there, samples differ. Their mean is right more
often than each of them, and blurred; the sample that comes nearest to it is nearly as right, and sharp. How far they
differ tells what the model knows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, UInt8
from torch import Tensor

from fb_core.completion.results.cache import CompletionCache, round_key
from fb_core.completion.results.completed_views import UNSAMPLED
from fb_core.sampling.integration.trajectory import counted
from fb_core.sampling.options import SamplingConfig
from fb_core.views import Views

_OTHER_SAMPLE = 1_000_003  # between the seeds of one round's samples; torch's generator reads 32 bits of a seed
_NEIGHBOURHOOD = 16  # which sample is the likeliest is decided over this part of the picture's side, to each side


@runtime_checkable
class Inpainter(Protocol):
    """What a round needs of ``fb_core.inpainter.Fillerbuster``."""

    model_hash: str

    @property
    def size(self) -> int:
        """Width and height of the views that the model was trained on, in pixels."""
        ...

    @property
    def recommended_sampling(self) -> SamplingConfig:
        """The options that the model's folder recommends."""
        ...

    def complete(
        self,
        views: Views,
        *,
        generator: torch.Generator,
        sampling: SamplingConfig,
        on_step: Callable[[int, int], None] | None,
        prompt: str | None = None,
        current: Views | None = None,
    ) -> Views:
        """The views with what was unknown generated; ``current`` is what generation starts from. Known pixels stay."""
        ...


@runtime_checkable
class DrawsOften(Protocol):
    """An inpainter that answers one question several times for less than several questions cost."""

    def complete_often(
        self,
        views: Views,
        *,
        generators: Sequence[torch.Generator],
        sampling: SamplingConfig,
        on_step: Callable[[int, int], None] | None,
        prompt: str | None = None,
        current: Views | None = None,
    ) -> list[Views]:
        """For each generator what `Inpainter.complete` gives with it."""
        ...


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Pictures of the views of a round, made of one sample or several."""

    images: UInt8[Tensor, "n h w 3"]
    """As the bank holds them."""
    deviation: UInt8[Tensor, "n h w 1"] | None
    """Standard deviation over the samples (root of the colours' mean variance), 254 is 1; None of a single sample."""


@dataclass(frozen=True, kw_only=True)
class Question:
    """All that decides the pictures of a round."""

    sequence: Views
    """Known and unknown views; those of the round stand last."""
    views: int
    """How many these are."""
    seed: int
    """Of the first sample; the others' follow from it."""
    sampling: SamplingConfig
    """How each of them is drawn."""
    prompt: str | None = None
    """What is to be seen."""
    current: Views | None = None
    """What generation starts from, or is told."""

    def seeds(self, samples: int) -> list[int]:
        """Seeds of so many samples; the first is the question's own."""
        return [(self.seed + number * _OTHER_SAMPLE) % 2**63 for number in range(samples)]


def draw(
    question: Question,
    model: Inpainter,
    *,
    samples: int,
    cache: CompletionCache | None,
    on_step: Callable[[int, int], None] | None = None,
    on_found: Callable[[], None] | None = None,
) -> Samples:
    """The samples, and what is made of them; those that the cache has are not drawn again.

    Args:
        question: what is asked.
        model: the diffusion model.
        samples: how many, 1 or more.
        cache: where pictures are kept; None for nowhere.
        on_step: called with (denoising steps done, steps in all).
        on_found: called when all are loaded from the cache.

    Raises ValueError as the model does.
    """
    pictures, keys = dict[int, Tensor](), dict[int, str]()
    seeds = question.seeds(samples)
    if cache is not None:
        settings = {"sampling": question.sampling, "model_hash": model.model_hash, "current": question.current}
        for seed in seeds:
            keys[seed] = round_key(question.sequence, seed=seed, prompt=question.prompt or "", **settings)
            cached = cache.find(keys[seed], views=question.views, size=question.sequence.size[0])
            if cached is not None:
                pictures[seed] = cached
    missing = [seed for seed in seeds if seed not in pictures]
    if not missing and on_found is not None:
        on_found()
    for seed, filled in zip(missing, _drawn(question, model, missing, on_step), strict=True):
        pictures[seed] = in_8_bits(filled.images[-question.views :])
        if cache is not None:
            cache.keep(keys[seed], pictures[seed])
    return made_of([pictures[seed] for seed in seeds])


def _drawn(
    question: Question, model: Inpainter, seeds: list[int], on_step: Callable[[int, int], None] | None
) -> list[Views]:
    """A sample for each seed."""
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    asked = {"sampling": question.sampling, "prompt": question.prompt or None, "current": question.current}
    if len(seeds) > 1 and isinstance(model, DrawsOften):
        return model.complete_often(question.sequence, generators=generators, on_step=on_step, **asked)

    return [
        model.complete(
            question.sequence, generator=generator, on_step=counted(on_step, number, len(generators)), **asked
        )
        for number, generator in enumerate(generators)
    ]


def made_of(samples: Sequence[UInt8[Tensor, "n h w 3"]]) -> Samples:
    """The likeliest of several samples, and how far they differ; a single one stays as it is."""
    if len(samples) == 1:
        return Samples(images=samples[0], deviation=None)
    levels = torch.stack([rearrange(one, "n h w c -> n c h w") for one in samples]).double()  # exact, in any order
    deviation = (levels.var(dim=0, correction=1).mean(dim=1, keepdim=True).sqrt() / 255).clamp(max=1)
    deviation = ((UNSAMPLED - 1) * deviation).round()
    deviation = rearrange(deviation.to(torch.uint8), "n c h w -> n h w c").contiguous()
    return Samples(images=in_8_bits(likeliest(levels) / 255), deviation=deviation)


def variance_of(deviation: UInt8[Tensor, "n h w 1"] | None) -> Float[Tensor, "n h w"] | None:
    """Variance over the samples; NaN of single ones, None where all are single."""
    if deviation is None:
        return None
    known = (deviation != UNSAMPLED)[..., 0]
    return torch.where(known, (deviation[..., 0].float() / (UNSAMPLED - 1)).square(), torch.nan)


def likeliest(samples: Float[Tensor, "s n 3 h w"]) -> Float[Tensor, "n 3 h w"]:
    """Every pixel from the sample that comes nearest to the mean of all in its neighbourhood."""
    away = (samples - samples.mean(dim=0)).square().mean(dim=2)
    reach = max(1, samples.shape[-1] // _NEIGHBOURHOOD)
    nearby = F.avg_pool2d(away, 2 * reach + 1, stride=1, padding=reach, count_include_pad=False)
    chosen = nearby.argmin(dim=0)[None, :, None]
    return samples.gather(0, chosen.expand(1, -1, *samples.shape[2:]))[0]


def in_8_bits(images: Float[Tensor, "n 3 h w"]) -> UInt8[Tensor, "n h w 3"]:
    """Pictures as the bank and the cache hold them."""
    return (images.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().contiguous()
