"""The compiled library beside torch, in turns: CPU seconds on one thread, and by the clock on as many as are free."""

from __future__ import annotations

import statistics
import time
from typing import Any

from torch import Tensor

from fb_core.machine.resources import usable_cores
from fb_core.splatting.compiled.threads import fixed_threads
from fb_core.splatting.rasterizer import rasterization
from method_configs.benchmarks.splats.drawing import Draw, seconds_of
from method_configs.benchmarks.splats.scenes import SplatScene


def compiled_rows(scene: SplatScene, runs: int) -> list[dict[str, Any]]:
    """One row for one thread (CPU seconds) and one for all cores (seconds by the clock), each beside torch's own one
    thread in the same turns.
    """
    rows = []
    for threads in sorted({1, usable_cores()}):
        clock = time.process_time if threads == 1 else time.perf_counter
        taken: dict[Draw, list[tuple[float, float]]] = {draw_torch: [], draw_compiled: []}
        with fixed_threads(threads):
            for _ in range(runs):
                for draw, times in taken.items():
                    times.append(seconds_of(draw, scene, clock))
        (slow_forward, slow), (forward, both) = (
            tuple(statistics.median(part) for part in zip(*times, strict=True)) for times in taken.values()
        )
        rows.append({
            "part": "compiled", "scene": scene.name, "threads": threads,
            "clock": "CPU" if threads == 1 else "wall", "forward_seconds": forward, "both_seconds": both,
            "torch_forward_seconds": slow_forward, "torch_both_seconds": slow,
            "forward_ratio": slow_forward / forward, "both_ratio": slow / both,
        })  # fmt: skip
    return rows


def draw_torch(**inputs: Any) -> tuple[Tensor, Tensor]:
    """Colours with depth, and alphas, by torch alone."""
    return rasterization(**inputs, render_mode="RGB+D", engine="torch")[:2]


def draw_compiled(**inputs: Any) -> tuple[Tensor, Tensor]:
    """Colours with depth, and alphas, by the compiled library."""
    return rasterization(**inputs, render_mode="RGB+D", engine="compiled")[:2]
