"""Training of the transformer: flow matching on the latents of whole sequences (paper, section 3.1 and appendix)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from einops import rearrange
from torch import Tensor

from fb_core.conditioning import Conditioning, assemble, encode_in_chunks, join, only_known, split, unsplit
from fb_core.data.sequences import RoomPool, Sequences, TaskConfig
from fb_core.flow import at_time, logit_normal_times, masked_loss, velocity
from fb_core.geometry.raymap import to_unit_range
from fb_core.masks import to_latent_grid
from fb_core.networks.dit import DiT
from fb_core.networks.embeddings import index_positions
from fb_core.networks.vae import VAE
from fb_core.training.loop import step_generator


@dataclass(frozen=True, kw_only=True)
class DiTLossConfig:
    """How a batch becomes a loss."""

    batch: int = 12
    """Sequences per step."""
    task: TaskConfig = TaskConfig()
    """Views, masks, and which modality is completed."""
    ray_weight: float = 1.0
    """Weight of the raymap channels' loss (paper: 1)."""


class DiTStage:
    """Trains the transformer with frozen autoencoders."""

    name = "dit"

    def __init__(self, network: DiT, *, image_vae: VAE, raymap_vae: VAE, pool: RoomPool, config: DiTLossConfig, seed: int):
        self.network, self.image_vae, self.raymap_vae = (
            network,
            image_vae.eval().requires_grad_(False),
            raymap_vae.eval().requires_grad_(False),
        )
        self.pool, self.config, self.seed = pool, config, seed

    def losses(self, step: int) -> dict[str, Tensor]:
        """Velocity errors of both modalities and their weighted sum."""
        self.pool.advance(step)
        draw = step_generator(self.seed, step, 1)
        sequences = self.pool.sequences(self.config.batch, self.config.task, generator=draw)
        data, conditioning = encode_sequences(sequences, image_vae=self.image_vae, raymap_vae=self.raymap_vae)
        times = logit_normal_times(len(data), generator=draw).to(data.device)
        noise = torch.randn(data.shape, generator=draw).to(data.device)
        index = index_positions(self.network.config.index, *data.shape[:2], generator=draw, device=data.device)
        predicted = self.network(join(at_time(data, noise, times), conditioning), times, None, index)
        image_error, ray_error = (
            masked_loss(got, wanted) for got, wanted in zip(split(predicted), split(velocity(data, noise)), strict=True)
        )
        return {"loss": image_error + self.config.ray_weight * ray_error, "image": image_error, "rays": ray_error}


@torch.no_grad()
def encode_sequences(sequences: Sequences, *, image_vae: VAE, raymap_vae: VAE) -> tuple[Tensor, Conditioning]:
    """(clean latents [b, n, 32, h, w], conditioning) of a batch.

    Latents that the pool kept are used. A view that is wholly known conditions with its clean latent, and all wholly unknown ones
    share one latent, so that only partly known views are encoded twice.
    """
    batch = sequences.images.shape[0]
    parts = []
    for vae, values, known, kept in (
        (image_vae, sequences.images, sequences.image_known, sequences.image_latents),
        (raymap_vae, to_unit_range(sequences.raymaps), sequences.rays_known, None),
    ):
        values, known = values.flatten(0, 1), known.flatten(0, 1)
        clean = encode_in_chunks(vae, values, 256) if kept is None else kept.flatten(0, 1)
        nothing = encode_in_chunks(vae, torch.zeros_like(values[:1]), 1)
        share = known.flatten(1).mean(dim=1)
        masked = torch.where((share > 0)[:, None, None, None], clean, nothing)
        partial = (share > 0) & (share < 1)
        if bool(partial.any()):
            masked[partial] = encode_in_chunks(vae, only_known(values[partial], known[partial]), 256)
        parts.append([rearrange(x, "(b n) c h w -> b n c h w", b=batch) for x in (clean, masked, to_latent_grid(known))])
    (image, image_masked, image_known), (rays, rays_masked, rays_known) = parts
    return unsplit(image, rays), assemble(image_masked, rays_masked, image_known, rays_known)
