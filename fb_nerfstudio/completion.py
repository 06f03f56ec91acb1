"""Completing a capture (paper, section 3.2): plan the new views, then generate them round by round.

A few anchors are generated first, on a cylinder around the scene and conditioned on the capture; rounds of densified views
follow, each conditioned on the capture and the anchors. Nothing here knows nerfstudio.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.paths import (
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
from fb_core.geometry.shell import Shell, fit_shell
from fb_core.inpainter import SamplingConfig
from fb_core.views import Views
from fb_nerfstudio.completed_views import ANCHOR, DENSIFY, CompletedViews, Origin

_ANCHOR_LEVELS, _DENSIFY_LEVELS = 2, 3
_SEEN_NEED = 0.2  # looking at what the capture has seen is worth this much of looking at what it has not
_PLANNING_POINTS = 4000


@dataclass
class PlacementConfig:
    """Where the cameras of generated views may stand and look."""

    radius: float = 1.0
    """Radius of the anchors' cylinder, in units of the capture's own radius."""
    inner_radius: float = 0.5
    """Densified views fill the cylinder from this radius outwards (same unit)."""
    height: float = 1.0
    """Spread of the cameras' heights, in units of the capture's own."""
    max_pitch_degrees: float = 45.0
    """Steepest look up or down in captures that look outward (rooms)."""
    target_spread: float = 0.7
    """How far from the focus cameras look in captures that look inward (objects), in units of the capture's radius."""
    clearance: float = 0.1
    """Least distance from seen geometry, in units of its median distance from the scene's centre; 0 allows any."""


@dataclass
class CompletionConfig:
    """What is generated, with which model, and how it takes part in the training."""

    enabled: bool = True
    """Complete the capture with generated views; without, this is plain Gaussian splatting."""
    model: Path | None = None
    """Folder of the diffusion model (config.json and safetensors); None is the small bundled model."""
    at_step: int = 0
    """Training step before which the views are generated. Later, the splats themselves show what is seen and how far it is."""
    context_views: int = 16
    """Captured views that the model is conditioned on; fewer when the capture has fewer."""
    context_choice: Literal["spread", "stride"] = "spread"
    """Take context views that differ most in place and direction, or every so many (the paper's choice)."""
    anchor_views: int = 24
    """Views generated together in the first round."""
    densify_rounds: int = 3
    """Rounds after the anchors, each conditioned on the context and the anchors."""
    densify_views: int = 24
    """Views generated together in each of these rounds."""
    image_size: int | None = None
    """Side of the square views in pixels; None is the size the model was trained at."""
    steps: int = 24
    """Denoising steps per round."""
    guidance_unknown: float = 7.0
    """Guidance scale in unknown pixels."""
    guidance_known: float = 1.1
    """Guidance scale in known pixels."""
    seed: int = 0
    """Decides cameras, images, and which training steps draw generated views."""
    placement: PlacementConfig = field(default_factory=PlacementConfig)
    """Where the new cameras stand and look."""
    generated_share: float = 0.5
    """Most of the steps that generated views may take; where they are fewer than the captured, all views are drawn equally often."""
    generated_pixels: Literal["all", "unseen"] = "all"
    """Train on whole generated views, or only on their pixels that the capture has not seen."""
    view_weight: float = 1.0
    """Weight of a generated view's loss; captured views have 1."""
    seed_gaussians: bool = True
    """Add Gaussians for generated pixels where the capture has seen nothing."""
    max_seed_gaussians: int = 20000
    """At most this many of them."""

    def __post_init__(self) -> None:
        for name, least in (
            ("at_step", 0),
            ("context_views", 1),
            ("anchor_views", 0),
            ("densify_rounds", 0),
            ("densify_views", 0),
            ("steps", 2),
        ):
            if getattr(self, name) < least:
                raise ValueError(f"completion.{name}: expected at least {least}, got {getattr(self, name)}")
        if self.image_size is not None and self.image_size < 16:
            raise ValueError(f"completion.image_size: expected at least 16 pixels, got {self.image_size}")
        if not 0.0 <= self.generated_share <= 1.0:
            raise ValueError(f"completion.generated_share: expected a probability from 0 to 1, got {self.generated_share}")
        if self.view_weight < 0:
            raise ValueError(f"completion.view_weight: expected 0 or more, got {self.view_weight}")

    @property
    def sampling(self) -> SamplingConfig:
        """The sampler's part of these options."""
        return SamplingConfig(steps=self.steps, guidance_unknown=self.guidance_unknown, guidance_known=self.guidance_known)


class Inpainter(Protocol):
    """What a round needs of ``fb_core.inpainter.Fillerbuster``."""

    model_hash: str

    @property
    def size(self) -> int: ...

    def complete(
        self, views: Views, *, generator: torch.Generator, sampling: SamplingConfig, on_step: Callable[[int, int], None] | None
    ) -> Views: ...


