"""``fillerbuster demo``: one room captured, completed and compared with plain splatting; report.png and
metrics.json.
"""

from __future__ import annotations

import json
import logging
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from fb_core.files.limits import MOST_SEED, MOST_TRAINING_STEPS, require_between
from fb_core.files.ownership import MARK_NAME, Target, mark_text
from fb_core.files.whole import remove_folder, swept, whole_file
from fb_core.machine.clock import Clock
from fb_core.machine.resources import usable_cores
from fb_nerfstudio.runs.earlier_runs import clear_run
from fb_nerfstudio.runs.training_process import TrainingProcess
from method_configs.room_runs import FAMILY, HELD_OUT, METHODS, ROUNDS, SIZE, VIEWS, run_folder, training_arguments

if TYPE_CHECKING:
    from fb_nerfstudio.runs.held_out_views import HeldOutViews

MARKER = MARK_NAME
"""File that marks a folder as a demo's own, which a later demo may replace."""
_EARLIER_MARKER = ".fillerbuster-demo"  # of versions before all commands had one kind of mark

_logger = logging.getLogger(__name__)


def run_demo(output: Path, *, seed: int = 0, iterations: int = 1500, model: Path | None = None) -> dict[str, Any]:
    """Make the capture, run both methods on it at the same time, measure them; returns what metrics.json holds.

    Raises ValueError when ``output`` holds something that is not a demo, when the model cannot be used, and when a
    training fails.
    """
    from fb_core.checkpoint import read_config
    from fb_core.data.rooms.room_captures import rooms
    from fb_core.inpainter import BUNDLED_MODEL

    if iterations < 1:
        raise ValueError(f"iterations: expected at least 1, got {iterations}")
    require_between("seed", seed, 0, MOST_SEED)
    require_between("iterations", iterations, 1, MOST_TRAINING_STEPS)
    read_config(model or BUNDLED_MODEL)  # a missing model is told before anything is made
    output = output.absolute()
    _clear(output, inputs=() if model is None else (model,))
    clock = Clock()
    with _peak_memory() as memory, _Bars() as bars:
        with clock.stage("capture"), bars.stage("Room capture") as bar:
            rooms(seed, output / "capture", family=FAMILY, views=VIEWS, size=SIZE, held_out=HELD_OUT)
            bar(1, 1)
        with clock.stage("train"):
            clock.seconds |= _train_both(output, seed=seed, iterations=iterations, model=model, bars=bars)
        with clock.stage("render"):
            views = _render_both(output, bars)
        with clock.stage("report"), bars.stage("Report") as bar:
            from method_configs.commands.demo_report import write_report

            quality = {name: held_out.quality() for name, held_out in views.items()}
            write_report(output, views, quality, seed=seed)
            bar(1, 1)
    metrics = {**_rounded(quality), "seconds": clock.rounded(), "peak_memory_gib": round(memory["gib"], 3)}
    with whole_file(output / "metrics.json") as unfinished:
        unfinished.write_text(json.dumps(metrics, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    _summarize(metrics, output)
    return metrics


def _train_both(output: Path, *, seed: int, iterations: int, model: Path | None, bars: _Bars) -> dict[str, float]:
    """Run both trainings at once, each on half of the cores; returns the seconds of their stages."""
    threads = max(1, usable_cores() // 2)
    (output / "runs").mkdir(exist_ok=True)  # logs of an earlier demo that failed may lie there
    started: dict[str, TrainingProcess] = {}
    try:
        for name, method in METHODS.items():
            arguments = training_arguments(output, method, seed=seed, iterations=iterations, model=model)
            rounds = ROUNDS if name == "with" else 0
            log, report = output / "runs" / f"{method}.log", bars.training(name, generates=rounds > 0)
            started[name] = TrainingProcess(
                arguments, log=log, iterations=iterations, rounds=rounds, threads=threads, report=report
            )
        while any(process.running for process in started.values()):
            for process in started.values():
                if not process.running:
                    process.finish()  # tells of a failure while the other one still works
            time.sleep(0.2)
        for process in started.values():
            process.finish()
    finally:
        for process in started.values():
            process.stop()
    return {
        "generate": started["with"].seconds["generate"],
        **{f"train_{name}": process.seconds["all"] - process.seconds["generate"] for name, process in started.items()},
    }


def _render_both(output: Path, bars: _Bars) -> dict[str, HeldOutViews]:
    """Held-out views of both runs; nerfstudio is imported no earlier than here, because that takes a while."""
    views: dict[str, HeldOutViews] = {}
    for name, method in METHODS.items():
        with bars.stage(f"Held-out views {name} completion") as bar, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of nerfstudio's dependencies about each other
            from fb_nerfstudio.runs.held_out_views import render_held_out

            views[name] = render_held_out(run_folder(output, method), output / "capture", on_view=bar)
    return views


def _clear(output: Path, *, inputs: tuple[Path, ...] = ()) -> None:
    """Make the folder, empty but for the marker; only an earlier demo is removed, and nothing in it that no demo
    makes.
    """
    swept(output)
    Target(folder=output, kind="demo", overwrite=True, inputs=inputs, earlier=_is_earlier_demo).check()
    with whole_file(output / MARKER) as unfinished:
        unfinished.write_text(mark_text("demo", []), encoding="utf-8")
    for method in METHODS.values():
        clear_run(run_folder(output, method), output)
    remove_folder(Target(folder=output / "capture", kind="capture", overwrite=True, inputs=inputs, earlier=_is_room))
    for entry in ("report.png", "metrics.json", _EARLIER_MARKER):
        (output / entry).unlink(missing_ok=True)


def _is_earlier_demo(folder: Path) -> bool:
    return (folder / _EARLIER_MARKER).is_file()


def _is_room(capture: Path) -> bool:
    """Whether a capture without a mark says that it shows a procedural room."""
    from fb_core.data.capture.transforms_json import JSON_NAME, load_transforms

    try:
        return "room" in load_transforms(capture / JSON_NAME)
    except (OSError, ValueError):
        return False


class _Bars:
    """Progress bars of all stages below each other."""

    def __init__(self) -> None:
        columns = TextColumn("{task.description:<36}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
        self._progress = Progress(*columns, console=Console(stderr=True))

    def __enter__(self) -> _Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    @contextmanager
    def stage(self, title: str):
        """A bar for the block, which is given the function (done, total)."""
        bar = self._progress.add_task(title, total=None)
        yield lambda done, total: self._progress.update(bar, completed=done, total=total)

    def training(self, name: str, *, generates: bool):
        """Bars of one training; gives the function (phase, done, total)."""
        phases = {"generate": f"Generating views, {name} completion"} if generates else {}
        phases["train"] = f"Training {name} completion"
        bars: dict[str, TaskID] = {phase: self._progress.add_task(title, total=None) for phase, title in phases.items()}

        def report(phase: str, done: int, total: int) -> None:
            self._progress.update(bars[phase], completed=done, total=total)

        return report


@contextmanager
def _peak_memory() -> Iterator[dict[str, float]]:
    """Largest resident memory of this process and all its children together, in GiB, sampled twice a second.

    Pages that processes share count for each of them, so the figure is an upper bound.
    """
    peak, ended = {"gib": 0.0}, threading.Event()

    def sample() -> None:
        own = psutil.Process()
        while not ended.wait(0.5):
            total = 0
            for process in [own, *own.children(recursive=True)]:
                try:
                    total += process.memory_info().rss
                except psutil.NoSuchProcess:
                    continue
            peak["gib"] = max(peak["gib"], total / 2**30)

    sampler = threading.Thread(target=sample, daemon=True)
    sampler.start()
    try:
        yield peak
    finally:
        ended.set()
        sampler.join()


def _rounded(values: Any) -> Any:
    """The same nested dictionary with 5 decimals, which is more than repeats of a run agree on."""
    return {name: _rounded(value) for name, value in values.items()} if isinstance(values, dict) else round(values, 5)


def bars_of(metrics: dict[str, Any]) -> list[tuple[str, float, str, float, bool]]:
    """The demo's promises: (what, value, sense, limit, holds)."""
    without, completed = metrics["without"], metrics["with"]
    gain = {kind: completed[kind]["psnr"] - without[kind]["psnr"] for kind in ("covered", "uncovered")}
    rows = [
        (
            "hole share on uncovered views",
            completed["uncovered"]["hole_share"],
            "<=",
            without["uncovered"]["hole_share"] / 3,
        ),
        ("PSNR gained on uncovered views (dB)", gain["uncovered"], ">=", 1.0),
        ("PSNR gained on covered views (dB)", gain["covered"], ">=", -0.5),
        ("seconds", metrics["seconds"]["total"], "<=", 600.0),
        ("peak memory (GiB)", metrics["peak_memory_gib"], "<=", 6.0),
    ]
    return [
        (what, value, sense, limit, value <= limit if sense == "<=" else value >= limit)
        for what, value, sense, limit in rows
    ]


def _summarize(metrics: dict[str, Any], output: Path) -> None:
    console = Console()
    quality = Table(title="Held-out views", title_justify="left")
    for heading in ("views", "completion", "PSNR (dB)", "SSIM", "holes"):
        quality.add_column(heading, justify="left" if heading in ("views", "completion") else "right")
    for kind in ("covered", "uncovered"):
        for name in METHODS:
            row = metrics[name][kind]
            quality.add_row(kind, name, f"{row['psnr']:.2f}", f"{row['ssim']:.3f}", f"{100 * row['hole_share']:.1f} %")
    promises = Table(title="What the demo promises", title_justify="left")
    for heading in ("", "value", "limit", ""):
        promises.add_column(heading, justify="left" if heading == "" else "right")
    for what, value, sense, limit, holds in bars_of(metrics):
        promises.add_row(
            what, f"{value:.3g}", f"{sense} {limit:.3g}", "[green]holds[/green]" if holds else "[red]missed[/red]"
        )
    console.print(quality, promises)
    console.print(f"Pictures: {output / 'report.png'}\nNumbers:  {output / 'metrics.json'}", soft_wrap=True)
    console.print(
        f"Look at the completed scene: ns-viewer --load-config {run_folder(output, METHODS['with']) / 'config.yml'} "
        "--viewer.websocket-host 127.0.0.1",
        soft_wrap=True,
    )
