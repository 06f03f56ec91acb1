"""How films code colours: YUV with one of several matrices and one of two ranges, as their tags say.

The conversion is made here, not by the scaler of FFmpeg, whose integers are off by up to 4 of 255. What no tag tells
follows the usual rule: BT.709 for HD, BT.601 below, limited range.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

_BT709, _UNTAGGED, _BT601, _YCGCO = 1, 2, 6, 8  # numbers of ITU-T H.273, which FFmpeg and all containers share
_LUMA = {
    _BT709: (0.2126, 0.0722),
    4: (0.30, 0.11),  # FCC
    5: (0.299, 0.114),  # BT.601 of 625 lines
    _BT601: (0.299, 0.114),
    7: (0.212, 0.087),  # SMPTE 240M
    9: (0.2627, 0.0593),  # BT.2020
    10: (0.2627, 0.0593),
}
"""Weights of red and blue in the luma, by the number of the matrix."""
_FULL_RANGE = 2
_HD_LONG, _HD_SHORT = 1280, 720  # pixels of the longer or shorter side from which a film is HD


def usual_matrix(height: int, width: int) -> int:
    """The matrix of an untagged film of this size, either way up: BT.709 from 720 lines or 1280 columns on, BT.601
    below.
    """
    is_hd = min(height, width) >= _HD_SHORT or max(height, width) >= _HD_LONG
    return _BT709 if is_hd else _BT601


def to_yuv420(pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h15 w"]:
    """RGB with even sides as planes below each other (FFmpeg's yuv420p), limited range, with :func:`usual_matrix`."""
    height, width = pixels.shape[:2]
    inverse = np.linalg.inv(_to_rgb(usual_matrix(height, width)))
    luma, blue, red = np.moveaxis(pixels.astype(np.float32) / 255 @ inverse.T.astype(np.float32), -1, 0)
    planes = [16 + 219 * luma] + [
        128 + 224 * one.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3)) for one in (blue, red)
    ]
    return np.concatenate([np.rint(plane).astype(np.uint8).reshape(-1) for plane in planes]).reshape(
        height * 3 // 2, width
    )


def tag(context: Any, height: int, width: int) -> None:
    """Give an encoder the tags of what :func:`to_yuv420` makes: sRGB's primaries, and BT.709's curve as is
    customary.
    """
    context.colorspace, context.color_range = usual_matrix(height, width), 1
    context.color_primaries = context.color_trc = 1


def to_rgb(frame: Any, height: int, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """A decoded frame at a size (of PyAV, as stored), by its tags."""
    if frame.format.is_rgb or len(frame.format.components) < 3:  # there is no matrix
        return frame.reformat(width=width, height=height, format="rgb24").to_ndarray()
    is_full = int(frame.color_range) == _FULL_RANGE or frame.format.name.startswith("yuvj")
    matrix = int(frame.colorspace)
    if matrix not in _LUMA and matrix != _YCGCO:
        matrix = usual_matrix(frame.height, frame.width)
    planes, top = _full_size_planes(frame, height, width)
    offset, span = (0, (255, 255, 255)) if is_full else (16, (219, 224, 224))
    zero, unit = (np.array(values, dtype=np.float32) for values in ((offset, 128, 128), span))
    yuv = (planes * np.float32(255 / top) - zero) / unit
    return np.rint((yuv @ _to_rgb(matrix).T.astype(np.float32)).clip(0, 1) * 255).astype(np.uint8)


def _full_size_planes(frame: Any, height: int, width: int) -> tuple[Float[np.ndarray, "h w 3"], float]:
    """Luma and differences as they are coded, each for every pixel, and what stands for 255 in 8 bits."""
    deep = max(component.bits for component in frame.format.components) > 8
    same = {"src_colorspace": "ITU709", "dst_colorspace": "ITU709", "src_color_range": 2, "dst_color_range": 2}
    scaled = frame.reformat(width=width, height=height, format="yuv444p16le" if deep else "yuv444p", **same)
    planes = scaled.to_ndarray().astype(np.float32)
    return (np.moveaxis(planes, 0, -1) if planes.shape[0] == 3 else planes), 255.0 * 256 if deep else 255.0


def _to_rgb(matrix: int) -> Float[np.ndarray, "3 3"]:
    """From luma in [0, 1] and two differences in [-.5, .5] to RGB."""
    if matrix == _YCGCO:
        return np.array([[1.0, -1.0, 1.0], [1.0, 1.0, 0.0], [1.0, -1.0, -1.0]])
    red, blue = _LUMA[matrix]
    green = 1 - red - blue
    from_red, from_blue = 2 * (1 - red), 2 * (1 - blue)
    return np.array([[1, 0, from_red], [1, -from_blue * blue / green, -from_red * red / green], [1, from_blue, 0]])
