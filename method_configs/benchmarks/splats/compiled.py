"""The compiled library beside torch, in turns: CPU seconds on one thread, and by the clock on as many as are free."""

from __future__ import annotations

import statistics
import time
from typing import Any

from torch import Tensor

from fb_core.machine.resources import usable_cores
from fb_core.splatting.compiled.threads import fixed_threads
from fb_core.splatting.rasterizer import Engine, rasterization
from method_configs.benchmarks.splats.scenes import SplatScene


def compiled_rows(scene: SplatScene, runs: int) -> list[dict[str, Any]]:
    """One row for one thread (CPU seconds) and one for all cores (seconds by the clock), each beside torch's own one
    thread in the same turns.
    """
    rows = []
    for threads in sorted({1, usable_cores()}):
        clock = time.process_time if threads == 1 else time.perf_counter
        taken: dict[Engine, list[tuple[float, float]]] = {"torch": [], "compiled": []}
        with fixed_threads(threads):
            for _ in range(runs):
                for engine, times in taken.items():
                    times.append(_seconds(scene, engine, clock))
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


def draw_compiled(**inputs: Any) -> tuple[Tensor, Tensor]:
    """Colours with depth, and alphas."""
    return rasterization(**inputs, render_mode="RGB+D", engine="compiled")[:2]


def _seconds(scene: SplatScene, engine: Engine, clock: Any) -> tuple[float, float]:
    """Forward, and forward and backward without the loss between them."""
    inputs = scene.inputs(gradients=True)
    begin = clock()
    images, alphas = rasterization(**inputs, render_mode="RGB+D", engine=engine)[:2]
    middle = clock()
    loss = images.square().sum() + alphas.sum()
    again = clock()
    loss.backward()
    end = clock()
    return middle - begin, (middle - begin) + (end - again)
