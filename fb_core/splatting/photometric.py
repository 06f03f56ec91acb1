"""Photometric terms over known pixels only: every mean is divided by the mask's sum, not by the image's size.

PSNR and SSIM are here once, for losses and for metrics. SSIM is our own because it is a loss over masked pictures:
kornia's knows no mask and no picture below 11 pixels, takes twice the time with its gradient, and adds 1e-12 to a
denominator of 9e-8, which is 1e-5 of the value where pictures are black (without it, it agrees to 1e-7). torchmetrics'
rounds by 2e-4 where pictures are of one colour, and takes six times as long.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

WINDOW = 11
"""Side of the SSIM window in pixels (Wang et al. 2004)."""
WINDOW_SIGMA = 1.5
"""Standard deviation of the SSIM window in pixels."""
_LEAST_ERROR = 1e-12  # identical pictures have 120 dB instead of infinity, which JSON cannot hold


def known_mean(
    values: Float[Tensor, "h w c"],
    known: Float[Tensor, "h w 1"] | None = None,
    weight: Float[Tensor, "h w 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean over known pixels and all channels; zero when nothing is known. Fractional masks weigh.

    ``weight`` multiplies what a pixel contributes, not what the sum is divided by: a picture of half the weight
    everywhere has half the mean.
    """
    if weight is not None:
        values = values * weight
    if known is None:
        return values.mean()
    return (values * known).sum() / (known.sum() * values.shape[-1]).clamp_min(1e-6)


def l1(
    first: Float[Tensor, "h w c"],
    second: Float[Tensor, "h w c"],
    known: Float[Tensor, "h w 1"] | None = None,
    weight: Float[Tensor, "h w 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean absolute difference over known pixels, each of its weight."""
    return known_mean((first - second).abs(), known, weight)


def psnr(
    first: Float[Tensor, "h w c"], second: Float[Tensor, "h w c"], known: Float[Tensor, "h w 1"] | None = None
) -> Float[Tensor, ""]:
    """Peak signal-to-noise ratio in dB over known pixels of images in [0, 1]; at most 120 dB."""
    return decibels(known_mean((first - second).square(), known))


def decibels(mean_square: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Peak signal-to-noise ratio in dB of a mean squared error of values in [0, 1]; at most 120 dB."""
    return -10 * mean_square.clamp_min(_LEAST_ERROR).log10()


def ssim(
    first: Float[Tensor, "h w c"], second: Float[Tensor, "h w c"], known: Float[Tensor, "h w 1"] | None = None
) -> Float[Tensor, ""]:
    """Mean structural similarity of images in [0, 1], Gaussian window, valid windows only.

    With a mask both images are black where nothing is known, and windows count by the mask at their centre. Images
    smaller than the window use the largest odd window that fits.
    """
    if known is None:
        return _similarity(first, second).mean()
    similarity = _similarity(first * known, second * known)
    return known_mean(similarity, _centres(known, similarity))


def dissimilarity(
    first: Float[Tensor, "h w c"],
    second: Float[Tensor, "h w c"],
    known: Float[Tensor, "h w 1"] | None = None,
    weight: Float[Tensor, "h w 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean of 1 - SSIM, as :func:`ssim`; each window counts by the weight at its centre. Pixels of weight 0 are black
    in both pictures.
    """
    if weight is None:
        return 1 - ssim(first, second, known)
    known = torch.ones_like(first[..., :1]) if known is None else known
    looked_at = known * (weight > 0)
    similarity = _similarity(first * looked_at, second * looked_at)
    return known_mean(1 - similarity, _centres(known, similarity), _centres(weight, similarity))


def _centres(values: Float[Tensor, "h w 1"], similarity: Float[Tensor, "a b c"]) -> Float[Tensor, "a b 1"]:
    """The values at the centres of the windows."""
    edge, beside = ((full - valid) // 2 for full, valid in zip(values.shape[:2], similarity.shape[:2], strict=True))
    return values[edge : edge + similarity.shape[0], beside : beside + similarity.shape[1]]


def _similarity(first: Float[Tensor, "h w c"], second: Float[Tensor, "h w c"]) -> Float[Tensor, "a b c"]:
    """Of every valid window."""
    height, width, channels = first.shape
    side = min(WINDOW, height - (height + 1) % 2, width - (width + 1) % 2)
    window = _window(side).to(first)
    a, b = first.movedim(-1, 0), second.movedim(-1, 0)
    stacked = torch.stack([a, b, a * a, b * b, a * b])
    # All moments in one depthwise convolution per axis: twice as fast on a CPU as one convolution per moment.
    planes = 5 * channels
    blurred = F.conv2d(
        stacked.reshape(1, planes, height, width), window.view(1, 1, side, 1).repeat(planes, 1, 1, 1), groups=planes
    )
    blurred = F.conv2d(blurred, window.view(1, 1, 1, side).repeat(planes, 1, 1, 1), groups=planes)
    mean_a, mean_b, square_a, square_b, product = blurred.view(5, channels, height - side + 1, width - side + 1)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_a * mean_b + c1) / (mean_a.square() + mean_b.square() + c1)
    structure = (2 * (product - mean_a * mean_b) + c2) / (square_a - mean_a.square() + square_b - mean_b.square() + c2)
    return (luminance * structure).movedim(0, -1)


def _window(side: int) -> Float[Tensor, " side"]:
    weights = torch.exp(-(torch.arange(side) - side // 2).square() / (2 * WINDOW_SIGMA**2))
    return weights / weights.sum()
