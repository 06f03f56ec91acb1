"""What ``fillerbuster complete`` says before, while and after it works: sentences for people, and the content of
report.json.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

from fb_core.completion.duration import duration_in_words
from fb_core.completion.fly_through import FoundCameras
from fb_core.data.photos.photo import Photo
from fb_core.geometry.pose_solver.verdict import Arrangement
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.memory.budget import GIB, bound
from fb_core.registration.choice import Registration
from method_configs.commands.complete.forecast import Forecast, memory_beside
from method_configs.commands.complete.options import POSES_AT_ONCE, CompleteOptions
from method_configs.commands.complete.output import COMMAND
from method_configs.commands.complete.plan import Plan

_MOST_NAMED = 5  # photos that are left out, on the screen
_METHODS = {"known": "given", "model": "by the model", "features": "by features"}


def announcement_of_work(
    photos: list[Photo],
    options: CompleteOptions,
    model: Fillerbuster | None,
    plan: Plan | None,
    pose_sampling: SamplingConfig | None,
    forecast: Forecast,
) -> str:
    """One sentence on what is about to be done, how long it may take and how much memory it needs."""
    unknown = sum(photo.camera is None for photo in photos)
    posed = "" if unknown == len(photos) else f" ({len(photos) - unknown} with known cameras)"
    seconds, memory = forecast.total, memory_beside(photos, model)
    if model is None or (plan is None and unknown == 0):
        how = "known" if unknown == 0 else "features"
        return f"Finding the cameras of {len(photos)} photos{posed} by {how}; {duration_in_words(seconds, memory)}."
    if unknown and options.cameras != "features":
        assert pose_sampling is not None
        memory += _memory(model, min(len(photos), POSES_AT_ONCE), model.size, pose_sampling)
    name = "the bundled model" if options.model is None else f"model {options.model.name}"
    named = f"{name} ({model.model_hash[:8]})"
    if plan is None:
        return f"Finding the cameras of {len(photos)} photos{posed} with {named}; {duration_in_words(seconds, memory)}."
    passing = _memory(model, plan.longest, plan.side, plan.sampling, options.prompt)
    memory = max(memory, memory_beside(photos, model) + passing)
    count = len(plan.passes.views)
    passes = (
        f"{count} {'pass' if count == 1 else 'passes'} of {plan.sampling.steps} steps over up to {plan.longest} views"
    )
    along = f"along {Path(options.path).name}" if options.path.endswith(".json") else f"along the {options.path}"
    return (
        f"Completing the scene with {named}: {sum(map(len, plan.passes.views))} new views {along} of "
        f"{plan.side}x{plan.side} pixels in "
        f"{passes}, conditioned on {plan.photos} of {len(photos)} photos{posed}; {duration_in_words(seconds, memory)}."
    )


def _memory(model: Fillerbuster, views: int, side: int, sampling: SamplingConfig, prompt: str | None = None) -> int:
    """Bytes at most: generously where that is little, since a precise answer takes seconds."""
    size, prompted = (side, side), bool(prompt)
    generous = bound(views, size, model=model.config, sampling=sampling, prompted=prompted)[1]
    return generous if generous < GIB else model.estimate(views, size, sampling, prompt=prompt).peak


def what_was_found(photos: list[Photo], found: FoundCameras) -> list[str]:
    """How many photos have a camera, and which are left out."""
    trusted, registration = found.trusted, found.registration
    lines = [f"{len(trusted)} of {len(photos)} photos have a camera ({_METHODS[found.method]})."]
    if len(found.tried) > 1:
        lines[0] = (
            f"The model is sure of {found.tried['model']} of {len(photos)} cameras, features of "
            f"{found.tried['features']}. " + lines[0]
        )
    if registration.arrangement == Arrangement.ONE_PLACE and trusted:
        lines.append(
            "All photos were taken in one place: their directions are known, but no distances, so that new views can "
            "only turn there."
        )
    lines += registration.notes
    others = [index for index in range(len(photos)) if index not in trusted]
    for index in others[:_MOST_NAMED]:
        lines.append(f"left out: {photos[index].name} ({registration.verdicts[index]}: {registration.reasons[index]})")
    if len(others) > _MOST_NAMED:
        lines.append(f"left out: {len(others) - _MOST_NAMED} more, named in report.json")
    return lines


def no_cameras(photos: list[Photo], found: FoundCameras, output: Path) -> str:
    """Why there is no capture, and what can be done."""
    answers = "; ".join(f"{_METHODS[method]}: {_in_short(registration)}" for method, registration in found.answers)
    other = "features" if "features" not in found.tried else "model" if "model" not in found.tried else None
    advice = (
        f"try --cameras {other}"
        if other
        else "add photos that overlap more, or give poses that you have with --known-poses"
    )
    return (
        f"cameras of {len(photos)} photos: expected at least two that can be trusted, got {len(found.trusted)} "
        f"({answers}); {advice}. "
        f"None was made up; {output} has the report"
    )


def _in_short(registration: Registration) -> str:
    """How often each verdict was given, and the commonest thing that speaks against a camera."""
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in Counter(registration.verdicts).most_common())
    reasons = Counter(reason for reason in registration.reasons if reason).most_common(1)
    return verdicts + (f", such as: {reasons[0][0]}" if reasons else "")


def report_of(
    source: Path,
    options: CompleteOptions,
    photos: list[Photo],
    left_out: dict[str, str],
    model: Fillerbuster | None,
    found: FoundCameras,
    told: dict[str, Any],
) -> dict[str, Any]:
    """The content of report.json that is known before the folder is written."""
    registration, trusted = found.registration, set(found.trusted)
    entries = []
    for index, photo in enumerate(photos):
        residual, camera = registration.residuals_degrees[index], registration.cameras[index]
        entries.append(
            {
                "name": photo.name,
                "source": photo.source.name,
                "seconds": photo.seconds,
                "width": photo.size[1],
                "height": photo.size[0],
                "used": index in trusted,
                "verdict": registration.verdicts[index],
                "reason": registration.reasons[index],
                "residual_degrees": None if math.isnan(residual) else residual,
                "focal": None if camera is None or index not in trusted else camera.focal[0].tolist(),
            }
        )
    entries += [
        {"name": name, "used": False, "verdict": "left out", "reason": reason} for name, reason in left_out.items()
    ]
    return {
        "command": COMMAND,
        "input": source,
        "options": dataclasses.asdict(options),
        "seed": options.seed,
        "model": None
        if model is None
        else {"hash": model.model_hash, "size": model.size, "preset": model.info.get("preset")},
        "cameras": {
            "method": found.method,
            "trusted_by_method": found.tried,
            "trusted": len(trusted),
            "photos": len(photos) + len(left_out),
            "arrangement": str(registration.arrangement),
            "notes": list(registration.notes),
        },
        "photos": entries,
        **told,
    }


@contextmanager
def bars() -> Iterator[Callable[[str, int, int], None]]:
    """Progress on the terminal, one bar for each thing that is being done; nothing when it is not one."""
    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    tasks: dict[str, TaskID] = {}
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:

        def report(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(what.capitalize(), total=total)
            progress.update(tasks[what], completed=done, total=total)

        yield report
