"""One photo: its pixels when they are asked for, and what is known of its camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.geometry.cameras import Pinholes
from fb_core.masks import resampled

Pixels = tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]


@dataclass(frozen=True, kw_only=True)
class Photo:
    """One photo, film frame or captured picture, upright and without lens distortion as far as that is known."""

    name: str
    """Unique within the input, fit for a file name without suffix."""
    source: Path
    """The file it comes from; the film for frames."""
    size: tuple[int, int]
    """(height, width) in pixels, upright."""
    focal_prior: float | None
    """Focal length in pixels of the full-size picture as EXIF data or a capture tells; None = unknown."""
    device: str
    """Photos with the same text were taken with the same lens at the same size (up to orientation); "" = nothing is
    known.
    """
    seconds: float | None
    """Time in the film, or EXIF time since 1970, or None."""
    camera: Pinholes | None
    """The camera of the whole picture where its pose is known (a batch of one, float64, the capture's world), else
    None.
    """
    thumbnail: Float[Tensor, "3 h w"] = field(repr=False, compare=False)
    """The picture with at most ``THUMBNAIL_SIDE`` pixels per side."""
    pixels: Callable[[], Pixels] = field(repr=False, compare=False)
    """Decodes colours in [0, 1] and the known-mask at full size."""
    stored: bool = True
    """Whether the file holds this very picture; one that was straightened later is nowhere stored."""
    bent: tuple[Pinholes, dict[str, float]] | None = field(default=None, repr=False, compare=False)
    """What a photo was straightened from after its lens was found: camera of the bent picture, distortion."""

    def load(self, longest_side: int | None = None) -> Float[Tensor, "3 h w"]:
        """The picture, RGB in [0, 1], shrunk by area averages so that no side is longer than ``longest_side``
        pixels.
        """
        return self.load_with_mask(longest_side)[0]

    def load_mask(self, longest_side: int | None = None) -> Float[Tensor, "1 h w"]:
        """1 = known: alpha channel, masks of a capture, the inside of a bent lens's picture; ones without. Fractions
        after shrinking.
        """
        return self.load_with_mask(longest_side)[1]

    def load_with_mask(self, longest_side: int | None = None) -> Pixels:
        """:meth:`load` and :meth:`load_mask` with one decoding. Raises ValueError for a file that has become
        unreadable.
        """
        return shrunk(self.pixels(), longest_side)


def shrunk(pixels: Pixels, longest_side: int | None) -> tuple[Float[Tensor, "3 h2 w2"], Float[Tensor, "1 h2 w2"]]:
    """Area averages of the known pixels; where nothing is known the colour is black."""
    image, mask = pixels
    if bool((mask == 1).all()):
        image = media.shrink(image, longest_side)
        return image, torch.ones_like(image[:1])
    image, share = resampled(image, mask, lambda channels: media.shrink(channels, longest_side))
    return image.clamp(0, 1), share
