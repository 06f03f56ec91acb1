"""Views: N views of one scene, each with an image, a raymap, and a known-mask for both. The spine of the package."""

from __future__ import annotations

import dataclasses
import numbers
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import raymaps_of


@dataclass(frozen=True, kw_only=True)
class Views:
    """N views of one scene (paper, section 3.1: I, R, M^I, M^R). All share one size; masks: 1 = known.

    What stands in unknown pixels is never looked at: it may be anything, NaN included.
    """

    images: Float[Tensor, "n 3 h w"]
    """RGB in [0, 1]."""
    image_known: Float[Tensor, "n 1 h w"]
    """1 where the pixel is given, 0 where it is to be generated."""
    raymaps: Float[Tensor, "n 6 h w"]
    """World-space origins (scene units) and unit directions."""
    rays_known: Float[Tensor, "n 1 h w"]
    """1 where the ray is given, 0 where it is to be recovered."""

    def __post_init__(self) -> None:
        count, _, height, width = self.images.shape
        expected = {"images": 3, "image_known": 1, "raymaps": 6, "rays_known": 1}
        for name, channels in expected.items():
            got = tuple(getattr(self, name).shape)
            if got != (count, channels, height, width):
                raise ValueError(
                    f"Views: {name} has shape {got}, expected {(count, channels, height, width)} like the images"
                )

    def __len__(self) -> int:
        return self.images.shape[0]

    def __getitem__(self, index) -> Views:
        """The chosen views; an integer keeps the leading dimension."""
        if isinstance(index, numbers.Integral):  # NumPy's integers too
            index = [int(index)]
        return dataclasses.replace(
            self, **{field.name: getattr(self, field.name)[index] for field in dataclasses.fields(self)}
        )

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.images.shape[2], self.images.shape[3]

    def to(self, *args, **kwargs) -> Views:
        """Like ``Tensor.to`` for every tensor."""
        return dataclasses.replace(
            self, **{f.name: getattr(self, f.name).to(*args, **kwargs) for f in dataclasses.fields(self)}
        )

    @staticmethod
    def known(
        images: Float[Tensor, "n 3 h w"], cameras: Pinholes, *, mask: Float[Tensor, "n 1 h w"] | None = None
    ) -> Views:
        """Captured views with known cameras; ``mask`` marks the known pixels (default: all).

        Rays keep the cameras' precision where that is the higher one: single precision knows no millimetre far from the
        origin.
        """
        ones, rays = torch.ones_like(images[:, :1]), raymaps_of(cameras)
        rays = rays.to(images.device, torch.promote_types(images.dtype, rays.dtype))
        return Views(images=images, image_known=ones if mask is None else mask, raymaps=rays, rays_known=ones)

    @staticmethod
    def unknown(cameras: Pinholes) -> Views:
        """Views that are to be generated at known cameras."""
        raymaps = raymaps_of(cameras)
        zeros = torch.zeros_like(raymaps[:, :1])
        return Views(
            images=zeros.expand(-1, 3, -1, -1), image_known=zeros, raymaps=raymaps, rays_known=torch.ones_like(zeros)
        )

    @staticmethod
    def unposed(images: Float[Tensor, "n 3 h w"]) -> Views:
        """Known images whose cameras are to be recovered."""
        ones = torch.ones_like(images[:, :1])
        return Views(
            images=images,
            image_known=ones,
            raymaps=torch.zeros_like(ones).expand(-1, 6, -1, -1),
            rays_known=torch.zeros_like(ones),
        )

    @staticmethod
    def cat(groups: list[Views]) -> Views:
        """All views in one sequence. Raises ValueError when the sizes differ."""
        sizes = {group.size for group in groups}
        if len(sizes) != 1:
            raise ValueError(
                f"views of one sequence must share one size (height, width), got {sorted(sizes)}; fit them first"
            )
        return dataclasses.replace(
            groups[0],
            **{f.name: torch.cat([getattr(group, f.name) for group in groups]) for f in dataclasses.fields(Views)},
        )
