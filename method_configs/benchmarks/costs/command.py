"""``fillerbuster bench costs``: seconds and memory over the size of a scene, and the power by which they grow."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from method_configs.benchmarks.table_files import TableFiles, origin_of

if TYPE_CHECKING:
    from fb_core.evaluation.results import Report
    from method_configs.benchmarks.costs.curves import Curve

_RUNS = 5
_LEAST_MEGABYTES = 1.0  # below, what is resident grows by whatever the allocator likes
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Costs(TableFiles):
    """CPU seconds and memory over captured views, the share of them that is known, Gaussians and pixels, with the
    exponent of each curve.
    """

    quick: bool = False
    """A miniature that shows that everything runs; its figures mean nothing."""

    def run(self) -> None:
        """Measure what was not measured before, and report."""
        from rich.progress import track

        from fb_core.evaluation.results import Report
        from method_configs.benchmarks.costs import curves as benchmark

        sizes, runs = (benchmark.QUICK, 1) if self.quick else (benchmark.Sizes(), _RUNS)
        report = Report(seed=self.seed)
        for curve in track(benchmark.curves(sizes, self.seed), description="costs", transient=True):
            _logger.info("measuring %s over %s", curve.name, curve.of)
            report.rows.extend(self._rows(curve, runs))
        report.rows.extend(exponents(report.rows))
        self.publish(report, draw)

    def _rows(self, curve: Curve, runs: int) -> list[dict[str, Any]]:
        """A curve's cells: their runs in turns, after one run each whose memory is looked at."""
        from fb_core.evaluation.results import commit, hardware

        def measure() -> list[dict[str, Any]]:
            import time

            from fb_core.evaluation.results import median_seconds, peak_megabytes

            jobs = {str(size): curve.job(size) for size in curve.sizes}
            jobs[str(curve.sizes[0])]()  # what is set up at first use is no job's memory
            memory = {name: peak_megabytes(job) for name, job in jobs.items()}
            seconds = median_seconds(jobs, runs, warm_up=False, clock=time.process_time)
            return [
                {
                    "part": f"{curve.name}, over {curve.of}", "curve": curve.name, "of": curve.of, "size": size,
                    "cpu_seconds": seconds[str(size)], "peak_mb": memory[str(size)],
                }
                for size in curve.sizes
            ]  # fmt: skip

        asked = {
            "curve": curve.name, "of": curve.of, "sizes": list(curve.sizes), "runs": runs, "seed": self.seed,
            "commit": commit(), "hardware": hardware(),
        }  # fmt: skip
        name = f"{curve.name} over {curve.of}".replace(" ", "-").replace(",", "").replace(":", "")
        return self.kept(name, asked, measure)


def exponents(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """For each curve the powers of its size by which seconds and memory grow, over all sizes and over the larger half
    of them; for shares known the last one's cost over that of the first.
    """
    found = []
    for part in dict.fromkeys(row["part"] for row in rows):
        cells = [row for row in rows if row["part"] == part]
        sizes = [row["size"] for row in cells]
        shares = cells[0]["of"] == "share known"
        summary = {"part": "ratios" if shares else "exponents", "curve": cells[0]["curve"], "of": cells[0]["of"]}
        summary |= {"from": sizes[0], "to": sizes[-1]}
        for name in ("cpu_seconds", "peak_mb"):
            values = [row[name] for row in cells]
            if shares:
                summary[f"{name}_first_over_last"] = values[0] / values[-1] if values[-1] > 0 else math.nan
                continue
            summary[f"{name}_exponent"] = exponent(sizes, values)
            half = len(sizes) // 2
            summary[f"{name}_exponent_of_larger_half"] = exponent(sizes[half:], values[half:])
        found.append(summary)
    return found


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """The power p of ``values`` ~ sizes^p: the least-squares slope of log values over log sizes, of values above 0;
    NaN for fewer than two of them.
    """
    points = [(math.log(size), math.log(value)) for size, value in zip(sizes, values, strict=True) if value > 0]
    if len(points) < 2:
        return math.nan
    across, up = (sum(numbers) / len(points) for numbers in zip(*points, strict=True))
    spread = sum((x - across) ** 2 for x, _ in points)
    return sum((x - across) * (y - up) for x, y in points) / spread if spread > 0 else math.nan


def draw(report: Report, path: Path) -> None:
    """Seconds above, memory below, over each kind of size; both axes logarithmic."""
    from matplotlib import pyplot

    from method_configs.benchmarks.figures import new_axes, save_figure

    pyplot.close(new_axes("")[0])  # chooses how figures are drawn
    cells = [row for row in report.rows if "size" in row]
    found = {(row["curve"], row["of"]): row for row in report.rows if "size" not in row}
    kinds = list(dict.fromkeys(row["of"] for row in cells))
    figure, axes = pyplot.subplots(2, len(kinds), figsize=(3.8 * len(kinds), 7.5), layout="constrained", squeeze=False)
    for column, of in enumerate(kinds):
        for curve in dict.fromkeys(row["curve"] for row in cells if row["of"] == of):
            rows = [row for row in cells if (row["curve"], row["of"]) == (curve, of)]
            for line, (name, least) in enumerate((("cpu_seconds", 0.0), ("peak_mb", _LEAST_MEGABYTES))):
                places = [(_across(row), row[name]) for row in rows if row[name] > least]
                label = f"{curve}: {_in_words(found[curve, of], name)}"
                axes[line, column].plot(*zip(*places, strict=True), marker="o", label=label) if places else None
        for line, what in enumerate(("CPU seconds", "memory (MB)")):
            one = axes[line, column]
            one.set(xscale="log", yscale="log", ylabel=what if column == 0 else "")
            one.set_xlabel("share unknown" if of == "share known" else of)
            one.spines[["top", "right"]].set_visible(False)
            if one.lines:
                one.legend(fontsize=6, loc="lower left", bbox_to_anchor=(0, 1), frameon=False)
    save_figure(figure, path, origin_of(report))


def _across(row: dict[str, Any]) -> float:
    return 1 - row["size"] if row["of"] == "share known" else row["size"]


def _in_words(summary: dict[str, Any], name: str) -> str:
    """A curve's exponent as its label says it."""
    if summary["of"] == "share known":
        return f"{summary[f'{name}_first_over_last']:.1f} times from {summary['to']:g} to {summary['from']:g} known"
    return f"{summary[f'{name}_exponent']:.2f} ({summary[f'{name}_exponent_of_larger_half']:.2f} of the larger half)"
