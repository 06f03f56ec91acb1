"""Films made on the way, with numbered or panned frames."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

HEIGHT, WIDTH = 96, 160


def write_film(
    path: Path, frames: list[np.ndarray], *, times: list[int] | None = None, rotation: int = 0, **options: str
) -> Path:
    """A film of RGB frames (uint8, [h, w, 3]); ``times`` in thirtieths of a second; ``rotation`` in degrees
    counterclockwise.
    """
    codec = {".avi": "mpeg4", ".webm": "libvpx-vp9"}.get(path.suffix, "libx264")
    muxing = {"movflags": options.pop("movflags")} if "movflags" in options else {}
    with av.open(str(path), "w", options=muxing) as container:
        stream = container.add_stream(
            codec, rate=30, options={"preset": "ultrafast", "qp": "12", **options} if codec == "libx264" else {}
        )
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 4_000_000
        stream.codec_context.time_base = Fraction(1, 30)
        if rotation:
            stream.set_display_rotation(rotation)
        for index, array in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(array), format="rgb24")
            frame.pts, frame.time_base = index if times is None else times[index], Fraction(1, 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def texture(seed: int = 0, scale: int = 8) -> np.ndarray:
    """A wide smooth pattern with detail of ``scale`` pixels: uint8 [h, w, 3]."""
    coarse = np.random.default_rng(seed).random((3 * HEIGHT // scale, 20 * WIDTH // scale, 3)).astype(np.float32)
    return (cv2.resize(coarse, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR) * 255).astype(np.uint8)


def pan(offsets: list[int]) -> list[np.ndarray]:
    """What a camera sees whose picture moves along a wide pattern to the given places (pixels)."""
    wide = texture()
    return [wide[HEIGHT : 2 * HEIGHT, offset : offset + WIDTH] for offset in offsets]


def numbered(number: int) -> np.ndarray:
    """A frame that tells its number: ten black or white blocks above a grey field."""
    frame = np.full((HEIGHT, WIDTH, 3), 128, dtype=np.uint8)
    for bit in range(10):
        frame[:32, bit * 16 : bit * 16 + 16] = 255 * (number >> bit & 1)
    return frame
