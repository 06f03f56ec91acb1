"""What every benchmark shares: fair timing, bars to hold, and one JSON form (docs/speed_and_accuracy.md is made from
these files).
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch

from fb_core.files.whole import whole_file
from fb_core.machine.resources import usable_cores

OnCell = Callable[[str], None]
"""Told what is measured next."""


@dataclass(frozen=True, kw_only=True)
class Bar:
    """A claim that a benchmark checks."""

    name: str
    """What is claimed."""
    value: float
    """What was measured."""
    limit: float
    """What it is held against."""
    sense: Literal["<=", ">="]
    """Whether the value may be at most or must be at least the limit."""

    @property
    def holds(self) -> bool:
        """Whether the claim was met; NaN never meets one."""
        return self.value <= self.limit if self.sense == "<=" else self.value >= self.limit


@dataclass(frozen=True, kw_only=True)
class Report:
    """What a benchmark found."""

    seed: int
    """Decides weights and inputs."""
    rows: list[dict[str, Any]] = field(default_factory=list)
    """Measurements; every row says what it is of and carries its error beside its time."""
    bars: list[Bar] = field(default_factory=list)
    """Claims."""

    def write(self, path: str | os.PathLike[str], *, command: str) -> Path:
        """Write the JSON file. Raises ValueError if a row holds what JSON cannot (NaN is written as null)."""
        content = {
            "command": command,
            "commit": commit(),
            "hardware": hardware(),
            "seed": self.seed,
            "rows": [{key: _plain(value) for key, value in row.items()} for row in self.rows],
            "bars": [
                {
                    "name": bar.name,
                    "value": _plain(bar.value),
                    "limit": bar.limit,
                    "sense": bar.sense,
                    "holds": bar.holds,
                }
                for bar in self.bars
            ],
        }
        path = Path(path)
        text = json.dumps(content, indent=2, allow_nan=False) + "\n"
        with whole_file(path) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
        return path


def median_seconds(
    jobs: Mapping[str, Callable[[], object]],
    runs: int,
    *,
    warm_up: bool = True,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median time of each job, by default by the clock on the wall. Every run does all jobs in turn, so that a busy
    moment of the machine meets all of them.
    """
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for run in range(runs + warm_up):
        for name, job in jobs.items():
            begin = clock()
            job()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if run >= warm_up:
                times[name].append(clock() - begin)
    return {name: statistics.median(values) for name, values in times.items()}


def peak_megabytes(job: Callable[[], object]) -> float:
    """Most resident memory of a job beyond what this process held before it, MB; NaN where the system does not tell
    (not Linux).
    """
    gc.collect()
    try:
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    except (OSError, AttributeError):
        return float("nan")
    before = _status("VmRSS")
    job()
    return (_status("VmHWM") - before) / 1024


def _status(name: str) -> int:
    """An entry of the process' status, kB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name + ":"))


def relative_difference(got: torch.Tensor, wanted: torch.Tensor) -> float:
    """Largest difference over the largest value."""
    return float((got - wanted).abs().max() / wanted.abs().max().clamp(min=1e-30))


def hardware() -> str:
    """Processor, threads and torch in one line."""
    name = platform.processor() or platform.machine()
    table = Path("/proc/cpuinfo")
    if table.exists():
        models = [
            line.split(":", 1)[1].strip() for line in table.read_text().splitlines() if line.startswith("model name")
        ]
        name = models[0] if models else name
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    return f"{name}, {usable_cores()} cores, {torch.get_num_threads()} threads{gpu}, torch {torch.__version__}"


def commit(where: Path = Path(__file__).resolve().parent) -> str:
    """Commit of the working tree that a folder, by default this code's, stands in, or 'unknown' outside of one."""
    try:
        done = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=where, capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip() if done.returncode == 0 else "unknown"


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
