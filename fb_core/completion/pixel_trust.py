"""How far each pixel of a generated view is to be believed: what speaks for and against it, and the curve from that to
trust.

Nobody knows the error of a generated pixel, but four things go along with it: how far the picture is off where splats
or photos know the answer, how far views of one place differ, how far samples differ, and how far away the next known
pixel is. A few captured views that were hidden and generated say how much each of them is worth on this capture.
Nothing here knows nerfstudio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.carry_over import SAME_SURFACE

LEAST = 0.05
"""Trust in what is no better than the baseline: it still fills what nobody has seen, and moves nothing else."""
SOURCES = ("known", "views", "spread", "distance")
"""What evidence there is, in the order of `Evidence.stacked` and `Curve.weights`."""
_BLOCK = 4  # pixels: errors are compared as means over blocks, for a single pixel says little
_ENOUGH = 0.05  # share of the blocks that must have a source before it gets a weight of its own
_MOST_OTHERS = 12  # views that one view is compared with, which bounds time
_NEAR = 8  # a difference speaks for pixels within about this part of the picture's side


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Of every generated pixel; squares are means over the colours, which are in [0, 1]. NaN where nobody can tell."""

    known: Float[Tensor, "n h w"]
    """Squared difference from what photos or splats show, in pixels nearby where they do."""
    views: Float[Tensor, "n h w"]
    """Squared difference from other generated views of the same place."""
    spread: Float[Tensor, "n h w"]
    """Variance over several samples."""
    distance: Float[Tensor, "n h w"]
    """Angle in radians to the nearest known pixel of the picture; that of the whole picture where it has none."""

    @property
    def stacked(self) -> Float[Tensor, "n 4 h w"]:
        """All of it, in the order of `SOURCES`."""
        return torch.stack([self.known, self.views, self.spread, self.distance], dim=1)

    def __getitem__(self, part: slice) -> Evidence:
        return Evidence(
            known=self.known[part], views=self.views[part], spread=self.spread[part], distance=self.distance[part]
        )


@dataclass(frozen=True, kw_only=True)
class Curve:
    """From evidence to trust, as hidden captured views have told."""

    weights: tuple[float, float, float, float, float]
    """Of a constant and of each source, none below 0: more evidence against a pixel never makes it more believed."""
    usual: tuple[float, float, float, float]
    """Of each source what it was on average, which stands in where nobody can tell."""
    baseline: float
    """Squared error of the better simple baseline."""

    def error(self, evidence: Evidence) -> Float[Tensor, "n h w"]:
        """The expected squared error; never below half the difference of two views of one place, nor below the samples'
        variance.

        (Two independent guesses of one colour differ by the sum of their squared errors on average.)
        """
        signs = _filled(evidence.stacked.double(), self.usual)
        weights = torch.tensor(self.weights, dtype=torch.float64)
        expected = weights[0] + torch.einsum("nchw,c->nhw", signs, weights[1:])
        return expected.maximum(evidence.views.double().nan_to_num(0.0) / 2).maximum(
            evidence.spread.double().nan_to_num(0.0)
        )

    def trust(self, evidence: Evidence) -> Float[Tensor, "n h w"]:
        """The share of the baseline's error that each pixel does away with, from `LEAST` to 1."""
        return (1 - self.error(evidence) / max(self.baseline, 1e-12)).clamp(LEAST, 1.0).float()


