"""Cameras of photos from the raymaps that the model denoises given images only (paper, "Raymap prediction"), window by
window.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.media import resize
from fb_core.data.photos.choice import choose_by_coverage
from fb_core.data.photos.photo import Photo
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.solver import PoseSolving, Verdict, recover_cameras
from fb_core.geometry.raymap import raymaps_of
from fb_core.geometry.viewpoints.paths import spread_subset
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.masks import wholly_known
from fb_core.views import Views

ROUNDS = 8
"""Random partitions into windows that are averaged in every step (paper)."""
_TOLD = 1e-4  # relative deviation of told focal lengths: they stand, because raymaps err by far more than they scatter
_FOCAL_SIDES = (0.05, 10.0)  # focal lengths in sides of the square that lenses have: 169 to 6 degrees of view
_FEWEST_ANCHORS = 2  # one tells no scale
_ANCHOR_SHARE = 0.25  # of a later window's views are photos that have a camera already


@dataclass(frozen=True, kw_only=True)
class Square:
    """The centred square of a photo at the model's size, and its way back."""

    image: Float[Tensor, "3 s s"]
    """RGB in [0, 1], black where it is not known."""
    known: Float[Tensor, "1 s s"]
    """1 = known, else 0."""
    whole: tuple[int, int]
    """(height, width) of the photo, pixels."""

    @staticmethod
    def of(photo: Photo, side: int) -> Square:
        """The square spans the photo's shorter side. What is opaque by half or more is known, as in the capture that is
        written.
        """
        left, top, short = _window(photo.size)
        image, known = (pixels[:, top : top + short, left : left + short] for pixels in photo.load_with_mask())
        image, known = wholly_known(image, (known >= 0.5).to(image), lambda channels: resize(channels, side, side))
        return Square(image=image.clamp(0, 1), known=known, whole=photo.size)

    @property
    def side(self) -> int:
        """Pixels."""
        return self.image.shape[1]

    def inside(self, camera: Pinholes) -> Pinholes:
        """The square's camera, from that of the whole photo."""
        left, top, short = _window(self.whole)
        return camera.cropped(left, top, short, short).scaled(self.side, self.side)

    def outside(self, camera: Pinholes) -> Pinholes:
        """The whole photo's camera, from that of the square: the inverse."""
        left, top, short = _window(self.whole)
        return camera.scaled(short, short).cropped(-left, -top, self.whole[1], self.whole[0])

    @property
    def principal(self) -> Float[Tensor, " 2"]:
        """Where the whole photo's middle is in the square."""
        left, top, short = _window(self.whole)
        middle = torch.tensor([self.whole[1] / 2 - left, self.whole[0] / 2 - top], dtype=torch.float64)
        return middle * self.side / short


def _window(size: tuple[int, int]) -> tuple[int, int, int]:
    """Left, top and side of the centred square of a picture of this (height, width)."""
    short = min(size)
    return (size[1] - short) // 2, (size[0] - short) // 2, short


@dataclass(frozen=True, kw_only=True)
class RaymapCameras:
    """What the raymaps of n photos say."""

    cameras: list[Pinholes | None]
    """Of whole photos, float64, in the frame of the raymaps; None where the rays fit no camera."""
    reasons: list[str]
    """Why there is none."""
    residuals_degrees: list[float]
    """Standard deviation of directions about the camera's; NaN where there is none."""
    raymaps: Float[Tensor, "n 6 s s"]
    """As denoised; those of known cameras are exact. NaN where nothing was denoised. Float64 where cameras were given:
    their world may be far from its origin.
    """
    origin_deviations: list[float]
    """Standard deviation of the mean of a photo's origins, in the raymaps' unit."""


def recover_with_model(
    photos: Sequence[Photo],
    model: Fillerbuster,
    *,
    seed: int,
    sampling: SamplingConfig,
    views_at_once: int,
    on_progress: Callable[[str, int, int], None] = lambda *_: None,
) -> RaymapCameras:
    """Raymaps of all photos in one frame, and the cameras that they fit.

    At most `views_at_once` photos are denoised together. With more of them, the first window holds those that cover the
    scene best; the others follow, each window beside some photos that have a camera by then, whose rays are given.
    Where photos come with cameras, these are given from the start, and the frame is theirs; all work is done near the
    first of them, so that a moved world loses nothing.
    """
    options = {"seed": seed, "sampling": sampling, "views_at_once": views_at_once, "on_progress": on_progress}
    given = [photo.camera for photo in photos if photo.camera is not None]
    if not given:
        return _recovered_near(photos, model, **options)
    origin = given[0].centers[0].double()
    near = [dataclasses.replace(photo, camera=_moved(photo.camera, -origin)) for photo in photos]
    recovered = _recovered_near(near, model, **options)
    back = [_moved(camera, origin) for camera in recovered.cameras]
    cameras = [camera if photo.camera is None else photo.camera for photo, camera in zip(photos, back, strict=True)]
    raymaps = recovered.raymaps.double() + torch.cat([origin, torch.zeros_like(origin)])[:, None, None]
    return dataclasses.replace(recovered, cameras=cameras, raymaps=raymaps)


def _moved(camera: Pinholes | None, shift: Float[Tensor, " 3"]) -> Pinholes | None:
    return None if camera is None else camera.to(torch.float64).moved(shift)


