"""How close rendered views are to the truth: PSNR and SSIM per view, and the share of holes."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.splatting import photometric

SOLID = 0.5
"""Accumulation from which a pixel counts as covered by the scene; below, it is a hole."""


def psnr(images: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Peak signal-to-noise ratio of each view in dB, for values in [0, 1]; at most 120 dB."""
    _require_pairs(images, truth)
    return photometric.decibels((images - truth).square().mean(dim=(1, 2, 3)))


def ssim(images: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"]) -> Float[Tensor, " n"]:
    """Mean structural similarity of each view, for values in [0, 1]: Gaussian window of 11 pixels and sigma 1.5, valid
    windows only (Wang et al. 2004).

    Raises ValueError for views with a side below 11 pixels, where no window fits.
    """
    _require_pairs(images, truth)
    window = photometric.WINDOW
    if min(images.shape[2:]) < window:
        raise ValueError(
            f"ssim: expected views of at least {window} x {window} pixels, got {images.shape[3]} x {images.shape[2]}"
        )
    if len(images) == 0:
        return images.new_zeros(0)
    pairs = zip(images.movedim(1, -1), truth.movedim(1, -1), strict=True)
    return torch.stack([photometric.ssim(image, true) for image, true in pairs])


def hole_share(accumulation: Float[Tensor, "n h w"]) -> Float[Tensor, " n"]:
    """Share of each view's pixels through which one looks out of the scene: accumulation below 0.5."""
    return (accumulation < SOLID).float().mean(dim=(1, 2))


def mean_quality(
    images: Float[Tensor, "n 3 h w"], truth: Float[Tensor, "n 3 h w"], accumulation: Float[Tensor, "n h w"]
) -> dict[str, float]:
    """``psnr`` (dB), ``ssim`` and ``hole_share``, each the mean over views. Raises ValueError for no views."""
    if len(images) == 0:
        raise ValueError("mean_quality: expected at least one view, got none")
    values = {"psnr": psnr(images, truth), "ssim": ssim(images, truth), "hole_share": hole_share(accumulation)}
    return {name: float(value.double().mean()) for name, value in values.items()}


def _require_pairs(images: Tensor, truth: Tensor) -> None:
    if images.shape != truth.shape:
        raise ValueError(
            f"image metrics: expected pictures of the truth's shape {tuple(truth.shape)}, got {tuple(images.shape)}"
        )
    if not bool(torch.isfinite(images).all()):
        raise ValueError("image metrics: expected finite pictures, got NaN or infinite pixels")
