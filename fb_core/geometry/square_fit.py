"""Where a whole picture stands in a square, the one way: long side scaled to the square's, in the middle."""

from __future__ import annotations

from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes


@dataclass(frozen=True, kw_only=True)
class SquareFit:
    """A picture's rectangle in a square, pixels of the square."""

    left: int
    top: int
    width: int
    """Of the scaled picture."""
    height: int
    """Of the scaled picture."""
    side: int
    """Of the square."""

    @staticmethod
    def of(height: float, width: float, side: int) -> SquareFit:
        """Of a picture of this size, or of this aspect."""
        scale = side / max(height, width)
        scaled_height, scaled_width = max(1, round(height * scale)), max(1, round(width * scale))
        return SquareFit(
            left=(side - scaled_width) // 2,
            top=(side - scaled_height) // 2,
            width=scaled_width,
            height=scaled_height,
            side=side,
        )

    def framed(
        self, scaled: Float[Tensor, "c {self.height} {self.width}"] | Bool[Tensor, "c {self.height} {self.width}"]
    ) -> Float[Tensor, "c {self.side} {self.side}"] | Bool[Tensor, "c {self.side} {self.side}"]:
        """The scaled picture in the square, with zeros around it."""
        right, below = self.side - self.width - self.left, self.side - self.height - self.top
        return F.pad(scaled, (self.left, right, self.top, below))

    def cut(self, square: Float[Tensor, "*n {self.side} {self.side}"]) -> Float[Tensor, "*n h w"]:
        """The picture's part of a square: the inverse of :meth:`framed`."""
        return square[..., self.top : self.top + self.height, self.left : self.left + self.width]

    def camera(self, camera: Pinholes) -> Pinholes:
        """The square's camera, from that of the picture; exact, so that it sees more to both sides."""
        return camera.scaled(self.width, self.height).cropped(-self.left, -self.top, self.side, self.side)