def _recovered_near(
    photos: Sequence[Photo],
    model: Fillerbuster,
    *,
    seed: int,
    sampling: SamplingConfig,
    views_at_once: int,
    on_progress: Callable[[str, int, int], None],
) -> RaymapCameras:
    """As :func:`recover_with_model`, for cameras that are given near the origin."""
    squares = [Square.of(photo, model.size) for photo in photos]
    raymaps = torch.full((len(photos), 6, model.size, model.size), torch.nan)
    given = [index for index, photo in enumerate(photos) if photo.camera is not None]
    for index in given:
        raymaps[index] = raymaps_of(squares[index].inside(_camera_of(photos[index])))[0].float()
    waiting = [index for index in range(len(photos)) if index not in given]
    total, number = len(waiting), 0
    solved = _solved(photos, squares, raymaps)
    while waiting:
        anchors = _anchors(
            solved,
            given,
            views_at_once
            if len(photos) <= views_at_once
            else max(_FEWEST_ANCHORS, round(_ANCHOR_SHARE * views_at_once)),
        )
        if number and not anchors:
            break  # nothing ties a further window to the first
        room = max(1, views_at_once - len(anchors))
        chosen = (
            waiting
            if len(waiting) <= room
            else [waiting[i] for i in choose_by_coverage([photos[i] for i in waiting], room)]
        )
        posed = [(squares[index], _inside(solved, squares, index)) for index in anchors]
        views = _views(posed, [squares[index] for index in chosen])
        generator = torch.Generator().manual_seed(seed + number)

        def on_step(step: int, steps: int, chosen: Sequence[int] = chosen, before: int = total - len(waiting)) -> None:
            on_progress("recovering cameras", before * steps + step * len(chosen), total * steps)

        raymaps[chosen] = (
            model.complete(views, generator=generator, sampling=sampling, on_step=on_step).raymaps[len(anchors) :].cpu()
        )
        waiting = [index for index in waiting if index not in chosen]
        solved = _solved(photos, squares, raymaps)
        number += 1
    return solved


def _camera_of(photo: Photo) -> Pinholes:
    assert photo.camera is not None
    return photo.camera


def _inside(solved: RaymapCameras, squares: Sequence[Square], index: int) -> Pinholes:
    camera = solved.cameras[index]
    assert camera is not None
    return squares[index].inside(camera)


def _anchors(solved: RaymapCameras, given: Sequence[int], most: int) -> list[int]:
    """Photos with cameras, given ones first choice, then those that fit best; spread over the scene, the most level one
    in front.
    """
    with_camera = [index for index, camera in enumerate(solved.cameras) if camera is not None]
    best = sorted(set(with_camera) - set(given), key=lambda index: solved.residuals_degrees[index])
    candidates = [*given, *best][: max(len(given), 2 * most)]
    if not candidates:
        return []
    chosen = spread_subset([camera for index in candidates if (camera := solved.cameras[index]) is not None], most)
    return [candidates[index] for index in chosen]


def _views(posed: Sequence[tuple[Square, Pinholes]], unposed: Sequence[Square]) -> Views:
    """Known images, with known rays for the posed ones."""
    squares = [*(square for square, _ in posed), *unposed]
    views = Views.unposed(torch.stack([square.image for square in squares]))
    views = dataclasses.replace(views, image_known=torch.stack([square.known for square in squares]))
    if not posed:
        return views
    raymaps, known = views.raymaps.clone(), views.rays_known.clone()
    raymaps[: len(posed)] = torch.cat([raymaps_of(camera).float() for _, camera in posed])
    known[: len(posed)] = 1.0
    return dataclasses.replace(views, raymaps=raymaps, rays_known=known)


def _solved(photos: Sequence[Photo], squares: Sequence[Square], raymaps: Float[Tensor, "n 6 s s"]) -> RaymapCameras:
    """Cameras of the raymaps that there are, one focal length for all photos of a device."""
    cameras = [photo.camera for photo in photos]
    reasons = [
        "" if camera is not None else "none of the others has a camera that it could be placed beside"
        for camera in cameras
    ]
    residuals, deviations = [math.nan] * len(photos), [math.nan] * len(photos)
    there = torch.isfinite(raymaps).flatten(1).all(dim=1).tolist()
    groups: dict[str, list[int]] = {}
    for index, photo in enumerate(photos):
        if photo.camera is None and there[index]:
            groups.setdefault(lens_in_words(photo), []).append(index)
    for members in groups.values():
        recovered = recover_cameras(
            raymaps[members],
            principal=torch.stack([squares[index].principal for index in members]),
            focal=torch.tensor([_told_focal(photos[index], squares[index]) for index in members], dtype=torch.float64),
            solving=PoseSolving(focal="shared", square_pixels=True, focal_deviation=_TOLD),
        )
        for place, index in enumerate(members):
            reasons[index] = recovered.reasons[place]
            sides = float(recovered.cameras.focal[place, 0]) / squares[index].side
            if recovered.verdicts[place] is Verdict.OK and not _FOCAL_SIDES[0] < sides < _FOCAL_SIDES[1]:
                reasons[index] = (
                    f"its rays fit a camera of {math.degrees(2 * math.atan(0.5 / sides)):.2g} degrees of view only"
                )
            elif recovered.verdicts[place] is Verdict.OK:
                cameras[index] = squares[index].outside(recovered.cameras[place].to(torch.float64))
                residuals[index] = float(recovered.residual_degrees[place])
                deviations[index] = float(recovered.covariance[place, 3, 3]) ** 0.5
    return RaymapCameras(
        cameras=cameras, reasons=reasons, residuals_degrees=residuals, raymaps=raymaps, origin_deviations=deviations
    )


def _told_focal(photo: Photo, square: Square) -> float:
    return math.nan if photo.focal_prior is None else photo.focal_prior * square.side / min(photo.size)


def lens_in_words(photo: Photo) -> str:
    """What photos of one focal length have in common. Where nothing is known of the device, photos of one size count as
    one device's.
    """
    return photo.device or f"unknown device, {max(photo.size)} x {min(photo.size)}"
