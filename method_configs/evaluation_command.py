"""``fillerbuster eval``: a model's completions of unseen rooms beside simple baselines, as a table, JSON and a sheet."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

from method_configs.bench_command import show


def evaluate(
    *,
    model: Path | None,
    rooms: int,
    views: int,
    known: int,
    family: str,
    guidance: Sequence[float],
    seed: int,
    json: Path | None,
    sheet: Path | None,
) -> None:
    """Complete the same unseen rooms at every guidance scale; ``guidance`` empty means the model's own recommendation."""
    from rich.progress import track

    from fb_core.evaluation.benchmarks import Report
    from fb_core.evaluation.completion import CompletionTask, RoomResult, evaluate_completion, summary
    from fb_core.inpainter import Fillerbuster

    completer = Fillerbuster.from_pretrained(model)
    task = CompletionTask(rooms=rooms, views=views, known=known, family=family, seed=seed)
    recommended = completer.recommended_sampling
    report, results = Report(seed=seed), list[RoomResult]()
    for scale in guidance or (recommended.guidance_unknown,):
        sampling = dataclasses.replace(recommended, guidance_unknown=scale)
        began = time.process_time()
        iterator = evaluate_completion(completer, task, sampling)
        results = list(track(iterator, description=f"guidance {scale:g}", total=rooms, transient=True))
        seconds = (time.process_time() - began) / rooms
        for method, values in summary(results).items():
            mine = {"guidance": scale, "steps": sampling.steps, "cpu_seconds_per_room": seconds} if method == "model" else {}
            blank = {"guidance": "-", "steps": "-", "cpu_seconds_per_room": "-"}
            report.rows.append(
                {"part": f"{rooms} unseen {family} rooms, {known} of {views} views known", "method": method} | values | blank | mine
            )
    show(report, json, [] if sheet is None else [lambda: _draw(sheet, results[:4], known, completer)])


def _draw(path: Path, results: Sequence, known: int, completer) -> None:
    from fb_core.evaluation.contact_sheet import Strip, write_contact_sheet

    strips = []
    for number, result in enumerate(results):
        hidden = result.truth[known:]
        strips.append(Strip(heading=f"Room {number}: known views", pictures=list(result.truth[:known])))
        strips.append(Strip(heading=f"Generated ({result.psnr['model']:.1f} dB)", pictures=list(result.completed[known:])))
        strips.append(Strip(heading="Truth", pictures=list(hidden)))
    path.parent.mkdir(parents=True, exist_ok=True)
    title = f"Unseen rooms completed by {completer.info.get('preset', 'a model')} ({completer.model_hash[:8]})"
    write_contact_sheet(path, strips, title=title, subtitle="each view is wholly unknown to the model, its camera is known")
