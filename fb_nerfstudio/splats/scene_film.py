"""Pictures of finished splats along a path, and of every pixel how much of it photos have seen, a model has made up,
and nobody has.

What a photo draws of a Gaussian, all its pixels together, is exactly the gradient of the picture's sum by the
Gaussian's colour: what stands behind something, or beside the picture, draws nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.splatting.spherical_harmonics import sh_colors
from fb_nerfstudio.splats.backend import BLUR, render_splats
from fb_nerfstudio.splats.splat_file import Splats

BEHIND = (0.1490, 0.1647, 0.2157)
"""Colour of what is empty: the viewer's."""
GENERATED, EMPTY = (1.0, 0.55, 0.1), (0.55, 0.1, 0.6)
"""Colours in pictures of trust: orange is made up, purple is empty; what was seen is grey."""
_SEEN_PIXELS = 1.0  # so much of a pixel, all photos together, a Gaussian must have drawn to count as seen


@dataclass(frozen=True, kw_only=True)
class FilmFrame:
    """One picture of the splats with what is behind each pixel. The three shares add up to 1."""

    image: Float[Tensor, "3 h w"]
    """RGB in [0, 1]."""
    seen: Float[Tensor, "h w"]
    """Share of the pixel that Gaussians draw which a photo shows."""
    generated: Float[Tensor, "h w"]
    """Share of those that no photo shows."""
    empty: Float[Tensor, "h w"]
    """Share through which nothing is seen."""

    @property
    def shares(self) -> dict[str, float]:
        """Means over the picture."""
        return {name: float(getattr(self, name).mean()) for name in ("seen", "generated", "empty")}

    @property
    def trust_picture(self) -> Float[Tensor, "3 h w"]:
        """Grey where photos have seen it, orange where a model has made it up, purple where nothing is."""
        grey = (self.image * self.image.new_tensor([0.299, 0.587, 0.114])[:, None, None]).sum(dim=0, keepdim=True)
        orange, purple = (self.image.new_tensor(color)[:, None, None] for color in (GENERATED, EMPTY))
        return (self.seen * grey + self.generated * (0.4 * grey + 0.6 * orange) + self.empty * purple).clamp(0, 1)


def seen_by_photos(
    splats: Splats,
    cameras: Sequence[Pinholes],
    known: Sequence[Bool[Tensor, "_h _w"] | None],
    on_photo: Callable[[int, int], None] | None = None,
) -> Bool[Tensor, " m"]:
    """Which Gaussians are drawn in the known pixels of captured pictures.

    Args:
        splats: in the world of the cameras.
        cameras: one each, of the size that the pictures were trained at.
        known: masks of their size; None is all of the picture.
        on_photo: told how many of how many are done.
    """
    drawn = splats.means.new_zeros(len(splats))
    for number, (camera, mask) in enumerate(zip(cameras, known, strict=True)):
        marks = splats.means.new_ones(len(splats), 1).requires_grad_()
        picture = _drawn(splats, marks, camera, BLUR)[0][..., 0]
        total = picture.sum() if mask is None else picture[mask.to(picture.device)].sum()
        if total.requires_grad:
            drawn += torch.autograd.grad(total, marks)[0][:, 0]
        if on_photo is not None:
            on_photo(number + 1, len(cameras))
    return drawn >= _SEEN_PIXELS


@torch.no_grad()
def film_frame(splats: Splats, seen: Bool[Tensor, " m"], camera: Pinholes, *, blur: float = BLUR) -> FilmFrame:
    """One camera's picture of the splats.

    Args:
        splats: in the camera's world.
        seen: which of them a photo shows.
        camera: one, of the picture's size.
        blur: variance in square pixels that every Gaussian is widened by. Pictures that are larger than those of the
            training need more of it, by the square of the ratio, or Gaussians shrink away from each other.
    """
    colors = sh_colors(splats.degree, splats.means - camera.centers.to(splats.means), splats.harmonics)
    marks = torch.cat([colors, seen[:, None].float()], dim=1)
    drawn, alpha = _drawn(splats, marks, camera, blur)
    opaque, by_photos = alpha[..., 0].clamp(0, 1), drawn[..., 3].clamp(0, 1)
    by_photos = torch.minimum(by_photos, opaque)
    image = drawn[..., :3] + (1 - opaque)[..., None] * drawn.new_tensor(BEHIND)
    frame = FilmFrame(
        image=image.clamp(0, 1).movedim(-1, 0), seen=by_photos, generated=opaque - by_photos, empty=1 - opaque
    )
    return FilmFrame(**{field.name: getattr(frame, field.name).cpu() for field in dataclasses.fields(frame)})


def _drawn(
    splats: Splats, colors: Float[Tensor, "m d"], camera: Pinholes, blur: float
) -> tuple[Float[Tensor, "h w d"], Float[Tensor, "h w 1"]]:
    camera = camera.to(splats.means.device, torch.float32)
    drawn = render_splats(
        means=splats.means,
        quats=splats.quats,
        scales=splats.log_scales.exp(),
        opacities=splats.logits.sigmoid(),
        colors=colors,
        viewmats=camera.world_to_camera,
        Ks=camera.intrinsics,
        width=camera.width,
        height=camera.height,
        eps2d=blur,
    )
    return drawn.colors[0], drawn.alphas[0]
