"""How far cameras are from the true ones in the same world."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes


def errors(found: Pinholes, truth: Pinholes) -> dict[str, Float[Tensor, " n"]]:
    """Rotation (degrees), centre (scene units) and focal length (percent, the worse of the two) of each view."""
    turn = found.rotations.double().transpose(1, 2) @ truth.rotations.double()
    axis = torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], dim=1
    )
    angle = torch.atan2(axis.norm(dim=1), turn.diagonal(dim1=1, dim2=2).sum(dim=1) - 1)  # exact for small angles
    return {
        "rotation_degrees": torch.rad2deg(angle),
        "center": (found.centers.double() - truth.centers).norm(dim=1),
        "focal_percent": 100 * (found.focal.double() / truth.focal - 1).abs().amax(dim=1),
    }
