"""The plan of a completion (paper, section 3.2): which captured views condition it, and where the new cameras stand and
look.

A few anchors on a cylinder around the scene come first; rounds of densified views fill the space between. Nothing here
knows nerfstudio.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.options import CompletionConfig, PlacementConfig
from fb_core.completion.planning.candidate_views import Candidates, looking_in, looking_out
from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.planning.path_candidates import with_path
from fb_core.completion.results.completed_views import ANCHOR, DENSIFY
from fb_core.data.capture.camera_path import read_camera_path
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_core.geometry.shell import Shell, fit_shell, sphere
from fb_core.geometry.viewpoints.coverage import Coverage, choose_views
from fb_core.geometry.viewpoints.paths import (
    CaptureShape,
    cylinder_centers,
    inward_targets,
    kept_clear,
    outward_directions,
    seen_by,
    sphere_directions,
    spread_subset,
    strided_subset,
)

_ANCHOR_LEVELS, _DENSIFY_LEVELS = 2, 3
_SEEN_NEED = 0.2  # looking at what the capture has seen is worth this much of looking at what it has not
_PLANNING_POINTS = 4000
_BEYOND = 1.25  # how far off an object new cameras may stand, in the distance of the farthest captured one
_FEWEST_POINTS = 16  # seen points; of fewer, nobody can tell where surfaces are
_PLACES, _CAPTURED_PLACES = 24, 16  # where candidates stand: new places for each role, and captured ones


@dataclass(frozen=True, kw_only=True)
class PlannedRound:
    """Views that will be generated together."""

    number: int
    """Counted from 0, the anchors."""
    role: str
    """``anchor``, ``densify``, ``requested`` or ``inpainted``."""
    seed: int
    """Decides the images."""
    cameras: Pinholes
    """The new views' cameras."""
    prompt: str = ""
    """What is to be seen, for models that read text."""
    context: tuple[int, ...] | None = None
    """Captured views that condition this round, the most level first; None is all that condition any."""
    aspect: float = 1.0
    """Width over height of the part of the square views that is trained on."""


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
class CompletionPlan:
    """All that is decided before the model runs."""

    shape: CaptureShape
    """Centre, up, radius and kind of the capture."""
    shell: Shell
    """Guess of the surface all around."""
    captured: int
    """Views the capture has."""
    context: tuple[int, ...]
    """Indices of the captured views that condition the rounds; the most level first."""
    rounds: tuple[PlannedRound, ...]
    """Anchors first."""
    size: int
    """Side of all views in pixels while they are generated."""
    covered: tuple[float, float] | None = None
    """Share of what surrounds the capture that its pictures (and generated views so far) show, and that the new views
    show besides; None where nobody asked.
    """
    blind: bool = False
    """Whether nobody knows where surfaces are, so that new cameras stay at captured places (where the capture
    decides).
    """
    former_views: int = 0
    """Views that were generated in rounds before this plan's."""
    coverage: Coverage | None = None
    """Points all over what surrounds the capture, and which of them are seen before these rounds; None where nobody
    asked.
    """

    @property
    def new_views(self) -> int:
        """How many views will be generated."""
        return sum(len(one.cameras) for one in self.rounds)

    def without(self, useless: Sequence[Bool[Tensor, "_n"]]) -> CompletionPlan:
        """The plan without some views of each round; rounds that have none left are gone, the others keep their numbers
        and seeds.
        """
        rounds = [
            dataclasses.replace(planned, cameras=planned.cameras[(~gone).nonzero()[:, 0].tolist()])
            for planned, gone in zip(self.rounds, useless, strict=True)
            if not bool(gone.all())
        ]
        return dataclasses.replace(self, rounds=tuple(rounds))

    def context_of(self, planned: PlannedRound) -> tuple[int, ...]:
        """Places in ``context`` of the views that condition a round."""
        return tuple(range(len(self.context)) if planned.context is None else map(self.context.index, planned.context))


