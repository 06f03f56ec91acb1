"""``fillerbuster bench``: its options; measures, shows a table, writes JSON and a figure. Heavy imports wait until it
runs.
"""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from method_configs.benchmarks.figures import new_axes, save_figure

if TYPE_CHECKING:
    from fb_core.evaluation.results import Report

_logger = logging.getLogger(__name__)
_WIDEST_TABLE = 8
_ALWAYS_SHOWN = (
    *("method", "room", "covered_psnr", "uncovered_psnr", "uncovered_hole_share", "consistency_psnr"),
    *("block_psnr", "seconds", "peak_gib"),
    *("scene", "peer", "views", "size", "steps", "parameters", "relative_difference"),
    *("rotation_degrees", "center", "focal_percent", "found_share", "trusted_share", "rra_15", "rta_15", "rooms"),
    *("capture", "rra_2", "rra_5", "rra_10", "median_degrees", "failed", "still_5"),
    *("model", "normals", "psnr", "ssim", "lpips", "val", "device", "how", "paper_a100_seconds"),
    *("design", "psnr_sample_gain", "psnr_sample_spread", "val_gain", "val_spread"),
    *("threads", "features_seconds", "matches_seconds", "cameras_seconds", "equal_to_one_thread"),
    *("build", "times_as_fast", "psnr_gain", "psnr_gain_error"),
    *("case", "cpu_seconds", "rotation_degrees_median", "rotation_degrees_max", "plain_rotation_degrees_median"),
)


@dataclass(frozen=True, kw_only=True)
class Networks:
    """Sampling with our networks against the original's way of doing it: time, memory and difference."""

    json: Path | None = None
    """Write all measurements to this file."""
    figure: Path | None = None
    """Draw a chart into this file (png, svg or pdf)."""
    quick: bool = False
    """A miniature that shows that everything runs; its times mean nothing."""
    views: tuple[int, ...] = (8, 16, 40)
    """Numbers of views of whole samplings."""
    sizes: tuple[int, ...] = (128, 256)
    """Their sides in pixels."""
    full_size: bool = True
    """Also time one step of the released architecture (takes 4 GB of memory)."""
    seed: int = 0
    """Decides weights and inputs."""

    def run(self) -> None:
        """Measure and report."""
        import dataclasses

        from method_configs.benchmarks import networks as benchmark

        config = benchmark.QUICK
        if not self.quick:
            cells = tuple((views, size) for size in self.sizes for views in self.views)
            config = dataclasses.replace(benchmark.NetworksBenchmark(), cells=cells)
            config = config if self.full_size else dataclasses.replace(config, full_size=None)
        config = dataclasses.replace(config, seed=self.seed)
        report = benchmark.run_networks(config, on_cell=_say)
        figure = self.figure
        show(report, self.json, [] if figure is None else [lambda: _draw_networks(report, figure)])


@dataclass(frozen=True, kw_only=True)
class Precision:
    """Whole samplings in bfloat16 against float32, over guidance scales and numbers of views."""

    json: Path | None = None
    """Write all measurements to this file."""
    figure: Path | None = None
    """Draw a chart into this file (png, svg or pdf)."""
    quick: bool = False
    """A miniature that shows that everything runs."""
    model: Path | None = None
    """Model folder; by default a tiny random model."""
    seed: int = 0
    """Decides weights and inputs."""

    def run(self) -> None:
        """Measure and report."""
        import dataclasses

        from fb_core.inpainter import Fillerbuster
        from method_configs.benchmarks import precision as benchmark

        config = dataclasses.replace(benchmark.QUICK if self.quick else benchmark.PrecisionBenchmark(), seed=self.seed)
        model = None if self.model is None else Fillerbuster.from_pretrained(self.model)
        report = benchmark.run_precision(config, model, on_cell=_say)
        figure = self.figure
        show(report, self.json, [] if figure is None else [lambda: _draw_precision(report, figure)])


def show(report: Report, json: Path | None, drawings: list) -> None:
    """Tables of the rows and bars on the terminal, then the files.."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for part in dict.fromkeys(row["part"] for row in report.rows):
        rows = [row for row in report.rows if row["part"] == part]
        table = Table(title=part)
        columns = [name for name in rows[0] if name != "part"]
        if len(columns) > _WIDEST_TABLE:  # the file has them all
            columns = [
                name for name in columns if "ratio" in name or name in _ALWAYS_SHOWN or name == "sampling_seconds"
            ]
        for name in columns:
            table.add_column(name.replace("_", " "), justify="right")
        for row in rows:
            table.add_row(*(_told(row[name]) for name in columns))
        console.print(table)
    for bar in report.bars:
        console.print(
            f"{'holds ' if bar.holds else 'MISSED'}  {bar.name}: {_told(bar.value)} (bar {bar.sense} {bar.limit:g})"
        )
    if json is not None:
        _logger.info("wrote %s", report.write(json, command=command_line()))
    for draw in drawings:
        draw()


def _say(cell: str) -> None:
    _logger.info("measuring %s", cell)


def _told(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def command_line() -> str:
    """What was typed, without the folder of the program."""
    return " ".join(["fillerbuster", *sys.argv[1:]])


def _draw_networks(report: Report, path: Path) -> None:
    """Two bars per cell: the original's way and ours."""
    rows = [row for row in report.rows if row["part"] == "sampling"]
    labels = [f"{row['views']} views\nof {row['size']}" for row in rows]
    figure, axes = new_axes("seconds per sampling")
    places = range(len(rows))
    axes.bar(
        [place - 0.2 for place in places],
        [row["sampling_plain_seconds"] for row in rows],
        0.4,
        label="as the original does it",
    )
    axes.bar([place + 0.2 for place in places], [row["sampling_seconds"] for row in rows], 0.4, label="ours")
    for place, row in zip(places, rows, strict=True):
        axes.annotate(f"{row['sampling_ratio']:.2f}x", (place + 0.2, row["sampling_seconds"]), ha="center", va="bottom")
    axes.set_xticks(list(places), labels)
    axes.set_yscale("log")
    axes.legend()
    save_figure(figure, path)


def _draw_precision(report: Report, path: Path) -> None:
    """Mean error of the images over guidance, one line per number of views."""
    figure, axes = new_axes("mean error of generated pixels (range 0 to 1)")
    for count in dict.fromkeys(row["views"] for row in report.rows):
        rows = [row for row in report.rows if row["views"] == count]
        axes.plot(
            [row["guidance"] for row in rows],
            [row["image_mean_error"] for row in rows],
            marker="o",
            label=f"{count} views",
        )
    axes.set_xlabel("guidance scale of unknown content")
    axes.set_yscale("log")
    axes.legend()
    save_figure(figure, path)
