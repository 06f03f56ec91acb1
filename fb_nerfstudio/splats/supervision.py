"""What a training batch says of a render: losses and metrics over what is known of its picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.normals import normals_of_picture
from fb_core.masks import resampled
from fb_core.splatting import photometric
from fb_core.splatting.normal_losses import alignment_loss, total_variation
from fb_nerfstudio.bridge import batch_image


@dataclass(frozen=True, kw_only=True)
class Supervision:
    """A batch at the resolution of the render."""

    target: Float[Tensor, "h w 3"]
    """The picture, in [0, 1]."""
    known: Float[Tensor, "h w 1"] | None
    """1 where it is known, fractions where a block is known in part; None where all is."""
    trust: Float[Tensor, "h w 1"] | None
    """How far each pixel is believed; None where wholly."""
    weight: float
    """What the view contributes beside others."""

    def photometric(self, rgb: Float[Tensor, "h w 3"], *, ssim_lambda: float) -> Float[Tensor, ""]:
        """Splatfacto's mixture of L1 and SSIM, over known pixels, each as far as it is believed."""
        loss = (1 - ssim_lambda) * photometric.l1(rgb, self.target, self.known, self.trust)
        if ssim_lambda > 0:
            loss = loss + ssim_lambda * photometric.dissimilarity(rgb, self.target, self.known, self.trust)
        return self.weight * loss

    def normals(
        self,
        normal: Float[Tensor, "h w 3"],
        surface_normal: Float[Tensor, "h w 3"],
        weights: Mapping[str, float],
        *,
        form: Literal["squared", "absolute"],
    ) -> dict[str, Tensor]:
        """Losses of rendered normals.

        Args:
            normal: the Gaussians' normals, as a picture (``normal_picture``).
            surface_normal: those of the rendered depth.
            weights: of the ``alignment`` of both and of the total variation (``tv``); 0 leaves a loss out.
            form: of the alignment.
        """
        known, weight, losses = self.known, self.weight, {}
        if self.trust is not None:  # means over what counts: of so much of the picture, by so much weight
            known = self.trust if known is None else known * self.trust
            weight = weight * photometric.known_mean(self.trust, self.known)
        if weights["alignment"] > 0:
            alignment = alignment_loss(normals_of_picture(normal), normals_of_picture(surface_normal), known, form=form)
            losses["normal_alignment"] = weight * (weights["alignment"] * alignment)
        if weights["tv"] > 0:
            losses["normal_tv"] = weight * (weights["tv"] * total_variation(normal, known))
        return losses

    def psnr(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
        """In dB, over known pixels."""
        return photometric.psnr(image, self.target, self.known)

    def metrics(
        self, image: Float[Tensor, "h w 3"], lpips: Callable[[Tensor, Tensor], float | None]
    ) -> dict[str, float]:
        """PSNR, SSIM and, where its weights are at hand, LPIPS, over known pixels."""
        metrics = {
            "psnr": float(self.psnr(image)),
            "ssim": float(photometric.ssim(image, self.target, self.known)),
        }
        known = self.known
        pair = (image, self.target) if known is None else (image * known, self.target * known)
        distance = lpips(*pair)
        return metrics if distance is None else metrics | {"lpips": distance}


def known_share(batch: Mapping[str, Any], smaller: Callable[[Tensor], Tensor]) -> Float[Tensor, "h w 1"] | None:
    """How far each pixel of a batch is known, made ``smaller`` ([h, w, c]); None for a batch without a mask.

    Raises ValueError for a mask of another size than the image's.
    """
    if "mask" not in batch:
        return None
    mask, size = batch["mask"], tuple(batch["image"].shape[:2])
    if tuple(mask.shape[:2]) != size:
        raise ValueError(f"batch['mask']: expected the image's size {size}, got {tuple(mask.shape[:2])}")
    return smaller(mask.reshape(*size, 1).float())


def known_colors_smaller(batch: Mapping[str, Any], smaller: Callable[[Tensor], Tensor]) -> Float[Tensor, "h w 3"]:
    """The picture of a batch that has a mask, made ``smaller`` ([h, w, c]) without mixing unknown colours in."""
    mask = batch["mask"].reshape(1, *batch["image"].shape[:2]).float()
    image, _ = resampled(batch_image(dict(batch)), mask, lambda both: smaller(both.movedim(0, -1)).movedim(-1, 0))
    return image.movedim(0, -1)


def needles(log_scales: Float[Tensor, "m 3"], most: float) -> Float[Tensor, ""]:
    """Penalty on Gaussians of which one axis is more than ``most`` times another (PhysGaussian)."""
    log_ratio = log_scales.amax(dim=-1) - log_scales.amin(dim=-1)
    return 0.1 * (log_ratio.exp() - most).clamp_min(0.0).mean()


def empty_outputs(width: int, height: int, background: Float[Tensor, "3"]) -> dict[str, Tensor]:
    """The outputs of a view that contains no Gaussian; all keys of a full one."""
    rgb = background.expand(height, width, 3)
    no_normal = torch.full_like(rgb, 0.5)
    return {
        "rgb": rgb,
        "accumulation": rgb.new_zeros(height, width, 1),
        "background": rgb,
        "depth": rgb.new_full((height, width, 1), 10.0),
        "normal": no_normal,
        "surface_normal": no_normal,
    }
