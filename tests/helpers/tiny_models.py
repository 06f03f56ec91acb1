"""Tiny random models for tests: the real architecture at a size that runs in milliseconds."""

from __future__ import annotations

from pathlib import Path

import torch

from fb_core import checkpoint
from fb_core.inpainter import Fillerbuster
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAE, VAEConfig

_SMALL_VAE = {"widths": (8, 8, 8, 8), "encoder_resnets": 1, "decoder_resnets": 1, "norm_groups": 4}


def save_tiny_model(folder: Path, *, index: str = "flexible", seed: int = 0, image_size: int = 32) -> Path:
    """Write a model folder with random weights of every kind (nothing is zero, so that everything has an effect)."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        image_vae = VAE(VAEConfig(**_SMALL_VAE))
        raymap_vae = VAE(VAEConfig(in_channels=6, padding="replicate", **_SMALL_VAE | {"norm": "none"}))
        dit = DiT(DiTConfig(heads=2, head_dim=16, depth=2, text_width=0, index=index))
        for parameter in dit.parameters():
            if parameter.ndim >= 2:
                torch.nn.init.normal_(parameter, std=0.5 * parameter[0].numel() ** -0.5)
    checkpoint.save(
        folder, dit=dit, image_vae=image_vae, raymap_vae=raymap_vae, info={"image_size": image_size, "preset": "random"}
    )
    return folder


def tiny_model(folder: Path, **options) -> Fillerbuster:
    """A loaded tiny random model."""
    return Fillerbuster.from_pretrained(save_tiny_model(folder / "model", **options))


def network_of(config: DiTConfig) -> DiT:
    """A transformer in float64 whose every parameter matters."""
    torch.manual_seed(1)
    network = DiT(config).double().eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return network
