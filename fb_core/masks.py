"""Known-masks (1 = known): the training mixture, conditioning dropout, growing a hole, pictures and masks on another
grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

WHOLLY = 1 - 1e-3
"""Share of known pixels from which on a resampled pixel counts as known altogether."""
_LEAST_SHARE = 1e-6  # below, a share is rounding of the resampling, and a colour divided by it would be too
Resampler = Callable[[Tensor], Tensor]
"""Takes channels [c, h, w] to channels [c, h2, w2], each channel alike, as means with weights of 0 or more that add up
to 1 at most.
"""


def partly_known(
    height: int, width: int, *, generator: torch.Generator, device: torch.device | str = "cpu"
) -> Float[Tensor, "1 h w"]:
    """A mask with 2 to 10 unknown rotated rectangles of 10 to 50 % of the image's side (paper, "Masking out regions").

    The draws are those of the generator, on the CPU; the mask is made on the device, all rectangles at once.
    """
    draws = [
        torch.rand(5, generator=generator, dtype=torch.float32)
        for _ in range(int(torch.randint(2, 11, (), generator=generator)))
    ]
    size_y, size_x, y, x, turn = torch.stack(draws).double().to(device)[..., None, None].unbind(1)
    down, along_row = ((torch.arange(side, device=device) + 0.5).double() for side in (height, width))
    down, right = down[:, None] - y * height, along_row - x * width
    cosine, sine = torch.cos(2 * math.pi * turn), torch.sin(2 * math.pi * turn)
    in_width = (right * cosine + down * sine).abs() <= (0.1 + 0.4 * size_x) * width / 2
    in_height = (down * cosine - right * sine).abs() <= (0.1 + 0.4 * size_y) * height / 2
    return 1 - (in_width & in_height).any(dim=0, keepdim=True).float()


def training_mixture(
    count: int,
    height: int,
    width: int,
    *,
    generator: torch.Generator,
    known: int | None = None,
    unknown: int | None = None,
    in_order: bool = False,
) -> Float[Tensor, "n 1 h w"]:
    """Masks of one training sequence, on the CPU: by default a quarter of the views known, half unknown, the rest
    partly known, in random order.

    ``known`` and ``unknown`` override the two counts (the released code's split is n//4 and n//2). ``in_order`` keeps
    known views first, then unknown ones, then the rest, as in the paper's evaluation.

    Raises ValueError for more known and unknown views than there are.
    """
    known = count // 4 if known is None else known
    unknown = count // 2 if unknown is None else unknown
    if known + unknown > count:
        raise ValueError(f"training mixture: {known} known and {unknown} unknown views do not fit into {count} views")
    masks = torch.zeros(count, 1, height, width, dtype=torch.float32)
    order = torch.arange(count) if in_order else torch.randperm(count, generator=generator)
    masks[order[:known]] = 1.0
    for view in order[known + unknown :].tolist():
        masks[view] = partly_known(height, width, generator=generator)
    return masks


def drop_conditioning(generator: torch.Generator, *, share: float = 0.1) -> tuple[bool, bool]:
    """(drop images, drop rays): with probability ``share`` something is dropped, equally images, rays, or both (paper,
    appendix).
    """
    if float(torch.rand((), generator=generator, dtype=torch.float32)) >= share:
        return False, False
    which = int(torch.randint(0, 3, (), generator=generator))
    return which in (0, 2), which in (1, 2)


def grow_hole(known: Float[Tensor, "n 1 h w"], *, pixels: int) -> Float[Tensor, "n 1 h w"]:
    """The mask with its unknown region grown by ``pixels`` in the maximum norm (the NeRFiller protocol uses 5)."""
    if pixels <= 0:
        return known
    return 1 - F.max_pool2d(1 - known, kernel_size=2 * pixels + 1, stride=1, padding=pixels)


def to_latent_grid(known: Float[Tensor, "n 1 h w"], *, factor: int = 8) -> Float[Tensor, "n 1 lh lw"]:
    """The operation D of the paper's Eq. 1: area averages, so borders of a mask become fractional. Sides are multiples
    of ``factor``.

    Raises ValueError for other sides.
    """
    height, width = known.shape[-2:]
    if height % factor or width % factor or not height or not width:
        raise ValueError(
            f"latent grid: expected a mask whose sides are multiples of {factor} pixels, got {width}x{height}; pad it "
            "first"
        )
    return F.avg_pool2d(known, kernel_size=factor)


def resampled(
    image: Float[Tensor, "c h w"], known: Float[Tensor, "1 h w"], how: Resampler
) -> tuple[Float[Tensor, "c h2 w2"], Float[Tensor, "1 h2 w2"]]:
    """Colours, not multiplied by anything, and the share of each new pixel that is known; colours are black where the
    share is 0.

    Args:
        image: any colours; what stands in unknown pixels may be anything, NaN included.
        known: 1 = known; fractions weigh.
        how: for example ``lambda channels: media.resize(channels, height, width)``.
    """
    known = known.to(image)
    weighted = torch.where(known > 0, image * known, torch.zeros_like(image))
    both = how(torch.cat([weighted, known]))
    share = both[-1:].clamp(0, 1)
    share = torch.where(share > _LEAST_SHARE, share, torch.zeros_like(share))
    return torch.where(share > 0, both[:-1] / share.clamp(min=_LEAST_SHARE), torch.zeros_like(share)), share


def wholly_known(
    image: Float[Tensor, "c h w"], known: Float[Tensor, "1 h w"], how: Resampler, *, least: float = WHOLLY
) -> tuple[Float[Tensor, "c h2 w2"], Float[Tensor, "1 h2 w2"]]:
    """Like :func:`resampled`, for what networks see and splats learn: 1 where a share of at least ``least`` is known,
    else black and 0.
    """
    colours, share = resampled(image, known, how)
    whole = (share >= least).to(share)
    return torch.where(whole > 0, colours, torch.zeros_like(colours)), whole
