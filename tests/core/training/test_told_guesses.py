"""Guesses, ray frames and known tokens through training, folders and completion."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from helpers.tiny_training import TOY

from fb_core import checkpoint
from fb_core.evaluation.completion import CompletionTask, edge_energy, evaluate_completion, unseen_room
from fb_core.inpainter import Fillerbuster
from fb_core.networks.transformer.dit import DiT
from fb_core.networks.vae import VAE
from fb_core.sampling.options import SamplingConfig
from fb_core.training.recipe import Recipe, adopt_autoencoders, dit_stage, export, run_stage
from fb_core.views import Views
from method_configs.commands.train_options import TrainOptions
from method_configs.commands.training import train_preset

NEW = dataclasses.replace(
    TOY,
    name="toy-new",
    dit=dataclasses.replace(TOY.dit, ray_frames=True, known_tokens="apart"),
    dit_loss=dataclasses.replace(
        TOY.dit_loss, draws=2, pure_noise=0.3, task=dataclasses.replace(TOY.dit_loss.task, guess=0.9)
    ),
    sampling=SamplingConfig(guidance_unknown=1.0, guidance_known=1.0, steps=3, guess="told"),
)
QUICK = SamplingConfig(guidance_unknown=1.0, guidance_known=1.0, steps=2)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A model of every new kind, trained for a few steps."""
    folder = tmp_path_factory.mktemp("trained")
    for stage in ("image-vae", "raymap-vae", "dit"):
        run_stage(NEW, stage, folder)
    export(NEW, folder, folder / "model")
    return folder


def autoencoders(recipe: Recipe) -> tuple[VAE, VAE]:
    torch.manual_seed(0)
    return VAE(recipe.image_vae), VAE(recipe.raymap_vae)


def test_a_training_is_the_same_however_its_rows_are_drawn():
    stage = dit_stage(NEW, *autoencoders(NEW))
    together = stage.draw(0, range(2))
    apart = [stage.draw(0, range(row, 2, 2)) for row in range(2)]
    for name in ("inputs", "times", "index", "velocity"):
        torch.testing.assert_close(getattr(together, name), torch.cat([getattr(part, name) for part in apart]))
    assert together.facts.sequences_per_scene == 2 and len(together.inputs) == 4
    assert torch.equal(together.index[0], together.index[1]) and not torch.equal(together.inputs[0], together.inputs[1])
    assert torch.equal(together.inputs[0, :, 32:], together.inputs[1, :, 32:])


def test_the_velocity_of_known_tokens_costs_nothing():
    stage = dit_stage(NEW, *autoencoders(NEW))
    drawn = stage.draw(0, range(2))
    known = (
        stage.network.where_known(drawn.facts.known, torch.ones_like(drawn.velocity), torch.zeros_like(drawn.velocity))
        > 0
    )
    assert bool(known.any()) and not bool(known.all())
    with torch.no_grad():
        predicted = stage.network(drawn.inputs, drawn.times, None, drawn.index, drawn.facts)
    torch.testing.assert_close(predicted[known], drawn.velocity[known], atol=2e-3, rtol=1e-3)


def test_a_share_of_the_draws_is_pure_noise():
    stage = dit_stage(
        dataclasses.replace(NEW, dit_loss=dataclasses.replace(NEW.dit_loss, pure_noise=1.0)), *autoencoders(NEW)
    )
    assert bool((stage.draw(0, range(2)).times == 1).all())


def test_a_folder_keeps_the_new_options_and_its_recommendation(trained):
    model = Fillerbuster.from_pretrained(trained / "model")
    assert model.dit.config == NEW.dit and model.recommended_sampling.guess == "told"


def test_a_model_as_released_has_the_folder_that_it_had(tmp_path):
    image_vae, raymap_vae = autoencoders(TOY)
    checkpoint.save(tmp_path / "m", dit=DiT(TOY.dit), image_vae=image_vae, raymap_vae=raymap_vae)
    assert "ray_frames" not in (tmp_path / "m" / "config.json").read_text()


