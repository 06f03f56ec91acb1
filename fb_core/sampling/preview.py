"""A cheap look at latents: one matrix from latent channels to colours, at an eighth of the size; no decoder runs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.networks.vae import VAE
from fb_core.sampling.integration.trajectory import Trajectory
from fb_core.sampling.randomness import generator_of

_PICTURES, _SIDE, _PATCHES = 16, 64, 4


@dataclass(frozen=True, kw_only=True)
class LatentColors:
    """The affine map from an image autoencoder's latents to the mean colours of their pixels that fits smooth pictures
    best.
    """

    matrix: Float[Tensor, "17 3"]
    """Weights of 16 channels, and the constant."""

    @staticmethod
    @torch.no_grad()
    def of(vae: VAE) -> LatentColors:
        """Fit the map on random smooth pictures; takes one small encoding."""
        colors = torch.rand(_PICTURES, 3, _PATCHES, _PATCHES, generator=generator_of(0), dtype=torch.float32)
        device = next(vae.parameters()).device
        pictures = F.interpolate(colors.to(device), size=(_SIDE, _SIDE), mode="bilinear", align_corners=True)
        latents = vae.encode(pictures).permute(0, 2, 3, 1).flatten(0, 2).double().cpu()
        wanted = F.avg_pool2d(pictures, vae.config.factor).permute(0, 2, 3, 1).flatten(0, 2).double().cpu()
        system = torch.cat([latents, torch.ones_like(latents[:, :1])], dim=1)
        ridge = 1e-4 * len(system) * torch.eye(system.shape[1], dtype=torch.float64)
        return LatentColors(matrix=torch.linalg.solve(system.T @ system + ridge, system.T @ wanted).float().to(device))

    def __call__(self, latents: Float[Tensor, "n 16 h w"]) -> Float[Tensor, "n 3 h w"]:
        """RGB in [0, 1], one pixel per latent."""
        colors = torch.einsum("nchw,cd->ndhw", latents.float(), self.matrix[:-1]) + self.matrix[-1, :, None, None]
        return colors.clamp(0, 1)


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Where a sampling stands after a step. Costs nothing until it is asked for more than its numbers."""

    trajectory: Trajectory
    """State, earlier velocity, grid."""
    image_vae: VAE
    """Autoencoder that the latents belong to."""

    @property
    def step(self) -> int:
        """Steps done."""
        return self.trajectory.step

    @property
    def steps(self) -> int:
        """Steps in all."""
        return self.trajectory.steps

    @property
    def time(self) -> float:
        """Time reached: 1 is noise, 0 is data."""
        return self.trajectory.point.time

    @property
    def latents(self) -> Float[Tensor, "n 32 h w"]:
        """Where the way leads if it goes straight on: the data that the last velocity points to."""
        return self.trajectory.point.data

    def preview(self) -> Float[Tensor, "n 3 h w"]:
        """Small pictures in [0, 1] of all views as they would come out, known ones too."""
        return LatentColors.of(self.image_vae)(self.latents[:, :16])