def plan_completion(
    cameras: list[Pinholes],
    points: Float[Tensor, "m 3"] | None,
    config: CompletionConfig,
    *,
    size: int,
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
    former: Former | None = None,
    free: FreeSpace | None = None,
) -> CompletionPlan:
    """Choose context views and new cameras.

    Anchors stand on a cylinder of the capture's own centre, up and radius. In captures that look outward (rooms) each
    looks where the capture and the views before it looked least; in captures that look inward (objects) each looks at a
    random point around the focus. No camera is placed outside the guessed surface or nearer to a seen point than the
    clearance. With ``config.camera_path`` the views of that path are taken as they are.

    Args:
        cameras: the captured cameras, one per entry (sizes may differ).
        points: seen surface points in the same world, or None when there are none yet.
        config: numbers of views, placement, seed.
        size: side of the generated views in pixels.
        known: of each captured picture its known part (a mask of any size, None for all of it); without, all of them
            are known.
        former: where the capture decides, plan the one round that follows these; None plans all rounds at once.
        free: space that is known to be free, in which cameras of captures that look outward stand; None where nobody
            knows.
    """
    cameras = [camera.to("cpu", torch.float64) for camera in cameras]  # a scene may lie far from the origin
    shape = CaptureShape.of(cameras)
    points = thinned_points(points, shape)
    site = _Site(
        shape=shape,
        shell=shell_of(shape, points),
        points=points,
        cameras=cameras,
        known=known,
        placement=config.placement,
        free=free,
    )
    count = config.context_views
    context = (
        strided_subset(len(cameras), count) if config.context_choice == "stride" else spread_subset(cameras, count)
    )
    covered = coverage = None
    if config.camera_path is not None:
        rounds = _path_rounds(config, size)
    elif config.anchor_views is None:
        rounds, covered, coverage = _needed_rounds(site, context, config, size, former)
    else:
        rounds = _placed_rounds(site, context, config, size)
    if config.context_choice == "overlap":
        rounds = [_with_own_context(one, context, site, count) for one in rounds]
    used = dict.fromkeys([*context, *(index for one in rounds for index in one.context or ())])
    return CompletionPlan(
        shape=shape,
        shell=site.shell,
        captured=len(cameras),
        context=tuple(used),
        rounds=tuple(rounds),
        size=size,
        covered=covered,
        coverage=coverage,
        blind=site.blind and site.shape.outward and config.placement.clearance > 0,
        former_views=0 if former is None else len(former.cameras),
    )


def _with_own_context(planned: PlannedRound, context: Sequence[int], site: _Site, count: int) -> PlannedRound:
    """The round with the views that show most of what its cameras will show; anchors look everywhere and keep the
    common ones.
    """
    near = (
        context
        if planned.role == ANCHOR
        else nearest_context(site.cameras, planned.cameras, site.shell, count, site.known)
    )
    return dataclasses.replace(planned, context=tuple(near))


def _placed_rounds(site: _Site, context: Sequence[int], config: CompletionConfig, size: int) -> list[PlannedRound]:
    """Anchors, then rounds of densified views, placed where the capture needs them."""
    half_angle = math.atan(size / 2 / focal_of_new_views(site.cameras, context, size))
    need = site.need()
    generator = torch.Generator().manual_seed(round_seed(config.seed, -1))
    rounds = []
    for number, views in enumerate([config.most_anchors] + [config.densify_views] * config.densify_rounds):
        if views == 0:
            continue
        role = ANCHOR if number == 0 else DENSIFY
        centers = site.centers(role, views, generator)
        targets, need = site.targets(centers, need, half_angle, generator)
        new = Pinholes.looking_at(
            centers, targets, up=site.shape.up, fov_degrees=math.degrees(2 * half_angle), width=size, height=size
        )
        new, seed = new.to(torch.float32), round_seed(config.seed, number)
        rounds.append(PlannedRound(number=number, role=role, seed=seed, cameras=new, prompt=config.prompt))
    return rounds


