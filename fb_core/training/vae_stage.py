"""Training of the two autoencoders: L1 reconstruction and a small KL term (paper, appendix "Loss and guidance weights")."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.sequences import RoomPool, TaskConfig
from fb_core.geometry.raymap import to_unit_range
from fb_core.networks.vae import VAE
from fb_core.training.loop import Stage, row_generator


@dataclass(frozen=True, kw_only=True)
class VAELossConfig:
    """Weights of the autoencoder's loss."""

    batch: int = 16
    """Images (or raymaps) per step."""
    l1: float = 1.0
    """Weight of the mean absolute error (values in [-1, 1], as the network sees them)."""
    kl: float = 1e-6
    """Weight of the KL divergence, summed over a latent's entries and averaged over the batch (paper: 1e-6)."""


def kl_divergence(mean: Float[Tensor, "b c h w"], logvar: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """KL(q || N(0, 1)), summed over each latent, averaged over the batch."""
    return 0.5 * (mean.square() + logvar.exp() - 1 - logvar).flatten(1).sum(dim=1).mean()


class VAEStage(Stage):
    """Trains one autoencoder on images or on raymaps of a pool of rooms."""

    def __init__(self, network: VAE, pool: RoomPool, *, kind: str, config: VAELossConfig, seed: int):
        if kind not in ("image-vae", "raymap-vae"):
            raise ValueError(f"autoencoder: expected 'image-vae' or 'raymap-vae', got {kind!r}")
        self.name: str = kind
        self.network: VAE = network
        self.pool, self.config, self.seed = pool, config, seed
        # Raymaps are seen under every heading and scale: the autoencoder must not know the frame.
        self._task = TaskConfig(views=min(4, pool.views), random_heading=True, random_fill=True)

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

    def draw(self, step: int, rows: range) -> tuple[Tensor, Tensor]:
        """(values in [0, 1], standard normal noise of their latents)."""
        self.pool.advance(step, rows)
        target = self.values(step, rows)
        config = self.network.config
        shape = config.latent_channels, target.shape[-2] // config.factor, target.shape[-1] // config.factor
        noise = torch.stack([torch.randn(shape, generator=row_generator(self.seed, step, row, 1)) for row in rows])
        return target, noise.to(target)

    def losses(self, drawn: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """L1, KL and their weighted sum."""
        target, noise = drawn
        mean, logvar = self.network.posterior(target)
        latent = mean + (0.5 * logvar).exp() * noise
        reconstruction = self.network.decode(latent * self.network.config.scaling, clamp=False)
        l1 = 2 * (reconstruction - target).abs().mean()  # in the network's own range [-1, 1]
        kl = kl_divergence(mean, logvar)
        return {"loss": self.config.l1 * l1 + self.config.kl * kl, "l1": l1, "kl": kl}


@torch.no_grad()
def reconstruction_error(network: VAE, values: Float[Tensor, "b c h w"]) -> dict[str, float]:
    """How well values in [0, 1] survive: PSNR in dB for images, degrees and cube units for raymaps."""
    decoded = network.decode(network.encode(values), clamp=True)
    if values.shape[1] == 3:
        return {"psnr": float(-10 * (decoded - values).square().mean().log10())}
    from fb_core.geometry.raymap import from_unit_range

    true, got = from_unit_range(values), from_unit_range(decoded)
    cosine = (true[:, 3:] * got[:, 3:]).sum(dim=1).clamp(-1, 1)
    return {
        "direction_degrees": float(torch.rad2deg(torch.arccos(cosine)).mean()),
        "origin_error": float((true[:, :3] - got[:, :3]).norm(dim=1).mean()),
    }
