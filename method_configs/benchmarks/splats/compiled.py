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

_IN_A_ROW = 4


def compiled_rows(scene: SplatScene, runs: int) -> list[dict[str, Any]]:
    """One row for one thread (CPU seconds) and one for all cores (seconds by the clock), each beside torch's own one
    thread, and beside the library on one thread, in the same turns. In a turn a way draws several times, as a training
    does, and the first time does not count: it takes memory anew that the way before it has given back.
    """
    rows = []
    for threads in sorted({1, usable_cores()}):
        clock = time.process_time if threads == 1 else time.perf_counter
        ways: dict[str, tuple[Draw, int]] = {"torch": (draw_torch, 1), "one": (draw_compiled, 1)}
        if threads > 1:
            ways["all"] = (draw_compiled, threads)
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in ways}
        for _ in range(runs):
            for name, (draw, used) in ways.items():
                with fixed_threads(used):
                    drawn = [seconds_of(draw, scene, clock) for _ in range(_IN_A_ROW)]
                    taken[name].extend(drawn[1:])
        medians = {
            name: tuple(statistics.median(part) for part in zip(*times, strict=True)) for name, times in taken.items()
        }
        (slow_forward, slow), (_, one), (forward, both) = medians["torch"], medians["one"], [*medians.values()][-1]
        rows.append({
            "part": "compiled", "scene": scene.name, "threads": threads,
            "clock": "CPU" if threads == 1 else "wall", "forward_seconds": forward, "both_seconds": both,
            "torch_forward_seconds": slow_forward, "torch_both_seconds": slow,
            "forward_ratio": slow_forward / forward, "both_ratio": slow / both, "over_one_thread": one / both,
        })  # fmt: skip
    return rows


def draw_torch(**inputs: Any) -> tuple[Tensor, Tensor]:
    """Colours with depth, and alphas, by torch alone."""
    return rasterization(**inputs, render_mode="RGB+D", engine="torch")[:2]


def draw_compiled(**inputs: Any) -> tuple[Tensor, Tensor]:
    """Colours with depth, and alphas, by the compiled library."""
    return rasterization(**inputs, render_mode="RGB+D", engine="compiled")[:2]
