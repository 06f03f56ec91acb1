"""Training presets. An ablation is ``dataclasses.replace(base, one_field=...)``."""

from __future__ import annotations

from fb_core.data.sequences import PoolConfig, TaskConfig
from fb_core.networks.dit import DiTConfig
from fb_core.networks.vae import VAEConfig
from fb_core.sampler import SamplingConfig
from fb_core.training.dit_stage import DiTLossConfig
from fb_core.training.loop import LoopConfig
from fb_core.training.recipe import Recipe
from fb_core.training.vae_stage import VAELossConfig

ROOMS_TINY = Recipe(
    name="rooms-tiny",
    image_vae=VAEConfig(widths=(16, 32, 64, 64), encoder_resnets=1, decoder_resnets=1, norm="none"),
    raymap_vae=VAEConfig(in_channels=6, widths=(8, 16, 32, 32), encoder_resnets=1, decoder_resnets=1, norm="none", padding="replicate"),
    dit=DiTConfig(heads=4, head_dim=64, depth=6, text_width=0),
    pool=PoolConfig(families=("narrow",), rooms=400, views=20, image_size=64, renewed_per_step=0.5),
    vae_pool=PoolConfig(families=("narrow",), rooms=120, views=16, image_size=64, renewed_per_step=0.5),
    # Both autoencoders start from a linear codec that is nearly right, which a higher rate would destroy.
    image_vae_loop=LoopConfig(steps=800, learning_rate=4e-4, warmup_steps=100, cooldown=0.5, average=0.98),
    raymap_vae_loop=LoopConfig(steps=600, learning_rate=1e-4, warmup_steps=100, cooldown=0.5),
    dit_loop=LoopConfig(steps=4800, learning_rate=7e-4, warmup_steps=100),
    image_vae_loss=VAELossConfig(batch=8),
    raymap_vae_loss=VAELossConfig(batch=16),
    # Heading and fill as at inference: a small model has none to spare for what the canonical frame can settle.
    # Guidance over-saturates what so small a model is unsure of (the paper uses 7); without it a step also costs half.
    sampling=SamplingConfig(steps=16, guidance_unknown=1.0, guidance_known=1.0),
    dit_loss=DiTLossConfig(batch=8, task=TaskConfig(views=12, ray_task=0.15, random_heading=False, random_fill=False), ray_weight=0.3),
)
"""The small bundled model: rooms with cameras near the centre, 64x64, trained on a CPU in about two and a half hours."""

PRESETS: dict[str, Recipe] = {recipe.name: recipe for recipe in (ROOMS_TINY,)}
