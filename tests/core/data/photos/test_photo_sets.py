"""Photo sets on which cameras by features once failed, from the shared cases, against their true cameras.

The slow ones were last run on 2026-11-28; all passed.
"""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
import torch
from conftest import shared_path
from helpers.textured_box import UP, cameras_on_an_arc, render

from fb_core.data.photos.collection import read_photos
from fb_core.evaluation.metrics.pose_metrics import pose_errors
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.chain import chain
from fb_core.geometry.features.pairs import PhotoFeatures, features_of
from fb_core.geometry.pose_solver.verdict import Arrangement
from fb_core.registration.choice import Registration, register


def found_in(case: str) -> tuple[Registration, list[Pinholes]]:
    """What features find, and the truth (none where the case has none)."""
    folder = shared_path(f"cases/{case}")
    photos = read_photos(folder / "input")
    truth = []
    if (folder / "truth.json").is_file():
        told = json.loads((folder / "truth.json").read_text())
        truth = [camera_of(told[photo.source.name]) for photo in photos]
    return register(photos, method="features", model=None, seed=0), truth


def camera_of(told: dict) -> Pinholes:
    pose = torch.cat([torch.tensor(told["R"]), torch.tensor(told["c"])[:, None]], dim=1).double()
    width, height = told["w"], told["h"]
    return Pinholes(
        camera_to_world=pose[None],
        focal=torch.full((1, 2), float(told["f"]), dtype=torch.float64),
        principal=torch.tensor([[width / 2, height / 2]], dtype=torch.float64),
        width=width,
        height=height,
    )


def test_a_turn_on_the_spot_has_rotations_and_no_distances():
    found, truth = found_in("photos-turn-on-spot-exact")
    assert found.arrangement == Arrangement.ONE_PLACE and set(found.verdicts) == {"ok"}
    result = pose_errors(found.cameras, truth)
    assert result["rotation_degrees"] < 0.1 and result["focal_percent"] < 0.5


@pytest.mark.slow
def test_three_lenses_without_tags():
    found, truth = found_in("photos-arc-three-lenses")
    result = pose_errors(found.cameras, truth)
    assert set(found.verdicts) == {"ok"} and result["rotation_degrees"] < 0.5 and result["center"] < 0.05
    assert result["focal_percent"] < 1 and any("3 focal lengths" in note for note in found.notes)


@pytest.mark.slow
def test_a_barrel_lens_is_straightened():
    found, truth = found_in("photos-arc-barrel")
    result = pose_errors(found.cameras, truth)
    assert set(found.verdicts) == {"ok"} and len(found.straight) == 12
    assert result["rotation_degrees"] < 0.2 and result["center"] < 0.02
    bent = next(iter(found.straight.values()))
    assert not bent.stored and any("straightened" in note for note in found.notes)
    assert bent.bent is not None
    lens, told = bent.bent[0].focal.mean(), truth[0].focal.mean()
    assert abs(float(lens / told) - 1) < 0.01, (lens, told)


@pytest.mark.slow
def test_tags_that_lie_are_not_believed():
    found, _ = found_in("photos-castle-35mm-wrong")  # 64 mm told, 35 mm true: 492 pixels by the set's own calibration
    assert set(found.verdicts) == {"ok"} and any("contradicts" in note for note in found.notes)


@pytest.mark.slow
def test_one_digitally_zoomed_photo_of_a_box():
    """Photo 3 shows little but a wall: with the lens of the others it fits as well from nearer by."""
    truth = cameras_on_an_arc(8, width=480, height=360)
    zoom = torch.ones(8, 1)
    zoom[3] = 1.8
    truth = dataclasses.replace(truth, focal=truth.focal * zoom)
    photos = [features_of(picture, focal=None, lens="one") for picture in render(truth)]
    found = chain([thinned(photo, number) for number, photo in enumerate(photos)])
    ok = [camera if trusted else None for camera, trusted in zip(found.cameras, found.trusted, strict=True)]
    result = pose_errors(ok, [truth[number].to(torch.float64) for number in range(8)])
    assert sum(found.trusted) >= 7 and all(found.trusted[number] for number in (0, 1, 2, 4, 5, 6, 7))
    assert result["rotation_degrees"] < 0.1 and result["center"] < 0.01 and result["focal_percent"] < 1
    assert any("2 focal lengths" in note for note in found.notes)


@pytest.mark.slow
def test_an_orbit_with_little_overlap_keeps_its_one_lens():
    """One focal length for all, badly begun, explained less than one each, of which two groups were left."""
    angles = torch.arange(12) * math.radians(30.0)
    centers = torch.stack([1.5 * angles.cos(), 1.5 * angles.sin(), 0.15 * (3 * angles).sin()], dim=1)
    inwards = torch.stack([angles.cos(), angles.sin(), 0.2 * (2 * angles).cos()], dim=1)
    truth = Pinholes.looking_at(centers, centers - 3 * inwards, up=UP, fov_degrees=60.0, width=480, height=360)
    found = chain(
        [thinned(features_of(picture, focal=None, lens="one"), number) for number, picture in enumerate(render(truth))]
    )
    ok = [camera if trusted else None for camera, trusted in zip(found.cameras, found.trusted, strict=True)]
    placed = [(camera, number) for number, camera in enumerate(ok) if camera is not None]
    result = pose_errors([camera for camera, _ in placed], [truth[number].to(torch.float64) for _, number in placed])
    assert placed and result["rotation_degrees"] < 0.2 and result["focal_percent"] < 2, found.notes


def thinned(photo: PhotoFeatures, seed: int, *, most: int = 700) -> PhotoFeatures:
    kept = torch.randperm(len(photo.places), generator=torch.Generator().manual_seed(seed))[:most].sort().values
    return dataclasses.replace(photo, places=photo.places[kept], descriptors=photo.descriptors[kept])


def test_360_degree_photos_are_refused():
    with pytest.raises(ValueError, match="360-degree picture"):
        read_photos(shared_path("cases/photos-equirect-360") / "input")
