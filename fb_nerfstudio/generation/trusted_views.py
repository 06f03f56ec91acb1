"""Trust of each pixel of generated views in a training: from the splats' renders, the shell, and the curve that hidden
views have told.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.completion.pixel_trust import Curve, evidence_of
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.samples import variance_of
from fb_core.completion.trust import Surroundings
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.shell import Shell, intersect
from fb_nerfstudio.capture.splat_renders import FIRM, Rendered, TrainedSplats, coarse, render_geometry
from fb_nerfstudio.capture.unseen import Unseen


def shell_depth(shell: Shell, cameras: Pinholes) -> Float[Tensor, "n h w"]:
    """z-depth of the shell in every pixel; infinite where a ray never meets it."""
    origin = shell.center.to("cpu", torch.float64)  # exact however far off the world's origin is
    nearby = cameras.to("cpu", torch.float64).moved(-origin)
    around = Shell(center=torch.zeros(3, dtype=torch.float64), log_radius=shell.log_radius.to("cpu", torch.float64))
    directions = nearby.directions()
    starts = nearby.centers[:, None, None].expand_as(directions)
    distance = intersect(around, starts.reshape(-1, 3), directions.reshape(-1, 3)).reshape(directions.shape[:3])
    return (distance * nearby.cosines()).float()


def surroundings_of(shell: Shell, splats: TrainedSplats | None) -> Callable[[Pinholes], Surroundings]:
    """What cameras see: the splats where they are solid (None before they are trained), the shell elsewhere."""

    def look(cameras: Pinholes) -> Surroundings:
        depth = shell_depth(shell, cameras)
        if splats is None:
            return Surroundings(depth, None)
        rendered = render_geometry(splats, cameras.to("cpu", torch.float32))
        return Surroundings(torch.where(rendered.solid, rendered.depth, depth), rendered.rgb)

    return look


def with_pixel_trust(
    views: CompletedViews,
    unseen: Unseen,
    rendered: Rendered | None,
    shell: Shell,
    curve: Curve | None,
) -> CompletedViews:
    """The views with a trust for each pixel, and their mean as that of the view; as they are without a curve.

    Views are compared with one another, as far as they show the same place.

    Args:
        views: as they were generated, before colours are fitted.
        unseen: which of their pixels the capture has not seen, coarse.
        rendered: the splats from the same coarse cameras, or None while they are untrained.
        shell: the guessed surface.
        curve: from evidence to trust.
    """
    if curve is None or not len(views):
        return views
    cameras = coarse(views.cameras)
    size = (cameras.height, cameras.width)
    images = F.interpolate(rearrange(views.images.float() / 255, "n h w c -> n c h w"), size=size, mode="area")
    depth, comparable = shell_depth(shell, cameras), None
    if rendered is not None:
        depth = torch.where(rendered.solid, rendered.depth, depth)
        comparable = ~unseen.mask & (rendered.accumulation >= FIRM)
    # Views of one place are nearer to one another than to the world's origin.
    nearby = cameras.to(torch.float64).moved(-shell.center.to("cpu", torch.float64)).to(torch.float32)
    shown, spread = None if rendered is None else rendered.rgb, variance_of(views.deviation)
    if spread is not None:
        spread = F.interpolate(spread[:, None], size=size, mode="area")[:, 0]
    evidence = evidence_of(images, nearby, depth, ~unseen.mask, shown, comparable, spread)
    trust = curve.trust(evidence)
    each = [round(float(one.double().mean()), 4) for one in trust]
    pixels = F.interpolate(trust[:, None], size=views.images.shape[1:3], mode="bilinear", align_corners=False)
    return dataclasses.replace(
        views,
        trust=rearrange((pixels * 255).round().to(torch.uint8), "n 1 h w -> n h w 1").contiguous(),
        origins=tuple(
            dataclasses.replace(origin, trust=mean) for origin, mean in zip(views.origins, each, strict=True)
        ),
    )
