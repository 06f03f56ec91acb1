"""How large input may be, asked before any of it is decoded, allocated or built: what is larger is refused in one
sentence.

The numbers are far above all that cameras, films and models have, and far below what takes a machine down.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fb_core.machine.resources import free_memory_bytes

MOST_PIXELS = 2**28
"""Of a picture (16384 x 16384; the largest cameras have 2**27)."""
MOST_FILM_PIXELS = 2**26
"""Of a film's frame as it is shown (8192 x 8192)."""
MOST_SIDE = 8192
"""Pixels of a generated view's side."""
MOST_VIEWS = 10_000
"""Of a camera path, of a sequence, of a capture's photos that a model is shown."""
MOST_SAMPLING_STEPS = 10_000
"""Of one sampling."""
MOST_TRAINING_STEPS = 10**9
"""Of one stage of a training."""
MOST_SEED = 2**32 - 1
"""Of whatever is drawn (NumPy takes no larger one)."""
_DECODED_BYTES = 9  # per pixel and channel while a picture is read: 8 bits, 32 bits, and 32 bits upright
_GIB = 2**30
_MODEL = {
    "heads": 1024,
    "head_dim": 1024,
    "depth": 512,
    "patch": 64,
    "in_channels": 8192,
    "out_channels": 8192,
    "text_width": 65536,
    "mlp_ratio": 64,
    "widths": 16384,
    "latent_channels": 4096,
    "encoder_resnets": 64,
    "decoder_resnets": 64,
    "norm_groups": 16384,
}
"""Most of every size in a model's configuration; the released transformer has 16 heads of 64 channels and 24 blocks."""


def require_between(name: str, value: float, least: float, most: float) -> None:
    """Raise a ValueError unless ``least <= value <= most`` (NaN is not)."""
    if not least <= value <= most:
        raise ValueError(f"{name}: expected {least:g} to {most:g}, got {_short(value)}")


def require_whole(name: str, value: object, least: int, most: int | None = None) -> None:
    """Raise a ValueError unless ``value`` is an integer (no truth value) of at least ``least``, and at most ``most`` if
    that is given.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise ValueError(f"{name}: expected a whole number, got {value!r:.40}")
    if most is None and value < least:
        raise ValueError(f"{name}: expected at least {least}, got {_short(int(value))}")
    if most is not None:
        require_between(name, int(value), least, most)


def require_text_name(path: Path) -> None:
    """Raise a ValueError for a path whose bytes are no text in UTF-8, which the libraries for pictures and films do not
    take.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        shown = str(path).encode(errors="backslashreplace").decode()
        raise ValueError(f"{shown}: expected a name in UTF-8, got other bytes; rename it") from None


def require_model_sizes(sizes: Mapping[str, Any]) -> None:
    """Raise a ValueError that names the first size of an architecture, or of a part of it, that no model has."""
    for name, most in _MODEL.items():
        values = sizes.get(name)
        for value in values if isinstance(values, list | tuple) else (values,):
            if isinstance(value, int | float) and not value <= most:
                raise ValueError(f"{name}: expected at most {most}, got {_short(value)}.")


def require_decodable(where: str, height: float, width: float, channels: int, *, most: int = MOST_PIXELS) -> None:
    """Raise a ValueError, which begins with ``where``, for a picture with too many pixels, or more than free memory
    takes.

    Sizes are those of the file's header, so that nothing has been decoded yet.
    """
    pixels = height * width
    if not pixels <= most:
        raise ValueError(
            f"{where}: {width:g} x {height:g} pixels are too many, expected at most {most / 1e6:.0f} million; make it "
            "smaller"
        )
    require_room(where, _DECODED_BYTES * channels * pixels, f"{width:g} x {height:g} pixels")


def require_room(where: str, needed: float, what: str) -> None:
    """Raise a ValueError, which begins with ``where``, if ``what`` needs more bytes than are free."""
    free = free_memory_bytes()
    if free is not None and needed > free:
        raise ValueError(
            f"{where}: {what} need {needed / _GIB:.2f} GiB of memory, but {free / _GIB:.2f} GiB are free; make it "
            "smaller"
        )


def _short(value: float) -> str:
    """A number in few digits: an integer may have thousands."""
    try:
        return f"{value:g}" if abs(value) >= 10**15 or isinstance(value, float) else str(value)
    except OverflowError:
        return "a number beyond 1e308"


def is_finite(value: Any) -> bool:
    """Whether a value is a finite number, and no truth value."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of more than 308 digits
        return False
