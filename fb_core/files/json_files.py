"""JSON that others wrote, read within bounds: a file that is too large, too deep or no JSON at all is a ValueError,
never more.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

MOST_BYTES = 2**27
"""Of a file; a hundred thousand cameras take about half of it."""
_MOST_DIGITS = 20  # of an integer that 64 bits may hold, its sign included


def read_json(path: Path, *, most_bytes: int = MOST_BYTES) -> Any:
    """What a file holds. Raises ValueError with the reason, without the file's name; OSError for one that cannot be
    read.
    """
    size = path.stat().st_size
    if size > most_bytes:
        raise ValueError(f"it has {size / 2**20:.0f} MiB, expected at most {most_bytes / 2**20:.0f}")
    return parse_json(path.read_bytes())


def parse_json(text: bytes) -> Any:
    """The value of a text in UTF-8 (with or without a byte order mark), -16 or -32.

    Numbers beyond the range of doubles, and integers that no 64 bits hold, become floats (possibly infinite): whoever
    asks for a finite number finds them. Raises ValueError with the reason.
    """
    try:
        return json.loads(text, parse_int=_integer)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"it is no text: {error.reason} at byte {error.start}") from None


def _integer(digits: str) -> int | float:
    number = int(digits) if len(digits) <= _MOST_DIGITS else float(digits)
    return number if -(2**63) <= number < 2**64 else float(number)
