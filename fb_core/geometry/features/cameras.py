"""What features say of photos: cameras, verdicts, lenses; and the case where they tell rotations alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.pairs import PhotoFeatures
from fb_core.geometry.features.panorama import Panorama
from fb_core.geometry.pose_solver.verdict import Arrangement

_COPIES_DEGREES = 0.2  # photos in one place that are turned by less are copies of one another


@dataclass(frozen=True, kw_only=True)
class FeatureCameras:
    """What features say of n photos."""

    cameras: list[Pinholes | None]
    """Each a batch of one, float64, of the whole photo, in a world of their own; None where features do not tell."""
    trusted: list[bool]
    """Whether there is a camera beyond doubt."""
    reasons: list[str]
    """What is to be doubted, or worth knowing; empty where all is well."""
    residuals_degrees: list[float]
    """Root mean square of the angles by which features miss their points, per axis; NaN where there is no camera."""
    arrangement: Arrangement
    """How the cameras stand to each other."""
    bends: list[tuple[float, float]]
    """k1 and k2 of each photo's lens, in OpenCV's model; zeros where it is straight."""
    notes: list[str]
    """Sentences on the lenses that were found; empty where they are as the photos tell, or as everybody would guess."""

    def with_those_of(self, other: FeatureCameras, photos: Sequence[int]) -> FeatureCameras:
        """With what another answer in the same world says of some photos."""
        chosen = set(photos)
        merged = {
            name: [
                (theirs if index in chosen else ours) for index, (ours, theirs) in enumerate(zip(*both, strict=True))
            ]
            for name in ("cameras", "trusted", "reasons", "residuals_degrees", "bends")
            for both in [(getattr(self, name), getattr(other, name))]
        }
        return dataclasses.replace(self, **merged)


def one_place(photos: Sequence[PhotoFeatures], panorama: Panorama, *, sure: bool) -> FeatureCameras:
    """Where rotations are all that features tell; trusted if it is sure that they explain the photos."""
    cameras = [
        None if turn is None else camera_of_photo(photo, turn, np.zeros(3), focal)
        for photo, turn, focal in zip(photos, panorama.rotations, panorama.focal, strict=True)
    ]
    turns = [turn for turn in panorama.rotations if turn is not None]
    copies = all(np.trace(turn @ turns[0].T) > 1 + 2 * np.cos(np.radians(_COPIES_DEGREES)) for turn in turns)
    here = (
        "shows the same as the others, from the same place"
        if copies
        else "taken in the same place as the others: no distances"
    )
    if not sure:
        here = (
            "neither one place nor several explain what it shares with the others (one place "
            f"{panorama.share:.0%} of it)"
        )
    return FeatureCameras(
        cameras=cameras,
        trusted=[camera is not None and sure and not copies for camera in cameras],
        reasons=["shares too few features with the others" if camera is None else here for camera in cameras],
        residuals_degrees=[float("nan")] * len(photos),
        arrangement=Arrangement.ONE_PLACE if turns else Arrangement.NO_CAMERA,
        bends=[(0.0, 0.0)] * len(photos),
        notes=[],
    )


def camera_of_photo(photo: PhotoFeatures, rotation: np.ndarray, shift: np.ndarray, focal: float) -> Pinholes:
    """A photo's camera from its world-to-camera map and its focal length in pixels."""
    height, width = photo.size
    pose = torch.from_numpy(np.concatenate([rotation.T, -(rotation.T @ shift)[:, None]], axis=1))
    return Pinholes(
        camera_to_world=pose[None],
        focal=torch.full((1, 2), float(focal), dtype=torch.float64),
        principal=torch.tensor([[width / 2, height / 2]], dtype=torch.float64),
        width=width,
        height=height,
    )
