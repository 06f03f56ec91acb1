"""Where sampling starts, and known latents that are re-imposed on the way."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import LATENT_CHANNELS, Conditioning, split, unsplit
from fb_core.flow import at_time
from fb_core.sampling.integration.jumps import Jumping, jumps_of, piece_of
from fb_core.sampling.integration.solvers import VelocityField
from fb_core.sampling.integration.time_grids import reference_grid


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


def wholly_known(conditioning: Conditioning) -> Float[Tensor, "n 32 h w"]:
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