def fitted_curve(
    evidence: Evidence, error: Float[Tensor, "n h w"], counts: Bool[Tensor, "n h w"], *, baseline: float
) -> Curve:
    """The curve whose errors are right on average over the blocks of hidden views (least squares with weights of 0 or
    more).

    A source that hardly any block has gets no weight; the bounds of `Curve.error` hold for it all the same.

    Args:
        evidence: of the hidden views.
        error: their squared errors.
        counts: pixels whose truth is known and that were generated.
        baseline: squared error of the better simple baseline there.
    """
    from scipy.optimize import nnls

    sources, _ = _blocks(evidence.stacked.double(), counts)
    target, weight = _blocks(error[:, None].double(), counts)
    used = weight[:, 0] > 0
    sources, target, weight = sources[used], target[used, 0], weight[used, 0]
    if len(target) == 0:
        return Curve(weights=(baseline, 0.0, 0.0, 0.0, 0.0), usual=(0.0, 0.0, 0.0, 0.0), baseline=baseline)
    there = torch.isfinite(sources)
    usual = torch.where(there, sources, 0.0).sum(dim=0) / there.sum(dim=0).clamp(min=1)
    enough = there.double().mean(dim=0) >= _ENOUGH
    columns = torch.where(there, sources, usual) * enough
    scale = columns.abs().amax(dim=0).clamp(min=1e-12)
    matrix = (
        torch.cat([torch.ones(len(columns), 1, dtype=torch.float64), columns / scale], dim=1) * weight.sqrt()[:, None]
    )
    solution, _ = nnls(matrix.numpy(), (target * weight.sqrt()).numpy())
    weights = torch.from_numpy(np.asarray(solution))
    weights[1:] /= scale
    return Curve(weights=_numbers(weights), usual=_numbers(usual), baseline=baseline)


def evidence_of(
    images: Float[Tensor, "n 3 h w"],
    cameras: Pinholes,
    depth: Float[Tensor, "n h w"],
    known: Bool[Tensor, "n h w"],
    shown: Float[Tensor, "n 3 h w"] | None = None,
    comparable: Bool[Tensor, "n h w"] | None = None,
    spread: Float[Tensor, "n h w"] | None = None,
) -> Evidence:
    """What speaks for and against the pixels of generated views.

    Args:
        images: colours in [0, 1], before they are fitted to anything.
        cameras: theirs, of the pictures' size.
        depth: z-depth of what each pixel shows, as far as anybody can guess; infinite or NaN where nobody can.
        known: pixels that photos or splats show, too.
        shown: what these show there.
        comparable: where that is to be compared; by default where it is known.
        spread: variance over samples, mean over the colours.
    """
    empty = torch.full_like(depth, torch.nan)
    difference = empty
    if shown is not None:
        difference = _nearby(
            (images - shown).square().mean(dim=1), known if comparable is None else comparable, depth.shape[-1] / _NEAR
        )
    return Evidence(
        known=difference,
        views=disagreement(images, cameras, depth),
        spread=empty if spread is None else spread,
        distance=angle_to_known(known, cameras),
    )


def disagreement(
    images: Float[Tensor, "n 3 h w"], cameras: Pinholes, depth: Float[Tensor, "n h w"]
) -> Float[Tensor, "n h w"]:
    """Mean squared difference from the other views (at most 12, those that look most the same way) that show the same
    place.

    Two views show the same place where their depths agree; NaN where no other view shows it.
    """
    count, width, height = len(cameras), cameras.width, cameras.height
    points = cameras.unproject(depth)
    look, result = cameras.rotations[:, :, 2], torch.full_like(depth, torch.nan)
    size = depth.new_tensor([width, height])
    for index in range(count):
        alike = (look @ look[index]).index_fill(0, torch.tensor([index]), -2.0)
        others = alike.topk(min(_MOST_OTHERS, count - 1)).indices
        if len(others) == 0:
            continue
        flat = points[index].reshape(-1, 3)
        pixels, away = cameras[others.tolist()].project(flat)
        grid = (pixels / size * 2 - 1)[:, :, None]
        inside = ((grid.abs() <= 1).all(dim=-1)[..., 0]) & (away > 0) & torch.isfinite(flat).all(dim=-1)
        grid = grid.nan_to_num(2.0, 2.0, 2.0)
        colors = F.grid_sample(images[others], grid, padding_mode="border", align_corners=False)[..., 0]
        there = F.grid_sample(
            depth[others][:, None].nan_to_num(0.0, 0.0, 0.0), grid, mode="nearest", align_corners=False
        )[:, 0, :, 0]
        same = inside & ((there / away - 1).abs() < SAME_SURFACE)
        squares = (colors - images[index].reshape(1, 3, -1)).square().mean(dim=1)
        number = same.sum(dim=0)
        mean = torch.where(same, squares, 0.0).sum(dim=0) / number.clamp(min=1)
        result[index] = torch.where(number > 0, mean, torch.nan).reshape(height, width)
    return _nearby(result.nan_to_num(0.0), torch.isfinite(result), 1.5, only_there=True)


