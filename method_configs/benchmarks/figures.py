"""Figures of benchmarks and evaluations: one manner, signed by the command that drew them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from fb_core.files.ownership import signature
from fb_core.files.whole import whole_file

_LETTERS_PER_INCH = 27  # of the smallest print
_logger = logging.getLogger(__name__)


def new_axes(label: str) -> tuple[Any, Any]:
    """A figure, and its axes with a label for what is measured."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 4.5), layout="constrained")
    axes.set_ylabel(label)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def save_figure(figure: Any, path: Path, origin: str = "") -> None:
    """Write a figure, whole or not at all, and say so; ``origin`` stands small above it."""
    import textwrap

    from matplotlib import pyplot

    if origin:
        lines = textwrap.wrap(origin, int(_LETTERS_PER_INCH * figure.get_figwidth()))
        figure.suptitle("\n".join(lines), fontsize=5, color="gray", parse_math=False)
    with whole_file(path) as unfinished:
        figure.savefig(unfinished, dpi=150, metadata=signature(path))
    pyplot.close(figure)
    _logger.info("wrote %s", path)
