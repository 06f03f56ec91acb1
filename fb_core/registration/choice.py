"""Cameras of photos that nobody has measured: by the model's raymaps or by features, in one upright world, with
verdicts.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.photos.photo import Photo
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.chain import FeatureCameras
from fb_core.geometry.gravity import upright
from fb_core.geometry.pose_solver.verdict import Arrangement, arrangement_of
from fb_core.geometry.similarity import Similarity
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.registration.by_features import recover_with_features
from fb_core.registration.by_raymaps import ROUNDS, RaymapCameras, recover_with_model

DOUBTFUL_DEGREES = 3.0
"""Raymaps that stray more from a pinhole camera's were not understood by the model: well denoised ones stray by less
than 0.1 degrees.
"""

OnProgress = Callable[[str, int, int], None]
"""Told what is being done, how much of it is done, and how much there is."""


@dataclass(frozen=True, kw_only=True)
class Registration:
    """The cameras of some photos, with what is to be thought of each."""

    cameras: tuple[Pinholes | None, ...]
    """One for each photo, in float64: of the whole upright picture at its full size. None: the photo is left out."""
    verdicts: tuple[str, ...]
    """"known" (it was given), "ok", "doubtful" (there is a camera, but little speaks for it), or why there is none."""
    reasons: tuple[str, ...]
    """A sentence for a person: what speaks against the camera, or is worth knowing; empty where all is well."""
    residuals_degrees: tuple[float, ...]
    """How badly a photo's rays or features fit its camera; NaN where that is not known."""
    raymaps: Float[Tensor, "n 6 h w"] | None
    """As the model denoised them, of the photos' central squares, in the model's own frame; None for features."""
    arrangement: Arrangement
    """How the cameras stand to each other."""
    straight: dict[int, Photo] = field(default_factory=dict)
    """Photos that were straightened because their lens bends, by number; their cameras are those of the straight
    photos.
    """
    notes: tuple[str, ...] = ()
    """Sentences for a person on all photos together, such as what was found of their lenses."""


def register(
    photos: Sequence[Photo],
    *,
    method: Literal["model", "features"],
    model: Fillerbuster | None,
    seed: int,
    sampling: SamplingConfig | None = None,
    views_at_once: int = 16,
    on_progress: OnProgress | None = None,
) -> Registration:
    """Cameras of all photos in one world: z up, the cameras' middle at the origin, the farthest camera at distance 1.

    Where photos have cameras (`Photo.camera`), these stay as they are and the world is theirs.

    Args:
        photos: two or more.
        method: "model" denoises raymaps given the images; "features" matches SIFT features and adjusts a bundle (no
            model is needed).
        model: for "model".
        seed: decides the samples.
        sampling: None is the model's `recommended_sampling.for_poses()` with the paper's 8 rounds.
        views_at_once: photos that the model sees together.
        on_progress: called with what is being done, how much is done, and of how much.

    Raises ValueError for fewer than two photos or `views_at_once` below 3, and for the method "model" without a model.
    """
    if len(photos) < 2:
        raise ValueError(
            f"register: expected at least two photos, got {len(photos)}; one photo says nothing of where it was taken"
        )
    if views_at_once < 3:
        raise ValueError(
            f"views_at_once: expected at least 3 (two that tell place and scale, and a new one), got {views_at_once}"
        )
    if method == "model" and model is None:
        raise ValueError(
            "register: the method 'model' needs a model, got None; load one, or choose the method 'features'"
        )
    report = on_progress or (lambda *_: None)
    if method == "model":
        assert model is not None
        sampling = sampling or dataclasses.replace(model.recommended_sampling.for_poses(), rounds=ROUNDS)
        recovered = recover_with_model(
            photos, model, seed=seed, sampling=sampling, views_at_once=views_at_once, on_progress=report
        )
        return _of_raymaps(photos, recovered)
    return _of_features(photos, *recover_with_features(photos, on_progress=report))


def _of_raymaps(photos: Sequence[Photo], found: RaymapCameras) -> Registration:
    """Raymaps that stray from every pinhole camera are the model's own doubt: good ones err by a twentieth of a
    degree.
    """
    verdicts, reasons = [], []
    for photo, camera, reason, residual in zip(
        photos, found.cameras, found.reasons, found.residuals_degrees, strict=True
    ):
        if photo.camera is not None:
            verdict, reason = "known", ""
        elif camera is None:
            verdict = "no camera"
        elif residual > DOUBTFUL_DEGREES:
            verdict, reason = (
                "doubtful",
                f"its rays stray from a camera's by {residual:.1f} degrees, expected at most {DOUBTFUL_DEGREES:g}",
            )
        else:
            verdict, reason = "ok", ""
        verdicts.append(verdict)
        reasons.append(reason)
    placed = [
        (camera, 0.0 if math.isnan(off) else off)
        for camera, off in zip(found.cameras, found.origin_deviations, strict=True)
        if camera
    ]
    arrangement = Arrangement.NO_CAMERA
    if placed:
        centers = torch.cat([camera.centers for camera, _ in placed])
        given = [photo.camera.centers[0] for photo in photos if photo.camera is not None]
        centers = (
            centers - given[0].to(centers) if given else centers
        )  # rounding is that of the place that raymaps were denoised at
        deviations = centers.new_tensor([off for _, off in placed])
        arrangement = arrangement_of(centers, deviations, precision=torch.finfo(torch.float32).eps)
    return Registration(
        cameras=_in_one_world(photos, found.cameras, verdicts),
        verdicts=tuple(verdicts),
        reasons=tuple(reasons),
        residuals_degrees=tuple(found.residuals_degrees),
        raymaps=found.raymaps,
        arrangement=arrangement,
    )


def _of_features(
    photos: Sequence[Photo], found: FeatureCameras, to_known: Similarity | None, straight: dict[int, Photo]
) -> Registration:
    known = [photo.camera is not None for photo in photos]
    cameras, verdicts, reasons = list[Pinholes | None](), list[str](), list[str]()
    for photo, camera, trusted, reason in zip(photos, found.cameras, found.trusted, found.reasons, strict=True):
        if photo.camera is not None:
            camera, verdict, reason = photo.camera, "known", ""
        elif camera is None:
            verdict = "no camera"
        elif any(known) and to_known is None:
            camera, verdict, reason = None, "no camera", "shares no features with the photos whose cameras are known"
        else:
            camera, verdict = camera if to_known is None else to_known.cameras(camera), "ok" if trusted else "doubtful"
        cameras.append(camera)
        verdicts.append(verdict)
        reasons.append(reason)
    return Registration(
        cameras=_in_one_world(photos, cameras, verdicts),
        verdicts=tuple(verdicts),
        reasons=tuple(reasons),
        residuals_degrees=tuple(found.residuals_degrees),
        raymaps=None,
        arrangement=found.arrangement,
        straight=straight,
        notes=tuple(found.notes),
    )


def _in_one_world(
    photos: Sequence[Photo], cameras: Sequence[Pinholes | None], verdicts: Sequence[str]
) -> tuple[Pinholes | None, ...]:
    """As they are where some are given (the frame is theirs already), else upright, by those that are trusted if there
    are two.
    """
    if any(photo.camera is not None for photo in photos):
        return tuple(cameras)
    trusted = [
        camera for camera, verdict in zip(cameras, verdicts, strict=True) if camera is not None and verdict == "ok"
    ]
    placed = trusted if len(trusted) > 1 else [camera for camera in cameras if camera is not None]
    if not placed:
        return tuple(cameras)
    to_world = upright(placed)
    return tuple(None if camera is None else to_world.cameras(camera) for camera in cameras)
