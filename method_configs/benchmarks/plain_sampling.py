"""Sampling as the original does it, with nothing saved: the readable twin that benchmarks and tests hold ours against.

Every conditioning is encoded twice over, with clean pictures that nobody looks at; all views pass through the
autoencoders in one piece; three passes a step run one after the other although the texts are equal; and nothing that
stays constant over the steps is kept.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import LATENT_CHANNELS, Conditioning, assemble, join, only_known
from fb_core.masks import to_latent_grid
from fb_core.networks.transformer.dit import DiT
from fb_core.networks.vae import VAE


def plain_conditionings(
    images: Float[Tensor, "n 3 hp wp"],
    image_known: Float[Tensor, "n 1 hp wp"],
    raymaps01: Float[Tensor, "n 6 hp wp"],
    rays_known: Float[Tensor, "n 1 hp wp"],
    *,
    image_vae: VAE,
    raymap_vae: VAE,
) -> tuple[Conditioning, Conditioning]:
    """(null, conditional): eight encodings of every image and of every raymap, where one of each and two pictures
    suffice.
    """
    nothing = torch.zeros_like(image_known)
    null = _network_input(images, nothing, raymaps01, nothing, image_vae, raymap_vae)
    return null, _network_input(images, image_known, raymaps01, rays_known, image_vae, raymap_vae)


def _network_input(
    images: Tensor, image_known: Tensor, raymaps01: Tensor, rays_known: Tensor, image_vae: VAE, raymap_vae: VAE
) -> Conditioning:
    def encoded_twice(vae: VAE, pixels: Tensor) -> Tensor:
        vae.encode(pixels)
        return vae.encode(pixels)

    encoded_twice(image_vae, images)  # clean latents, which the original makes too, though sampling starts from noise
    encoded_twice(raymap_vae, raymaps01)
    masked_images = encoded_twice(image_vae, only_known(images, image_known))
    masked_rays = encoded_twice(raymap_vae, only_known(raymaps01, rays_known))
    return assemble(masked_images, masked_rays, to_latent_grid(image_known), to_latent_grid(rays_known))


def plain_step(
    dit: DiT,
    state: Float[Tensor, "n 32 h w"],
    time: float,
    conditionings: tuple[Conditioning, Conditioning],
    text: Float[Tensor, "1 words t"] | None,
    scale: Float[Tensor, "n 32 h w"],
    text_scale: float = 10.0,
) -> Float[Tensor, "n 32 h w"]:
    """The guided velocity from three passes: nothing known, known, known with the (here equal) text.

    ``conditionings`` are those of `plain_conditionings`.
    """

    def velocity(conditioning: Conditioning) -> Tensor:
        return dit(join(state, conditioning)[None], torch.tensor([time], device=state.device), text)[0].float()

    null, conditional = conditionings
    unconditional, known, prompted = velocity(null), velocity(conditional), velocity(conditional)
    guided = unconditional + scale * (known - unconditional)
    guided[:, :LATENT_CHANNELS] += text_scale * (prompted - known)[:, :LATENT_CHANNELS]
    return guided


def plain_integrate(
    dit: DiT,
    noise: Float[Tensor, "n 32 h w"],
    times: list[float],
    conditionings: tuple[Conditioning, Conditioning],
    text: Float[Tensor, "1 words t"] | None,
    scale: Float[Tensor, "n 32 h w"],
) -> Float[Tensor, "n 32 h w"]:
    """Euler steps along `times`."""
    state = noise
    for index in range(len(times) - 1):
        slope = plain_step(dit, state, times[index], conditionings, text, scale)
        state = state + (times[index + 1] - times[index]) * slope
    return state
