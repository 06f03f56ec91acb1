"""From photos to a fly-through, without files (paper, "uncalibrated scene completion"): cameras of the photos, then
views along a path.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.photos.photo import Photo
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.verdict import arrangement_of
from fb_core.geometry.viewpoints.paths import spread_subset, strided_subset
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.memory.budget import SIDE_MULTIPLE, available_bytes, uncut
from fb_core.registration.by_raymaps import Square
from fb_core.registration.choice import OnProgress, Registration, register
from fb_core.views import Views

CameraMethod = Literal["auto", "model", "features"]
TRUSTED = ("known", "ok")
"""Verdicts of photos that are used."""
FEWEST = 2
"""Photos with a camera below which there is nothing to fly through."""
_ENOUGH = 0.75  # share of the photos that the model must find cameras for, or features are tried too
_ANCHOR_SHARE = 0.25  # of what a later pass has room for beside the photos are views of the first one


@dataclass(frozen=True, kw_only=True)
class FoundCameras:
    """The photos' cameras and how they were found."""

    registration: Registration
    """Of all photos."""
    method: Literal["known", "model", "features"]
    """What found them."""
    tried: dict[str, int]
    """Trusted cameras by each method that was tried."""
    answers: tuple[tuple[str, Registration], ...] = ()
    """What each method that was tried says, in order."""
    raymaps: Float[Tensor, "n 6 h w"] | None = None
    """What the model denoised, if it was asked, whoever found the cameras in the end; in its own frame, NaN where
    nothing was denoised.
    """

    @property
    def trusted(self) -> list[int]:
        """Photos that are used."""
        pairs = zip(self.registration.cameras, self.registration.verdicts, strict=True)
        return [index for index, (camera, verdict) in enumerate(pairs) if camera is not None and verdict in TRUSTED]

    def as_used(self, photos: Sequence[Photo]) -> list[Photo]:
        """The photos, straightened where their lens bends."""
        return [self.registration.straight.get(index, photo) for index, photo in enumerate(photos)]

    def camera(self, index: int) -> Pinholes:
        """Of a trusted photo, whole and at full size."""
        camera = self.registration.cameras[index]
        assert camera is not None
        return camera


def find_cameras(
    photos: Sequence[Photo],
    *,
    method: CameraMethod,
    model: Fillerbuster | None,
    seed: int,
    sampling: SamplingConfig | None = None,
    on_progress: OnProgress | None = None,
) -> FoundCameras:
    """Cameras of all photos, known ones kept; ``sampling`` is the model's, for raymaps.

    ``auto`` asks the model first. If it is not sure of three quarters of the photos, features are asked too, and the
    answer that leaves out fewer photos is taken. Raises as `register` does.
    """
    if all(photo.camera is not None for photo in photos):
        return FoundCameras(registration=_known(photos), method="known", tried={})
    order: tuple[Literal["model", "features"], ...] = ("model", "features") if method == "auto" else (method,)
    answers: list[FoundCameras] = []
    for one in order:
        registration = register(photos, method=one, model=model, seed=seed, sampling=sampling, on_progress=on_progress)
        answers.append(FoundCameras(registration=registration, method=one, tried={}))
        if len(answers[-1].trusted) >= _ENOUGH * len(photos):
            break
    best = max(answers, key=lambda answer: len(answer.trusted))  # the first of equals
    tried = {str(answer.method): len(answer.trusted) for answer in answers}
    raymaps = next((answer.registration.raymaps for answer in answers if answer.method == "model"), None)
    every = tuple((answer.method, answer.registration) for answer in answers)
    return FoundCameras(registration=best.registration, method=best.method, tried=tried, answers=every, raymaps=raymaps)


def choose_context(found: FoundCameras, count: int) -> list[int]:
    """The photos that new views are conditioned on, those that differ most in place and direction; the most level one
    comes first.
    """
    trusted = found.trusted
    return [trusted[place] for place in spread_subset([found.camera(index) for index in trusted], count)]


@dataclass(frozen=True, kw_only=True)
class Passes:
    """Which views each pass of the model generates; the first pass spans the whole path."""

    views: list[list[int]]
    """Places on the path, by pass."""
    anchors: int
    """Views of the first pass that later ones are given."""


def plan_passes(views: int, *, room: int) -> Passes:
    """Split the path's views into passes.

    Args:
        views: along the path.
        room: new views that fit into a sequence beside the photos, at least 1.

    Raises ValueError where there is no room for a new view.
    """
    if room < 1:
        raise ValueError(f"room: expected at least one new view beside the photos, got {room}")
    first = strided_subset(views, room)
    rest = [index for index in range(views) if index not in set(first)]
    anchors = int(_ANCHOR_SHARE * room) if rest else 0
    each = room - anchors
    count = math.ceil(len(rest) / each)
    return Passes(views=[first, *(rest[number::count] for number in range(count))], anchors=anchors)


