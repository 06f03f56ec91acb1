"""What the capture has not seen: which pixels of generated views, how far away they are, and Gaussians to put there or
to take away.

Two sources tell what was seen: the known parts of the captured pictures (always), and the splats' own accumulation and
depth once they have been trained for a while.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.seams import without_seams
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_core.geometry.shell import Shell, intersect
from fb_core.geometry.viewpoints.paths import seen_by
from fb_core.masks import resampled
from fb_nerfstudio.capture.splat_renders import FIRM, SMALL_SIDE, Rendered, coarse

_OPAQUE = 0.95  # accumulation from which a render's colour is that of the splats, without the background
_BESIDE = 0.5  # how far beside, as a part of the picture's side


@dataclass(frozen=True, kw_only=True)
class Unseen:
    """The part of generated views that the capture has not seen, at the size of :func:`coarse`."""

    mask: Bool[Tensor, "n h w"]
    """True where unseen."""
    points: Float[Tensor, "n h w 3"]
    """World points of the pixels on the shell; infinite where a ray never meets it."""

    def without(self, space: FreeSpace | None) -> Unseen:
        """Less the pixels whose point lies in a space: what was captured stays in view, from beside the captured places
        too, and nothing is put before it on a mere guess of where surfaces are. None leaves all.
        """
        if space is None:
            return self
        crossed = space.crossed(self.points.reshape(-1, 3))  # what is infinitely far off, no ray has passed
        return dataclasses.replace(self, mask=self.mask & ~crossed.reshape(self.mask.shape))


def coarse_mask(known: Float[Tensor, "1 h w"]) -> Bool[Tensor, "_h _w"] | None:
    """The known-mask of a captured picture, small: True where most of a cell is known; None when all is."""
    if bool((known == 1).all()):
        return None
    scale = min(1.0, SMALL_SIDE / max(known.shape[1:]))
    size = [max(1, round(side * scale)) for side in known.shape[1:]]
    return F.interpolate(known[None], size=size, mode="area")[0, 0] >= 0.5


def find_unseen(
    new: Pinholes,
    captured: Sequence[Pinholes],
    shell: Shell,
    rendered: Rendered | None,
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
) -> Unseen:
    """Which pixels of views from new cameras show, or would show, what the capture has not.

    A pixel is seen when its surface point falls into the known part of a captured picture and, if ``rendered`` tells,
    splats cover it. Just beside the captured pictures firm splats are believed too: they continue what was captured
    better than a generated picture would. The surface point is the splats' where they cover the pixel and the shell's
    elsewhere.

    Args:
        new: the views' cameras; their pictures need not be there yet.
        captured: the capture's cameras.
        shell: the guessed surface, for depth.
        rendered: the splats from the views' cameras made coarse, or None while they are untrained.
        known: of each captured picture :func:`coarse_mask`; without, all of them are known.
    """
    origin = shell.center.to("cpu", torch.float64)
    cameras = _about(coarse(new), origin)
    directions = cameras.directions()
    origins = cameras.centers[:, None, None].expand_as(directions)
    around = Shell(center=torch.zeros(3).to(origins), log_radius=shell.log_radius.to(origins))
    distance = intersect(around, origins.reshape(-1, 3), directions.reshape(-1, 3)).reshape(directions.shape[:3])
    points = origins + distance[..., None] * directions
    far = distance.nan_to_num(posinf=1e6 * float(shell.log_radius.max().exp()))
    surface, covered = origins + far[..., None] * directions, torch.ones_like(distance, dtype=torch.bool)
    if rendered is not None:
        covered = rendered.solid
        surface = torch.where(covered[..., None], cameras.unproject(rendered.depth), surface)
    flat = surface.reshape(-1, 3)
    nearby = [_about(camera, origin) for camera in captured]
    inside = seen_by(nearby, flat, known).reshape(covered.shape)
    if rendered is not None:
        wider = None if known is None else [None if mask is None else _widened_mask(mask) for mask in known]
        beside = seen_by([_widened(camera) for camera in nearby], flat, wider).reshape(covered.shape)
        inside |= beside & (rendered.accumulation >= FIRM)
    return Unseen(mask=~(covered & inside), points=(points + origin).to(new.camera_to_world.dtype))


def _about(cameras: Pinholes, origin: Float[Tensor, "3"]) -> Pinholes:
    """The cameras on the CPU, their places counted from a point near them, which is exact however far off the world's
    origin is.
    """
    return cameras.to("cpu", torch.float64).moved(-origin).to(torch.float32)


def _widened(camera: Pinholes) -> Pinholes:
    """The same camera with a picture that shows more to all sides."""
    x, y = round(camera.width * _BESIDE), round(camera.height * _BESIDE)
    return camera.cropped(-x, -y, camera.width + 2 * x, camera.height + 2 * y)


def _widened_mask(known: Bool[Tensor, "h w"]) -> Bool[Tensor, "_h _w"]:
    """The mask of :func:`_widened`: what was masked out stays unknown, what lies beside the picture counts as known."""
    y, x = (round(side * _BESIDE) for side in known.shape)
    return F.pad(known, (x, x, y, y), value=True)


def with_matched_colors(views: CompletedViews, unseen: Unseen, rendered: Rendered) -> CompletedViews:
    """The views with colours that meet the splats' where the capture has seen them
    (:mod:`fb_core.completion.seams`).
    """
    images = rearrange(views.images.float() / 255, "n h w c -> n c h w")
    size = images.shape[2:]
    reliable = ~unseen.mask & (rendered.accumulation >= _OPAQUE)
    colors = torch.stack([_enlarged(rgb, there, size) for rgb, there in zip(rendered.rgb, reliable, strict=True)])
    matched = without_seams(images, colors, _at_size(reliable, size)[:, 0])
    return dataclasses.replace(
        views, images=rearrange((matched * 255).round().to(torch.uint8), "n c h w -> n h w c").contiguous()
    )


def with_unseen_masks(views: CompletedViews, unseen: Unseen) -> CompletedViews:
    """The views with masks that leave only unseen pixels of what they left. No seam: generated pixels would blur
    captured ones.
    """
    masks = _at_size(unseen.mask, views.images.shape[1:3])
    return dataclasses.replace(views, masks=rearrange(masks, "n 1 h w -> n h w 1") & views.masks)


def _enlarged(
    rgb: Float[Tensor, "3 h w"], reliable: Bool[Tensor, "h w"], size: Sequence[int]
) -> Float[Tensor, "3 height width"]:
    """The splats' reliable colours at the size (height, width) of the pictures; others are not mixed in."""

    def enlarged(channels: Float[Tensor, "c h w"]) -> Float[Tensor, "c height width"]:
        return F.interpolate(channels[None], size=tuple(size), mode="bilinear", align_corners=False)[0]

    return resampled(rgb, reliable[None].to(rgb), enlarged)[0]


