"""Normals of Gaussians and the two losses that tie them to the rendered surface (paper, "Normal regularization")."""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.normals import facing, normal_picture, unit_or_zero
from fb_core.splatting.photometric import known_mean

AlignmentForm = Literal["squared", "absolute"]


def gaussian_normals(
    means: Float[Tensor, "m 3"], quats: Float[Tensor, "m 4"], log_scales: Float[Tensor, "m 3"], camera: Pinholes
) -> Float[Tensor, "m 3"]:
    """Unit normals in the camera frame (OpenCV axes) of one camera: each Gaussian's shortest axis, turned to face the
    camera.

    ``quats`` are wxyz of any length. The gradient reaches the quaternions only: which axis is shortest, which side
    faces the camera, and the camera itself are constants.
    """
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
    columns = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], dim=-1),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], dim=-1),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], dim=-1),
        ],
        dim=1,
    )
    shortest = log_scales.detach().argmin(dim=-1)
    normals = columns[torch.arange(len(columns), device=columns.device), shortest]
    normals = facing(normals, camera.centers[0].detach() - means.detach())
    return normals @ camera.rotations[0].detach()


def blended_normals(composited: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """Rasterized normals (an alpha-weighted sum) as unit vectors; zero, without NaN, where no Gaussian was drawn."""
    return unit_or_zero(composited, smallest=1e-6)


def alignment_loss(
    rendered: Float[Tensor, "h w 3"],
    surface: Float[Tensor, "h w 3"],
    known: Float[Tensor, "h w 1"] | None = None,
    *,
    form: AlignmentForm = "squared",
) -> Float[Tensor, ""]:
    """How far Gaussian normals and depth-derived normals (unit or zero, same frame) disagree; each side is pulled to
    the other.

    ``squared``: the paper's |sg(N_r) - N_d|^2 + |N_r - sg(N_d)|^2 with unit vectors, averaged over the pixels that have
    both normals and are known. ``absolute``: the released code's L1 between the two pictures in [0, 1], averaged over
    pixels and channels. Pixels without either normal (background, the border) are not counted.
    """
    both = (rendered.detach().abs().sum(-1, keepdim=True) > 0) & (surface.detach().abs().sum(-1, keepdim=True) > 0)
    counted = both.to(rendered) if known is None else both * known
    if form == "absolute":
        rendered, surface = normal_picture(rendered), normal_picture(surface)
        difference = (rendered.detach() - surface).abs() + (rendered - surface.detach()).abs()
        return known_mean(difference, counted)
    difference = (rendered.detach() - surface).square() + (rendered - surface.detach()).square()
    return known_mean(difference.sum(dim=-1, keepdim=True), counted)


def total_variation(picture: Float[Tensor, "h w 3"], known: Float[Tensor, "h w 1"] | None = None) -> Float[Tensor, ""]:
    """Mean absolute difference of vertical neighbours plus that of horizontal ones, over pairs that are known on both
    sides.
    """
    down, right = picture[1:] - picture[:-1], picture[:, 1:] - picture[:, :-1]
    if known is None:
        return down.abs().mean() + right.abs().mean()
    return known_mean(down.abs(), known[1:] * known[:-1]) + known_mean(right.abs(), known[:, 1:] * known[:, :-1])
