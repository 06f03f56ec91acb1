"""Training of the autoencoders: L1, a small KL term, and judges of how real it looks (paper, appendix "Loss and
guidance weights").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from fb_core.data.training.task import Source, TaskConfig
from fb_core.geometry.raymap import to_unit_range
from fb_core.networks.vae import VAE
from fb_core.splatting.photometric import decibels
from fb_core.training.run.stage import Stage, row_generator
from fb_core.training.stages.adversarial import PatchDiscriminator, discriminator_loss, generator_loss


@dataclass(frozen=True, kw_only=True)
class VAELossConfig:
    """Weights of the autoencoder's loss."""

    batch: int = 16
    """Images (or raymaps) per step."""
    l1: float = 1.0
    """Weight of the mean absolute error (values in [-1, 1], as the network sees them)."""
    kl: float = 1e-6
    """Weight of the KL divergence, summed over a latent's entries and averaged over the batch (paper: 1e-6)."""
    adversarial: float = 0.0
    """Weight of the adversarial term (paper: 0.5); 0 for none, and no discriminator."""
    adversarial_from: int = 0
    """Step from which the autoencoder feels it; the discriminator learns from the first step on."""
    perceptual: float = 0.0
    """Weight of LPIPS, where its weights are at hand; images only."""
    edges: float = 0.0
    """Weight of the mean absolute error of differences between neighbouring pixels (values in [-1, 1]), which is small
    only where edges are sharp and in their places.
    """
    frame: Literal["upright", "random"] = "upright"
    """Frames of the raymaps."""


def kl_divergence(mean: Float[Tensor, "b c h w"], logvar: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """KL(q || N(0, 1)), summed over each latent, averaged over the batch."""
    return 0.5 * (mean.square() + logvar.exp() - 1 - logvar).flatten(1).sum(dim=1).mean()


def _edge_error(error: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """Mean absolute difference of errors that are neighbours, down and to the right."""
    return (error[..., 1:, :] - error[..., :-1, :]).abs().mean() + (error[..., 1:] - error[..., :-1]).abs().mean()


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """What an autoencoder is given for some rows of a batch."""

    values: Float[Tensor, "b c h w"]
    """Images or raymaps in [0, 1]."""
    noise: Float[Tensor, "b z lh lw"]
    """Standard normal; makes a sample of the posterior."""
    step: int
    """The step that they belong to."""


class VAEStage(Stage):
    """Trains one autoencoder on images or on raymaps of a source."""

    def __init__(
        self,
        network: VAE,
        pool: Source,
        *,
        kind: str,
        config: VAELossConfig,
        seed: int,
        perceptual: nn.Module | None = None,
    ):
        """``perceptual`` is LPIPS of images in [0, 1] (``fb_core.training.stages.perceptual``); without it that term is
        left out.
        """
        if kind not in ("image-vae", "raymap-vae"):
            raise ValueError(f"autoencoder: expected 'image-vae' or 'raymap-vae', got {kind!r}")
        self.name: str = kind
        self.network: VAE = network.to(
            memory_format=torch.channels_last
        )  # convolutions in bfloat16 are a quarter faster so
        self.pool, self.config, self.seed = pool, config, seed
        self._perceptual = perceptual if config.perceptual and kind == "image-vae" else None
        if config.adversarial:
            critic = PatchDiscriminator(network.config.in_channels).initialize(torch.Generator().manual_seed(seed))
            self.critic = critic.to(next(network.parameters()).device)
        # Raymaps are seen under every heading and scale: the autoencoder must not know the frame.
        self._task = TaskConfig(views=min(4, pool.views), frame=config.frame, random_heading=True, random_fill=True)

    @property
    def batch(self) -> int:
        """Images (or raymaps) per step."""
        return self.config.batch

    def values(self, step: int, rows: range) -> Float[Tensor, "b c h w"]:
        """What is encoded in these rows of a step's batch, in [0, 1]."""
        draw = partial(row_generator, self.seed, step)
        if self.name == "image-vae":
            return self.pool.images(rows, draw)
        return to_unit_range(self.pool.raymaps(rows, self._task, draw))

    def draw(self, step: int, rows: range) -> Pictures:
        """Images or raymaps of these rows of a step's batch; a row's noise depends on (seed, step, row) too."""
        self.pool.advance(step, rows)
        values = self.values(step, rows)
        config, each = self.network.config, len(values) // len(rows)
        shape = each, config.latent_channels, values.shape[-2] // config.factor, values.shape[-1] // config.factor
        noise = torch.cat([torch.randn(shape, generator=row_generator(self.seed, step, row, 1)) for row in rows])
        values = values.contiguous(memory_format=torch.channels_last)
        return Pictures(values=values, noise=noise.to(values), step=step)

    def losses(self, drawn: Pictures) -> dict[str, Tensor]:
        """The terms, and their weighted sum. The discriminator's own loss is part of the sum; neither network feels the
        other's.

        The raymap autoencoder learns in float32 whatever the others do: it is always used in it.
        """
        if self.name == "image-vae":
            return self._losses(drawn)
        with torch.autocast(drawn.values.device.type, enabled=False):
            return self._losses(drawn)

    def _losses(self, drawn: Pictures) -> dict[str, Tensor]:
        config, target = self.config, drawn.values
        mean, logvar = self.network.posterior(target)
        latent = mean + (0.5 * logvar).exp() * drawn.noise
        reconstruction = self.network.decode(latent * self.network.config.scaling, clamp=False)
        l1 = 2 * (reconstruction - target).abs().mean()  # in the network's own range [-1, 1]
        kl = kl_divergence(mean, logvar)
        terms = {"l1": l1, "kl": kl}
        loss = config.l1 * l1 + config.kl * kl
        if config.edges:
            terms["edges"] = 2 * _edge_error(reconstruction - target)
            loss = loss + config.edges * terms["edges"]
        if self._perceptual is not None:
            terms["lpips"] = self._perceptual(reconstruction, target, normalize=True).mean()
            loss = loss + config.perceptual * terms["lpips"]
        if self.critic is not None:
            real, fake = 2 * target - 1, 2 * reconstruction - 1
            terms["critic"] = discriminator_loss(self.critic, real, fake)
            terms["adversarial"] = (
                generator_loss(self.critic, fake) if drawn.step >= config.adversarial_from else torch.zeros_like(l1)
            )
            loss = loss + terms["critic"] + config.adversarial * terms["adversarial"]
        return {"loss": loss, **terms}


@torch.no_grad()
def reconstruction_error(network: VAE, values: Float[Tensor, "b c h w"]) -> dict[str, float]:
    """How well values in [0, 1] survive: PSNR in dB for images, degrees and cube units for raymaps."""
    decoded = network.decode(network.encode(values), clamp=True)
    if values.shape[1] == 3:
        return {"psnr": float(decibels((decoded - values).square().mean()))}
    from fb_core.geometry.raymap import from_unit_range

    true, got = from_unit_range(values), from_unit_range(decoded)
    cosine = (true[:, 3:] * got[:, 3:]).sum(dim=1).clamp(-1, 1)
    return {
        "direction_degrees": float(torch.rad2deg(torch.arccos(cosine)).mean()),
        "origin_error": float((true[:, :3] - got[:, :3]).norm(dim=1).mean()),
    }
