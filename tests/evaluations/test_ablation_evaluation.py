"""The comparison of designs: masks as in the paper, a validation loss with a known answer, nothing done twice, honest
claims.
"""

import json
import math

import pytest
import torch
from helpers.tiny_models import save_tiny_model, tiny_model

from fb_core.conditioning import encode_known, join, stacked_facts, unsplit
from fb_core.evaluation.ablations import (
    AblationTask,
    asked_sequences,
    conditional_validation_loss,
    evaluate_design,
    interval,
)
from fb_core.evaluation.completion import unseen_room
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of, to_unit_range
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.masks import training_mixture
from fb_core.training import side_by_side
from method_configs.evaluations import ablations as ablation_evaluation
from method_configs.evaluations.ablations import Ablations, claims

DESIGNS = ("base", "no-index-emb", "fixed-index-emb", "no-poses", "random-poses")


@pytest.mark.parametrize("views", [4, 8, 16, 32, 9])
def test_a_quarter_is_known_half_unknown_and_the_rest_partly_known(views):
    share = (
        training_mixture(views, 32, 32, generator=torch.Generator().manual_seed(0), in_order=True)
        .flatten(1)
        .mean(dim=1)
    )
    known, unknown = views // 4, views // 2
    assert bool((share[:known] == 1).all()) and bool((share[known : known + unknown] == 0).all())
    assert bool(((share[known + unknown :] > 0) & (share[known + unknown :] < 1)).all())


def test_a_network_that_answers_nothing_has_the_velocity_s_own_size_as_validation_loss(tmp_path):
    model = tiny_model(tmp_path)
    room = unseen_room(family="narrow", seed=0, number=0, views=4, size=32)
    masks = training_mixture(4, 32, 32, generator=torch.Generator().manual_seed(0), in_order=True)
    for parameter in model.dit.parameters():
        parameter.zero_()
    latents = model.image_vae.encode(room.images)
    loss = conditional_validation_loss(model, room, masks, times=2)
    assert loss == pytest.approx(1 + float(latents.square().mean()), rel=0.15)


@pytest.mark.parametrize("weights", ["joint", "apart"])
@torch.no_grad()
def test_validation_loss_is_that_of_the_network_at_every_time(weights, tmp_path):
    """The twin asks the network itself at each time, and keeps nothing between them."""
    model = tiny_model(tmp_path) if weights == "joint" else Fillerbuster.from_pretrained(None)
    assert model.config.transformer.known_tokens == weights
    room = unseen_room(family="narrow", seed=0, number=0, views=4, size=model.size)
    known = training_mixture(4, model.size, model.size, generator=torch.Generator().manual_seed(0), in_order=True)
    rays = to_unit_range(CanonicalFrame.of(room.cameras).apply(raymaps_of(room.cameras)))
    vaes = {"image_vae": model.image_vae, "raymap_vae": model.raymap_vae}
    told = encode_known(room.images, known, rays, torch.ones_like(known), **vaes, transformer=model.dit.config)
    data = unsplit(model.image_vae.encode(room.images), model.raymap_vae.encode(rays))
    noise = torch.randn(data[None].shape, generator=torch.Generator().manual_seed(5))[0]
    errors = []
    for time in (1.0, 0.75, 0.5, 0.25):
        state = join((1 - time) * data + time * noise, told)[None]
        velocity = model.dit(state, torch.tensor([time]), None, None, stacked_facts([told], model.dit.config))[0]
        errors.append(float((velocity - (noise - data))[:, :16].square().mean()))
    loss = conditional_validation_loss(model, room, known, times=4, seed=5)
    assert loss == pytest.approx(sum(errors) / 4, rel=1e-4)


def test_known_views_are_not_scored_and_rows_are_reproducible(tmp_path):
    model = tiny_model(tmp_path)
    task = asked_sequences(AblationTask(sequences=1, lengths=(4,)), model.size)
    first, again = (evaluate_design(model, task, SamplingConfig(steps=1), times=1) for _ in range(2))
    assert first == again and set(first[0]) == {"views", "psnr", "ssim", "val"}
    with_distance = evaluate_design(
        model, task, SamplingConfig(steps=1), times=1, distance=lambda a, b: torch.tensor([float(len(a))])
    )
    assert with_distance[0]["lpips"] == 3


def test_interval_is_student_s():
    mean, half = interval([1.0, 2.0, 3.0])
    assert mean == 2 and half == pytest.approx(4.302653 / 3**0.5, rel=1e-6)
    assert math.isnan(interval([1.0])[1])


def test_a_claim_is_reproduced_only_beyond_its_interval():
    losses = {
        "base": (0.2, 0.21, 0.2),
        "no-index-emb": (0.3, 0.31, 0.3),
        "fixed-index-emb": (0.1, 0.11, 0.1),
        "no-poses": (0.1, 0.3, 0.2),
    }
    results = {
        (design, seed): [{"views": views, "val": losses.get(design, losses["base"])[seed]} for views in (8, 16)]
        for design in DESIGNS
        for seed in range(3)
    }
    seen = {(row["claim"].split()[0], row["views"]): row["seen"] for row in claims(results, (0, 1, 2), trained=8)}
    assert (
        seen[("an", 8)] == "undecided" and seen[("random", 16)] == "reversed" and seen[("denoising", 8)] == "undecided"
    )
    assert ("random", 8) not in seen


def test_designs_are_trained_once_and_measured_once(tmp_path, monkeypatch):
    options = {"output": tmp_path / "out", "model": save_tiny_model(tmp_path / "model"), "seeds": (0,), "steps": 1}
    asked = {"sequences": 1, "lengths": (8,)}
    monkeypatch.setattr(ablation_evaluation, "designs_of", _tiny_designs)
    Ablations(**options, **asked, json=tmp_path / "first.json").run()
    monkeypatch.setattr(side_by_side, "train_side_by_side", None)
    Ablations(**options, **asked, json=tmp_path / "again.json").run()
    first, again = (json.loads((tmp_path / name).read_text())["rows"] for name in ("first.json", "again.json"))
    assert first == again and [row["design"] for row in first if row["part"] == "designs"] == list(DESIGNS)


def _tiny_designs(base, steps):
    import dataclasses

    from fb_core.data.training.sequences import PoolConfig
    from fb_core.networks.transformer.dit import DiTConfig
    from method_configs.presets import PRESETS, ablations_of

    recipe = PRESETS[base]
    task = dataclasses.replace(recipe.dit_loss.task, views=4)
    recipe = dataclasses.replace(
        recipe,
        dit=DiTConfig(heads=2, head_dim=16, depth=1, text_width=0),
        pool=PoolConfig(rooms=2, views=4, image_size=32, supersample=1, renewed_per_step=0),
        dit_loop=dataclasses.replace(recipe.dit_loop, steps=steps),
        dit_loss=dataclasses.replace(recipe.dit_loss, batch=2, task=task),
        sampling=SamplingConfig(steps=1),
    )
    return {"base": recipe} | {other.name.removeprefix(f"{base}-"): other for other in ablations_of(recipe)}
