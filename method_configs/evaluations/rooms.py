"""``fillerbuster eval rooms``: a model's completions of unseen rooms beside simple baselines, as a table, JSON and a
sheet.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from method_configs.benchmarks.command import show


@dataclass(frozen=True, kw_only=True)
class Rooms:
    """Complete unseen rooms, from noise and from pixels carried over; compare with these, the nearest known view and
    the mean colour.
    """

    model: Path | None = None
    """Model folder; by default the bundled one."""
    rooms: int = 20
    """Unseen rooms."""
    views: int = 16
    """Views per room."""
    known: int = 8
    """How many of them the model is given."""
    family: Literal["narrow", "medium", "wide"] = "narrow"
    """How varied room and cameras are; the bundled model knows narrow rooms."""
    guidance: tuple[float, ...] = ()
    """Guidance scales of unknown content to try; by default the model's own."""
    steps: tuple[int, ...] = ()
    """Numbers of denoising steps to try; by default the model's own."""
    strengths: tuple[float, ...] = (0.7,)
    """Strengths at which the model also starts from the pixels carried over by direction, instead of from noise; none
    to leave it out.
    """
    samples: int = 4
    """Samples whose mean is scored, too; 1 to leave it out."""
    seed: int = 0
    """Decides rooms, cameras and samples."""
    json: Path | None = None
    """Write all measurements to this file."""
    sheet: Path | None = None
    """Draw the first rooms into this PNG."""

    def run(self) -> None:
        """Complete the same unseen rooms at every guidance scale, with every number of steps, and report.

        Raises ValueError for strengths beyond 0 to 1, and for no samples.
        """
        import dataclasses

        from rich.progress import track

        from fb_core.evaluation.completion import (
            TOLD,
            CompletionTask,
            RoomResult,
            evaluate_completion,
            likeliest_of,
            mean_of,
            started_at,
            summary,
        )
        from fb_core.evaluation.results import Report
        from fb_core.inpainter import Fillerbuster

        if not all(0 < strength < 1 for strength in self.strengths):
            raise ValueError(f"strengths: expected times between 0 and 1, got {' '.join(map(str, self.strengths))}")
        if self.samples < 1:
            raise ValueError(f"samples: expected at least 1, got {self.samples}")
        completer = Fillerbuster.from_pretrained(self.model)
        task = CompletionTask(rooms=self.rooms, views=self.views, known=self.known, family=self.family, seed=self.seed)
        recommended = completer.recommended_sampling
        takes_guess = recommended.guess != "start"  # a model that was trained to be told a guess also is
        report, results = Report(seed=self.seed), list[RoomResult]()
        for scale, steps in itertools.product(
            self.guidance or (recommended.guidance_unknown,), self.steps or (recommended.steps,)
        ):
            sampling = dataclasses.replace(recommended, guidance_unknown=scale, steps=steps)
            began = time.process_time()
            iterator = evaluate_completion(
                completer, task, sampling, strengths=self.strengths, samples=self.samples, told=takes_guess
            )
            results = list(
                track(iterator, description=f"guidance {scale:g}, {steps} steps", total=self.rooms, transient=True)
            )
            seconds = (time.process_time() - began) / self.rooms / (self.samples + len(self.strengths) + takes_guess)
            drawn = {mean_of(self.samples): 1.0, likeliest_of(self.samples): 1.0}
            times = {"model": 1.0, TOLD: 1.0, **drawn} | {started_at(strength): strength for strength in self.strengths}
            mine = {"guidance": scale, "steps": sampling.steps, "cpu_seconds_per_room": seconds}
            for method, values in summary(results).items():
                own = mine | {"strength": times[method]} if method in times else dict.fromkeys([*mine, "strength"], "-")
                part = f"{self.rooms} unseen {self.family} rooms, {self.known} of {self.views} views known"
                report.rows.append({"part": part, "method": method} | values | own)
        sheet = self.sheet
        show(report, self.json, [] if sheet is None else [lambda: _draw(sheet, results[:4], self.known, completer)])


def _draw(path: Path, results: Sequence, known: int, completer) -> None:
    from fb_core.evaluation.completion import TOLD
    from fb_core.evaluation.figures.contact_sheet import Strip, write_contact_sheet

    strips = []
    for number, result in enumerate(results):
        hidden, shown = result.truth[known:], TOLD if TOLD in result.psnr else "model"
        strips.append(Strip(heading=f"Room {number}: known views", pictures=list(result.truth[:known])))
        strips.append(
            Strip(heading=f"Generated ({result.psnr[shown]:.1f} dB)", pictures=list(result.completed[known:]))
        )
        strips.append(Strip(heading="Truth", pictures=list(hidden)))
    path.parent.mkdir(parents=True, exist_ok=True)
    title = f"Unseen rooms completed by {completer.info.get('preset', 'a model')} ({completer.model_hash[:8]})"
    write_contact_sheet(
        path, strips, title=title, subtitle="each view is wholly unknown to the model, its camera is known"
    )
