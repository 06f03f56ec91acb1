"""Surface normals from depth (paper, appendix on normal regularization), with every division guarded."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes


def unit_or_zero(vectors: Float[Tensor, "*batch 3"], *, smallest: float = 1e-12) -> Float[Tensor, "*batch 3"]:
    """Vectors scaled to length one; those shorter than ``smallest`` become exactly zero, with zero gradient.

    ``F.normalize`` instead would multiply the gradient of a vanishing vector by 1e12.
    """
    squared = vectors.square().sum(dim=-1, keepdim=True)
    long_enough = squared > smallest**2
    return torch.where(long_enough, vectors * torch.where(long_enough, squared, 1.0).rsqrt(), 0.0)


def normals_from_depth(depth: Float[Tensor, "n h w"], cameras: Pinholes) -> Float[Tensor, "n h w 3"]:
    """Unit normals in the camera frame (OpenCV axes) of the surface that z-depth ``depth`` (scene units) describes.

    The cross product of central differences of the back-projected pixel centres, (right - left) x (top - bottom). It
    points towards the camera, however rough the depth. Where the pixel or one of its four neighbours has no depth
    (zero, negative or not finite) the normal is zero, as it is on the border of one pixel. An overall scale of the
    depth changes nothing.

    Raises ValueError when depth and cameras disagree in number or size.
    """
    expected = (len(cameras), cameras.height, cameras.width)
    if tuple(depth.shape) != expected:
        raise ValueError(
            f"depth: expected a shape {expected} like the cameras (number, height, width), got {tuple(depth.shape)}"
        )
    in_plane = (cameras.pixel_centers() - cameras.principal[:, None, None]) / cameras.focal[:, None, None]
    usable = depth.isfinite() & (depth > 0)
    filled = torch.where(usable, depth, 1.0)
    points = torch.cat([in_plane, torch.ones_like(in_plane[..., :1])], dim=-1) * filled[..., None]
    reach = filled.detach()[..., None]
    # The length of either difference changes nothing. In units of their own depth their product stays far from
    # underflow, however near this surface and however far another one in the picture.
    across = (points[:, 1:-1, 2:] - points[:, 1:-1, :-2]) / torch.maximum(reach[:, 1:-1, 2:], reach[:, 1:-1, :-2])
    upward = (points[:, :-2, 1:-1] - points[:, 2:, 1:-1]) / torch.maximum(reach[:, :-2, 1:-1], reach[:, 2:, 1:-1])
    normals = unit_or_zero(torch.linalg.cross(across, upward))
    supported = (
        usable[:, 1:-1, 1:-1] & usable[:, 1:-1, 2:] & usable[:, 1:-1, :-2] & usable[:, :-2, 1:-1] & usable[:, 2:, 1:-1]
    )
    normals = torch.where(supported[..., None], normals, 0.0)
    return torch.nn.functional.pad(normals, (0, 0, 1, 1, 1, 1))


def normal_picture(normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Camera-frame normals as colours in [0, 1]: red right, green up, blue towards the camera; no normal is mid-grey.

    The customary picture, hence the flip of y and z; :func:`normals_of_picture` undoes it.
    """
    return normals * normals.new_tensor([0.5, -0.5, -0.5]) + 0.5


def normals_of_picture(picture: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """The inverse of :func:`normal_picture`, without normalisation."""
    return (picture - 0.5) * picture.new_tensor([2.0, -2.0, -2.0])


def facing(normals: Float[Tensor, "*batch 3"], towards: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Normals flipped where they point away from the direction ``towards`` (any length; taken as constant)."""
    cosine = (normals.detach() * towards.detach()).sum(dim=-1, keepdim=True)
    return torch.where(cosine < 0, -normals, normals)
