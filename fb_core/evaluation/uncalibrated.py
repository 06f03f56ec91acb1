"""Unposed views of unseen rooms: how well their cameras are recovered, by which method, and what a fly-through made
from them is worth.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.photos.photo import Photo
from fb_core.data.rooms.ray_caster import render
from fb_core.evaluation.completion import mean_color, unseen_house, unseen_room
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.evaluation.metrics.pose_metrics import aligned, pose_errors
from fb_core.evaluation.self_consistency import photo_of, self_consistency
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.chain import FOCAL_GUESS
from fb_core.geometry.viewpoints.camera_paths import path_cameras
from fb_core.inpainter import Fillerbuster
from fb_core.registration.choice import register
from fb_core.views import Views


@dataclass(frozen=True, kw_only=True)
class UncalibratedTask:
    """What is asked."""

    rooms: int = 20
    """Unseen rooms."""
    views: int = 16
    """Views per room, whose cameras are to be found."""
    path: int = 8
    """Views of the fly-through."""
    sides: tuple[int, ...] = (64, 256)
    """Pixels of the pictures that features are looked for in; the model always sees its own size."""
    loops: int = 4
    """Rooms, the first ones, in which the closed loop is measured too."""
    family: str = "narrow"
    """Room family."""
    seed: int = 0
    """Decides rooms, cameras and samples."""

    def __post_init__(self) -> None:
        if self.rooms < 1 or self.views < 2 or self.path < 1:
            raise ValueError(
                f"uncalibrated evaluation: expected rooms and path of at least 1 and views of at least 2, got {self}"
            )


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """One room with its truth."""

    images: Float[Tensor, "n 3 s s"]
    cameras: Pinholes
    path: Pinholes
    path_images: Float[Tensor, "m 3 s s"]


@dataclass(frozen=True, kw_only=True)
class _Answer:
    """Cameras that a method found, for pictures of the model's size."""

    cameras: list[Pinholes | None]
    trusted_share: float
    cpu_seconds: float


Outcome = dict[tuple[str, str], dict[str, float]]
"""What was measured in one room, by part and method."""


def evaluate_uncalibrated(
    model: Fillerbuster, task: UncalibratedTask, *, on_room: Callable[[str], None] = lambda _: None
) -> Iterator[Outcome]:
    """Of one room after the other: cameras by method, fly-throughs made from them, and the closed loop poses -> views
    -> poses.

    Errors are taken after the best similarity to the truth, which also places the fly-through in each method's own
    world.
    """
    for number in range(task.rooms):
        on_room(f"room {number + 1} of {task.rooms}")
        seed, outcome = task.seed + number, Outcome()
        scene = _scene(task, number, model.size)
        truth = _each(scene.cameras)
        answers = {"identity": _identity(scene)}
        answers |= {f"features at {side}": _by_features(task, number, side, model.size) for side in task.sides}
        answers["model"] = _by_model(model, scene, seed)
        for method, answer in answers.items():
            measures = {"trusted_share": answer.trusted_share, "cpu_seconds": answer.cpu_seconds}
            outcome["cameras", method] = pose_errors(answer.cameras, truth) | measures
            generated = None if method == "identity" else _fly_through(model, scene, answer.cameras, seed)
            outcome["fly-through", method] = {"psnr": math.nan if generated is None else _psnr(generated, scene)}
        best = _fly_through(model, scene, truth, seed)
        assert best is not None
        outcome["fly-through", "true cameras"] = {"psnr": _psnr(best, scene)}
        outcome["fly-through", "mean colour"] = {"psnr": _psnr(mean_color(scene.images, len(scene.path)), scene)}
        if number < task.loops:
            outcome["closed loop", "true views"] = _closed_loop(model, scene, scene.path_images, seed)
            outcome["closed loop", "generated views"] = _closed_loop(model, scene, best, seed)
        yield outcome


def evaluate_capture(
    model: Fillerbuster, photos: Sequence[Photo], *, seed: int, on_method: Callable[[str], None] = lambda _: None
) -> list[dict[str, Any]]:
    """Rows of errors of photos whose cameras are known, once these are hidden: by the model and by features, focal
    lengths told or not.

    Raises ValueError for fewer than two photos with cameras.
    """
    truth = [photo.camera for photo in photos if photo.camera is not None]
    if len(truth) != len(photos) or len(photos) < 2:
        raise ValueError(
            f"capture: expected at least two photos with cameras, got {len(photos)} photos, {len(truth)} of them with "
            "cameras"
        )
    rows: list[dict[str, Any]] = []
    for method in ("features", "model"):
        for focal_known in (True, False):
            name = f"{method}, focal length {'told' if focal_known else 'unknown'}"
            on_method(name)
            hidden = [
                dataclasses.replace(photo, camera=None, focal_prior=photo.focal_prior if focal_known else None)
                for photo in photos
            ]
            began = time.process_time()
            registration = register(hidden, method=method, model=model if method == "model" else None, seed=seed)
            seconds = time.process_time() - began
            trusted = sum(verdict == "ok" for verdict in registration.verdicts) / len(photos)
            row = pose_errors(registration.cameras, truth) | {"trusted_share": trusted, "cpu_seconds": seconds}
            rows.append({"part": f"{len(photos)} photos of a capture", "method": name} | row)
    return rows


