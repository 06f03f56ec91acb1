"""How well a model completes unseen rooms: generated views against simple baselines, view by view, from ground
truth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.completion.samples import likeliest
from fb_core.data.rooms.ray_caster import render
from fb_core.data.rooms.room import FAMILIES, Room, make_room, require_family
from fb_core.data.rooms.room_cameras import training_cameras
from fb_core.data.telea import inpainted
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.evaluation.reprojection import reproject
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.carry_over import BELIEF_BY_DIRECTION, Carried, carried_over
from fb_core.geometry.raymap import raymaps_of
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.views import Views

METHODS = ("model", "nearest", "mean", "reprojected", "reprojected by true depth")
"""What is always compared; beside these the model may start from re-projections (`started_at`)."""
TOLD = "model told what is carried over"
"""The model that is told the pixels carried over by direction, as a guess with a mask between 0 and 1."""
_FAR = 1e4  # metres; so far away that only the camera's rotation counts
_FIRST_UNSEEN_ROOM = 10**12  # seeds that no training reaches
_OTHER_SAMPLE = 10**6  # between the seeds of one room's samples


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
        require_family(self.family)


@dataclass(frozen=True, kw_only=True)
class RoomResult:
    """One room's generated views and their errors."""

    truth: Float[Tensor, "n 3 h w"]
    """All views, the known ones first."""
    completed: Float[Tensor, "n 3 h w"]
    """The same with the unknown views generated."""
    psnr: dict[str, float]
    """Mean PSNR in dB over the unknown views, per method."""
    edges: dict[str, float] = field(default_factory=dict)
    """Edge energy over the unknown views, per method (:func:`edge_energy`)."""


@dataclass(frozen=True, kw_only=True)
class RoomViews:
    """Views of one room with its ground truth."""

    images: Float[Tensor, "n 3 h w"]
    cameras: Pinholes
    depth: Float[Tensor, "n h w"]
    """z-depth in metres."""

    def __getitem__(self, part: slice) -> RoomViews:
        places = list(range(*part.indices(len(self.images))))
        return RoomViews(images=self.images[part], cameras=self.cameras[places], depth=self.depth[part])


def unseen_house(*, family: str, seed: int, number: int) -> Room:
    """A room outside every training."""
    return make_room(_FIRST_UNSEEN_ROOM + 1000 * seed + number, FAMILIES[family])


def unseen_room(*, family: str, seed: int, number: int, views: int, size: int) -> RoomViews:
    """That room, seen by cameras as in training."""
    room = unseen_house(family=family, seed=seed, number=number)
    cameras = training_cameras(room, views, size=size, generator=torch.Generator().manual_seed(room.seed))
    rendered = render(room, cameras, supersample=2)
    return RoomViews(images=rendered.rgb.clamp(0, 1), cameras=cameras, depth=rendered.depth)


def nearest_known(images: Float[Tensor, "k 3 h w"], known: Pinholes, unknown: Pinholes) -> Float[Tensor, "m 3 h w"]:
    """For every unknown camera the known picture whose camera looks in the most similar direction."""
    alike = unknown.rotations[:, :, 2] @ known.rotations[:, :, 2].T
    return images[alike.argmax(dim=1)]


def mean_color(images: Float[Tensor, "k 3 h w"], count: int) -> Float[Tensor, "m 3 h w"]:
    """The known pictures' mean colour everywhere."""
    return images.mean(dim=(0, 2, 3))[None, :, None, None].expand(count, -1, *images.shape[2:])


def baselines(given: RoomViews, hidden: Pinholes) -> dict[str, Float[Tensor, "m 3 h w"]]:
    """What one has without a model. The one by true depth knows what nobody has at hand: a bound, not a competitor."""
    answers = {
        "nearest": nearest_known(given.images, given.cameras, hidden),
        "mean": mean_color(given.images, len(hidden)),
    }
    for name, depth in (
        ("reprojected", torch.full_like(given.depth, _FAR)),
        ("reprojected by true depth", given.depth),
    ):
        answers[name] = inpainted(*reproject(given.images, depth, given.cameras, hidden))
    return answers


def complete_hidden(
    model: Fillerbuster,
    given: RoomViews,
    hidden: Pinholes,
    sampling: SamplingConfig,
    *,
    seed: int,
    start: Float[Tensor, "m 3 h w"] | None = None,
    start_known: Float[Tensor, "m 1 h w"] | None = None,
) -> Float[Tensor, "m 3 h w"]:
    """The hidden views as the model generates them in one sequence with the given ones.

    ``start`` is a guess of them, there where ``start_known`` is 1 (default: everywhere), which enters as
    ``sampling.guess`` says.
    """
    known = Views.known(given.images, given.cameras)
    views = Views.cat([known, Views.unknown(hidden)])
    current = None if start is None else Views.cat([known, Views.known(start, hidden, mask=start_known)])
    completed = model.complete(views, generator=torch.Generator().manual_seed(seed), sampling=sampling, current=current)
    return completed.images[len(given.images) :]


