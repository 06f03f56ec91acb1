"""How well a model completes unseen rooms: generated views against simple baselines, view by view, from ground truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.ray_caster import render
from fb_core.data.room_cameras import training_cameras
from fb_core.data.rooms import FAMILIES, make_room
from fb_core.evaluation.image_metrics import psnr
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.views import Views

METHODS = ("model", "nearest", "mean")
_FIRST_UNSEEN_ROOM = 10**12  # seeds that no training reaches


@dataclass(frozen=True, kw_only=True)
class CompletionTask:
    """What is asked of the model."""

    rooms: int = 20
    """Unseen rooms."""
    views: int = 16
    """Views per room."""
    known: int = 8
    """How many of them are given."""
    family: str = "narrow"
    """Room family."""
    seed: int = 0
    """Decides rooms, cameras and samples."""

    def __post_init__(self) -> None:
        if not 1 <= self.known < self.views or self.rooms < 1:
            raise ValueError(f"evaluation: expected 1 <= known < views and at least one room, got {self}")
        if self.family not in FAMILIES:
            raise ValueError(f"room family: expected one of {sorted(FAMILIES)}, got {self.family!r}")


@dataclass(frozen=True, kw_only=True)
class RoomResult:
    """One room's generated views and their errors."""

    truth: Float[Tensor, "n 3 h w"]
    """All views, the known ones first."""
    completed: Float[Tensor, "n 3 h w"]
    """The same with the unknown views generated."""
    psnr: dict[str, float]
    """Mean PSNR in dB over the unknown views, per method of `METHODS`."""


def unseen_room(task: CompletionTask, number: int, size: int) -> tuple[Float[Tensor, "n 3 h w"], Pinholes]:
    """Pictures and cameras of a room outside every training."""
    seed = _FIRST_UNSEEN_ROOM + 1000 * task.seed + number
    room = make_room(seed, FAMILIES[task.family])
    cameras = training_cameras(room, task.views, size=size, generator=torch.Generator().manual_seed(seed))
    return render(room, cameras, supersample=2).rgb.clamp(0, 1), cameras


def nearest_known(images: Float[Tensor, "k 3 h w"], known: Pinholes, unknown: Pinholes) -> Float[Tensor, "m 3 h w"]:
    """For every unknown camera the known picture whose camera looks in the most similar direction."""
    alike = unknown.rotations[:, :, 2] @ known.rotations[:, :, 2].T
    return images[alike.argmax(dim=1)]


def mean_color(images: Float[Tensor, "k 3 h w"], count: int) -> Float[Tensor, "m 3 h w"]:
    """The known pictures' mean colour everywhere."""
    return images.mean(dim=(0, 2, 3))[None, :, None, None].expand(count, -1, *images.shape[2:])


def evaluate_completion(
    model: Fillerbuster,
    task: CompletionTask,
    sampling: SamplingConfig = SamplingConfig(),
    *,
    on_room: Callable[[int, int], None] | None = None,
) -> Iterable[RoomResult]:
    """Complete one unseen room after the other; yields each result."""
    for number in range(task.rooms):
        images, cameras = unseen_room(task, number, model.size)
        mask = torch.zeros_like(images[:, :1])
        mask[: task.known] = 1
        views = dataclasses.replace(Views.known(images, cameras), image_known=mask)
        completed = model.complete(views, generator=torch.Generator().manual_seed(task.seed + number), sampling=sampling).images
        given, hidden = images[: task.known], images[task.known :]
        answers = {
            "model": completed[task.known :],
            "nearest": nearest_known(given, cameras[list(range(task.known))], cameras[list(range(task.known, task.views))]),
            "mean": mean_color(given, len(hidden)),
        }
        errors = {name: float(psnr(answer, hidden).mean()) for name, answer in answers.items()}
        yield RoomResult(truth=images, completed=completed, psnr=errors)
        if on_room is not None:
            on_room(number + 1, task.rooms)


def summary(results: list[RoomResult]) -> dict[str, dict[str, float]]:
    """Mean PSNR over rooms and its standard error, per method."""
    table = {}
    for method in METHODS:
        values = torch.tensor([result.psnr[method] for result in results], dtype=torch.float64)
        error = float(values.std() / len(values) ** 0.5) if len(values) > 1 else 0.0
        table[method] = {"psnr": float(values.mean()), "standard_error": error}
    return table
