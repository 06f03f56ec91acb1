"""Raymaps (paper, section 3.1): 3 origin and 3 unit direction channels per pixel, and the canonical frame they live in.

The canonical frame puts one reference camera at the origin, turns its up axis to +z, gives it a heading, and scales all
origins into the cube [-1, 1]^3. It is a similarity, so it has an exact inverse.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

_SCALE_MARGIN = 1e-6  # keeps the largest origin strictly inside the cube


def raymaps_of(cameras: Pinholes) -> Float[Tensor, "n 6 h w"]:
    """World-space raymaps: channels 0-2 the camera centre (scene units), 3-5 the unit direction through the pixel
    centre.
    """
    directions = cameras.directions().permute(0, 3, 1, 2)
    origins = cameras.centers[:, :, None, None].expand_as(directions)
    return torch.cat([origins, directions], dim=1)


def to_unit_range(raymaps: Float[Tensor, "*n 6 h w"]) -> Float[Tensor, "*n 6 h w"]:
    """Canonical raymaps (origins and directions in [-1, 1]) to the [0, 1] range that the raymap VAE takes."""
    return raymaps / 2 + 0.5


def from_unit_range(raymaps01: Float[Tensor, "n 6 h w"]) -> Float[Tensor, "n 6 h w"]:
    """Inverse of :func:`to_unit_range`; directions are brought back to unit length (a zero direction stays zero)."""
    raymaps = raymaps01 * 2 - 1
    return torch.cat([raymaps[:, :3], F.normalize(raymaps[:, 3:], dim=1)], dim=1)


def axes_of(directions: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 3"]:
    """Camera-to-world rotation of a pinhole camera from its ray directions alone (columns: right, down, forward).

    The rays of one pixel row span a plane that holds the right axis, so the normals of two rows' planes cross in it;
    columns give the down axis. Exact for any principal point and any focal lengths without skew; needs at least 2x2
    pixels.
    """
    rays = directions.double()
    row_normals = [torch.linalg.cross(rays[:, row, 0], rays[:, row, -1]) for row in (0, -1)]
    column_normals = [torch.linalg.cross(rays[:, 0, column], rays[:, -1, column]) for column in (0, -1)]
    # Normals of rows point down, those of columns left; crossing upper with lower (left with right) gives the axis up
    # to its sign.
    right = F.normalize(torch.linalg.cross(row_normals[0], row_normals[1]), dim=0)
    down = F.normalize(torch.linalg.cross(column_normals[0], column_normals[1]), dim=0)
    right = right * torch.sign(right @ (rays[:, 0, -1] - rays[:, 0, 0]))
    down = down * torch.sign(down @ (rays[:, -1, 0] - rays[:, 0, 0]))
    down = F.normalize(down - (down @ right) * right, dim=0)
    return torch.stack([right, down, torch.linalg.cross(right, down)], dim=1).to(directions.dtype)


def _check_reference(reference: int, count: int) -> None:
    if count == 0:
        raise ValueError("canonical frame: expected at least one camera, got none; pass the captured cameras")
    if not -count <= reference < count:
        raise ValueError(f"canonical frame: expected a reference among {count} cameras, got number {reference}")


def _nearest_rotation(matrix: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """Files hold rounded rotations, but only a true one makes a frame with an exact inverse. Refuses what is no
    rotation at all.
    """
    error = float((matrix.T @ matrix - torch.eye(3, dtype=matrix.dtype)).abs().max())
    if not error < 1e-2 or float(torch.linalg.det(matrix)) < 0:
        raise ValueError(
            "canonical frame: the reference camera's pose is singular, mirrored or scaled, expected a rotation, got "
            f"{matrix.tolist()}"
        )
    left, _, right = torch.linalg.svd(matrix)
    return left @ right


@dataclass(frozen=True, kw_only=True)
class CanonicalFrame:
    """The similarity world -> canonical: ``x' = rotation @ (x - center) / scale``; directions are only rotated."""

    rotation: Float[Tensor, "3 3"]
    """World-to-canonical rotation."""
    center: Float[Tensor, " 3"]
    """World point that becomes the origin (the reference camera's centre)."""
    scale: float
    """World length that becomes 1."""

    @staticmethod
    def of(cameras: Pinholes, *, reference: int = 0, heading_radians: float = 0.0, fill: float = 1.0) -> CanonicalFrame:
        """The frame of ``cameras[reference]`` (reference facts, section 3.6).

        Args:
            cameras: the cameras with known poses, any units.
            reference: the camera that goes to the origin, upright.
            heading_radians: rotation about the canonical z axis (training draws it, inference uses 0).
            fill: for captures that already fit into the cube: 1 fills the cube, 0 leaves the scale alone (training
                draws it).
        """
        _check_reference(reference, len(cameras))
        return CanonicalFrame.around(
            cameras.rotations[reference],
            cameras.centers[reference],
            cameras.centers,
            heading_radians=heading_radians,
            fill=fill,
        )

    @staticmethod
    def of_raymaps(
        raymaps: Float[Tensor, "n 6 h w"], *, reference: int = 0, heading_radians: float = 0.0, fill: float = 1.0
    ) -> CanonicalFrame:
        """The same frame from the raymaps of pinhole cameras alone; every ray must be known. Sides of at least 2
        pixels.
        """
        _check_reference(reference, len(raymaps))
        rotation = axes_of(raymaps[reference, 3:])
        centers = raymaps[:, :3].flatten(2).double().mean(dim=2).to(raymaps.dtype)
        return CanonicalFrame.around(rotation, centers[reference], centers, heading_radians=heading_radians, fill=fill)

    @staticmethod
    def around(
        rotation_camera: Float[Tensor, "3 3"],
        center: Float[Tensor, " 3"],
        all_centers: Float[Tensor, "n 3"],
        *,
        heading_radians: float = 0.0,
        fill: float = 1.0,
    ) -> CanonicalFrame:
        """The frame that is upright in a camera-to-world rotation and holds all centres. In float64 on the CPU (a few
        numbers).

        Raises ValueError for centres that are not finite.
        """
        axes = _nearest_rotation(rotation_camera.detach().cpu().double())
        centers = all_centers.detach().cpu().double()
        flip = axes.new_tensor([1.0, -1.0, -1.0]).diag()  # OpenCV axes to y up, z backward
        upright = axes.new_tensor(
            [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
        )  # +90 degrees about x: y up -> z up
        cosine, sine = math.cos(heading_radians), math.sin(heading_radians)
        turn = axes.new_tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        rotation = turn @ upright @ flip @ axes.T
        extent = float(((centers - center.detach().cpu().double()) @ rotation.T).abs().max())
        if not math.isfinite(extent):
            raise ValueError(
                "canonical frame: a camera centre holds NaN or infinity; expected finite camera_to_world matrices"
            )
        rounding = 4 * torch.finfo(all_centers.dtype).eps * float(centers.abs().max())
        scale = extent if extent >= 1.0 else extent * fill + (1.0 - fill)
        if (
            scale <= rounding
        ):  # every camera in one place, up to rounding: any scale is right, but noise must not fill the cube
            scale = 1.0
        return CanonicalFrame(rotation=rotation.to(rotation_camera), center=center, scale=scale * (1.0 + _SCALE_MARGIN))

    def apply(self, raymaps: Float[Tensor, "n 6 h w"]) -> Float[Tensor, "n 6 h w"]:
        """World raymaps to canonical ones (origins in [-1, 1]^3 for the cameras the frame was made from)."""
        origins = torch.einsum("ij,njhw->nihw", self.rotation, raymaps[:, :3] - self.center[:, None, None]) / self.scale
        return torch.cat([origins, torch.einsum("ij,njhw->nihw", self.rotation, raymaps[:, 3:])], dim=1)

    def invert(self, raymaps: Float[Tensor, "n 6 h w"]) -> Float[Tensor, "n 6 h w"]:
        """Canonical raymaps back to the world: the exact inverse of :meth:`apply`."""
        origins = torch.einsum("ji,njhw->nihw", self.rotation, raymaps[:, :3] * self.scale) + self.center[:, None, None]
        return torch.cat([origins, torch.einsum("ji,njhw->nihw", self.rotation, raymaps[:, 3:])], dim=1)
