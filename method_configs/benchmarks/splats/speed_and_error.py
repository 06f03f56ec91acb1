"""``fillerbuster bench splat``: the torch rasterizer's time, memory and error, beside what else draws splats on a CPU,
and the floor.

Times are CPU seconds of one thread, so that a busy machine disturbs them less than a clock on the wall would; it still
does, by caches and memory that others use. `exp_per_second` says how fast the machine was in the same minute.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from fb_core.evaluation.results import Bar, OnCell, Report, peak_megabytes
from fb_core.splatting.compiled.library import loaded
from fb_core.splatting.rasterizer import rasterization
from fb_core.splatting.single_thread import single_thread
from fb_core.splatting.tiles import compositing as torch_compositing
from method_configs.benchmarks.splats.compiled import compiled_rows, draw_compiled, draw_torch
from method_configs.benchmarks.splats.drawing import Draw, loss_of, seconds_of
from method_configs.benchmarks.splats.peers import gsplat_kernels, gsplat_torch, tile_loop
from method_configs.benchmarks.splats.scenes import LEAVES, SplatScene, capture_scene, room_scene

SECONDS = {"10k@256": (0.06, 0.14), "50k@512": (0.13, 0.30), "200k@512": (0.5, 1.2)}
"""Bars: forward, forward and backward, on a machine that does 1e9 exponentials a second on one core."""
TIMES_FASTER = {"10k@256": (8.0, 5.0), "50k@512": (20.0, 13.0)}
"""Bars: over gsplat's torch functions with vectorised lists."""
MEGABYTES = {"50k@512": 150.0}
"""Bar: peak memory of forward and backward beyond the inputs."""
_IN_CACHE = 2**18


@dataclass(frozen=True, kw_only=True)
class SplatBenchmark:
    """What is measured."""

    cells: tuple[tuple[int, int], ...] = ((1000, 64), (10_000, 256), (50_000, 256), (50_000, 512), (200_000, 512))
    """Gaussians and picture side of each room scene."""
    capture: Path | None = None
    """An npz file of real points and cameras to draw as well."""
    runs: int = 7
    """Runs of ours, of which the median and the best are reported."""
    peer_runs: int = 2
    """Runs of the others; 0 leaves them out."""
    most_for_peers: int = 50_000
    """Gaussians from which on the others are left out: they would need minutes and gigabytes."""
    seed: int = 0
    """Decides rooms and Gaussians."""

    def __post_init__(self) -> None:
        if (
            not self.cells
            or min(number for cell in self.cells for number in cell) < 1
            or self.runs < 1
            or self.peer_runs < 0
        ):
            raise ValueError(
                "cells, runs, peer_runs: expected at least one cell of positive numbers, one run and 0 peer runs, got "
                f"{self.cells}, {self.runs}, {self.peer_runs}"
            )


QUICK = SplatBenchmark(cells=((300, 32),), runs=1, peer_runs=1)
"""A miniature that runs in seconds."""


def run_splat(config: SplatBenchmark = SplatBenchmark(), *, on_cell: OnCell = lambda _: None) -> Report:
    """Parts of the report: ours, compiled (where `fillerbuster compile` has run), peers, work (how much there is to do,
    and the floor), machine (best runs, its speed just then), gpu.
    """
    report = Report(seed=config.seed)
    scenes: list[Callable[[], SplatScene]] = [
        lambda c=count, s=size: room_scene(c, s, seed=config.seed) for count, size in config.cells
    ]
    if config.capture is not None:
        scenes.append(lambda: capture_scene(config.capture, seed=config.seed))  # type: ignore[arg-type]
    names = ("ours", "compiled", "peers", "work", "machine", "gpu")
    parts: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    with single_thread():
        for make in scenes:
            scene = make()
            on_cell(scene.name)
            _measure(scene, config, parts)
    report.rows.extend(row for rows in parts.values() for row in rows)
    report.bars.extend(_bars(parts))
    return report