def _told_guess(given: RoomViews, hidden: Pinholes) -> Carried:
    known = torch.ones_like(given.images[:, :1])
    return carried_over(given.images, known, raymaps_of(given.cameras), raymaps_of(hidden))


def started_at(strength: float) -> str:
    """The name of the model that starts from what is reprojected, noised to that time."""
    return f"model from reprojected, strength {strength:g}"


def edge_energy(generated: Float[Tensor, "m 3 h w"], truth: Float[Tensor, "m 3 h w"]) -> float:
    """Mean magnitude of the gradient of generated pictures over that of the truth: 1 is as sharp, 0 is flat."""

    def magnitude(images: Tensor) -> Tensor:
        down, right = images[..., 1:, :-1] - images[..., :-1, :-1], images[..., :-1, 1:] - images[..., :-1, :-1]
        return (down.square() + right.square()).sqrt().mean()

    return float(magnitude(generated) / magnitude(truth))


def mean_of(samples: int) -> str:
    """The name of the mean of several samples: what one expects to see, blurred where the model is unsure."""
    return f"mean of {samples} samples"


def likeliest_of(samples: int) -> str:
    """The name of what is made of several samples: in every neighbourhood the one nearest to their mean."""
    return f"likeliest of {samples} samples"


def evaluate_completion(
    model: Fillerbuster,
    task: CompletionTask,
    sampling: SamplingConfig | None = None,
    *,
    strengths: Sequence[float] = (),
    samples: int = 1,
    told: bool = False,
    on_room: Callable[[int, int], None] | None = None,
) -> Iterable[RoomResult]:
    """Complete one unseen room after the other, from noise and at each of the strengths from re-projections; yields
    each result.

    With several ``samples`` their mean and the likeliest of them are scored, too; with ``told`` the model that is told
    what is carried over, which is then what is shown as completed. ``sampling`` None is what the model's folder
    recommends.
    """
    sampling = model.recommended_sampling if sampling is None else sampling
    averaged = (mean_of(samples), likeliest_of(samples)) if samples > 1 else ()
    for number in range(task.rooms):
        room = unseen_room(family=task.family, seed=task.seed, number=number, views=task.views, size=model.size)
        given, hidden = room[: task.known], room[task.known :]
        seed, answers = task.seed + number, baselines(given, hidden.cameras)
        completed = answers["model"] = complete_hidden(model, given, hidden.cameras, sampling, seed=seed)
        for strength in strengths:
            later = dataclasses.replace(sampling, strength=strength)
            start = answers["reprojected"]
            answers[started_at(strength)] = complete_hidden(model, given, hidden.cameras, later, seed=seed, start=start)
        if told:
            guess = _told_guess(given, hidden.cameras)
            later = dataclasses.replace(sampling, guess="told", belief=BELIEF_BY_DIRECTION)
            answers[TOLD] = complete_hidden(
                model, given, hidden.cameras, later, seed=seed, start=guess.images, start_known=guess.there
            )
        if averaged:
            others = [_OTHER_SAMPLE * other + seed for other in range(1, samples)]
            drawn = torch.stack(
                [
                    completed,
                    *(complete_hidden(model, given, hidden.cameras, sampling, seed=other) for other in others),
                ]
            )
            answers[mean_of(samples)], answers[likeliest_of(samples)] = drawn.mean(dim=0), likeliest(drawn)
        methods = (*METHODS, *map(started_at, strengths), *((TOLD,) if told else ()), *averaged)
        errors = {name: float(psnr(answers[name], hidden.images).mean()) for name in methods}
        edges = {name: edge_energy(answers[name], hidden.images) for name in methods}
        yield RoomResult(
            truth=room.images,
            completed=torch.cat([given.images, answers[TOLD] if told else completed]),
            psnr=errors,
            edges=edges,
        )
        if on_room is not None:
            on_room(number + 1, task.rooms)


def summary(results: list[RoomResult]) -> dict[str, dict[str, float]]:
    """Mean PSNR over rooms, and how far that is above the pixels carried over by direction, with standard errors, per
    method.

    The second is the mean of differences room by room, which is far surer than the difference of the means.
    """
    rows = {}
    for method in results[0].psnr:
        above = mean_psnr([result.psnr[method] - result.psnr["reprojected"] for result in results])
        rows[method] = mean_psnr([result.psnr[method] for result in results]) | {
            f"above_{name}": value for name, value in above.items()
        }
        if method in results[0].edges:
            rows[method]["edges"] = sum(result.edges[method] for result in results) / len(results)
    return rows


def mean_psnr(values: Sequence[float]) -> dict[str, float]:
    """Mean over rooms (dB) and its standard error; 0 of a single room."""
    numbers = torch.tensor(values, dtype=torch.float64)
    error = float(numbers.std() / len(numbers) ** 0.5) if len(numbers) > 1 else 0.0
    return {"psnr": float(numbers.mean()), "standard_error": error}
