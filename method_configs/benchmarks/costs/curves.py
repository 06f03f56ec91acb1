"""What grows with the size of a scene: jobs of rising size, one curve for each thing that a completion or a training
does.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.planning.plan import plan_completion
from fb_core.completion.planning.site import Site
from fb_core.completion.rounds import CapturedView, fitted_view
from fb_core.data.rooms.room import FAMILIES, make_room
from fb_core.data.rooms.room_cameras import cameras_by_angles, free_positions
from fb_core.evaluation.completion import unseen_room
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import raymaps_of
from fb_core.inpainter import Fillerbuster
from fb_core.splatting.rasterizer import rasterization
from fb_core.views import Views
from method_configs.benchmarks.splats.drawing import loss_of
from method_configs.benchmarks.splats.scenes import SplatScene, room_scene

Job = Callable[[], object]
"""What is timed."""
_NEW = 24  # views of a round of densified ones
_SIZE = 64  # side of generated views in pixels
_HALF_HEADING = math.radians(60)  # the captures look to one side, so that much is left to plan however many views
_PIXELS = 512 * 512


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How large the jobs are."""

    views: tuple[int, ...] = (10, 20, 50, 100, 200, 500, 1000, 2000)
    """Captured views."""
    shares: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95)
    """Shares of the views of a sampling that are known."""
    sequence: int = 40
    """Views of that sampling."""
    gaussians: tuple[int, ...] = (1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000, 200_000, 500_000)
    """Gaussians, drawn on 512 x 512 pixels."""
    sides: tuple[int, ...] = (64, 128, 256, 512, 1024)
    """Sides of the square picture that 50,000 Gaussians are drawn on."""
    fixed_gaussians: int = 50_000
    """That number."""


QUICK = Sizes(views=(4, 8), shares=(0.0, 0.5), sequence=4, gaussians=(100, 200), sides=(16, 32), fixed_gaussians=100)
"""A miniature that runs in seconds."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Jobs of rising size."""

    name: str
    """What is done."""
    of: str
    """What the sizes count."""
    sizes: tuple[float, ...]
    """Rising; of what is known, what is left unknown is what the cost should follow."""
    job: Callable[[float], Job]
    """Makes the job of a size, all of its input ready."""


def curves(sizes: Sizes, seed: int) -> list[Curve]:
    """All that are measured; ``seed`` decides rooms, cameras and noise."""
    splats = [
        Curve(
            name="one training step of splats", of="Gaussians", sizes=sizes.gaussians,
            job=lambda count: _drawing(room_scene(int(count), round(_PIXELS**0.5), seed=seed)),
        ),
        Curve(
            name="one training step of splats", of="pixels", sizes=tuple(side**2 for side in sizes.sides),
            job=lambda pixels: _drawing(_at_side(sizes.fixed_gaussians, round(pixels**0.5), seed)),
        ),
    ]  # fmt: skip
    works = {
        "planning new views": _planning,
        "context for a round of 24": _choosing,
        "a round of 24 views, sampled": _round,
    }
    captures = [
        Curve(name=name, of="captured views", sizes=sizes.views, job=lambda count, work=work: work(int(count), seed))
        for name, work in works.items()
    ]
    sampling = Curve(
        name=f"sampling of {sizes.sequence} views", of="share known", sizes=sizes.shares,
        job=lambda share: _sampling(sizes.sequence, share, seed),
    )  # fmt: skip
    return [*captures, sampling, *splats]


def _capture(count: int, seed: int) -> tuple[list[Pinholes], torch.Tensor]:
    """So many cameras in a room, all of which look to the same side, and 4000 points of its surfaces."""
    room, generator = make_room(seed, FAMILIES["medium"]), torch.Generator().manual_seed(seed)
    centers = free_positions(room, count, generator=generator)
    heading = _HALF_HEADING * (2 * torch.rand(count, generator=generator) - 1)
    pitch = 0.3 * (2 * torch.rand(count, generator=generator) - 1)
    cameras = cameras_by_angles(centers, heading, pitch, torch.full((count,), 60.0), size=_SIZE)
    return [cameras[[number]] for number in range(count)], room_scene(4000, _SIZE, seed=seed).means


def _planning(count: int, seed: int) -> Job:
    """Where all new views stand and look, and the context for all of them."""
    cameras, points = _capture(count, seed)
    return lambda: plan_completion(cameras, points, CompletionConfig(seed=seed), size=_SIZE)


def _choosing(count: int, seed: int) -> Job:
    """The captured views that show most of what a round of new ones will."""
    cameras, points = _capture(count, seed)
    config = CompletionConfig(seed=seed)
    shell = Site.of(cameras, points, config.placement).shell
    asked = Pinholes.cat(_capture(_NEW, seed + 1)[0])
    return lambda: nearest_context(cameras, asked, shell, config.context_views)


def _round(count: int, seed: int) -> Job:
    """The context's pictures (256 pixels) fitted to the model's size, and a round of new views sampled beside them."""
    cameras, points = _capture(count, seed)
    model, config = Fillerbuster.from_pretrained(), CompletionConfig(seed=seed)
    picture, known = torch.full((3, 256, 256), 0.5), torch.ones(1, 256, 256)
    context = [
        CapturedView(image=picture, known=known, camera=cameras[index].scaled(256, 256))
        for index in plan_completion(cameras, points, config, size=_SIZE).context
    ]
    asked = Views.unknown(Pinholes.cat(_capture(_NEW, seed + 1)[0]))
    sampling = dataclasses.replace(model.recommended_sampling, precision="auto")

    def job() -> None:
        views = Views.cat([*(fitted_view(view, _SIZE) for view in context), asked])
        model.complete(views, generator=torch.Generator().manual_seed(seed), sampling=sampling)

    return job


def _sampling(count: int, share: float, seed: int) -> Job:
    """One whole sampling of the bundled model, pictures in memory to pictures in memory."""
    model = Fillerbuster.from_pretrained()
    room = unseen_room(family="narrow", seed=seed, number=0, views=count, size=_SIZE)
    known = torch.ones(count, 1, _SIZE, _SIZE)
    image_known = known.clone()
    image_known[round(share * count) :] = 0
    raymaps = raymaps_of(room.cameras).float()
    views = Views(images=room.images * image_known, image_known=image_known, raymaps=raymaps, rays_known=known)
    sampling = dataclasses.replace(model.recommended_sampling, precision="auto")
    return lambda: model.complete(views, generator=torch.Generator().manual_seed(seed), sampling=sampling)


def _at_side(count: int, side: int, seed: int) -> SplatScene:
    """The same Gaussians, as large as on 512 pixels, on a picture of another side."""
    scene = room_scene(count, round(_PIXELS**0.5), seed=seed)
    intrinsics = scene.Ks.clone()
    intrinsics[:, :2] *= side / scene.width
    return dataclasses.replace(scene, Ks=intrinsics, width=side, height=side)


def _drawing(scene: SplatScene) -> Job:
    """A picture with its depth, and the gradients of the Gaussians, by the engine in use."""
    return lambda: loss_of(*rasterization(**scene.inputs(gradients=True), render_mode="RGB+D")[:2]).backward()