def _measure(scene: SplatScene, config: SplatBenchmark, parts: dict[str, list[dict[str, Any]]]) -> None:
    """All rows of one scene."""
    exact = _picture_and_gradients(draw_torch, scene, torch.float64)
    errors = _errors(_picture_and_gradients(draw_torch, scene), exact)
    megabytes = _peak_megabytes(draw_torch, scene)
    others = {"gsplat torch": gsplat_torch, "tile loop": tile_loop} if len(scene.means) <= config.most_for_peers else {}
    peers = {}
    for name, draw in (others if config.peer_runs else {}).items():
        peers[name] = {**_errors(_picture_and_gradients(draw, scene), exact), "peak_mb": _peak_megabytes(draw, scene)}
    times: dict[str, list[tuple[float, float]]] = {"ours": [], **{name: [] for name in peers}}
    rates = []
    for run in range(config.runs):  # in turn, so that a busy moment of the machine meets all of them
        rates.append(_exponentials_per_second())
        times["ours"].append(seconds_of(draw_torch, scene))
        for name in peers if run < config.peer_runs else ():
            times[name].append(seconds_of(others[name], scene))
    forward, both = (statistics.median(taken) for taken in zip(*times["ours"], strict=True))
    parts["ours"].append(
        {
            "part": "ours",
            "scene": scene.name,
            "forward_seconds": forward,
            "both_seconds": both,
            "peak_mb": megabytes,
            **errors,
        }
    )
    for name, values in peers.items():
        slow_forward, slow_both = (statistics.median(taken) for taken in zip(*times[name], strict=True))
        parts["peers"].append({
            "part": "peers", "scene": scene.name, "peer": name, "forward_seconds": slow_forward,
            "both_seconds": slow_both,
            "forward_ratio": slow_forward / forward, "both_ratio": slow_both / both, **values,
        })  # fmt: skip
    if loaded(torch.float32) is not None:
        wrong = _errors(_picture_and_gradients(draw_compiled, scene), exact)
        parts["compiled"].extend({**row, **wrong} for row in compiled_rows(scene, config.runs))
    parts["work"].append(_work(scene, forward))
    if torch.cuda.is_available():
        parts["gpu"].append(_kernels(scene, exact, "cuda", config.runs))
    parts["machine"].append({
        "part": "machine", "scene": scene.name, "best_forward_seconds": min(taken[0] for taken in times["ours"]),
        "best_both_seconds": min(taken[1] for taken in times["ours"]),
        "no_gradient_seconds": statistics.median(_seconds_without_gradients(scene) for _ in range(config.runs)),
        "exp_per_second": statistics.median(rates), "load": os.getloadavg()[0],
    })  # fmt: skip


@torch.no_grad()
def _seconds_without_gradients(scene: SplatScene) -> float:
    inputs = scene.inputs()
    begin = time.process_time()
    draw_torch(**inputs)
    return time.process_time() - begin