@dataclass(frozen=True, kw_only=True)
class CapturedView:
    """One captured picture with its camera, as far as it is known."""

    image: Float[Tensor, "3 h w"]
    """RGB in [0, 1]."""
    known: Float[Tensor, "1 h w"]
    """1 where the pixel is given."""
    camera: Pinholes
    """One camera of the picture's size."""


@dataclass(frozen=True, kw_only=True)
class PlannedRound:
    """Views that will be generated together."""

    number: int
    """Counted from 0, the anchors."""
    role: str
    """``anchor`` or ``densify``."""
    seed: int
    """Decides the images."""
    cameras: Pinholes
    """The new views' cameras."""


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
    """Indices of the captured views that condition every round; the most level first."""
    rounds: tuple[PlannedRound, ...]
    """Anchors first."""
    size: int
    """Side of all views in pixels while they are generated."""

    @property
    def new_views(self) -> int:
        """How many views will be generated."""
        return sum(len(one.cameras) for one in self.rounds)


def plan_completion(cameras: list[Pinholes], points: Float[Tensor, "m 3"] | None, config: CompletionConfig, *, size: int) -> CompletionPlan:
    """Choose context views and new cameras.

    Anchors stand on a cylinder of the capture's own centre, up and radius. In captures that look outward (rooms) each looks
    where the capture and the views before it looked least; in captures that look inward (objects) each looks at a random
    point around the focus. No camera is placed outside the guessed surface or nearer to a seen point than the clearance.

    Args:
        cameras: the captured cameras, one per entry (sizes may differ).
        points: seen surface points in the same world, or None when there are none yet.
        config: numbers of views, placement, seed.
        size: side of the generated views in pixels.
    """
    cameras = [camera.to("cpu", torch.float32) for camera in cameras]
    shape = CaptureShape.of(cameras)
    points = _thinned(points, shape)
    shell = _shell_of(shape, points)
    count = config.context_views
    context = spread_subset(cameras, count) if config.context_choice == "spread" else strided_subset(len(cameras), count)
    focal = float(torch.stack([cameras[i].focal.mean() * size / max(cameras[i].width, cameras[i].height) for i in context]).median())
    surface = shape.center + (directions := sphere_directions(1024, like=shape.center)) * shell.radius(directions)[:, None]
    # Level directions matter more than floor and ceiling: people look ahead, and so did the model's training cameras.
    need = (1.0 - 0.6 * (directions @ shape.up) ** 2) * torch.where(seen_by(cameras, surface), _SEEN_NEED, 1.0)
    generator = torch.Generator().manual_seed(_round_seed(config.seed, -1))
    counts = [config.anchor_views] + [config.densify_views] * config.densify_rounds
    rounds = []
    for number, views in enumerate(counts):
        if views == 0:
            continue
        role = ANCHOR if number == 0 else DENSIFY
        centers = _clear_centers(shape, shell, points, cameras, config.placement, role, views, generator)
        if shape.outward:
            looks, need = outward_directions(
                centers,
                surface=surface,
                need=need,
                up=shape.up,
                half_angle_radians=math.atan(size / 2 / focal),
                max_pitch_degrees=config.placement.max_pitch_degrees,
                generator=generator,
            )
            targets = centers + looks * max(shape.radius, 1.0)
        else:
            targets = inward_targets(centers, shape=shape, spread=config.placement.target_spread, generator=generator)
        fov = math.degrees(2 * math.atan(size / 2 / focal))
        new = Pinholes.looking_at(centers, targets, up=shape.up, fov_degrees=fov, width=size, height=size)
        rounds.append(PlannedRound(number=number, role=role, seed=_round_seed(config.seed, number), cameras=new))
    return CompletionPlan(shape=shape, shell=shell, captured=len(cameras), context=tuple(context), rounds=tuple(rounds), size=size)