def _at_size(mask: Bool[Tensor, "n h w"], size: Sequence[int]) -> Bool[Tensor, "n 1 height width"]:
    """A coarse mask at the size (height, width) of the pictures, without blur."""
    return F.interpolate(mask[:, None].float(), size=tuple(size), mode="nearest") > 0


def unseen_gaussians(
    views: CompletedViews, unseen: Unseen, *, limit: int, generator: torch.Generator
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Points and colours in [0, 1] for Gaussians: a random subset of the unseen pixels, on the shell.

    All views share the shell, so what they agree on lands in one place.
    """
    usable = unseen.mask & torch.isfinite(unseen.points).all(dim=-1)
    images = rearrange(views.images.float() / 255, "n h w c -> n c h w")
    colors = rearrange(F.interpolate(images, size=usable.shape[1:], mode="area"), "n c h w -> n h w c")
    chosen = torch.randperm(int(usable.sum()), generator=generator)[:limit]
    return unseen.points[usable][chosen], colors[usable][chosen]


def seen_by_nobody_else(
    means: Float[Tensor, "m 3"],
    leaving: CompletedViews,
    staying: CompletedViews | None,
    captured: Sequence[Pinholes],
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
) -> Bool[Tensor, "m"]:
    """Which Gaussians only the views that leave the bank had a say in: their centres lie in a supervised pixel of
    those, and in none of the generated views that stay nor in a known pixel of the capture. Nothing would train them
    any more.

    Occlusion is not considered, so that what a staying picture may show is left alone.

    Args:
        means: centres of the Gaussians.
        leaving: the views that go.
        staying: the generated views that stay, or None.
        captured: the capture's cameras.
        known: of each captured picture :func:`coarse_mask`; without, all of them are known.
    """
    points = means.detach().to("cpu", torch.float64)
    nearby = [camera.to("cpu", torch.float64) for camera in captured]
    seen = seen_by(nearby, points, known)
    if staying is not None:
        seen |= _supervised(staying, points)
    return _supervised(leaving, points) & ~seen


def _supervised(views: CompletedViews, points: Float[Tensor, "m 3"]) -> Bool[Tensor, "m"]:
    cameras = views.cameras.to("cpu", torch.float64)
    return seen_by([cameras[index] for index in range(len(cameras))], points, [*views.masks[..., 0].cpu()])
