"""A film of generated views: H.264 in an MP4 file that players and browsers show."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.data.photos.film_colours import tag, to_yuv420
from fb_core.files.whole import by_way_of_memory

_QUALITY = (
    "12"  # constant rate factor: even fields come back within 1 of 255 (3 at 18, the customary one for no visible loss)
)
_CHROMA_PLACE = "chromaloc=1"  # in the middle of the four pixels that share it
_LEAST_SIDE = 480  # smaller pictures are enlarged in whole numbers, since players blur what they enlarge themselves


def write_film(path: Path, frames: Iterable[Float[Tensor, "3 h w"]], *, frames_per_second: float = 8.0) -> int:
    """Write pictures of one size, RGB in [0, 1], as an H.264 film; returns how many.

    Small pictures are enlarged by a whole number. H.264 wants even sides, so that an odd one loses its last row or
    column.

    Raises ValueError for no pictures, for pictures of different or too small sizes and for a frame rate that is not
    positive, and OSError when the disk is full.
    """
    if not 0 < frames_per_second <= 240:
        raise ValueError(f"film: expected between 0 and 240 frames per second, got {frames_per_second:g}")
    import av

    size: tuple[int, ...] = ()
    count = 0
    with (
        by_way_of_memory(path) as place,
        av.open(place, "w", format="mp4", options={"movflags": "faststart"}) as container,
    ):
        stream: Any = None
        for picture in frames:
            pixels = _even_pixels(picture)
            if stream is None:
                size = pixels.shape
                stream = container.add_stream("libx264", rate=Fraction(frames_per_second).limit_denominator(1001))
                stream.width, stream.height, stream.pix_fmt = size[1], size[0], "yuv420p"
                stream.options = {"crf": _QUALITY, "x264-params": _CHROMA_PLACE}
                tag(stream.codec_context, size[0], size[1])
            if pixels.shape != size:
                raise ValueError(f"film: expected pictures of one size, got {_told(pixels.shape)} after {_told(size)}")
            container.mux(stream.encode(av.VideoFrame.from_ndarray(to_yuv420(pixels), format="yuv420p")))
            count += 1
        if stream is None:
            raise ValueError("film: expected at least one picture, got none")
        container.mux(stream.encode())
    return count


def _even_pixels(picture: Float[Tensor, "3 h w"]) -> np.ndarray:
    """8 bits, (height, width, 3), with even sides, enlarged if it is small."""
    height, width = picture.shape[1:]
    if min(height, width) < 2:
        raise ValueError(f"film: expected pictures of at least 2x2 pixels, got {width}x{height}")
    scale = max(1, round(_LEAST_SIDE / min(height, width)))
    if scale > 1:
        size = (scale * height, scale * width)
        picture = F.interpolate(picture[None].float(), size=size, mode="bicubic", align_corners=False)[0]
    picture = picture[:, : picture.shape[1] // 2 * 2, : picture.shape[2] // 2 * 2]
    values = (picture.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8)
    return np.ascontiguousarray(values.movedim(0, -1).numpy())


def _told(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
