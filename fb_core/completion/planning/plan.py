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

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.planning.path_candidates import with_path
from fb_core.completion.planning.site import Former, Site
from fb_core.completion.results.completed_views import ANCHOR, DENSIFY
from fb_core.data.capture.camera_path import read_camera_path
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_core.geometry.shell import Shell
from fb_core.geometry.viewpoints.coverage import Coverage, choose_views
from fb_core.geometry.viewpoints.paths import CaptureShape, spread_subset, strided_subset


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
    site = Site.of(cameras, points, config.placement, known=known, free=free)
    count = config.context_views
    chosen = strided_subset(len(cameras), count) if config.context_choice == "stride" else None
    context = spread_subset(site.cameras, count) if chosen is None else chosen
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
        shape=site.shape,
        shell=site.shell,
        captured=len(cameras),
        context=tuple(used),
        rounds=tuple(rounds),
        size=size,
        covered=covered,
        coverage=coverage,
        blind=site.keeps_to_captured_places,
        former_views=0 if former is None else len(former.cameras),
    )


def _with_own_context(planned: PlannedRound, context: Sequence[int], site: Site, count: int) -> PlannedRound:
    """The round with the views that show most of what its cameras will show; anchors look everywhere and keep the
    common ones.
    """
    near = (
        context
        if planned.role == ANCHOR
        else nearest_context(site.cameras, planned.cameras, site.shell, count, site.known)
    )
    return dataclasses.replace(planned, context=tuple(near))


def _placed_rounds(site: Site, context: Sequence[int], config: CompletionConfig, size: int) -> list[PlannedRound]:
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
    site: Site, context: Sequence[int], config: CompletionConfig, size: int, former: Former | None
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
        worth=places.worth,
        centers=places.centers,
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
        if places.wider is not None:
            new = dataclasses.replace(new, focal=new.focal / places.wider[group][:, None])
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


def round_seed(seed: int, number: int) -> int:
    """An independent seed for each round."""
    return int(np.random.SeedSequence([seed % 2**63, number + 1]).generate_state(1, np.uint64)[0] >> np.uint64(1))