def summary(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row for each part and method: medians over the rooms where there is a value, and how many these are."""
    rows: list[dict[str, Any]] = []
    for part, method in dict.fromkeys(key for outcome in outcomes for key in outcome):
        rooms = [outcome[part, method] for outcome in outcomes if (part, method) in outcome]
        row: dict[str, Any] = {"part": part, "method": method}
        for name in rooms[0]:
            values = [room[name] for room in rooms if not math.isnan(room[name])]
            row[name] = statistics.median(values) if values else math.nan
        first = next(iter(rooms[0]))
        rows.append(row | {"rooms": sum(not math.isnan(room[first]) for room in rooms)})
    return rows


def _closed_loop(model: Fillerbuster, scene: _Scene, pictures: Float[Tensor, "m 3 s s"], seed: int) -> dict[str, float]:
    images, cameras = [*scene.images, *pictures], [*_each(scene.cameras), *_each(scene.path)]
    return self_consistency(images, cameras, method="model", model=model, seed=seed, views_at_once=len(images))


def _scene(task: UncalibratedTask, number: int, size: int) -> _Scene:
    views = unseen_room(family=task.family, seed=task.seed, number=number, views=task.views, size=size)
    path = path_cameras("ellipse", [views.cameras], task.path, size=size)
    house = unseen_house(family=task.family, seed=task.seed, number=number)
    pictures = render(house, path, supersample=2).rgb.clamp(0, 1)
    return _Scene(images=views.images, cameras=views.cameras, path=path, path_images=pictures)


def _each(cameras: Pinholes) -> list[Pinholes]:
    return [cameras[index] for index in range(len(cameras))]


def _identity(scene: _Scene) -> _Answer:
    """The answer of somebody who knows nothing: all cameras in one place, looking one way, with a normal lens."""
    size = scene.cameras.width
    camera = Pinholes(
        camera_to_world=torch.eye(4, dtype=torch.float64)[None, :3],
        focal=torch.full((1, 2), FOCAL_GUESS * size, dtype=torch.float64),
        principal=torch.full((1, 2), size / 2, dtype=torch.float64),
        width=size,
        height=size,
    )
    return _Answer(cameras=[camera] * len(scene.cameras), trusted_share=0.0, cpu_seconds=0.0)


def _by_features(task: UncalibratedTask, number: int, side: int, size: int) -> _Answer:
    images = unseen_room(family=task.family, seed=task.seed, number=number, views=task.views, size=side).images
    return _registered(images, size, method="features", model=None, seed=0)


def _by_model(model: Fillerbuster, scene: _Scene, seed: int) -> _Answer:
    return _registered(scene.images, model.size, method="model", model=model, seed=seed)


def _registered(
    images: Float[Tensor, "n 3 s s"],
    size: int,
    *,
    method: Literal["model", "features"],
    model: Fillerbuster | None,
    seed: int,
) -> _Answer:
    photos = [photo_of(image, name=f"view {index}", device="one") for index, image in enumerate(images)]
    began = time.process_time()
    registration = register(photos, method=method, model=model, seed=seed)
    seconds = time.process_time() - began
    cameras = [None if camera is None else camera.scaled(size, size) for camera in registration.cameras]
    return _Answer(
        cameras=cameras,
        trusted_share=sum(verdict == "ok" for verdict in registration.verdicts) / len(photos),
        cpu_seconds=seconds,
    )


def _fly_through(
    model: Fillerbuster, scene: _Scene, found: Sequence[Pinholes | None], seed: int
) -> Float[Tensor, "m 3 s s"] | None:
    """The path's views, generated from the pictures that have a camera; the path is brought into the world of the found
    cameras.
    """
    similarity = aligned(found, _each(scene.cameras))
    there = [index for index, camera in enumerate(found) if camera is not None]
    if similarity is None or not there:
        return None
    cameras = Pinholes.cat([camera.to(torch.float32) for camera in found if camera is not None])
    if (
        similarity.scale < 1e-6
    ):  # found places that tell nothing: nor do they tell where the path runs, but it keeps its unit
        similarity = dataclasses.replace(similarity, scale=1.0, shift=scene.cameras.centers.double().mean(dim=0))
    path = similarity.inverse.cameras(scene.path)
    views = Views.cat([Views.known(scene.images[there], cameras), Views.unknown(path.to(torch.float32))])
    generator = torch.Generator().manual_seed(seed)
    return model.complete(views, generator=generator, sampling=model.recommended_sampling).images[len(there) :]


def _psnr(pictures: Float[Tensor, "m 3 s s"], scene: _Scene) -> float:
    return float(psnr(pictures, scene.path_images).mean())
