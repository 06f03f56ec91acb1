"""How large a film is and how long its splats are trained, so that all of it takes about the time a person gives."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch

from fb_core.completion.options import CompletionConfig
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.splats.backend import render_splats
from fb_nerfstudio.splats.scene_film import film_frame
from fb_nerfstudio.splats.splat_file import Splats
from method_configs.commands.complete.options import CompleteOptions
from method_configs.commands.complete.scenes.scene_training import SceneSchedule

FEWEST_STEPS, MOST_STEPS = 300, 7000
_WANTED_STEPS = 1500  # enough for what photos show; more time goes into larger pictures first
_SIDES = (64, 96, 128, 160, 240, 320, 480, 640, 960, 1280, 1920, 2560, 3840)  # of pictures that splats are trained on
_TRAINING_SHARE, _FILM_SHARE = (
    0.65,
    0.2,
)  # of the time; the rest is for new views, files, and for guesses that were too low
_PROBE_SIDE, _PROBE_SPLATS = 96, 4000
_LEAST_SIDE = 17  # pixels of the shorter side: what is trained on has 16 at least, after rounding
_LEAST_SECONDS = 10.0
_ON_CPU, _ON_GPU = 20_000, 500_000  # Gaussians


@dataclass(frozen=True, kw_only=True)
class Speed:
    """What this machine does just now."""

    step: float
    """Seconds of a training step for each pixel."""
    frame: float
    """Seconds of a film's frame for each pixel."""
    whole_step: float = 0.0
    """Seconds of a training step besides, whatever the size of its picture: Gaussians, optimizer, trainer."""


@dataclass(frozen=True, kw_only=True)
class SceneBudget:
    """Sizes and steps."""

    photo_side: int
    """Longest side in pixels of the photos that splats are trained on."""
    film_side: int
    """Longest side in pixels of the film."""
    schedule: SceneSchedule
    """Of the training."""
    seconds: float
    """That this may take, new views left out."""

    @staticmethod
    def of(
        seconds: float,
        speed: Speed,
        options: CompleteOptions,
        *,
        photos: tuple[int, int],
        device: str,
    ) -> SceneBudget:
        """What fits into a time.

        Args:
            seconds: that are left.
            speed: of the machine.
            options: pictures of the film; steps and sides, where they are given.
            photos: width and height of the photos in pixels; their longer side is one that nothing exceeds.
            device: where splats are trained.
        """
        seconds = max(seconds, _LEAST_SECONDS)
        steps, longest, aspect = options.iterations, max(photos), min(photos) / max(photos)
        wanted = _WANTED_STEPS if steps is None else steps

        def training(side: int, steps: int) -> float:
            return steps * (speed.whole_step + speed.step * aspect * side**2)

        def film(side: int) -> float:
            return options.views * speed.frame * aspect * side**2

        side = options.photo_size or max(
            [one for one in _SIDES if one < longest and training(one, wanted) <= _TRAINING_SHARE * seconds]
            or [_SIDES[0]]
        )
        side = min(max(side, math.ceil(_LEAST_SIDE / aspect)), longest)
        if steps is None:
            affordable = _TRAINING_SHARE * seconds / max(training(side, 1), 1e-9)
            steps = int(min(max(affordable, FEWEST_STEPS), MOST_STEPS)) // 10 * 10
        # Splats know no more than the photos that they were trained on: beyond twice that size a film only gets larger.
        film_side = options.film_size or max(
            [one for one in _SIDES if one <= 2 * side and film(one) <= _FILM_SHARE * seconds] or [_SIDES[0]]
        )
        film_side = min(film_side, longest)
        most = _ON_GPU if torch.device(device).type == "cuda" else _ON_CPU
        complete_at = min(CompletionConfig.at_step, max(1, steps // 2))
        return SceneBudget(
            photo_side=side,
            film_side=film_side,
            schedule=SceneSchedule(steps=steps, complete_at=complete_at, most_gaussians=most),
            seconds=training(side, steps) + film(film_side),
        )


def measured_speed(device: str) -> Speed:
    """Of a few small pictures, which takes about a second."""
    generator = torch.Generator().manual_seed(0)
    count, side = _PROBE_SPLATS, _PROBE_SIDE
    splats = Splats(
        means=torch.rand(count, 3, generator=generator) * torch.tensor([2.0, 2.0, 1.0])
        - torch.tensor([1.0, 1.0, -1.5]),
        log_scales=torch.full((count, 3), -3.5),
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1),
        logits=torch.randn(count, generator=generator),
        harmonics=torch.rand(count, 4, 3, generator=generator),
    )
    camera = Pinholes(
        camera_to_world=torch.eye(4)[None, :3],
        focal=torch.full((1, 2), float(side)),
        principal=torch.full((1, 2), side / 2),
        width=side,
        height=side,
    )
    if torch.device(device).type == "cuda":
        return Speed(step=1e-8, frame=1e-8, whole_step=0.01)  # gsplat's take about as long whatever the size
    steps, frames = [], []
    for _ in range(4):
        began = time.perf_counter()
        _step(splats, camera)
        between = time.perf_counter()
        film_frame(splats, torch.ones(count, dtype=torch.bool), camera)
        steps.append(between - began)
        frames.append(time.perf_counter() - between)
    return Speed(
        step=_STEP_FACTOR * min(steps) / side**2,
        frame=_FRAME_FACTOR * min(frames) / side**2,
        whole_step=_WHOLE_STEP_FACTOR * min(steps),
    )


# What trainings of 17,000 Gaussians took beside the bare probe of 18 ms: 40 ms a step on 18 x 32 pixels, 65 on
# 135 x 240, 185 on 270 x 480.
_STEP_FACTOR, _WHOLE_STEP_FACTOR, _FRAME_FACTOR = 0.55, 2.0, 1.2


def _step(splats: Splats, camera: Pinholes) -> None:
    given = {
        name: getattr(splats, name).clone().requires_grad_()
        for name in ("means", "log_scales", "quats", "logits", "harmonics")
    }
    drawn = render_splats(
        means=given["means"],
        quats=given["quats"],
        scales=given["log_scales"].exp(),
        opacities=given["logits"].sigmoid(),
        colors=given["harmonics"],
        viewmats=camera.world_to_camera,
        Ks=camera.intrinsics,
        width=camera.width,
        height=camera.height,
        sh_degree=1,
    )
    drawn.colors.square().mean().backward()
