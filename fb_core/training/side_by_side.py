"""Several designs of a transformer trained side by side on the same rooms, which are rendered and encoded once for all
of them.

In a small training on a CPU the data cost more than the network; and what designs see alike cannot be what makes them
differ.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

from fb_core.networks.transformer.dit import DiT
from fb_core.networks.vae import VAE
from fb_core.training.recipe import Recipe, dit_stage, sequences_of
from fb_core.training.run.loop import Run
from fb_core.training.stages.dit_stage import SharedBatches

_TURN = 50  # steps of one design before the next one has its turn


def train_side_by_side(
    recipes: Mapping[Path, Recipe],
    *,
    image_vae: VAE,
    raymap_vae: VAE,
    on_step: Callable[[str, int, int], None] = lambda name, step, steps: None,
) -> dict[Path, DiT]:
    """The averaged transformers of recipes that share seed and data, by the folder of each training; what is in the
    folders is resumed.

    Raises ValueError for recipes of different seeds, pools or data, and SystemExit(128 + signal) after a signal, with
    all work saved.
    """
    first = next(iter(recipes.values()))
    for recipe in recipes.values():
        for what in ("seed", "pool", "data"):
            if getattr(recipe, what) != getattr(first, what):
                raise ValueError(
                    f"{recipe.name}: expected the {what} of {first.name}, {getattr(first, what)}, because trainings "
                    "side by side share "
                    f"their data, got {getattr(recipe, what)}; train it alone"
                )
    shared = SharedBatches(keep=2 * _TURN)
    source = sequences_of(first, image_vae)
    runs = {}
    for folder, recipe in recipes.items():
        stage = dit_stage(recipe, image_vae, raymap_vae, source=source, shared=shared)
        # Drawn ahead, the next batch of one design would be made while another one asks the same pool.
        engine = dataclasses.replace(recipe.engine, draw_ahead=False)
        runs[folder] = Run(stage, recipe.dit_loop, folder, preset=recipe.name, engine=engine)
    while unfinished := [run for run in runs.values() if run.step < run.config.steps]:
        run = min(unfinished, key=lambda run: run.step)
        run.train(
            at_most=_TURN - run.step % _TURN,
            on_progress=lambda step, steps, losses, name=run.preset: on_step(name, step, steps),
        )
        if run.signal:
            raise SystemExit(128 + run.signal)
    return {folder: _averaged(recipes[folder], run) for folder, run in runs.items()}


def _averaged(recipe: Recipe, run: Run) -> DiT:
    transformer = DiT(recipe.dit)
    transformer.load_state_dict(run.averaged_state())
    return transformer