def room_beside(
    photos: int,
    model: Fillerbuster,
    *,
    sequence: int,
    views: int,
    side: int,
    sampling: SamplingConfig,
    prompt: str | None = None,
) -> int:
    """New views of so many pixels a side that one sequence can hold beside the photos, for its length and for the
    memory that is free.

    Where not even one fits, the answer is still 1, and `Fillerbuster.complete` says what would fit. Raises ValueError
    for a sequence that the photos fill.
    """
    room = min(views, sequence - photos)
    if room < 1:
        raise ValueError(
            f"sequence: expected more than the {photos} photos that new views are conditioned on, got {sequence}"
        )
    while room > 1 and not _fits(model, photos + room, side, sampling, prompt):
        room = room // 2
    return room


def _fits(model: Fillerbuster, views: int, side: int, sampling: SamplingConfig, prompt: str | None) -> bool:
    """Whether a sequence fits into the memory that is free, however its work is cut."""
    size, free = (side, side), available_bytes(model.device)
    if (
        free is None
        or uncut(views, size, free, model=model.config, sampling=sampling, prompted=bool(prompt)) is not None
    ):
        return True
    tight = dataclasses.replace(
        sampling, memory_budget_bytes=model.estimate(1, (SIDE_MULTIPLE, SIDE_MULTIPLE), sampling).weights + free
    )
    try:
        model.estimate(views, size, tight, prompt=prompt)
    except ValueError:
        return False
    return True


def generate(
    photos: Sequence[Photo],
    cameras: Sequence[Pinholes],
    path: Pinholes,
    passes: Passes,
    model: Fillerbuster,
    *,
    seed: int,
    sampling: SamplingConfig,
    prompt: str | None = None,
    on_progress: OnProgress | None = None,
) -> Float[Tensor, "n 3 s s"]:
    """Views at the path's cameras, pass by pass, conditioned on the photos' central squares (and on views of the first
    pass).

    The model is told of all cameras near their middle, so that a world far from its origin gives the same views.

    Args:
        photos: what is known.
        cameras: of the whole photos.
        path: square cameras; their size is that of the views. In float64 where the world is far from its origin.
        passes: see `plan_passes`; pass ``k`` draws from ``seed + k``.
        model: the diffusion model.
        seed: the same seed and the same input give the same views.
        sampling: how each pass is sampled.
        prompt: for models that read text.
        on_progress: told of denoising steps, over all passes.
    """
    side = path.width
    squares = [Square.of(photo, side) for photo in photos]
    inside = Pinholes.cat([square.inside(camera) for square, camera in zip(squares, cameras, strict=True)]).to(
        torch.float64
    )
    middle = inside.centers.mean(dim=0)
    inside, path = (
        some.to(torch.float64).moved(-middle.to(some.centers.device)).to(torch.float32) for some in (inside, path)
    )
    images, masks = (torch.stack([getattr(square, name) for square in squares]) for name in ("image", "known"))
    given = Views.known(images, inside, mask=masks)
    made = torch.zeros(len(path), 3, side, side)
    for number, chosen in enumerate(passes.views):
        anchors = _anchors(passes) if number else []
        known = given if not anchors else Views.cat([given, Views.known(made[anchors], path[anchors])])

        def on_step(step: int, steps: int, number: int = number) -> None:
            if on_progress is not None:
                on_progress("generating views", number * steps + step, len(passes.views) * steps)

        filled = model.complete(
            Views.cat([known, Views.unknown(path[chosen])]),
            generator=torch.Generator().manual_seed(seed + number),
            sampling=sampling,
            prompt=prompt or None,
            on_step=on_step,
        )
        made[chosen] = filled.images[len(known) :].clamp(0, 1).float().cpu()
    return made


def _anchors(passes: Passes) -> list[int]:
    first = passes.views[0]
    return [first[place] for place in strided_subset(len(first), passes.anchors)]


def _known(photos: Sequence[Photo]) -> Registration:
    """What there is to say of cameras that are given."""
    cameras = tuple(photo.camera for photo in photos)
    centers = torch.cat([camera.centers for camera in cameras if camera is not None]).double()
    return Registration(
        cameras=cameras,
        verdicts=("known",) * len(photos),
        reasons=("",) * len(photos),
        residuals_degrees=(math.nan,) * len(photos),
        raymaps=None,
        arrangement=arrangement_of(
            centers, torch.zeros(len(centers), dtype=torch.float64), precision=torch.finfo(torch.float64).eps
        ),
    )
