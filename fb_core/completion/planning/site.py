"""Where new cameras may stand, and what they should look at: the capture's shape, its shell, and what it has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.options import PlacementConfig
from fb_core.completion.planning.candidate_views import Candidates, looking_in, looking_out, with_wider_lens
from fb_core.completion.results.completed_views import ANCHOR, DENSIFY
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_core.geometry.shell import Shell, fit_shell, sphere
from fb_core.geometry.viewpoints.coverage import Coverage
from fb_core.geometry.viewpoints.paths import (
    CaptureShape,
    cylinder_centers,
    inward_targets,
    kept_clear,
    outward_directions,
    seen_by,
    sphere_directions,
    spread_subset,
)

_ANCHOR_LEVELS, _DENSIFY_LEVELS = 2, 3
_SEEN_NEED = 0.2  # looking at what the capture has seen is worth this much of looking at what it has not
_PLANNING_POINTS = 4000
_BEYOND = 1.25  # how far off an object new cameras may stand, in the distance of the farthest captured one
_FEWEST_POINTS = 16  # seen points; of fewer, nobody can tell where surfaces are
_PLACES, _CAPTURED_PLACES = 24, 16  # where candidates stand: new places for each role, and captured ones


@dataclass(frozen=True, kw_only=True)
class Former:
    """What the plan of one round has to know of those before it."""

    number: int
    """Of the round to plan, from 0."""
    cameras: tuple[Pinholes, ...] = ()
    """Of the generated views so far, one each."""
    shown: tuple[Bool[Tensor, "_h _w"], ...] = ()
    """Their pixels that count as seen; masks of any size."""


@dataclass(frozen=True, kw_only=True)
class Site:
    """The scene as far as placing cameras needs it."""

    shape: CaptureShape
    """Centre, up, radius and kind of the capture."""
    shell: Shell
    """Guess of the surface all around."""
    points: Float[Tensor, "m 3"]
    """Seen surface points, at most a few thousand."""
    cameras: list[Pinholes]
    """The captured ones, in float64 on the CPU, one per entry."""
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None
    """Of each captured picture its known part, None for all of it."""
    placement: PlacementConfig
    """Where new cameras may stand."""
    free: FreeSpace | None = None
    """Space that is known to be free; None where nobody knows."""

    @staticmethod
    def of(
        cameras: Sequence[Pinholes],
        points: Float[Tensor, "m 3"] | None,
        placement: PlacementConfig,
        *,
        known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
        free: FreeSpace | None = None,
    ) -> Site:
        """Of captured cameras (sizes may differ) and seen surface points, if there are any."""
        exact = [camera.to("cpu", torch.float64) for camera in cameras]  # a scene may lie far from the origin
        shape = CaptureShape.of(exact)
        seen = thinned_points(points, shape)
        return Site(
            shape=shape,
            shell=shell_of(shape, seen, torch.cat([camera.centers for camera in exact]) if shape.outward else None),
            points=seen,
            cameras=exact,
            known=known,
            placement=placement,
            free=free,
        )

    @property
    def blind(self) -> bool:
        """Whether nobody knows where surfaces are: no point was seen, and no splats are trained."""
        return len(self.points) < _FEWEST_POINTS and (self.free is None or not self.free.is_known)

    @property
    def keeps_to_captured_places(self) -> bool:
        """Whether new cameras stand where captured ones stood: a wall may stand anywhere else."""
        return self.blind and self.shape.outward and self.placement.clearance > 0

    def surface(self) -> tuple[Float[Tensor, "k 3"], Float[Tensor, "k 3"]]:
        """Points all over the shell, and their directions from its centre."""
        directions = sphere_directions(1024, like=self.shape.center)
        return self.shape.center + directions * self.shell.radius(directions)[:, None], directions

    def need(self) -> Float[Tensor, "k"]:
        """How much each surface point deserves to be seen: little where the capture saw it, and less far from level.

        People look ahead more than at floor and ceiling, and so did the cameras that the model was trained on.
        """
        surface, directions = self.surface()
        seen = seen_by(self.cameras, surface, self.known)
        return (1.0 - 0.6 * (directions @ self.shape.up) ** 2) * torch.where(seen, _SEEN_NEED, 1.0)

    def centers(self, role: str, views: int, generator: torch.Generator) -> Float[Tensor, "n 3"]:
        """Camera centres of one round, pulled out of seen geometry."""
        shape, placement = self.shape, self.placement
        typical = float(self.shell.log_radius.median().exp())
        radius = placement.radius * max(shape.radius, 0.05 * typical)  # a pure rotation gets a little parallax
        half_height = placement.height * (
            shape.half_height if shape.outward else max(shape.half_height, 0.125 * shape.radius)
        )
        centers = cylinder_centers(
            shape,
            views,
            generator=generator,
            radius=radius,
            inner_radius=radius if role == ANCHOR else placement.inner_radius * radius,
            half_height=half_height,
            levels=_ANCHOR_LEVELS if role == ANCHOR else _DENSIFY_LEVELS,
        )
        if placement.clearance == 0:
            return centers
        refuges = torch.cat([camera.centers for camera in self.cameras])
        return kept_clear(
            centers,
            shell=self._bounds(refuges),
            points=self.points,
            clearance=placement.clearance * typical,
            refuges=refuges,
            free=self.free if shape.outward and self.free is not None and self.free.is_known else None,
        )

    def _bounds(self, standing: Float[Tensor, "n 3"]) -> Shell:
        """What no new camera stands outside of: the shell, unless that is an object which the captured cameras stand
        around.
        """
        if self.shape.outward or float(self.shell.contains(standing).double().mean()) > 0.5:
            return self.shell
        return sphere(self.shape.center, _BEYOND * float((standing - self.shape.center).norm(dim=1).max()))

    def candidates(self, generator: torch.Generator, former: Former | None = None) -> Candidates:
        """Places and directions for new views, and what of the scene is seen by the capture and by former views."""
        chosen = spread_subset(self.cameras, _CAPTURED_PLACES)
        standing = torch.cat([self.cameras[index].centers for index in chosen])
        around = [self.centers(role, _PLACES, generator) for role in (ANCHOR, DENSIFY)]
        if self.keeps_to_captured_places:
            around = []
        if self.shape.outward:
            surface, directions = self.surface()
            weight = 1.0 - 0.6 * (directions @ self.shape.up) ** 2  # as `need`
            coverage = Coverage.of(self.cameras, surface, weight, self.known)
            places = looking_out(
                torch.cat([standing, *around]), self.shape, coverage, max_pitch_degrees=self.placement.max_pitch_degrees
            )
            if self.placement.wider_lens > 1:
                captured = Pinholes.cat([self.cameras[index][[0]].scaled(1, 1) for index in chosen])
                places = with_wider_lens(places, captured, self.placement.wider_lens)
            return places if former is None else places.also_seen(seen_by(self._of(former), surface, former.shown))
        places = looking_in(torch.cat(around), self.shape, self.cameras)
        whole = (
            []
            if former is None
            else [
                camera for camera, mask in zip(self._of(former), former.shown, strict=True) if mask.float().mean() > 0.5
            ]
        )
        return places.also_seen(looking_in(torch.cat(around), self.shape, whole).coverage.seen) if whole else places

    def _of(self, former: Former) -> list[Pinholes]:
        return [camera.to("cpu", torch.float64) for camera in former.cameras]

    def targets(
        self,
        centers: Float[Tensor, "n 3"],
        need: Float[Tensor, "k"],
        half_angle_radians: float,
        generator: torch.Generator,
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "k"]]:
        """A point for each camera to look at, and the need that remains."""
        if not self.shape.outward:
            return inward_targets(
                centers, shape=self.shape, spread=self.placement.target_spread, generator=generator
            ), need
        looks, need = outward_directions(
            centers,
            surface=self.surface()[0],
            need=need,
            up=self.shape.up,
            half_angle_radians=half_angle_radians,
            max_pitch_degrees=self.placement.max_pitch_degrees,
            generator=generator,
        )
        return centers + looks * max(self.shape.radius, 1.0), need


def thinned_points(points: Tensor | None, shape: CaptureShape) -> Float[Tensor, "m 3"]:
    """At most a few thousand finite points on the CPU."""
    if points is None:
        return shape.center.new_empty(0, 3)
    points = points.detach().cpu().to(shape.center)
    points = points[torch.isfinite(points).all(dim=1)]
    return points[torch.linspace(0, len(points) - 1, min(len(points), _PLANNING_POINTS), dtype=torch.float64).long()]


def shell_of(shape: CaptureShape, points: Tensor, standing: Float[Tensor, "c 3"] | None = None) -> Shell:
    """The surface all around, with room where people stood; without points, a sphere that leaves the cameras room."""
    guess = (3.0 if shape.outward else 2.0) * shape.radius
    return fit_shell(
        points, center=shape.center, fallback_radius=guess if guess > 1e-6 else 1.0, up=shape.up, standing=standing
    )
