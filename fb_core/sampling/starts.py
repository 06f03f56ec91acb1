"""Where sampling starts, and known latents that are re-imposed on the way."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import FACTOR, LATENT_CHANNELS, Conditioning, split, unsplit
from fb_core.flow import at_time
from fb_core.masks import to_latent_grid
from fb_core.sampling.integration.jumps import Jumping, jumps_of, piece_of
from fb_core.sampling.integration.solvers import VelocityField
from fb_core.sampling.integration.time_grids import reference_grid
from fb_core.sampling.options import SamplingConfig
from fb_core.views import Views

_JOINING_TIMES = 4  # steps in which a mask between 0 and 1 says when a latent joins the sampling


@dataclass(frozen=True, kw_only=True)
class Start:
    """Where denoising starts."""

    sampling: SamplingConfig
    """With the strength that follows: 1 where nothing is started from."""
    latents: Float[Tensor, "n 32 h w"] | None = None
    """Of what is started from."""
    joined: Float[Tensor, "n 32 h w"] | None = None
    """Which of these count, and from when on (`joining`)."""
    guess: Views | None = None
    """What is told as a guess."""


def started(
    current: Float[Tensor, "n 32 h w"], noise: Float[Tensor, "n 32 h w"], start: float
) -> Float[Tensor, "n 32 h w"]:
    """SDEdit (Meng et al. 2022): current latents brought to the time at which sampling starts, where the noise hides
    what is to change.
    """
    return at_time(current, noise, current.new_full((len(current),), start))


def reference_started(
    current: Float[Tensor, "n 32 h w"], noise: Float[Tensor, "n 32 h w"], *, strength: float, steps: int
) -> Float[Tensor, "n 32 h w"]:
    """What the original starts from at an image strength below 1 (its flaw F2).

    The image channels alone are brought to the grid's time that is nearest to the strength, but sampling then starts at
    t = 1 all the same.
    """
    wanted = int(1000 * strength) / 1000
    nearest = min(reference_grid(steps)[:-1], key=lambda time: abs(time - wanted))
    return unsplit(split(started(current, noise, nearest))[0], split(noise)[1])


def known_channels(conditioning: Conditioning) -> Float[Tensor, "n 32 h w"]:
    """1 at the latents whose pixels (or rays) are all known, 0 elsewhere."""
    return known_latents(conditioning.image_known, conditioning.rays_known)


def known_latents(
    image_known: Float[Tensor, "n 1 h w"], rays_known: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, "n 32 h w"]:
    """1 where all of a latent is known, 0 elsewhere; the masks are those of the latent grid."""
    image, rays = (
        (known == 1).to(known.dtype).expand(-1, LATENT_CHANNELS, -1, -1) for known in (image_known, rays_known)
    )
    return unsplit(image, rays)


def joining(current: Views, views: Views) -> Float[Tensor, "n 32 h w"] | None:
    """Which latents start from what is current: 1 where they are wholly known in current views or in those to be
    completed, 0 where they start from noise; None where the current ones add nothing.

    Where the least known pixel of a latent has a mask between 0 and 1 in the current views it is that, in quarters: it
    starts in between.
    """
    rays_known = views.rays_known.maximum(current.rays_known)
    known = known_latents(to_latent_grid(views.image_known), to_latent_grid(views.rays_known))
    there = (views.image_known >= 1).to(current.image_known).maximum(current.image_known)
    least = -F.max_pool2d(-there, kernel_size=FACTOR)
    pixels = (least * _JOINING_TIMES).floor() / _JOINING_TIMES
    rays = (to_latent_grid(rays_known) == 1).to(pixels)
    joined = unsplit(*(part.expand(-1, LATENT_CHANNELS, -1, -1).to(known) for part in (pixels, rays)))
    return None if torch.equal(joined, known) else joined


def imposed(
    field: VelocityField,
    known: Float[Tensor, "n *rest"],
    noise: Float[Tensor, "n *rest"],
    mask: Float[Tensor, "n *rest"],
    *,
    until: float = -1.0,
) -> VelocityField:
    """The field with the straight way from the noise to the known latents where the mask is 1, as long as the time is
    above ``until``.

    Every solver goes straight ways without error, so at each time the network sees the known latents with just the
    noise of that time. At ``until`` the velocity jumps (`Jumping`): latents that went straight join the others. Times
    should go through it.
    """
    straight = noise - known

    def piece(since: float) -> VelocityField:
        inner = piece_of(field, since)
        return inner if since <= until else lambda state, time: straight.where(mask > 0, inner(state, time))

    return Jumping(jumps=(*jumps_of(field), until), piece=piece)
