"""Training presets. An ablation is ``dataclasses.replace(base, one_field=...)``."""

from __future__ import annotations

import dataclasses
from typing import Any

from fb_core.data.training.folders import Resolution
from fb_core.data.training.sequences import PoolConfig
from fb_core.data.training.task import TaskConfig
from fb_core.networks.transformer.dit import DiTConfig
from fb_core.networks.vae import IMAGE_VAE, RAYMAP_VAE, VAEConfig
from fb_core.sampling import SamplingConfig
from fb_core.training.recipe import Recipe
from fb_core.training.run.options import EngineConfig, LoopConfig
from fb_core.training.stages.dit_stage import DiTLossConfig
from fb_core.training.stages.vae_stage import VAELossConfig

_NARROW_TO_WIDE = ("narrow", "medium", "wide")

ROOMS_TINY = Recipe(
    name="rooms-tiny",
    image_vae=VAEConfig(widths=(16, 32, 64, 64), encoder_resnets=1, decoder_resnets=1, norm="none"),
    raymap_vae=VAEConfig(
        in_channels=6, widths=(8, 16, 32, 32), encoder_resnets=1, decoder_resnets=1, norm="none", padding="replicate"
    ),
    dit=DiTConfig(heads=4, head_dim=64, depth=6, text_width=0, ray_frames=True, known_tokens="apart"),
    pool=PoolConfig(families=("narrow",), rooms=400, views=20, image_size=64, renewed_per_step=0.25),
    # Busier rooms than the transformer learns from: what an autoencoder blurs, no transformer makes sharp.
    vae_pool=PoolConfig(
        families=("narrow", "medium"), take_turns=True, rooms=120, views=16, image_size=64, renewed_per_step=0.25
    ),
    image_vae_loop=LoopConfig(
        steps=2500, learning_rate=1e-3, warmup_steps=100, cooldown=0.5, average=0.98, optimizer="muon"
    ),
    # Starts from a linear codec that is nearly right, which a higher rate would destroy.
    raymap_vae_loop=LoopConfig(steps=1000, learning_rate=1e-4, warmup_steps=100, cooldown=0.5),
    dit_loop=LoopConfig(steps=16_000, learning_rate=7e-4, warmup_steps=100, optimizer="muon"),
    image_vae_loss=VAELossConfig(batch=16, edges=0.5),
    raymap_vae_loss=VAELossConfig(batch=16),
    # Heading and fill as at inference: a small model has none to spare for what the canonical frame can settle.
    # Guidance over-saturates what so small a model is unsure of (the paper uses 7); without it a step also costs half.
    sampling=SamplingConfig(steps=4, guidance_unknown=1.0, guidance_known=1.0, guess="told"),
    dit_loss=DiTLossConfig(
        batch=8,
        draws=2,  # a scene that is encoded, and whose known tokens are computed, is worth two draws of noise
        pure_noise=0.1,  # so that one step answers with the mean
        ray_weight=0.3,
        task=TaskConfig(views=12, ray_task=0.15, random_heading=False, random_fill=False, guess=0.7, sector=0.5),
    ),
    engine=EngineConfig(
        precision="auto", draw_ahead=True
    ),  # on two cores data are waited for in 1 % of the time instead of 16 %
)
"""The small bundled model: rooms with cameras near the centre, 64x64, trained on one core in about nine hours."""

