"""Similarities between two worlds: a rotation, a scale and a shift, in float64."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

_ONE_PLACE = 1e-6  # units of spread that count as none, beside the rounding of the coordinates


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """``y = scale * rotation @ x + shift`` from one world to another; float64."""

    rotation: Float[Tensor, "3 3"]
    """A proper rotation."""
    scale: float
    """Above 0; units of the second world per unit of the first."""
    shift: Float[Tensor, " 3"]
    """Where the first world's origin is in the second."""

    @staticmethod
    def between(
        first: tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]],
        second: tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]],
        *,
        scale_of_one_place: float = 1.0,
    ) -> Similarity:
        """The one that takes cameras (camera-to-world rotations, centres) of a world to the same cameras in another.

        Exact for exact cameras, least squares otherwise. Cameras that all stand in one place tell no scale; then it is
        the one given.

        Raises ValueError without cameras and for poses that are not finite.
        """
        (rotations, centers), (their_rotations, their_centers) = first, second
        if not len(centers) or not all(bool(torch.isfinite(one).all()) for pair in (first, second) for one in pair):
            raise ValueError(
                "similarity: expected the poses of one or more cameras, got none or one that holds NaN or infinity"
            )
        rounding = rounding_of(centers)
        rotations, centers, their_rotations, their_centers = (
            x.double() for x in (rotations, centers, their_rotations, their_centers)
        )
        rotation = nearest_rotations(torch.einsum("nij,nkj->ik", their_rotations, rotations)[None])[0]
        spread, their_spread = centers - centers.mean(dim=0), (their_centers - their_centers.mean(dim=0)) @ rotation
        scale = scale_of_one_place
        if float(spread.abs().max()) > _ONE_PLACE + rounding:
            scale = float((spread * their_spread).sum() / spread.square().sum())
        shift = their_centers.mean(dim=0) - scale * rotation @ centers.mean(dim=0)
        return Similarity(rotation=rotation, scale=scale, shift=shift)

    @property
    def inverse(self) -> Similarity:
        """From the second world to the first."""
        return Similarity(
            rotation=self.rotation.T, scale=1 / self.scale, shift=-(self.rotation.T @ self.shift) / self.scale
        )

    def points(self, points: Float[Tensor, "*m 3"]) -> Float[Tensor, "*m 3"]:
        """The same points in the other world."""
        return self.scale * points.double() @ self.rotation.T + self.shift

    def cameras(self, cameras: Pinholes) -> Pinholes:
        """The same cameras in the other world, in float64, their rotations made exact."""
        rotations = nearest_rotations(self.rotation @ cameras.rotations.double())
        poses = torch.cat([rotations, self.points(cameras.centers)[:, :, None]], dim=2)
        return dataclasses.replace(cameras.to(torch.float64), camera_to_world=poses)


def rounding_of(places: Float[Tensor, "n 3"]) -> float:
    """What the precision that places are told in may have moved them by, scene units."""
    return 8 * torch.finfo(places.dtype).eps * float(places.abs().max())


def nearest_rotations(matrices: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """The proper rotations nearest to matrices in the sum of squares (orthogonal Procrustes)."""
    left, _, right = torch.linalg.svd(matrices)
    signs = torch.ones_like(matrices[:, 0])
    signs[:, 2] = torch.det(left @ right).sign()
    return (left * signs[:, None, :]) @ right