def test_a_training_starts_from_a_model_and_keeps_its_autoencoders(trained, tmp_path):
    again = dataclasses.replace(NEW, start_from=trained / "model")
    adopt_autoencoders(again, tmp_path)
    run_stage(again, "dit", tmp_path, steps=1)
    export(again, tmp_path, tmp_path / "model")
    old, new = (Fillerbuster.from_pretrained(folder / "model") for folder in (trained, tmp_path))
    assert new.info["started_from"] == old.model_hash
    for before, after in zip(old.image_vae.parameters(), new.image_vae.parameters(), strict=True):
        assert torch.equal(before, after)
    assert all(
        float((a - b).abs().max()) < 0.1 for a, b in zip(old.dit.parameters(), new.dit.parameters(), strict=True)
    )


def test_another_architecture_is_no_start(trained, tmp_path):
    with pytest.raises(ValueError, match=r"model"):
        train_preset("rooms-tiny", tmp_path, TrainOptions(start_from=trained / "model", steps=1))
    assert not any(tmp_path.rglob("*.pt"))


@pytest.mark.parametrize("guess", ["told", "both"])
def test_completion_is_told_a_guess(trained, guess):
    model = Fillerbuster.from_pretrained(trained / "model")
    room = unseen_room(family="narrow", seed=0, number=0, views=4, size=16)
    views = Views.cat([Views.known(room.images[:2], room.cameras[[0, 1]]), Views.unknown(room.cameras[[2, 3]])])
    sampling = dataclasses.replace(QUICK, guess=guess, strength=0.6)

    def completed(current: Views | None, sampling=sampling) -> torch.Tensor:
        return model.complete(
            views, generator=torch.Generator().manual_seed(0), sampling=sampling, current=current
        ).images

    guessed = Views.known(room.images, room.cameras)
    plain = completed(None, QUICK)
    told = completed(guessed)
    assert not torch.equal(told, plain) and torch.equal(told[:2], room.images[:2])
    nothing = dataclasses.replace(
        guessed, image_known=torch.zeros_like(guessed.image_known), images=guessed.images * float("nan")
    )
    assert torch.equal(completed(nothing), plain)


def test_known_views_are_computed_once_and_change_nothing_else(trained):
    """The law of known tokens apart: a completion equals the plain network's, step by step (see also
    tests/core/networks/transformer/test_known_tokens.py).
    """
    model = Fillerbuster.from_pretrained(trained / "model")
    room = unseen_room(family="narrow", seed=0, number=1, views=4, size=16)
    views = Views.cat([Views.known(room.images[:3], room.cameras[[0, 1, 2]]), Views.unknown(room.cameras[[3]])])
    denoising = model.denoising(views, seed=3, sampling=QUICK)
    field, state = denoising.field(), denoising.start()
    sequence = torch.cat([state, denoising.conditioning.channels], dim=1)[None]
    facts = dataclasses.replace(
        denoising.conditioning,
        channels=denoising.conditioning.channels[None],
        frames=denoising.conditioning.frames[None],
    ).facts(model.dit.config)
    for time in (1.0, 0.4):
        expected = model.dit(sequence, torch.tensor([time]), facts=facts)[0]
        torch.testing.assert_close(field(state, time), expected, atol=1e-5, rtol=1e-4)


def test_windows_and_guidance_work_with_known_tokens_apart(trained):
    model = Fillerbuster.from_pretrained(trained / "model")
    room = unseen_room(family="narrow", seed=0, number=1, views=5, size=16)
    views = Views.cat([Views.known(room.images[:3], room.cameras[[0, 1, 2]]), Views.unknown(room.cameras[[3, 4]])])
    for changes in (
        {"window": 2, "rounds": 2},
        {"guidance_unknown": 3.0, "guidance_known": 1.1},
        {"known": "imposed"},
        {"solver": "heun"},
    ):
        sampling = dataclasses.replace(QUICK, **changes)
        completed = model.complete(views, generator=torch.Generator().manual_seed(0), sampling=sampling)
        assert bool(torch.isfinite(completed.images).all()), changes
        assert torch.equal(completed.images[:3], room.images[:3])


def test_eval_scores_the_told_model_and_its_edges(trained):
    model = Fillerbuster.from_pretrained(trained / "model")
    (result,) = evaluate_completion(model, CompletionTask(rooms=1, views=4, known=2), QUICK, told=True)
    assert "model told what is carried over" in result.psnr and result.edges.keys() == result.psnr.keys()


def test_edge_energy_of_the_truth_is_one_and_of_blur_less():
    truth = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    assert edge_energy(truth, truth) == pytest.approx(1.0)
    assert edge_energy(torch.nn.functional.avg_pool2d(truth, 3, 1, 1), truth) < 0.6
