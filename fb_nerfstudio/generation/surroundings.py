"""What surrounds a generation inside a training: progress, one sentence for refusals, randomness, memory."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from fb_core.completion.planning.plan import PlannedRound
from fb_core.completion.results.completed_views import round_title
from fb_core.completion.rounds import CapturedView
from fb_core.files.faults import Refused
from fb_core.sampling.randomness import mixed
from fb_nerfstudio.viewer import CompletionPanel


def say_found(planned: PlannedRound) -> None:
    """One line for a round that the cache had."""
    title = round_title(planned.role, planned.number)
    CONSOLE.print(f"{title}: {len(planned.cameras)} views found in the cache, nothing is generated for them.")


def release_memory() -> None:
    """Memory of the model that has just been dropped goes back to the machine and to the GPU."""
    gc.collect()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


@contextmanager
def refusing() -> Iterator[None]:
    """A sentence instead of a traceback for what the model refuses, such as too small a memory budget."""
    try:
        yield
    except ValueError as error:
        raise Refused(str(error)) from None


class LazyViews(Sequence[CapturedView]):
    """Captured views in order, each read when it is looked at: whole photos as floats would fill the memory."""

    def __init__(self, load: Callable[[int], CapturedView], indices: Sequence[int]):
        self._load, self._indices = load, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, place: Any) -> Any:
        return (
            [self._load(index) for index in self._indices[place]]
            if isinstance(place, slice)
            else self._load(self._indices[place])
        )


class Bars:
    """Progress of the rounds on the terminal (nothing when it is not one) and in the viewer."""

    def __init__(self, panel: CompletionPanel, rounds: int):
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        self._progress = Progress(*columns, console=CONSOLE, transient=True, disable=not CONSOLE.is_terminal)
        self._panel, self._rounds, self._tasks = panel, rounds, {}

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        self._panel.report("")

    def trial(self, done: int, steps: int) -> None:
        """Called by the sampler while the model is tried on hidden views."""
        title = "Trying the model on hidden views"
        if -1 not in self._tasks:
            self._tasks[-1] = self._progress.add_task(title, total=steps)
        self._progress.update(self._tasks[-1], completed=done)
        self._panel.report(f"{title}, step {done} of {steps}", share=done / steps)

    def step(self, planned: PlannedRound, done: int, steps: int) -> None:
        """Called by the sampler after each denoising step."""
        title = f"{round_title(planned.role, planned.number)}: {len(planned.cameras)} views"
        if planned.number not in self._tasks:
            self._tasks[planned.number] = self._progress.add_task(title, total=steps)
        self._progress.update(self._tasks[planned.number], completed=done)
        self._panel.report(f"Generating, {title}, step {done} of {steps}", share=done / steps)


@contextmanager
def own_randomness(device: torch.device | str, *, seed: int, step: int) -> Iterator[None]:
    """Draws from torch's global state that ``seed`` and ``step`` alone decide, whatever happened before, a kill even.

    Leaves that state as it was: training goes on as if nothing had been generated.
    """
    device = torch.device(device)
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        torch.manual_seed(mixed(seed, step))
        yield
