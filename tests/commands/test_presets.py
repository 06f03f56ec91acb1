"""The table of presets: sizes, the paper's numbers, and ablations that are one field away from their base."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch

from fb_core.networks.transformer.dit import DiT
from fb_core.networks.vae import VAE
from fb_core.training.recipe import STAGES, Recipe, make_stage
from method_configs.presets import PAPER, PAPER_SHORT, PRESETS, ROOMS, ROOMS_TINY

_CHANGES = {
    "no-index-emb": {"dit.index": ("flexible", "none")},
    "fixed-index-emb": {"dit.index": ("flexible", "fixed")},
    "no-poses": {"dit_loss.ray_weight": (None, 0.0)},
    "random-poses": {"dit_loss.task.frame": ("upright", "random")},
}


def leaves(value: Any, name: str = "") -> dict[str, Any]:
    """Every number of a recipe by its dotted name."""
    if not dataclasses.is_dataclass(value):
        return {name: value}
    found: dict[str, Any] = {}
    for field in dataclasses.fields(value):
        found |= leaves(getattr(value, field.name), f"{name}.{field.name}".lstrip("."))
    return found


@pytest.mark.parametrize("base", [ROOMS_TINY, PAPER_SHORT], ids=lambda base: base.name)
@pytest.mark.parametrize("ablation", _CHANGES)
def test_an_ablation_differs_from_its_base_in_that_field_only(base, ablation):
    before, after = leaves(base), leaves(PRESETS[f"{base.name}-{ablation}"])
    different = {name for name in before if before[name] != after[name]}
    assert different == {"name", *_CHANGES[ablation]}
    for name, (then, now) in _CHANGES[ablation].items():
        assert then in (None, before[name]) and after[name] == now


def millions(recipe: Recipe) -> tuple[float, float, float]:
    with torch.device("meta"):
        networks = VAE(recipe.image_vae), VAE(recipe.raymap_vae), DiT(recipe.dit)
    first, second, third = (sum(weights.numel() for weights in network.parameters()) / 1e6 for network in networks)
    return first, second, third


def test_paper_has_the_papers_sizes():
    image, raymap, transformer = millions(PAPER)
    assert round(image) == 84 and round(raymap) == 5 and transformer == pytest.approx(650, rel=0.01)


def test_paper_has_the_papers_numbers():
    numbers = leaves(PAPER)
    wanted = {
        "image_vae_loss.l1": 1.0, "image_vae_loss.kl": 1e-6, "image_vae_loss.adversarial": 0.5,
        "raymap_vae_loss.l1": 1.0, "raymap_vae_loss.kl": 1e-6, "raymap_vae_loss.adversarial": 0.5,
        "dit_loop.learning_rate": 1e-4, "dit_loop.steps": 1_100_000, "resolutions_from": 1_000_000,
        "single_view_share": 0.5,
        "dit_loss.batch": 4 * 64, "dit_loss.images_per_row": 52 // 4, "dit_loss.task.views": 10,
        "dit_loss.task.ray_task": 0.25,
        "dit_loss.task.dropout": 0.1, "pool.image_size": 256, "engine.precision": "bfloat16",
    }  # fmt: skip
    assert {name: numbers[name] for name in wanted} == wanted
    assert [(one.image_size, one.views) for one in PAPER.resolutions] == [
        (64, 20),
        (128, 20),
        (256, 10),
        (512, 5),
        (1024, 2),
    ]
    assert {PAPER.dit_loop.rate(step) for step in (0, 1, 500_000, 1_099_999)} == {1e-4}  # constant


def test_rooms_fits_into_48_megabytes():
    image, raymap, transformer = millions(ROOMS)
    assert 2 * image + 4 * raymap + 2 * transformer < 48  # the raymap autoencoder stays in float32
    assert not ROOMS.dit.text_width and ROOMS.pool.image_size == 128 and 16 <= ROOMS.dit_loss.task.views <= 24
    seen = ROOMS.pool.rooms + ROOMS.dit_loop.steps * ROOMS.pool.renewed_per_step
    assert (
        ROOMS.pool.families == ("narrow", "medium", "wide") and seen > 3 * ROOMS.pool.family_rooms
    )  # the widest gets the most


@pytest.mark.slow
def test_every_stage_of_rooms_makes_a_step():
    """On a pool of one room and one row."""
    small = dataclasses.replace(ROOMS.pool, rooms=1, views=20, supersample=1, families=("narrow",))
    recipe = dataclasses.replace(
        ROOMS,
        pool=small,
        vae_pool=dataclasses.replace(small, views=4),
        image_vae_loss=dataclasses.replace(ROOMS.image_vae_loss, batch=1),
        raymap_vae_loss=dataclasses.replace(ROOMS.raymap_vae_loss, batch=1),
        dit_loss=dataclasses.replace(ROOMS.dit_loss, batch=1),
    )
    for name in STAGES:
        stage, _ = make_stage(recipe, name, None)
        assert torch.isfinite(stage.losses(stage.draw(0, range(1)))["loss"]), name
