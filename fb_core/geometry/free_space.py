"""Space that is known to be free: rays of captured pictures have crossed it on their way to what they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

_BESIDE = 0.5  # of the extent of the capture
_SHARE = 0.9  # of the way to a surface that counts as crossed, which leaves room for errors of depth


@dataclass(frozen=True, kw_only=True)
class FreeSpace:
    """What rays have crossed from each camera to the surface that it shows."""

    cameras: tuple[Pinholes, ...]
    """One each, with small pictures."""
    depth: tuple[Float[Tensor, "_h _w"], ...]
    """z-depth of the surface in each of their pixels; 0 or not finite where it is not known."""

    @property
    def is_known(self) -> bool:
        """Whether any ray is known to have reached a surface."""
        return any(bool((torch.isfinite(one) & (one > 0)).any()) for one in self.depth)

    def crossed(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        """Whether a ray of some picture has passed each point well before the surface that it shows; memory does not
        grow with pictures. Points that are not finite lie in no free space.
        """
        result = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        for camera, depth in zip(self.cameras, self.depth, strict=True):
            pixels, away = camera.to(points).project(points)
            cell = pixels[0].nan_to_num(-1.0).floor()
            inside = (
                (cell >= 0).all(dim=-1) & (cell[:, 0] < depth.shape[1]) & (cell[:, 1] < depth.shape[0]) & (away[0] > 0)
            )
            column, row = cell[inside].long().unbind(dim=-1)
            surface = depth[row, column].to(points)
            result[inside] |= torch.isfinite(surface) & (away[0][inside] < _SHARE * surface)
        return result


def cameras_beside(cameras: Sequence[Pinholes]) -> list[Pinholes]:
    """Where else people may look from: each camera (one per entry) moved to the left, the right, up and down by half of
    the distance of the farthest camera from their middle. None where all stand in one place.
    """
    centers = torch.cat([camera.centers for camera in cameras]) if cameras else torch.empty(0, 3)
    reach = _BESIDE * float((centers - centers.mean(dim=0)).norm(dim=1).max()) if len(centers) else 0.0
    if reach <= 1e-6 * (1 + float(centers.abs().max() if len(centers) else 0.0)):
        return []
    return [
        camera.moved(sign * reach * camera.rotations[0, :, axis])
        for camera in cameras
        for axis in (0, 1)
        for sign in (-1, 1)
    ]