ROOMS_ABLATION = dataclasses.replace(
    ROOMS_TINY,
    name="rooms-ablation",
    dit=dataclasses.replace(
        ROOMS_TINY.dit, heads=2, depth=4, ray_frames=False, known_tokens="joint"
    ),  # the paper's design
    # A pool that stays as it is, which designs that take turns can share.
    pool=dataclasses.replace(ROOMS_TINY.pool, rooms=200, views=12, renewed_per_step=0.0),
    dit_loop=dataclasses.replace(ROOMS_TINY.dit_loop, steps=400, learning_rate=2e-3),
    sampling=dataclasses.replace(ROOMS_TINY.sampling, steps=4, guess="start"),
    engine=EngineConfig(),  # float32: the same table on every machine
    # The tasks are the paper's, unlike those of rooms-tiny: the designs differ in how raymaps count.
    dit_loss=dataclasses.replace(
        ROOMS_TINY.dit_loss,
        draws=1,
        pure_noise=0.0,
        ray_weight=1.0,
        task=dataclasses.replace(
            ROOMS_TINY.dit_loss.task, views=8, mixture="quarters", ray_task=0.25, guess=0.0, sector=0.0
        ),
    ),
)
"""A transformer of 1 M parameters between the autoencoders of rooms-tiny, for comparing designs on a CPU (``eval
ablations``).
"""

ROOMS = Recipe(
    name="rooms",
    image_vae=VAEConfig(widths=(32, 64, 128, 128), encoder_resnets=1, decoder_resnets=1, norm="none"),
    raymap_vae=VAEConfig(
        in_channels=6, widths=(16, 32, 32, 32), encoder_resnets=1, decoder_resnets=1, norm="none", padding="replicate"
    ),
    dit=DiTConfig(heads=6, head_dim=64, depth=6, text_width=0),
    # Narrow rooms first, then medium, then wide: starting wide, a small model does not learn.
    pool=PoolConfig(
        families=("narrow", "medium", "wide"),
        family_rooms=2000,
        rooms=600,
        views=24,
        image_size=128,
        renewed_per_step=0.25,
    ),
    vae_pool=PoolConfig(
        families=("narrow", "medium", "wide"),
        family_rooms=400,
        rooms=300,
        views=24,
        image_size=128,
        renewed_per_step=0.25,
    ),
    image_vae_loop=LoopConfig(
        steps=4000, learning_rate=4e-4, warmup_steps=200, cooldown=0.5, average=0.99, save_every=500
    ),
    raymap_vae_loop=LoopConfig(steps=3000, learning_rate=1e-4, warmup_steps=200, cooldown=0.5, save_every=500),
    dit_loop=LoopConfig(steps=30_000, learning_rate=6e-4, warmup_steps=500, average=0.999, save_every=1000),
    image_vae_loss=VAELossConfig(batch=64),
    raymap_vae_loss=VAELossConfig(batch=64),
    sampling=SamplingConfig(steps=16, guidance_unknown=1.0, guidance_known=1.0),
    dit_loss=DiTLossConfig(
        batch=32, task=TaskConfig(views=20, ray_task=0.15, random_heading=False, random_fill=False), ray_weight=0.3
    ),
    engine=EngineConfig(precision="bfloat16", draw_ahead=True),
)
"""Rooms at 128x128 with sequences of 20, for one large GPU: 46 MB in half precision. Sized for about 25 minutes on an
H200; not run yet.
"""

# ---- the paper's recipe: every number that it gives, and where from ---- "paper": the paper or its appendix.
# "released": what the authors' code does where the paper is silent. "ours": a choice of this project.

_CONSTANT = LoopConfig(
    steps=200_000,  # ours, of the autoencoders
    learning_rate=1e-4,  # paper: constant at 1e-4
    warmup_steps=1,  # paper: constant
    cooldown=0.0,  # paper: constant
    weight_decay=1e-2,  # released
    betas=(0.9, 0.999),  # released
    clip=1.0,  # released
    average=0.9999,  # ours
    save_every=5000,  # released
)
_PAPER_POOL = PoolConfig(  # ours: rooms that stand in for captures and meshes where none are named
    families=_NARROW_TO_WIDE, family_rooms=20_000, rooms=128, views=20, image_size=256, renewed_per_step=0.1
)  # image_size: paper, 256 x 256 for the first million steps

