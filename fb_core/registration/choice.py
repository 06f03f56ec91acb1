"""Cameras of photos that nobody has measured: by the model's raymaps or by features, in one upright world, with
verdicts.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
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
from fb_core.registration.two_draws import AGREEING_DEGREES, LEAST_AGREEMENT, agreement

DOUBTFUL_DEGREES = 3.0
"""Raymaps that stray more from a pinhole camera's were not understood by the model: well denoised ones stray by less
than 0.1 degrees.
"""

_ANOTHER_SEED = 2**31  # apart from the seeds of a draw's windows

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
        method: "model" denoises raymaps given the images, a second time where they are those of firm cameras, and
            believes what is the same (`two_draws`); "features" matches SIFT features and adjusts a bundle (no
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
        ask = partial(recover_with_model, model=model, sampling=sampling, views_at_once=views_at_once)
        return _asked_twice(photos, ask, seed=seed, on_progress=report)
    return _of_features(photos, *recover_with_features(photos, on_progress=report))


def _asked_twice(
    photos: Sequence[Photo], ask: Callable[..., RaymapCameras], *, seed: int, on_progress: OnProgress
) -> Registration:
    """A model's cameras; those of firm rays are asked for once more, the photos the other way round, so that nothing
    but they is the same.
    """
    recovered = ask(photos, seed=seed, on_progress=on_progress)
    if not any(_is_firm(residual) for residual in recovered.residuals_degrees):
        return _of_raymaps(photos, recovered, [None] * len(photos))

    def once_more(what: str, done: int, steps: int) -> None:
        on_progress(f"{what} once more", done, steps)

    again = ask(photos[::-1], seed=seed ^ _ANOTHER_SEED, on_progress=once_more)
    return _of_raymaps(photos, recovered, again.cameras[::-1])


def _is_firm(residual_degrees: float) -> bool:
    return residual_degrees <= DOUBTFUL_DEGREES  # NaN is not


def _of_raymaps(photos: Sequence[Photo], found: RaymapCameras, again: Sequence[Pinholes | None]) -> Registration:
    """Raymaps that stray from every pinhole camera are the model's own doubt (good ones err by a twentieth of a
    degree); so are cameras that are others when the model is asked again.
    """
    verdicts, reasons = [], []
    arrangement = _arrangement(photos, found)
    shares = agreement(found.cameras, again, apart=arrangement is Arrangement.APART).tolist()
    for photo, camera, reason, residual, share in zip(
        photos, found.cameras, found.reasons, found.residuals_degrees, shares, strict=True
    ):
        if photo.camera is not None:
            verdict, reason = "known", ""
        elif camera is None:
            verdict = "no camera"
        elif not _is_firm(residual):
            verdict, reason = (
                "doubtful",
                f"its rays stray from a camera's by {residual:.1f} degrees, expected at most {DOUBTFUL_DEGREES:g}",
            )
        elif not share >= LEAST_AGREEMENT:  # NaN: nobody to compare with
            verdict, reason = (
                "doubtful",
                f"asked twice, the model turns and shifts it alike to {0 if math.isnan(share) else share:.0%} of the "
                f"other photos (within {AGREEING_DEGREES:g} degrees), expected at least {LEAST_AGREEMENT:.0%}",
            )
        else:
            verdict, reason = "ok", ""
        verdicts.append(verdict)
        reasons.append(reason)
    return Registration(
        cameras=_in_one_world(photos, found.cameras, verdicts),
        verdicts=tuple(verdicts),
        reasons=tuple(reasons),
        residuals_degrees=tuple(found.residuals_degrees),
        raymaps=found.raymaps,
        arrangement=arrangement,
    )


def _arrangement(photos: Sequence[Photo], found: RaymapCameras) -> Arrangement:
    """How the cameras stand to each other, as far as their origins' deviations tell."""
    placed = [
        (camera, 0.0 if math.isnan(off) else off)
        for camera, off in zip(found.cameras, found.origin_deviations, strict=True)
        if camera
    ]
    if not placed:
        return Arrangement.NO_CAMERA
    centers = torch.cat([camera.centers for camera, _ in placed])
    given = [photo.camera.centers[0] for photo in photos if photo.camera is not None]
    centers = (
        centers - given[0].to(centers) if given else centers
    )  # rounding is that of the place that raymaps were denoised at
    deviations = centers.new_tensor([off for _, off in placed])
    return arrangement_of(centers, deviations, precision=torch.finfo(torch.float32).eps)


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
