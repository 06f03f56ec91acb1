"""How a model's completions change with the number of known views, and with sequences longer than it was trained on.

The same hidden views of the same rooms are scored in every row, so that rows differ in nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fb_core.data.rooms.room import require_family
from fb_core.evaluation.completion import RoomViews, complete_hidden, mean_psnr, unseen_room
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import Fillerbuster, SamplingConfig

OnRoom = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class ScalingTask:
    """What is compared."""

    rooms: int = 20
    """Unseen rooms."""
    contexts: tuple[int, ...] = (3, 8, 16)
    """Numbers of known views."""
    scored: int = 8
    """Hidden views that are scored: the only ones where the context varies, the first ones where the length does."""
    lengths: tuple[int, ...] = (1, 2, 3)
    """Sequence lengths, in multiples of the length that the model was trained on."""
    known: int = 4
    """Known views where the length varies."""
    trained_views: int = 12
    """Views of a training sequence."""
    family: str = "narrow"
    """Room family."""
    seed: int = 0
    """Decides rooms, cameras and samples."""

    def __post_init__(self) -> None:
        require_family(self.family)
        if self.rooms < 1 or self.scored < 1 or min((*self.contexts, self.known, *self.lengths), default=1) < 1:
            raise ValueError(f"scaling: expected at least one room, scored view, known view and length, got {self}")
        shortest = min(self.lengths, default=1) * self.trained_views
        if self.lengths and self.known + self.scored > shortest:
            raise ValueError(
                f"scaling: {self.known} known and {self.scored} scored views do not fit into {shortest} views; "
                "score fewer views or compare longer sequences"
            )


def evaluate_scaling(
    model: Fillerbuster, task: ScalingTask, sampling: SamplingConfig, *, on_room: OnRoom = lambda _: None
) -> list[dict[str, float | int | str]]:
    """One row for each context and each length: mean PSNR in dB over rooms, and its standard error."""
    longest = max(
        (task.scored + max(task.contexts, default=0), *(length * task.trained_views for length in task.lengths))
    )
    rooms = [
        unseen_room(family=task.family, seed=task.seed, number=number, views=longest, size=model.size)
        for number in range(task.rooms)
    ]
    rows: list[dict[str, float | int | str]] = []
    for known in task.contexts:
        on_room(f"{known} known views")
        errors = _errors(model, rooms, known, 0, task, sampling)
        rows.append({"part": "context", "known": known, "views": known + task.scored} | mean_psnr(errors))
    for length in task.lengths:
        views = length * task.trained_views
        on_room(f"{views} views in one sequence")
        errors = _errors(model, rooms, task.known, views - task.known - task.scored, task, sampling)
        rows.append({"part": "length", "known": task.known, "views": views} | mean_psnr(errors))
    return rows


def _errors(
    model: Fillerbuster,
    rooms: Iterable[RoomViews],
    known: int,
    unscored: int,
    task: ScalingTask,
    sampling: SamplingConfig,
) -> list[float]:
    """PSNR of the scored views in each room, completed together with further unknown views."""
    means = []
    for number, room in enumerate(rooms):
        scored, given, further = (
            room[: task.scored],
            room[task.scored : task.scored + known],
            room[task.scored + known :][:unscored],
        )
        asked = Pinholes.cat([scored.cameras, further.cameras]) if unscored else scored.cameras
        completed = complete_hidden(model, given, asked, sampling, seed=task.seed + number)
        means.append(float(psnr(completed[: task.scored], scored.images).mean()))
    return means