PAPER = Recipe(
    name="paper",
    image_vae=IMAGE_VAE,  # paper: 128, 256, 512, 512; 84M
    raymap_vae=RAYMAP_VAE,  # paper: 32, 64, 128, 128, no norms, replicated borders; 5M
    dit=DiTConfig(),  # paper: DiT-L/2, 24 layers, width 1024, text by cross-attention; 650M
    pool=_PAPER_POOL,
    vae_pool=_PAPER_POOL,
    image_vae_loop=_CONSTANT,
    raymap_vae_loop=_CONSTANT,
    dit_loop=dataclasses.replace(_CONSTANT, steps=1_100_000),  # paper: 1M, then 100K with varying resolution
    image_vae_loss=VAELossConfig(
        batch=64,  # ours
        l1=1.0,  # paper
        kl=1e-6,  # paper
        adversarial=0.5,  # paper
        adversarial_from=10_000,  # released
        perceptual=0.1,  # released; only where the weights of LPIPS are at hand
    ),
    raymap_vae_loss=VAELossConfig(
        batch=64,  # ours
        l1=1.0,  # paper
        kl=1e-6,  # paper
        adversarial=0.5,  # paper
        adversarial_from=10_000,  # released
        frame="random",  # released: any rotation and centre
    ),
    dit_loss=DiTLossConfig(
        batch=256,  # paper: 4 sequences on each of 64 GPUs
        images_per_row=13,  # paper: 52 single images instead of 4 sequences
        ray_weight=1.0,  # released
        task=TaskConfig(
            views=10,  # paper
            mixture="quarters",  # paper (section 4.4) and released
            ray_task=0.25,  # paper
            dropout=0.1,  # paper: 10 % in all, equally images, raymaps, both
            frame="upright",  # paper
            random_heading=True,  # paper
            random_fill=True,  # paper
        ),
    ),
    single_view_share=0.5,  # paper
    resolutions=(  # paper: image sizes and views; ours: how many sequences and pictures fill a row
        Resolution(image_size=64, views=20, sequences=8, images=200),
        Resolution(image_size=128, views=20, sequences=2, images=52),
        Resolution(image_size=256, views=10, sequences=1, images=13),
        Resolution(image_size=512, views=5, sequences=1, images=3),
        Resolution(image_size=1024, views=2, sequences=1, images=1),
    ),
    resolutions_from=1_000_000,  # paper
    engine=EngineConfig(precision="bfloat16", draw_ahead=True),  # paper: bfloat16
)
"""The paper's training at its full size: 64 GPUs for a month. On fewer, ``--accumulate`` keeps the batch."""

PAPER_SHORT = dataclasses.replace(
    PAPER,
    name="paper-short",
    dit_loop=dataclasses.replace(_CONSTANT, steps=100_000),
    dit_loss=dataclasses.replace(PAPER.dit_loss, task=dataclasses.replace(PAPER.dit_loss.task, views=8)),
    resolutions=(),
    resolutions_from=0,
)
"""What the paper's ablations start from: 100K steps with sequences of 8 (section 4.4)."""


def ablations_of(base: Recipe) -> tuple[Recipe, ...]:
    """The four ablations of the paper's table 2, each one field away from ``base``."""

    def named(name: str, **changes: Any) -> Recipe:
        return dataclasses.replace(base, name=f"{base.name}-{name}", **changes)

    task = dataclasses.replace(base.dit_loss.task, frame="random")
    return (
        named("no-index-emb", dit=dataclasses.replace(base.dit, index="none")),  # raymaps alone tell views apart
        named(
            "fixed-index-emb", dit=dataclasses.replace(base.dit, index="fixed")
        ),  # trained on the same few positions always
        named("no-poses", dit_loss=dataclasses.replace(base.dit_loss, ray_weight=0.0)),  # raymaps are not denoised
        named(
            "random-poses", dit_loss=dataclasses.replace(base.dit_loss, task=task)
        ),  # no camera at the origin and upright
    )


_BASES = (ROOMS_TINY, ROOMS_ABLATION, ROOMS, PAPER, PAPER_SHORT)
PRESETS: dict[str, Recipe] = {
    recipe.name: recipe for recipe in (*_BASES, *ablations_of(ROOMS_TINY), *ablations_of(PAPER_SHORT))
}
"""``fillerbuster train PRESET``."""
