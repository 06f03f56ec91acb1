"""Points in space with their colours."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Points:
    """Coloured points of a scene."""

    positions: Float[Tensor, "m 3"]
    """World coordinates, scene units."""
    colors: Float[Tensor, "m 3"]
    """RGB in [0, 1]."""

    def __post_init__(self) -> None:
        if self.positions.shape != self.colors.shape or self.positions.ndim != 2 or self.positions.shape[1] != 3:
            raise ValueError(
                f"Points: expected positions and colors of shape (m, 3), got {tuple(self.positions.shape)} and "
                f"{tuple(self.colors.shape)}"
            )
        if not bool(torch.isfinite(self.positions).all() and torch.isfinite(self.colors).all()):
            raise ValueError(
                "Points: positions or colors hold NaN or infinity, expected finite numbers; drop those points"
            )

    def __len__(self) -> int:
        return self.positions.shape[0]
