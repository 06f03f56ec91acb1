"""What splats look like while they are trained: colours, depth and accumulation from cameras of ours, and the surfaces
that they show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_nerfstudio.bridge import to_nerfstudio

SOLID = 0.5
"""Accumulation from which a pixel counts as covered by splats; below, it is a hole."""
FIRM = 0.75
"""Accumulation from which the splats' colours are believed beside the captured pictures, and as a start of generation.
(A room at step 500: 14 dB from 0.5 on, which generated views exceed, 19 dB from 0.75 on, 27 dB from 0.95 on.)
"""
TRAINED_STEPS = 100
"""Steps after which the splats' own depth and accumulation are believed."""
_SAME_DEPTH = 0.1
"""Of the depth, by which two cameras may differ about a surface: splats of some hundred steps are no better."""
_FEWEST_BORNE_OUT = 0.2
"""Share of a capture's surface that two cameras must agree on for the rest to be left out."""
_ELSEWHERE = 0.01
"""Of the depth, by which a second camera must stand apart from the first to tell anything of it."""
SMALL_SIDE = 64
"""Pixels; what was seen is judged on pictures of at most this size, which bounds time for large views and captures."""


@runtime_checkable
class TrainedSplats(Protocol):
    """What generation needs of the model that is trained (:mod:`fb_nerfstudio.splats.splat_model`)."""

    training: bool

    @property
    def device(self) -> torch.device:
        """Where its parameters are."""
        ...

    @property
    def means(self) -> Tensor:
        """Centres of the Gaussians [m, 3] in the world of the training."""
        ...

    @property
    def room(self) -> int | None:
        """Gaussians that its limit leaves room for; None without a limit."""
        ...

    def train(self, mode: bool = True) -> Any:
        """Switch to training, or to evaluation."""
        ...

    def eval(self) -> Any:
        """Switch to evaluation."""
        ...

    def get_outputs_for_camera(self, camera: Cameras) -> Mapping[str, Tensor]:
        """A render's ``rgb``, ``accumulation`` and ``depth`` ([h, w, c])."""
        ...

    def add_gaussians(self, points: Tensor, colors: Tensor, optimizers: Optimizers | None) -> int:
        """Append Gaussians between two iterations; returns how many there was room for."""
        ...

    def remove_gaussians(self, chosen: Tensor, optimizers: Optimizers | None) -> int:
        """Take the chosen Gaussians away between two iterations; returns how many went."""
        ...


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """What the splats look like from some cameras, on the CPU."""

    depth: Float[Tensor, "n h w"]
    """Expected z-depth in scene units; means nothing where accumulation is low."""
    accumulation: Float[Tensor, "n h w"]
    """Opacity in [0, 1]."""
    rgb: Float[Tensor, "n 3 h w"]
    """Colours in [0, 1], over the model's background where the splats are not opaque."""

    @property
    def solid(self) -> Bool[Tensor, "n h w"]:
        """True where splats cover the pixel at a depth that means something."""
        return (self.accumulation >= SOLID) & torch.isfinite(self.depth) & (self.depth > 0)


def coarse(cameras: Pinholes) -> Pinholes:
    """The same cameras with small pictures, on the CPU."""
    scale = min(1.0, SMALL_SIDE / max(cameras.width, cameras.height))
    return cameras.to("cpu", torch.float32).scaled(
        max(1, round(cameras.width * scale)), max(1, round(cameras.height * scale))
    )


@torch.no_grad()
def render_geometry(splats: TrainedSplats, cameras: Pinholes) -> Rendered:
    """Colours, depth and accumulation of the splats from each camera, in evaluation mode; the training mode is
    restored. On the CPU.
    """
    was_training = splats.training
    splats.eval()
    try:
        outputs = [
            splats.get_outputs_for_camera(to_nerfstudio(cameras[index], splats.device)) for index in range(len(cameras))
        ]
    finally:
        splats.train(was_training)
    return Rendered(
        depth=torch.stack([one["depth"][..., 0].float().cpu() for one in outputs]),
        accumulation=torch.stack([one["accumulation"][..., 0].float().cpu() for one in outputs]),
        rgb=torch.stack([one["rgb"].movedim(-1, 0).float().cpu() for one in outputs]),
    )


def surface_points(splats: TrainedSplats, cameras: Sequence[Pinholes], *, limit: int = 20000) -> Float[Tensor, "m 3"]:
    """World points of what the splats show in the captured cameras (at most ``limit``, evenly spread over the
    pictures).

    Where one camera alone shows something, splats may stand anywhere along its rays, and often stand close before it.
    So a point counts when the depth in a camera that stands elsewhere bears it out; where hardly any is borne out (a
    single camera, or all in one place), all count.
    """
    small = [coarse(camera) for camera in cameras]
    depths = []
    for camera in small:
        rendered = render_geometry(splats, camera)
        depths.append(torch.where(rendered.solid, rendered.depth, 0.0)[0])
    groups = [camera.unproject(depth[None])[0][depth > 0] for camera, depth in zip(small, depths, strict=True)]
    points = _evenly(torch.cat(groups) if groups else torch.empty(0, 3), limit)
    origins = [camera.centers.expand_as(group) for camera, group in zip(small, groups, strict=True)]
    borne_out = _borne_out(small, depths, points, _evenly(torch.cat(origins) if origins else torch.empty(0, 3), limit))
    return points[borne_out] if float(borne_out.float().mean()) > _FEWEST_BORNE_OUT else points


def _evenly(points: Float[Tensor, "m 3"], limit: int) -> Float[Tensor, "_m 3"]:
    return points[torch.linspace(0, len(points) - 1, min(len(points), limit), dtype=torch.float64).long()]


def _borne_out(
    cameras: Sequence[Pinholes],
    depths: Sequence[Float[Tensor, "_h _w"]],
    points: Float[Tensor, "m 3"],
    origins: Float[Tensor, "m 3"],
) -> Bool[Tensor, " m"]:
    """Whether a camera that stands apart from each point's origin (the camera that shows it) shows the point too: it
    lies in the picture, at the depth that stands there.
    """
    result = torch.zeros(len(points), dtype=torch.bool)
    for camera, depth in zip(cameras, depths, strict=True):
        pixels, away = (one[0] for one in camera.project(points))
        size = pixels.new_tensor([depth.shape[1], depth.shape[0]])
        inside = ((pixels >= 0) & (pixels < size)).all(dim=-1) & (away > 0)
        inside &= (origins - camera.centers).norm(dim=1) > _ELSEWHERE * away
        column, row = pixels[inside].long().unbind(dim=-1)
        result[inside] |= (depth[row, column] - away[inside]).abs() < _SAME_DEPTH * away[inside]
    return result


def free_space(splats: TrainedSplats, cameras: Sequence[Pinholes]) -> FreeSpace:
    """What rays of the captured cameras have crossed on their way to the surfaces that the splats show."""
    small = [coarse(camera) for camera in cameras]
    rendered = [render_geometry(splats, camera) for camera in small]
    return FreeSpace(cameras=tuple(small), depth=tuple(torch.where(one.solid, one.depth, 0.0)[0] for one in rendered))