def angle_to_known(known: Bool[Tensor, "n h w"], cameras: Pinholes) -> Float[Tensor, "n h w"]:
    """Angle in radians from every pixel to the nearest known one of its picture, 0 in known ones; the picture's
    diagonal where none is.
    """
    import cv2

    diagonal = float((cameras.width**2 + cameras.height**2) ** 0.5)
    away = [
        torch.from_numpy(cv2.distanceTransform((~mask).to(torch.uint8).numpy(), cv2.DIST_L2, 5))
        if bool(mask.any())
        else None
        for mask in known.cpu()
    ]
    pixels = torch.stack(
        [torch.full(known.shape[1:], diagonal) if one is None else one.clamp(max=diagonal) for one in away]
    )
    return torch.atan(pixels.to(cameras.focal) / cameras.focal.mean(dim=1)[:, None, None])


def _nearby(
    values: Float[Tensor, "n h w"], there: Bool[Tensor, "n h w"], sigma: float, *, only_there: bool = False
) -> Float[Tensor, "n h w"]:
    """The mean of the values around each pixel where there are some, by a Gaussian; the picture's mean far from all,
    NaN without any.
    """
    if not len(values):
        return values
    weight = there.to(values)
    both = torch.stack([torch.where(there, values, 0.0), weight], dim=1)
    reach = max(1, round(2.5 * sigma))
    taps = torch.exp(-(torch.arange(-reach, reach + 1).to(values) ** 2) / (2 * sigma**2))
    taps = taps / taps.sum()
    for shape, pad in (((1, 1, 1, -1), (reach, reach, 0, 0)), ((1, 1, -1, 1), (0, 0, reach, reach))):
        both = F.conv2d(
            F.pad(both, pad),
            taps.view(shape).expand(2, *(1 if side == 1 else len(taps) for side in shape[1:])),
            groups=2,
        )
    number = weight.sum(dim=(1, 2))[:, None, None]
    mean = torch.where(there, values, 0.0).sum(dim=(1, 2))[:, None, None] / number.clamp(min=1)
    result = (both[:, 0] + 1e-3 * mean) / (both[:, 1] + 1e-3)
    result = torch.where(number > 0, result, torch.nan)
    return torch.where(there, result, torch.nan) if only_there else result


def _blocks(
    values: Float[Tensor, "n c h w"], counts: Bool[Tensor, "n h w"]
) -> tuple[Float[Tensor, "b c"], Float[Tensor, "b 1"]]:
    """Means over blocks of the finite values of pixels that count (NaN where a block has none), and how many pixels
    count in each.
    """
    side = min(_BLOCK, *values.shape[-2:])
    ok = torch.isfinite(values) & counts[:, None]
    total = F.avg_pool2d(torch.where(ok, values, 0.0), side) * side**2
    number = F.avg_pool2d(ok.to(values), side) * side**2
    mean = torch.where(number > 0.5, total / number.clamp(min=1), torch.nan)
    weight = F.avg_pool2d(counts[:, None].to(values), side) * side**2
    return mean.movedim(1, -1).reshape(-1, values.shape[1]), weight.movedim(1, -1).reshape(-1, 1)


def _filled(values: Float[Tensor, "n 4 h w"], usual: Sequence[float]) -> Float[Tensor, "n 4 h w"]:
    return torch.where(torch.isfinite(values), values, values.new_tensor(usual)[None, :, None, None])


def _numbers(values: Tensor) -> tuple:
    return tuple(float(value) for value in values)