def run_completion(
    plan: CompletionPlan,
    context: Sequence[CapturedView],
    model: Inpainter,
    config: CompletionConfig,
    *,
    done: CompletedViews | None = None,
    on_step: Callable[[PlannedRound, int, int], None] | None = None,
) -> Iterator[CompletedViews]:
    """Generate the planned rounds one after the other; yields the new views of each.

    Every round sees the context views (fitted to the model's size) and, if it is no anchor round, all anchors. The same plan,
    context, model and options give the same views whatever happened before: each round has its own seed.

    Args:
        plan: what to generate.
        context: the captured views ``plan.context``, in that order.
        model: the diffusion model.
        config: sampling options.
        done: views of rounds that an interrupted run has generated; these rounds are skipped.
        on_step: called with (round, denoising steps done, steps in all).
    """
    fitted = Views.cat([fitted_view(view, plan.size) for view in context])
    finished = [] if done is None else done.rounds
    anchors = None if done is None else _as_views(done[[i for i, origin in enumerate(done.origins) if origin.role == ANCHOR]])
    for planned in plan.rounds:
        if planned.number in finished:
            continue
        known = [fitted] if planned.role == ANCHOR or anchors is None else [fitted, anchors]
        sequence = Views.cat([*known, Views.unknown(planned.cameras)])
        filled = model.complete(
            sequence,
            generator=torch.Generator().manual_seed(planned.seed),
            sampling=config.sampling,
            on_step=None if on_step is None else lambda step, steps, planned=planned: on_step(planned, step, steps),
        )
        new = filled[list(range(len(sequence) - len(planned.cameras), len(sequence)))]
        images = (new.images.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().contiguous()
        origin = Origin(role=planned.role, round=planned.number, seed=planned.seed, prompt="", model_hash=model.model_hash)
        views = CompletedViews(
            images=images,
            masks=torch.ones_like(images[..., :1], dtype=torch.bool),
            cameras=planned.cameras,
            origins=(origin,) * len(planned.cameras),
        )
        if planned.role == ANCHOR:
            anchors = _as_views(views)
        yield views


def fitted_view(view: CapturedView, size: int) -> Views:
    """A captured view at the model's size: the long side scaled to ``size``, the short side padded with unknown pixels.

    The camera follows exactly (a padded picture sees more to both sides). Unknown pixels neither bleed into known ones nor
    matter; a resampled pixel is known when all that it was made from is known.
    """
    _, height, width = view.image.shape
    scale = size / max(height, width)
    new_height, new_width = max(1, round(height * scale)), max(1, round(width * scale))
    known = view.known.to(view.image)
    content = torch.cat([torch.where(known > 0, view.image, torch.zeros_like(view.image)) * known, known])
    if (new_height, new_width) != (height, width):
        content = F.interpolate(content[None], size=(new_height, new_width), mode="bilinear", antialias=True, align_corners=False)[0]
    share = content[3:]
    known = (share > 0.999).to(content)
    image = torch.where(known > 0, content[:3] / share.clamp(min=1e-6), torch.zeros_like(content[:3]))
    left, top = (size - new_width) // 2, (size - new_height) // 2
    pads = (left, size - new_width - left, top, size - new_height - top)
    camera = view.camera.scaled(new_width, new_height).cropped(-left, -top, size, size)
    return Views.known(F.pad(image, pads)[None], camera, mask=F.pad(known, pads)[None])


def announcement(plan: CompletionPlan, config: CompletionConfig, model: Inpainter) -> str:
    """One sentence on what is about to be generated."""
    name = "the bundled model" if config.model is None else f"model {Path(config.model).name}"
    asked = "" if len(plan.context) >= config.context_views else f" (asked for {config.context_views}; the capture has no more)"
    sequence = len(plan.context) + max(len(one.cameras) + (0 if one.role == ANCHOR else _anchors(plan)) for one in plan.rounds)
    return (
        f"Completing the scene with {name} ({model.model_hash[:8]}): {plan.new_views} new views of {plan.size}x{plan.size} pixels "
        f"in {len(plan.rounds)} passes of {config.steps} steps over up to {sequence} views, "
        f"conditioned on {len(plan.context)} of {plan.captured} captured views{asked}."
    )


def _anchors(plan: CompletionPlan) -> int:
    return sum(len(one.cameras) for one in plan.rounds if one.role == ANCHOR)


def _as_views(views: CompletedViews) -> Views | None:
    """Generated views as known ones for the next round."""
    if len(views) == 0:
        return None
    return Views.known(views.images.permute(0, 3, 1, 2).float() / 255, views.cameras)


def _thinned(points: Tensor | None, shape: CaptureShape) -> Float[Tensor, "m 3"]:
    """At most a few thousand finite points on the CPU."""
    if points is None:
        return shape.center.new_empty(0, 3)
    points = points.detach().cpu().to(shape.center)
    points = points[torch.isfinite(points).all(dim=1)]
    return points[torch.linspace(0, len(points) - 1, min(len(points), _PLANNING_POINTS)).long()]


def _shell_of(shape: CaptureShape, points: Tensor) -> Shell:
    """The surface all around; without points, a sphere that leaves the cameras room."""
    guess = (3.0 if shape.outward else 2.0) * shape.radius
    return fit_shell(points, center=shape.center, fallback_radius=guess if guess > 1e-6 else 1.0, up=shape.up)


def _clear_centers(
    shape: CaptureShape,
    shell: Shell,
    points: Tensor,
    cameras: list[Pinholes],
    placement: PlacementConfig,
    role: str,
    views: int,
    generator: torch.Generator,
) -> Float[Tensor, "n 3"]:
    """Camera centres of one round, pulled out of seen geometry."""
    typical = float(shell.log_radius.median().exp())
    radius = placement.radius * max(shape.radius, 0.05 * typical)  # a pure rotation gets a little parallax
    half_height = placement.height * (shape.half_height if shape.outward else max(shape.half_height, 0.125 * shape.radius))
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
    refuges = torch.cat([camera.centers for camera in cameras])
    return kept_clear(centers, shell=shell, points=points, clearance=placement.clearance * typical, refuges=refuges)


def _round_seed(seed: int, number: int) -> int:
    """An independent seed for each round."""
    return int(np.random.SeedSequence([seed % 2**63, number + 1]).generate_state(1, np.uint64)[0] >> np.uint64(1))