def _picture_and_gradients(
    draw: Draw, scene: SplatScene, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> dict[str, Tensor]:
    inputs = scene.inputs(dtype, gradients=True, device=device)
    images, alphas = draw(**inputs)
    loss_of(images, alphas).backward()
    return {"picture": images[..., :3].detach().cpu(), **{name: inputs[name].grad.cpu() for name in LEAVES}}


def _kernels(scene: SplatScene, exact: dict[str, Tensor], device: str, runs: int) -> dict[str, Any]:
    """gsplat's own kernels against our float64 picture and gradients, and their wall-clock time."""
    errors = _errors(_picture_and_gradients(gsplat_kernels, scene, device=device), exact)
    inputs = scene.inputs(gradients=True, device=device)
    taken = []
    for _ in range(runs + 1):
        times = [time.perf_counter()]
        images, alphas = gsplat_kernels(**inputs)
        _finish(times)
        loss = loss_of(images, alphas)
        _finish(times)
        loss.backward()
        _finish(times)
        taken.append((times[1] - times[0], times[1] - times[0] + times[3] - times[2]))
    forward, both = (statistics.median(part) for part in zip(*taken[1:], strict=True))  # the first may compile
    return {"part": "gpu", "scene": scene.name, "forward_seconds": forward, "both_seconds": both, **errors}


def _finish(times: list[float]) -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    times.append(time.perf_counter())


def _errors(got: dict[str, Tensor], exact: dict[str, Tensor]) -> dict[str, float]:
    """Of the colours in [0, 1], and the worst relative error (norms) among the gradients."""
    difference = (got["picture"] - exact["picture"]).abs()
    gradients = [float((got[name] - exact[name]).norm() / exact[name].norm().clamp(min=1e-30)) for name in LEAVES]
    return {
        "mean_error": float(difference.mean()),
        "max_error": float(difference.max()),
        "gradient_error": max(gradients),
    }


def _peak_megabytes(draw: Draw, scene: SplatScene) -> float:
    """Most resident memory of forward and backward beyond the inputs, MB."""
    inputs = scene.inputs(gradients=True)
    return peak_megabytes(lambda: loss_of(*draw(**inputs)).backward())


def _exponentials_per_second() -> float:
    """What a plain float32 exponential does in the cache, by the clock of the CPU: how fast the machine is at this
    moment.
    """
    values, out = torch.linspace(-6, 0, _IN_CACHE), torch.empty(_IN_CACHE)
    begin = time.process_time()
    for _ in range(64):
        torch.exp(values, out=out)
    return 64 * _IN_CACHE / (time.process_time() - begin)


def _work(scene: SplatScene, forward: float) -> dict[str, Any]:
    """Pairs that are evaluated and pairs that are drawn, and the seconds that the latter's exponentials alone take."""
    inputs = scene.inputs()
    with torch.no_grad(), _counting() as pairs:
        radii = rasterization(**inputs, render_mode="RGB+D", engine="torch")[2]["radii"]
    values, out, left = torch.linspace(-6, 0, _IN_CACHE), torch.empty(_IN_CACHE), pairs["drawn"]
    begin = time.process_time()
    while left > 0:
        torch.exp(values[:left], out=out[:left])
        left -= _IN_CACHE
    floor = time.process_time() - begin
    return {
        "part": "work", "scene": scene.name, "gaussians": len(scene.means), "visible": int((radii > 0).sum()),
        "evaluated_pairs": pairs["evaluated"], "drawn_pairs": pairs["drawn"], "floor_seconds": floor,
        "floor_share": floor / forward,
    }  # fmt: skip


@contextmanager
def _counting() -> Iterator[dict[str, int]]:
    """Counts the pairs (Gaussian, pixel) of forward passes inside the block by watching the compositor's blocks go
    by.
    """
    pairs, composited = {"evaluated": 0, "drawn": 0}, torch_compositing._forward_block

    def counted(block: torch_compositing.Block, image: Tensor) -> None:
        pairs["evaluated"] += block.weights.numel()
        pairs["drawn"] += int(torch.count_nonzero(block.weights))
        composited(block, image)

    torch_compositing._forward_block = counted
    try:
        yield pairs
    finally:
        torch_compositing._forward_block = composited


def _bars(parts: dict[str, list[dict[str, Any]]]) -> list[Bar]:
    bars = []
    for row in parts["ours"]:
        scene = row["scene"]
        for limit, name in zip(SECONDS.get(scene, ()), ("forward", "both"), strict=False):
            bars.append(Bar(name=f"{name} CPU seconds, {scene}", value=row[f"{name}_seconds"], limit=limit, sense="<="))
        if scene in MEGABYTES:
            bars.append(Bar(name=f"peak MB, {scene}", value=row["peak_mb"], limit=MEGABYTES[scene], sense="<="))
    for row in parts["compiled"]:
        if row["scene"] == "50k@512" and row["threads"] == 1:
            label = "compiled, times faster than torch on one thread, 50k@512"
            bars.append(Bar(name=label, value=row["both_ratio"], limit=2.5, sense=">="))
        if row["scene"] == "50k@512" and row["threads"] == 2:
            for label, name in (("torch", "both_ratio"), ("one thread", "over_one_thread")):
                label = f"compiled on two threads, times faster than {label}, 50k@512"
                bars.append(Bar(name=label, value=row[name], limit=1.5, sense=">="))
    for row in parts["peers"]:
        limits = TIMES_FASTER.get(row["scene"], ()) if row["peer"] == "gsplat torch" else ()
        for limit, name in zip(limits, ("forward", "both"), strict=False):
            label = f"{name}, times faster than gsplat's torch, {row['scene']}"
            bars.append(Bar(name=label, value=row[f"{name}_ratio"], limit=limit, sense=">="))
    return bars
