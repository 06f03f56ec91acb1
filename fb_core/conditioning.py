"""Conditioning (paper, Eq. 1): encode what is known, concatenate, split the prediction. The one owner of channel order.

The network's 66 input channels are, in the order of the released weights:
[0:16] noisy image latent, [16:32] noisy raymap latent, [32:48] latent of the masked image, [48:64] latent of the masked
raymap, [64] image mask, [65] ray mask. Its 32 outputs are the image velocity [0:16] and the raymap velocity [16:32].
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from einops import reduce
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.masks import to_latent_grid
from fb_core.networks.shared_results import SharedResults
from fb_core.networks.tiled_decoder import TiledDecoder
from fb_core.networks.transformer.dit import DiTConfig, TokenFacts
from fb_core.networks.transformer.ray_frames import frames_of_rays
from fb_core.networks.vae import VAE

LATENT_CHANNELS = 16
FACTOR = 8
"""Pixels per latent along each side."""
STATE_CHANNELS = 2 * LATENT_CHANNELS
CONDITIONING_CHANNELS = 2 * LATENT_CHANNELS + 2
_VIEWS_AT_ONCE = 16  # so that memory does not grow with the number of views
_ROUNDING = 1e-4  # of the mean of a mask over a latent's pixels


@dataclass(frozen=True, kw_only=True)
class Conditioning:
    """What the network is told, on the latent grid, for n views (leading batch dimensions are allowed)."""

    channels: Float[Tensor, "*b 34 h w"]
    """Masked image latent, masked raymap latent, image mask, ray mask."""
    frames: Float[Tensor, "*b th tw 4 4"] | None = None
    """Frames of the known rays of every token, for networks that attend in them; None where no ray is known, or nobody
    asks.
    """

    def known_tokens(self, patch: int) -> Bool[Tensor, "*b th tw"]:
        """Whether all that a token of ``patch`` x ``patch`` latents shows is known, of images and of rays."""
        whole = self.image_known.minimum(self.rays_known) > 1 - _ROUNDING
        return reduce(whole, "... 1 (h p) (w q) -> ... h w", "all", p=patch, q=patch)

    def facts(self, config: DiTConfig) -> TokenFacts:
        """What a transformer takes beside the channels, for conditionings with a batch dimension."""
        return TokenFacts(
            frames=self.frames, known=self.known_tokens(config.patch) if config.known_tokens == "apart" else None
        )

    def repeated(self, times: int) -> Conditioning:
        """Every conditioning of the batch so many times in a row."""
        frames = None if self.frames is None else self.frames.repeat_interleave(times, dim=0)
        return Conditioning(channels=self.channels.repeat_interleave(times, dim=0), frames=frames)

    @property
    def image_known(self) -> Float[Tensor, "*b 1 h w"]:
        """Share of known pixels per latent cell."""
        return self.channels[..., 2 * LATENT_CHANNELS : 2 * LATENT_CHANNELS + 1, :, :]

    @property
    def rays_known(self) -> Float[Tensor, "*b 1 h w"]:
        """Share of known rays per latent cell."""
        return self.channels[..., 2 * LATENT_CHANNELS + 1 :, :, :]


def stacked_facts(parts: Sequence[Conditioning], config: DiTConfig) -> TokenFacts:
    """The facts of several conditionings of the same views (the branches of guidance), as one batch."""
    channels = torch.stack([part.channels for part in parts])
    frames = None
    if config.ray_frames and any(part.frames is not None for part in parts):
        like = next(part.frames for part in parts if part.frames is not None)
        identity = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device).expand_as(like)
        frames = torch.stack([identity if part.frames is None else part.frames for part in parts])
    return Conditioning(channels=channels, frames=frames).facts(config)


@dataclass(frozen=True, kw_only=True)
class Encoding:
    """How the autoencoders encode."""

    views_at_once: int = 16
    """Views encoded together, which bounds memory."""
    generators: Sequence[torch.Generator] | None = None
    """One for each view, on the CPU, to sample the posteriors; without, their means are taken."""
    precision: torch.dtype = torch.float32
    """Of the image autoencoder where it does not sample (:func:`encode_frozen`); rays are always in float32, for
    rounding would move cameras.
    """
    shared: SharedResults | None = None
    """Latents of the same pixels, to be used again where posteriors are not sampled."""


def only_known(values: Float[Tensor, "n c h w"], known: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n c h w"]:
    """``values`` where known (scaled by a fractional mask), 0 elsewhere. Chosen, not multiplied: NaN in unknown pixels
    does not survive.
    """
    return torch.where(known > 0, values * known, torch.zeros((), dtype=values.dtype, device=values.device))


def with_guess(
    told: Float[Tensor, "n c h w"],
    known: Float[Tensor, "n 1 h w"],
    guess: Float[Tensor, "n c h w"],
    belief: Float[Tensor, "n 1 h w"],
) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n 1 h w"]]:
    """Known pixels and, where nothing is known, guessed ones; and the mask that tells them: the belief, below 1, at
    guessed pixels.

    A model has to be trained to be told guesses; unlike a known pixel under a fractional mask, a guess keeps its full
    colour.
    """
    guessed = (known == 0) & (belief > 0)
    return torch.where(guessed, guess, told), torch.where(guessed, belief, known)


def assemble(
    image_latents: Float[Tensor, "*b 16 h w"],
    ray_latents: Float[Tensor, "*b 16 h w"],
    image_known: Float[Tensor, "*b 1 h w"],
    rays_known: Float[Tensor, "*b 1 h w"],
    frames: Float[Tensor, "*b th tw 4 4"] | None = None,
) -> Conditioning:
    """Put the encoded parts in channel order."""
    return Conditioning(
        channels=torch.cat([image_latents, ray_latents, image_known, rays_known], dim=-3), frames=frames
    )


def encode_known(
    images: Float[Tensor, "n 3 hp wp"],
    image_known: Float[Tensor, "n 1 hp wp"],
    raymaps01: Float[Tensor, "n 6 hp wp"],
    rays_known: Float[Tensor, "n 1 hp wp"],
    *,
    image_vae: VAE,
    raymap_vae: VAE,
    transformer: DiTConfig | None = None,
    guess: tuple[Float[Tensor, "n 3 hp wp"], Float[Tensor, "n 1 hp wp"]] | None = None,
    encoding: Encoding = Encoding(),
) -> Conditioning:
    """What the network is told of n views, the part of Eq. 1 that does not change with the time:

        E_I(m_I * I) ++ E_R(m_R * R) ++ m_I ++ m_R

    with the autoencoders E_I and E_R and the masks m, which follow on the latent grid. Pixels and rays are in [0, 1];
    unknown ones become 0, which the autoencoders see as -1. For a ``transformer`` that attends in ray frames these are
    reckoned too. A ``guess`` (images, belief) is told where no pixel is known (:func:`with_guess`).
    """
    known_images = only_known(images, image_known)
    if guess is not None:
        known_images, image_known = with_guess(known_images, image_known, *guess)
    image_latents = _encoded_once(image_vae, known_images, image_known, encoding)
    del known_images
    exact = dataclasses.replace(encoding, precision=torch.float32)
    ray_latents = _encoded_once(raymap_vae, only_known(raymaps01, rays_known), rays_known, exact)
    frames = frames_for(transformer, 2 * raymaps01 - 1, rays_known)
    return assemble(image_latents, ray_latents, to_latent_grid(image_known), to_latent_grid(rays_known), frames)


def frames_for(
    transformer: DiTConfig | None, raymaps: Float[Tensor, "*b 6 hp wp"], rays_known: Float[Tensor, "*b 1 hp wp"]
) -> Float[Tensor, "*b th tw 4 4"] | None:
    """Frames of the known rays (in [-1, 1]) of every token of a ``transformer`` that attends in them; None for any
    other.
    """
    if transformer is None or not transformer.ray_frames:
        return None
    parts = zip(
        raymaps.flatten(0, -4).split(_VIEWS_AT_ONCE), rays_known.flatten(0, -4).split(_VIEWS_AT_ONCE), strict=True
    )
    frames = torch.cat([frames_of_rays(rays, known, FACTOR * transformer.patch) for rays, known in parts])
    return frames.unflatten(0, raymaps.shape[:-3])


def encode_null(like: Conditioning, *, image_vae: VAE, raymap_vae: VAE, pixels: tuple[int, int]) -> Conditioning:
    """The conditioning of "nothing is known", for classifier-free guidance: one black image and one raymap of zeros,
    encoded once.
    """
    image_latent = image_vae.encode(like.channels.new_zeros(1, 3, *pixels))
    ray_latent = raymap_vae.encode(like.channels.new_zeros(1, 6, *pixels))
    masks = like.channels.new_zeros(1, 2, *like.channels.shape[-2:])
    null = torch.cat([image_latent, ray_latent, masks], dim=-3)
    return Conditioning(channels=null.expand(like.channels.shape))


def _encoded_once(
    vae: VAE,
    told: Float[Tensor, "n c h w"],
    known: Float[Tensor, "n 1 h w"],
    encoding: Encoding,
) -> Float[Tensor, "n 16 lh lw"]:
    """Latents of what is told; views of which nothing is known, which are all alike, are encoded as one (but for
    samples, which differ).
    """
    if encoding.generators is not None:
        return encode_in_chunks(vae, told, encoding.views_at_once, encoding.generators)
    something = (known > 0).flatten(1).any(dim=1)
    if int((~something).sum()) < 2:
        return _encoded_or_shared(vae, told, encoding)
    first = int((~something).nonzero()[0, 0])
    chosen = torch.cat([something.nonzero()[:, 0], something.new_tensor([first], dtype=torch.long)])
    latents = _encoded_or_shared(vae, told[chosen], encoding)
    place = torch.where(something, something.cumsum(0) - 1, len(chosen) - 1)
    return latents[place]


def _encoded_or_shared(vae: VAE, told: Float[Tensor, "n c h w"], encoding: Encoding) -> Float[Tensor, "n 16 lh lw"]:
    """Latents of what is told. Those that are shared are looked for by the views that are encoded together, for an
    autoencoder rounds differently in other company.
    """
    at_once, precision, shared = encoding.views_at_once, encoding.precision, encoding.shared
    if shared is None:
        return encode_frozen(vae, told, at_once, precision)
    return torch.cat(
        [
            shared.of(partial(encode_frozen, vae, part, at_once, precision), vae, part, str(precision))
            for part in told.split(at_once)
        ]
    )


def encode_in_chunks(
    vae: VAE, pixels: Float[Tensor, "n c h w"], views_at_once: int, generators: Sequence[torch.Generator] | None = None
) -> Float[Tensor, "n 16 lh lw"]:
    """Latents of n views, a few at a time so that memory does not grow with n. The autoencoder computes in its own
    precision.

    With a generator for each view they are samples, which depend neither on the other views nor on how many are encoded
    at a time.
    """
    chunks = []
    for first in range(0, len(pixels), views_at_once):
        part = slice(first, first + views_at_once)
        chunks.append(vae.encode(_laid_out(vae, pixels[part]), None if generators is None else generators[part]))
    return torch.cat(chunks)


def encode_frozen(
    vae: VAE, pixels: Float[Tensor, "n c h w"], views_at_once: int, precision: torch.dtype = torch.float32
) -> Float[Tensor, "n 16 lh lw"]:
    """Latents of n views by an autoencoder that is not trained, in float32, its convolutions computed in a training's
    ``precision``.

    In bfloat16 they differ by about 1.5 % (root mean square) from those in float32, and take a third of the time on a
    CPU that has it.
    """
    if precision == torch.float32:
        return encode_in_chunks(vae, pixels, views_at_once)
    with torch.autocast(pixels.device.type, precision):
        return encode_in_chunks(vae, pixels.to(memory_format=torch.channels_last), views_at_once).float()


def decode_in_chunks(
    vae: VAE, latents: Float[Tensor, "n 16 lh lw"], views_at_once: int = 16, tile: int | None = None
) -> Float[Tensor, "n c h w"]:
    """Pixels in [0, 1] of n views, a few at a time; with a `tile`, each of them in tiles of so many pixels
    (`TiledDecoder`).
    """
    decoder = None if tile is None else TiledDecoder(vae.decoder, tile)
    chunks = (_laid_out(vae, chunk) for chunk in latents.split(views_at_once))
    return torch.cat([vae.decode(chunk, clamp=True, decoder=decoder).contiguous() for chunk in chunks])


def _laid_out(vae: VAE, values: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
    """As convolutions take them fastest: with the channels last in memory on a CPU, a quarter less time for narrow
    ones. Group norm computes other, less exact sums so; autoencoders with one keep the usual order.
    """
    faster = values.device.type == "cpu" and vae.config.norm == "none"
    return values.contiguous(memory_format=torch.channels_last) if faster else values


def join(state: Float[Tensor, "*b 32 h w"], conditioning: Conditioning) -> Float[Tensor, "*b 66 h w"]:
    """The sequence of Eq. 1 at time t, along the channels:

        s_t = z_t^I ++ z_t^R ++ E_I(m_I * I) ++ E_R(m_R * R) ++ m_I ++ m_R

    ``state`` is z_t^I ++ z_t^R, the noisy latents of images and raymaps; the rest is the conditioning
    (:func:`encode_known`).
    """
    return torch.cat([state, conditioning.channels.to(state.dtype)], dim=-3)


def split(state: Float[Tensor, "*b 32 h w"]) -> tuple[Float[Tensor, "*b 16 h w"], Float[Tensor, "*b 16 h w"]]:
    """(image part, raymap part) of a state or of a predicted velocity."""
    return state[..., :LATENT_CHANNELS, :, :], state[..., LATENT_CHANNELS:, :, :]


def unsplit(image: Float[Tensor, "*b 16 h w"], rays: Float[Tensor, "*b 16 h w"]) -> Float[Tensor, "*b 32 h w"]:
    """Inverse of :func:`split`."""
    return torch.cat([image, rays], dim=-3)
