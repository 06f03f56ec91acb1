"""360-degree photos and panoramas: pictures that no lens takes at once, so that no camera of ours describes them."""

from __future__ import annotations

import re
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from fb_core.data.media import shrink

_LONGEST = 3.0  # longer over shorter side from which a picture is a panorama; the longest film format has 2.7
_SIDE = 96  # of the small copy that is looked at
_SMOOTH = 2.0  # times the usual difference between neighbouring columns, up to which the picture goes on at its edge
_FAR = 0.5  # times the usual difference between opposite columns, below which that is no accident
_LEAST_STRUCTURE = 0.04  # deviation along the columns at the edge; before a plain background they tell nothing
_HEADER = 1 << 18  # bytes of a file in which its XMP data stand
_PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*(\w+)")
_ADVICE = "cut it into views first, for example with `ns-process-data {kind} --camera-type equirectangular`"


def panorama_fault(path: Path, image: Float[Tensor, "3 h w"]) -> str:
    """Why a picture is no photo of one camera, in words that follow its name, with what to do; empty if it may be one.

    Args:
        path: its file, whose XMP data may tell (Google's GPano tags).
        image: RGB in [0, 1].
    """
    height, width = image.shape[1:]
    projection = _projection(path)
    if (projection == "equirectangular" and width == 2 * height) or goes_on_at_its_edge(image):
        return around_fault((height, width), kind="images")
    if projection or max(width, height) >= _LONGEST * min(width, height):
        return f"a panorama ({width} x {height}), expected a picture taken through a single lens; use the single photos"
    return ""


def around_fault(size: tuple[int, int], *, kind: str) -> str:
    """What to say of a 360-degree picture of a size (height, width), or of "video" of them, and what to do."""
    return (
        f"a 360-degree picture ({size[1]} x {size[0]}, equirectangular), expected one taken through a single lens; "
        + _ADVICE.format(kind=kind)
    )


def goes_on_at_its_edge(image: Float[Tensor, "3 h w"]) -> bool:
    """Whether a picture is twice as wide as high and its left edge continues its right one, as in an equirectangular
    projection.
    """
    height, width = image.shape[1:]
    if width != 2 * height or height < 16:
        return False
    small = shrink(image, _SIDE)
    columns = small.shape[2]
    beside = (small - small.roll(1, dims=2)).abs().mean(dim=(0, 1))  # the first is that across the edge
    opposite = (small - small.roll(columns // 2, dims=2)).abs().mean(dim=(0, 1))
    structure = small[:, :, [0, -1]].std(dim=1).mean()
    edge, usual = float(beside[0]), float(beside[1:].median())
    return (
        edge <= _SMOOTH * usual + 1e-3
        and edge <= _FAR * float(opposite.median())
        and float(structure) >= _LEAST_STRUCTURE
    )


def _projection(path: Path) -> str:
    """What the file's GPano tags call its projection; empty without such tags."""
    try:
        with path.open("rb") as file:
            tag = _PROJECTION.search(file.read(_HEADER))
    except OSError:
        return ""
    return tag.group(1).decode("ascii", "replace").lower() if tag else ""
