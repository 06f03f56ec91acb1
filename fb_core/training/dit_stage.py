"""Training of the transformer: flow matching on the latents of whole sequences (paper, section 3.1 and appendix)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import Conditioning, assemble, encode_in_chunks, join, only_known, split, unsplit
from fb_core.data.sequences import RoomPool, Sequences, TaskConfig
from fb_core.flow import at_time, logit_normal_times, masked_loss, velocity
from fb_core.geometry.raymap import to_unit_range
from fb_core.masks import to_latent_grid
from fb_core.networks.dit import DiT
from fb_core.networks.embeddings import index_positions
from fb_core.networks.vae import VAE
from fb_core.training.loop import Stage, row_generator


@dataclass(frozen=True, kw_only=True)
class DiTLossConfig:
    """How a batch becomes a loss."""

    batch: int = 12
    """Sequences per step."""
    task: TaskConfig = TaskConfig()
    """Views, masks, and which modality is completed."""
    ray_weight: float = 1.0
    """Weight of the raymap channels' loss (paper: 1)."""


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What the transformer is given for some rows of a batch, and what it should answer."""

    inputs: Float[Tensor, "b n 66 h w"]
    """Noisy latents and conditioning."""
    times: Float[Tensor, "b"]
    """Times in (0, 1)."""
    index: Float[Tensor, "b n"]
    """Positions of the views."""
    velocity: Float[Tensor, "b n 32 h w"]
    """Noise minus data."""


class DiTStage(Stage):
    """Trains the transformer with frozen autoencoders."""

    name = "dit"

    def __init__(self, network: DiT, *, image_vae: VAE, raymap_vae: VAE, pool: RoomPool, config: DiTLossConfig, seed: int):
        self.network: DiT = network
        self.image_vae, self.raymap_vae = (vae.eval().requires_grad_(False) for vae in (image_vae, raymap_vae))
        self.pool, self.config, self.seed = pool, config, seed

    @property
    def batch(self) -> int:
        """Sequences per step."""
        return self.config.batch

    @torch.no_grad()
    def draw(self, step: int, rows: range) -> Drawn:
        """Latents of these rows of a step's batch, on their way between data and noise."""
        self.pool.advance(step, rows)
        sequences = self.pool.sequences(rows, self.config.task, partial(row_generator, self.seed, step))
        data, conditioning = encode_sequences(sequences, image_vae=self.image_vae, raymap_vae=self.raymap_vae)
        generators = [row_generator(self.seed, step, row, 1) for row in rows]
        times = torch.cat([logit_normal_times(1, generator=generator) for generator in generators]).to(data.device)
        noise = torch.stack([torch.randn(data.shape[1:], generator=generator) for generator in generators]).to(data)
        mode, views = self.network.config.index, data.shape[1]
        index = torch.cat([index_positions(mode, 1, views, generator=generator) for generator in generators]).to(data.device)
        inputs = join(at_time(data, noise, times), conditioning)
        return Drawn(inputs=inputs, times=times, index=index, velocity=velocity(data, noise))

    def losses(self, drawn: Drawn) -> dict[str, Tensor]:
        """Velocity errors of both modalities and their weighted sum."""
        predicted = self.network(drawn.inputs, drawn.times, None, drawn.index)
        image_error, ray_error = (masked_loss(got, wanted) for got, wanted in zip(split(predicted), split(drawn.velocity), strict=True))
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