def _needed_rounds(
    site: _Site, context: Sequence[int], config: CompletionConfig, size: int, former: Former | None
) -> tuple[list[PlannedRound], tuple[float, float], Coverage]:
    """The views that show most of what the capture does not, none that adds too little: anchors, then rounds of what is
    left.

    After former rounds it is one round of what these have left, and none where that would add too little.
    Also returns the shares of what surrounds the capture that are seen before and after, and what is seen before.
    """
    half_angle = math.atan(size / 2 / focal_of_new_views(site.cameras, context, size))
    places = site.candidates(torch.Generator().manual_seed(round_seed(config.seed, -1)), former)
    if config.film_path is not None:
        places = with_path(places, read_camera_path(config.film_path, size=size).cameras, site.shape)
    sizes = dict(enumerate([config.most_anchors] + [config.densify_views] * config.densify_rounds))
    if former is not None:
        sizes = {former.number: sizes.get(former.number, 0)}
    # Shares are of what the capture alone has not seen, so that no round becomes dear because little is left.
    left = places.coverage.unseen_share
    more = max(1.0, places.unseen_by_capture / left) if left > 0 else 1.0
    chosen = choose_views(
        places.coverage,
        places.shown(half_angle),
        most=sum(sizes.values()),
        least_gain=min(1.0, more * config.least_gain),
    )
    taken = list(chosen.indices)
    if former is not None and former.number > 0 and sum(chosen.gains) < config.least_round_gain * more * left:
        taken = []
    rounds, first = [], 0
    for number, views in sizes.items():
        group = taken[first : first + views]
        first += views
        if not group:
            continue
        centers = places.centers[group]
        targets = centers + places.looks[group] * max(site.shape.radius, 1.0)
        new = Pinholes.looking_at(
            centers, targets, up=site.shape.up, fov_degrees=math.degrees(2 * half_angle), width=size, height=size
        )
        new, seed = new.to(torch.float32), round_seed(config.seed, number)
        role = ANCHOR if number == 0 else DENSIFY
        rounds.append(PlannedRound(number=number, role=role, seed=seed, cameras=new, prompt=config.prompt))
    return rounds, (1 - left, 1 - chosen.unseen_share if taken else 1 - left), places.coverage


def _path_rounds(config: CompletionConfig, size: int) -> list[PlannedRound]:
    """The views of a person's camera path, none of them moved: equally spaced ones first, as anchors, then what lies
    between.

    Where the path has more views than anchors and rounds may have together, equally spaced ones are taken.
    """
    assert config.camera_path is not None
    path = read_camera_path(config.camera_path, size=size)
    most = config.most_anchors + config.densify_rounds * config.densify_views
    taken = strided_subset(len(path.cameras), most)
    anchors = strided_subset(len(taken), config.most_anchors)
    rest = [index for place, index in enumerate(taken) if place not in set(anchors)]
    needed = -(-len(rest) // max(config.densify_views, 1))
    groups = [[taken[place] for place in anchors], *(rest[first::needed] for first in range(needed))]
    return [
        PlannedRound(
            number=number,
            role=ANCHOR if number == 0 else DENSIFY,
            seed=round_seed(config.seed, number),
            cameras=path.cameras[group],
            prompt=config.prompt,
            aspect=path.aspect,
        )
        for number, group in enumerate(groups)
        if group
    ]


def focal_of_new_views(cameras: Sequence[Pinholes], context: Sequence[int], size: int) -> float:
    """Focal length in pixels of new square views: the scale of the fitted context views, one lens for all as in
    training.
    """
    return float(
        torch.stack(
            [cameras[i].focal.mean() * size / max(cameras[i].width, cameras[i].height) for i in context]
        ).median()
    )


@dataclass(frozen=True, kw_only=True)
class _Site:
    """The scene as far as placing cameras needs it."""

    shape: CaptureShape
    shell: Shell
    points: Float[Tensor, "m 3"]
    cameras: list[Pinholes]
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None
    placement: PlacementConfig
    free: FreeSpace | None = None

    @property
    def blind(self) -> bool:
        """Whether nobody knows where surfaces are: no point was seen, and no splats are trained."""
        return len(self.points) < _FEWEST_POINTS and (self.free is None or not self.free.is_known)

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
        if self.blind and self.shape.outward and self.placement.clearance > 0:
            around = []  # a wall may stand anywhere but where somebody stood
        if self.shape.outward:
            surface, directions = self.surface()
            weight = 1.0 - 0.6 * (directions @ self.shape.up) ** 2  # as `need`
            coverage = Coverage.of(self.cameras, surface, weight, self.known)
            places = looking_out(
                torch.cat([standing, *around]), self.shape, coverage, max_pitch_degrees=self.placement.max_pitch_degrees
            )
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


def shell_of(shape: CaptureShape, points: Tensor) -> Shell:
    """The surface all around; without points, a sphere that leaves the cameras room."""
    guess = (3.0 if shape.outward else 2.0) * shape.radius
    return fit_shell(points, center=shape.center, fallback_radius=guess if guess > 1e-6 else 1.0, up=shape.up)


def round_seed(seed: int, number: int) -> int:
    """An independent seed for each round."""
    return int(np.random.SeedSequence([seed % 2**63, number + 1]).generate_state(1, np.uint64)[0] >> np.uint64(1))
