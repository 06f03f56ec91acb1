"""Classifier-free guidance with a scale per latent (paper, section 3.3: 7 where content is unknown, 1.1 where known),
and its variants.

`guided` makes a velocity field of a prediction under several branches: (null, conditional) or the conditional alone,
and last the conditional with a prompt. All is combined in float32, because a scale of 7 amplifies the rounding of the
branches 13 times.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import LATENT_CHANNELS, Conditioning, join, split, unsplit
from fb_core.sampling.integration.jumps import Jumping
from fb_core.sampling.integration.solvers import VelocityField
from fb_core.sampling.tiling import Predict

_TINY = 1e-12


@dataclass(frozen=True, kw_only=True)
class GuidanceVariant:
    """What may be done beside the paper's guidance; the defaults are the paper's."""

    rescale: float = 0.0
    """Share (0 to 1) by which the guided velocity's spread is brought back to the conditional one's, per view and
    modality, against over-saturation (Lin et al. 2024, section 3.4).
    """
    optimized_scale: bool = False
    """Scale the null velocity to fit the conditional one best before guiding away from it (CFG-Zero*, Fan et al.
    2025).
    """
    zero_init: float = 0.0
    """Share of the way, at its noisy start, on which the state stands still (CFG-Zero*: 0.04); costs no evaluation."""
    begin: float = 1.0
    """Time (1 is noise) below which guidance acts; above it only the conditional branch is evaluated. Another
    distribution.
    """
    end: float = 0.0
    """Time above which guidance acts (Kynkäänniemi et al. 2024)."""

    def __post_init__(self) -> None:
        for name in ("rescale", "zero_init"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"guidance {name}: expected a share from 0 to 1, got {getattr(self, name)}")
        if not 0 <= self.end <= self.begin <= 1:
            raise ValueError(
                f"guidance interval: expected 0 <= end <= begin <= 1, got end {self.end} and begin {self.begin}"
            )

    def acts_at(self, time: float) -> bool:
        """Whether guidance acts at a time."""
        return self.end <= time <= self.begin

    def stands_still_at(self, time: float) -> bool:
        """Whether the state does not move yet."""
        return time > 1 - self.zero_init

    @property
    def is_limited(self) -> bool:
        """Whether there are times without guidance."""
        return self.begin < 1 or self.end > 0

    @property
    def jumps(self) -> tuple[float, ...]:
        """Times in (0, 1) at which the velocity jumps on the way from noise to data, each the first of what follows.

        At `end` itself guidance acts, so what follows begins at the next smaller number.
        """
        return tuple(time for time in (1 - self.zero_init, self.begin, math.nextafter(self.end, 0)) if 0 < time < 1)


PLAIN = GuidanceVariant()
"""The paper's guidance."""


def guidance_map(conditioning: Conditioning, *, known: float, unknown: float) -> Float[Tensor, "n 32 h w"]:
    """Guidance scale per latent: the known scale where known, the unknown scale elsewhere, each modality by its own
    mask.
    """
    image = unknown + (known - unknown) * conditioning.image_known
    rays = unknown + (known - unknown) * conditioning.rays_known
    return unsplit(image.expand(-1, LATENT_CHANNELS, -1, -1), rays.expand(-1, LATENT_CHANNELS, -1, -1))


def branches(
    conditioning: Conditioning, null: Conditioning | None, scale: Float[Tensor, "n 32 h w"]
) -> list[Conditioning]:
    """What guidance has to evaluate: (null, conditional), or only the conditional branch when the scale is 1
    everywhere.

    Raises ValueError where a null branch is needed and there is none.
    """
    if bool((scale == 1).all()):
        return [conditioning]
    if null is None:
        raise ValueError("guidance: a scale other than 1 needs the conditioning of 'nothing is known', got None")
    return [null, conditioning]


def evaluated_by(network: Callable[[Tensor, Tensor], Tensor], parts: list[Conditioning]) -> Predict:
    """The plain way to evaluate branches: join state and conditioning and run the network (sequence, times) on all of
    it, every time.
    """

    def predict(state: Tensor, time: float, views: Tensor | None = None) -> Tensor:
        chosen = slice(None) if views is None else views
        sequences = torch.stack([join(state, Conditioning(channels=part.channels[chosen])) for part in parts])
        return network(sequences, state.new_full((len(parts),), time))

    return predict


def guided(
    predict: Predict,
    scale: Float[Tensor, "n 32 h w"],
    *,
    text_scale: float | None = None,
    variant: GuidanceVariant = PLAIN,
    unguided: Predict | None = None,
) -> VelocityField:
    """Classifier-free guidance v = u + scale (c - u) with a scale per latent; `predict` gives (u, c), or c alone (see
    `branches`).

    Args:
        predict: velocities of the branches.
        scale: from `guidance_map`; it belongs to the views in their given order.
        text_scale: with it one more branch t comes last, c with a prompt, and text_scale (t - c) is added to the
            image's channels.
        variant: changes to the paper's guidance.
        unguided: evaluates what is left without the null branch (c, or c and t) where the variant's interval leaves
            guidance out; None evaluates `predict` and ignores its null branch.
    """

    def piece(since: float) -> VelocityField:
        if variant.stands_still_at(since):
            return lambda state, time: torch.zeros_like(state)
        acts = variant.acts_at(since)
        evaluated = predict if acts or unguided is None else unguided

        def field(state: Tensor, time: float) -> Tensor:
            return combined(
                evaluated(state, time, None).float(), scale, text_scale=text_scale, variant=variant, acts=acts
            )

        return field

    return Jumping(jumps=variant.jumps, piece=piece)


def combined(
    velocities: Float[Tensor, "b n 32 h w"],
    scale: Float[Tensor, "n 32 h w"],
    *,
    text_scale: float | None = None,
    variant: GuidanceVariant = PLAIN,
    acts: bool = True,
) -> Float[Tensor, "n 32 h w"]:
    """The guided velocity of the branches' velocities (see `guided`)."""
    prompted = None
    if text_scale is not None:
        velocities, prompted = velocities[:-1], velocities[-1]
    conditional = velocity = velocities[-1]
    if acts and len(velocities) == 2:
        null = velocities[0]
        if variant.optimized_scale:
            null = _fitted(null, conditional) * null
        velocity = null + scale * (conditional - null)
    if prompted is not None and text_scale is not None:
        image, rays = split(prompted - conditional)
        velocity = velocity + text_scale * unsplit(image, torch.zeros_like(rays))
    if variant.rescale > 0 and velocity is not conditional:
        velocity = velocity * (1 + variant.rescale * (_deviation(conditional) / _deviation(velocity) - 1))
    return velocity


def _fitted(null: Tensor, conditional: Tensor) -> Tensor:
    """The factor of the null velocity that is nearest to the conditional one, per view and modality (1 where there is
    no null velocity).
    """

    def of(pair: tuple[Tensor, Tensor]) -> Tensor:
        square = pair[0].square().sum(dim=(1, 2, 3), keepdim=True)
        factor = (pair[0] * pair[1]).sum(dim=(1, 2, 3), keepdim=True) / square.clamp(min=_TINY)
        return torch.where(square > _TINY, factor, torch.ones_like(factor)).expand_as(pair[0])

    return unsplit(*map(of, zip(split(null), split(conditional), strict=True)))


def _deviation(velocity: Tensor) -> Tensor:
    """Standard deviation per view and modality, never 0 (also not in its gradient)."""

    def of(part: Tensor) -> Tensor:
        return (part.var(dim=(1, 2, 3), keepdim=True, correction=0) + _TINY).sqrt().expand_as(part)

    return unsplit(*map(of, split(velocity)))
