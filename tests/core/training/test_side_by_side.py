"""Trainings side by side: each learns what it would learn alone, bit for bit, and data are made once."""

import dataclasses
import json

import pytest
import torch
from helpers.tiny_models import tiny_model

from fb_core.conditioning import assemble
from fb_core.data.training.sequences import PoolConfig, RoomPool
from fb_core.networks.transformer.dit import DiTConfig
from fb_core.training.recipe import dit_stage
from fb_core.training.run.loop import Run
from fb_core.training.side_by_side import train_side_by_side
from fb_core.training.stages.dit_stage import Encoded, SharedBatches
from method_configs.presets import ROOMS_ABLATION, ablations_of

SMALL = dataclasses.replace(
    ROOMS_ABLATION,
    dit=DiTConfig(heads=2, head_dim=16, depth=1, text_width=0),
    pool=PoolConfig(rooms=2, views=4, image_size=32, supersample=1, renewed_per_step=0),
    dit_loop=dataclasses.replace(ROOMS_ABLATION.dit_loop, steps=2),
    dit_loss=dataclasses.replace(
        ROOMS_ABLATION.dit_loss, batch=2, task=dataclasses.replace(ROOMS_ABLATION.dit_loss.task, views=4)
    ),
)
NO_INDEX, _, _, RANDOM_POSES = ablations_of(SMALL)
DESIGNS = (SMALL, NO_INDEX, RANDOM_POSES)


@pytest.fixture(scope="module")
def vaes(tmp_path_factory):
    model = tiny_model(tmp_path_factory.mktemp("model"))
    return {"image_vae": model.image_vae, "raymap_vae": model.raymap_vae}


def losses_of(folder):
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_every_design_learns_what_it_would_learn_alone(tmp_path, vaes):
    together = train_side_by_side({tmp_path / recipe.name: recipe for recipe in DESIGNS}, **vaes)
    for recipe in DESIGNS:
        alone = Run(dit_stage(recipe, **vaes), recipe.dit_loop, tmp_path / "alone" / recipe.name, preset=recipe.name)
        alone.train()
        assert losses_of(tmp_path / recipe.name) == losses_of(tmp_path / "alone" / recipe.name)
        for name, value in together[tmp_path / recipe.name].state_dict().items():
            assert torch.equal(value, alone.averaged_state()[name]), name


def test_rooms_are_rendered_once_and_what_is_trained_already_rests(tmp_path, vaes, monkeypatch):
    rendered = []
    render = RoomPool.render
    monkeypatch.setattr(RoomPool, "render", lambda self, numbers: rendered.extend(numbers) or render(self, numbers))
    folders = {tmp_path / recipe.name: recipe for recipe in DESIGNS[:2]}
    first = train_side_by_side(folders, **vaes)
    assert sorted(rendered) == [0, 1]
    again = train_side_by_side(folders, **vaes)
    assert sorted(rendered) == [0, 1]
    assert all(
        torch.equal(a, b) for f in folders for a, b in zip(first[f].parameters(), again[f].parameters(), strict=True)
    )


def test_designs_that_differ_in_their_data_are_refused(tmp_path, vaes):
    other = dataclasses.replace(SMALL, name="other", seed=1)
    with pytest.raises(ValueError, match="other: expected the seed of rooms-ablation, 0"):
        train_side_by_side({tmp_path / "a": SMALL, tmp_path / "b": other}, **vaes)


def test_the_latest_batches_are_remembered():
    shared, made = SharedBatches(keep=2), []

    def make(key: int) -> Encoded:
        made.append(key)
        latents = torch.full((1, 1, 32, 4, 4), float(key))
        return Encoded(
            latents,
            assemble(latents[:, :, :16], latents[:, :, :16], latents[:, :, :1], latents[:, :, :1]),
            None,
            None,
            None,
        )

    for key in (1, 2, 1, 3, 1):
        assert float(shared.get(key, lambda key=key: make(key)).data.mean()) == key
    assert made == [1, 2, 3, 1]
