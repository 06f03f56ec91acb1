"""Labelled sheets of pictures: rows with a heading, pictures with a caption, one PNG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.files.ownership import signature
from fb_core.files.whole import whole_file

_CELL_INCHES = 1.45
_HEADING_INCHES, _CAPTION_INCHES, _TITLE_INCHES, _MARGIN_INCHES = 0.36, 0.22, 0.62, 0.15
_HEADING_POINTS, _CAPTION_POINTS, _TITLE_POINTS, _SUBTITLE_POINTS = 12, 9, 17, 11


@dataclass(frozen=True, kw_only=True)
class Strip:
    """Pictures that belong together; they wrap into as many lines as they need."""

    heading: str
    """Stands above the pictures."""
    pictures: Sequence[Float[Tensor, "3 _h _w"]]
    """RGB in [0, 1]; sizes may differ."""
    captions: Sequence[str] | None = None
    """One under each picture; None for none."""

    def __post_init__(self) -> None:
        if self.captions is not None and len(self.captions) != len(self.pictures):
            raise ValueError(
                f"strip {self.heading!r}: expected {len(self.pictures)} captions, one for each picture, got "
                f"{len(self.captions)}"
            )


def evenly(items: Sequence, count: int) -> list:
    """At most ``count`` of the items, evenly spread, first and last included."""
    if len(items) <= count:
        return list(items)
    return [items[index] for index in torch.linspace(0, len(items) - 1, count).round().long().tolist()]


def write_contact_sheet(
    path: Path, strips: Sequence[Strip], *, title: str, subtitle: str = "", columns: int = 8, dpi: int = 150
) -> None:
    """Draw the strips below each other into a PNG; pixels stay sharp.

    Args:
        path: the picture's file; missing folders are made.
        strips: strips without pictures are left out.
        title: stands at the top.
        subtitle: a second, smaller line.
        columns: pictures per line.
        dpi: pixels per inch; a picture is about 1.4 inches wide.

    Raises ValueError when no strip has a picture, and CannotWrite when the disk is full; an earlier picture then
    stands.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    strips = [strip for strip in strips if len(strip.pictures) > 0]
    if not strips:
        raise ValueError("contact sheet: expected at least one picture, got none")
    width = columns * _CELL_INCHES + 2 * _MARGIN_INCHES
    height = _TITLE_INCHES + sum(_strip_inches(strip, columns) for strip in strips) + _MARGIN_INCHES
    figure = pyplot.figure(figsize=(width, height), dpi=dpi, facecolor="white")
    try:
        left = _MARGIN_INCHES / width
        figure.text(left, 1 - 0.10 / height, title, fontsize=_TITLE_POINTS, fontweight="bold", va="top")
        figure.text(left, 1 - 0.42 / height, subtitle, fontsize=_SUBTITLE_POINTS, color="0.3", va="top")
        top = height - _TITLE_INCHES
        for strip in strips:
            _draw_strip(figure, strip, columns, top)
            top -= _strip_inches(strip, columns)
        with whole_file(path) as unfinished:
            figure.savefig(unfinished, format="png", metadata=signature(Path("sheet.png")))
    finally:
        pyplot.close(figure)


def _line_inches(strip: Strip) -> float:
    return _CELL_INCHES + (0.0 if strip.captions is None else _CAPTION_INCHES)


def _strip_inches(strip: Strip, columns: int) -> float:
    return _HEADING_INCHES + math.ceil(len(strip.pictures) / columns) * _line_inches(strip)


def _draw_strip(figure, strip: Strip, columns: int, top: float) -> None:
    """Heading, pictures and captions; ``top`` in inches from the lower edge of the figure."""
    width, height = figure.get_size_inches()
    line = (top - _HEADING_INCHES + 0.07) / height
    figure.text(_MARGIN_INCHES / width, line, strip.heading, fontsize=_HEADING_POINTS, fontweight="bold", va="bottom")
    side = _CELL_INCHES * 0.965
    for index, picture in enumerate(strip.pictures):
        line, column = divmod(index, columns)
        left = _MARGIN_INCHES + column * _CELL_INCHES
        lower = top - _HEADING_INCHES - line * _line_inches(strip) - _CELL_INCHES
        axes = figure.add_axes((left / width, lower / height, side / width, side / height))
        axes.imshow(picture.detach().float().clamp(0, 1).movedim(0, -1).cpu().numpy(), interpolation="nearest")
        axes.set_axis_off()
        if strip.captions is not None:
            figure.text(
                (left + side / 2) / width,
                (lower - 0.04) / height,
                strip.captions[index],
                fontsize=_CAPTION_POINTS,
                ha="center",
                va="top",
            )
