"""One build of the project that answers another process: completes views that lie in files and says how long that took.

``python build_worker.py`` with a checkout's root on PYTHONPATH; it uses what every version offers, so that builds can
be compared. Each line that it reads names files and options in JSON; each answer is a line that starts with ``ANSWER``.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import sys
import time
from typing import Any

ANSWER = "answer "
"""Begins the lines that are answers; libraries may print others."""


_PLAIN = {
    "dit": {"ray_frames": False, "known_tokens": "joint"},
    "dit_loss": {"draws": 1, "pure_noise": 0.0},
    "dit_loss.task": {"guess": 0.0, "sector": 0.0},
    "pool": {"rooms": 24},
}
"""What makes the preset rooms-tiny of every build the same training: the paper's design. Options that a build lacks are
left out.
"""


def main() -> None:
    """Answer until there is no more to read."""
    from fb_core.inpainter import Fillerbuster

    model = Fillerbuster.from_pretrained()
    sampling = _replaced(model.recommended_sampling, [], {"precision": "auto"})
    _say({"steps": sampling.steps})
    training = None
    for line in sys.stdin:
        asked = json.loads(line)
        if "views" in asked:
            _say(_completed(model, sampling, asked))
        else:
            training = _Training() if training is None else training
            _say(training.step())


def _say(answer: dict[str, Any]) -> None:
    print(ANSWER + json.dumps(answer), flush=True)


def _completed(model: Any, sampling: Any, asked: dict[str, Any]) -> dict[str, float]:
    """Complete the views of a file round by round as a completion does, keep the answers in another one."""
    import numpy as np
    import torch

    rounds = _rounds(asked)
    if len(rounds) > 1 and hasattr(model, "shared"):
        model.shared = importlib.import_module("fb_core.networks.shared_results").SharedResults()
    began, began_cpu = time.perf_counter(), time.process_time()
    answers = [
        model.complete(views, generator=torch.Generator().manual_seed(asked["seed"] + number), sampling=sampling)
        for number, views in enumerate(rounds)
    ]
    took = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - began_cpu}
    generated = torch.cat([answer.images[asked["known"] :] for answer in answers])
    np.save(asked["answer"], generated.clamp(0, 1).numpy())
    if asked["exact_steps"]:
        took["latent_error"] = _latent_error(model, sampling, rounds[0], asked)
    return took


def _rounds(asked: dict[str, Any]) -> list[Any]:
    """The known views of a file and, in each round, so many others of which the rays are known."""
    import numpy as np
    import torch

    from fb_core.views import Views

    first, unknown = asked["known"], asked["unknown"]
    with np.load(asked["views"]) as stored:
        images, raymaps = (torch.from_numpy(stored[name]) for name in ("images", "raymaps"))
    rounds = []
    for start in range(first, len(images), unknown):
        chosen = [*range(first), *range(start, start + unknown)]
        known = torch.ones_like(images[chosen, :1])
        image_known = known.clone()
        image_known[first:] = 0
        rounds.append(
            Views(
                images=images[chosen] * image_known,
                image_known=image_known,
                raymaps=raymaps[chosen],
                rays_known=known,
            )
        )
    return rounds


def _latent_error(model: Any, sampling: Any, views: Any, asked: dict[str, Any]) -> float:
    """Distance of the generated views' latents from those of many steps, over the length of these."""
    import torch

    with torch.no_grad():
        got, exact = (
            model.denoising(views, seed=asked["seed"], sampling=dataclasses.replace(sampling, steps=steps)).run()
            for steps in (sampling.steps, asked["exact_steps"])
        )
    # The first 16 channels are the image's; rays are known.
    got, exact = got[asked["known"] :, :16], exact[asked["known"] :, :16]
    return float((got - exact).norm() / exact.norm())


class _Training:
    """A training of the preset rooms-tiny in the paper's design, in the precision that the build chooses on this
    machine.
    """

    def __init__(self) -> None:
        from fb_core.networks.vae import VAE
        from fb_core.training.recipe import dit_stage

        run_class = _first_of("fb_core.training.run.loop", "fb_core.training.loop").Run
        recipe = _first_of("method_configs.presets", "method_configs.ablations").ROOMS_TINY
        for where, options in _PLAIN.items():
            recipe = _replaced(recipe, where.split("."), options)
        recipe = _replaced(recipe, ["engine"], {"draw_ahead": False})
        self._run = run_class(
            dit_stage(recipe, VAE(recipe.image_vae), VAE(recipe.raymap_vae)),
            recipe.dit_loop,
            None,
            engine=recipe.engine,
        )
        self._run.train(at_most=2)

    def step(self) -> dict[str, float]:
        """One step of it, its data included."""
        began, began_cpu = time.perf_counter(), time.process_time()
        self._run.train(at_most=1)
        took = {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - began_cpu}
        return took | {"loss": self._run.smoothed["loss"]}


def _first_of(*names: str) -> Any:
    """The first of these modules that the build has: their names changed."""
    for name in names:
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError:
            continue
    raise ValueError(f"this build has none of the modules {', '.join(names)}; compare with a later one")


def _replaced(config: Any, where: list[str], options: dict[str, Any]) -> Any:
    """The configuration with these options of a part of it, as far as the part has them."""
    if where:
        return dataclasses.replace(config, **{where[0]: _replaced(getattr(config, where[0]), where[1:], options)})
    names = {field.name for field in dataclasses.fields(config)}
    return dataclasses.replace(config, **{name: value for name, value in options.items() if name in names})


if __name__ == "__main__":
    main()
