"""Cameras from features: exact places give exact cameras, whatever the order; what features cannot tell is said."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from helpers.scenes.features import SIZE, around, bundle, cloud, lenses, perturbed, rotations_of, seen

from fb_core.evaluation.metrics.pose_metrics import pose_errors
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.bundle_adjustment import _jacobians, adjust
from fb_core.geometry.features.chain import chain
from fb_core.geometry.features.pairs import PhotoFeatures, features_of, match_pairs, verified_pair
from fb_core.geometry.pose_solver.verdict import Arrangement


def turning(count: int) -> Pinholes:
    """Cameras in one place that look around."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    angles = torch.linspace(-0.25, 0.25, count, dtype=torch.float64)
    targets = torch.stack([angles.cos(), angles.sin(), 0.3 * angles.cos() * (5 * angles).sin()], dim=1)
    cameras = Pinholes.looking_at(
        torch.zeros_like(targets), targets, up=up, fov_degrees=60.0, width=SIZE[1], height=SIZE[0]
    )
    return dataclasses.replace(cameras, focal=torch.full((count, 2), 700.0, dtype=torch.float64))


def errors(found, truth: Pinholes) -> dict[str, float]:
    return pose_errors(found.cameras, [truth[index] for index in range(len(truth))])


@pytest.mark.parametrize("count", [2, 3, 7])
def test_exact_places_and_a_told_focal_length_give_exact_cameras(count):
    truth = around(count, arc_degrees=8.0 * count)
    found = chain(seen(truth, cloud(200), told=500.0))
    result = errors(found, truth)
    assert found.arrangement == Arrangement.APART and all(found.trusted) and found.reasons == [""] * count
    assert result["rotation_degrees"] < 0.01 and result["center"] < 0.002 and result["focal_percent"] < 0.1


@pytest.mark.parametrize("focal", [420.0, 900.0])
def test_an_unknown_focal_length_is_found(focal):
    truth = around(5, focal=focal, arc_degrees=50.0)
    result = errors(chain(seen(truth, cloud(250), noise=0.3)), truth)
    assert result["found_share"] == 1.0
    assert result["rotation_degrees"] < 0.3 and result["center"] < 0.02 and result["focal_percent"] < 2.0


def test_two_lenses_have_two_focal_lengths():
    truth = around(6, arc_degrees=50.0)
    points = cloud(150)
    first, second = truth[[0, 2, 4]], dataclasses.replace(truth[[1, 3, 5]], focal=truth.focal[:3] * 1.5)
    photos = [*seen(first, points, noise=0.2), *seen(second, points, lens="other", noise=0.2, seed=1)]
    cameras = chain(photos).cameras
    assert all(camera is not None for camera in cameras)
    lengths = [float(camera.focal[0, 0]) for camera in cameras if camera is not None]
    assert lengths == pytest.approx([500.0] * 3 + [750.0] * 3, rel=0.02)


def test_wrong_matches_and_noise_are_borne():
    truth = around(6)
    result = errors(chain(seen(truth, cloud(500), told=500.0, noise=0.4, wrong=0.25)), truth)
    assert result["found_share"] == 1.0 and result["rotation_degrees"] < 0.2 and result["center"] < 0.02


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("noise", [0.03, 0.2])
def test_two_photos_of_little_but_a_wall_have_the_right_motion(seed: int, noise: float):
    """Within a pixel of tolerance a wrong motion explains a wall as well, but puts half of it behind a camera."""
    generator = np.random.default_rng(seed)
    focal, size = 104.0, (120, 160)
    wall = np.stack([*generator.uniform([[-1.6], [-1.2]], [[1.6], [1.2]], (2, 220)), np.full(220, 2.5)], axis=1)
    wall[::12, 2] -= 0.15  # some of it stands out a little
    angle = math.radians(generator.uniform(12, 30))
    rotation = np.array([[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]])
    shift = np.array([2.2 * math.sin(angle), 0.1, 2.2 * (1 - math.cos(angle))])  # around the wall's middle
    both = [points[:, :2] / points[:, 2:] * focal for points in (wall, wall @ rotation.T + shift)]
    photos = [
        PhotoFeatures(
            places=torch.from_numpy(offsets + noise * generator.normal(size=offsets.shape) + [80, 60]).float(),
            descriptors=torch.eye(220),
            coarse=torch.zeros(0, 220),
            size=size,
            focal=focal,
            lens="a",
        )
        for offsets in both
    ]
    every = np.arange(220).repeat(2).reshape(-1, 2)
    pair = verified_pair(photos, (0, 1), every, [focal, focal])
    assert pair is not None and len(pair.matches) > 200
    turn = math.degrees(math.acos(min(1.0, (np.trace(pair.rotation @ rotation.T) - 1) / 2)))
    assert turn < (0.6 if noise < 0.1 else 4)


def test_an_assertion_that_fails_within_opencv_ends_nothing(monkeypatch: pytest.MonkeyPatch):
    """OpenCV 4.10 fails one in findFundamentalMat on some matches of good photos."""
    import cv2

    original, asked = cv2.findFundamentalMat, []

    def failing(first, second, method, *rest):
        asked.append(method)
        if method == cv2.USAC_MAGSAC:
            raise cv2.error("(-215:Assertion failed) !model.empty() in function 'setModelParameters'")
        return original(first, second, method, *rest)

    monkeypatch.setattr(cv2, "findFundamentalMat", failing)
    photos = seen(around(3), cloud(120))
    found = match_pairs(photos, lambda done, total: None)
    assert cv2.USAC_MAGSAC in asked and len(found) == 3 and all(len(matches) > 60 for matches in found.values())


def test_the_order_of_photos_only_changes_the_world():
    truth, order = around(5), [3, 0, 4, 2, 1]
    photos = seen(truth, cloud(200), told=500.0)
    straight, shuffled = chain(photos).cameras, chain([photos[index] for index in order]).cameras
    assert all(camera is not None for camera in straight)
    result = pose_errors(shuffled, [camera for index in order if (camera := straight[index]) is not None])
    assert result["rotation_degrees"] < 0.01 and result["center"] < 0.002


def test_the_same_call_gives_the_same_cameras():
    photos = seen(around(3, arc_degrees=25.0), cloud(120), told=500.0, noise=0.3)
    first, second = (chain(photos).cameras for _ in range(2))
    assert all(torch.equal(a.camera_to_world, b.camera_to_world) for a, b in zip(first, second, strict=True) if a and b)


def test_photos_of_another_scene_are_left_out():
    truth = around(4)
    photos = [*seen(truth, cloud(200), told=500.0), *seen(around(1), cloud(200, seed=5), told=500.0, alphabet=1)]
    found = chain(photos)
    assert found.cameras[4] is None and not found.trusted[4] and "too few features" in found.reasons[4]
    assert all(found.trusted[:4]) and math.isnan(found.residuals_degrees[4])


def test_a_pure_rotation_is_said_to_be_one_and_its_rotations_are_found():
    truth = turning(4)
    found = chain(seen(truth, 5 * F.normalize(cloud(3000), dim=1)))
    result = errors(found, truth)
    assert found.arrangement == Arrangement.ONE_PLACE and all("same place" in reason for reason in found.reasons)
    assert all(found.trusted) and result["rotation_degrees"] < 0.5 and result["focal_percent"] < 4.0


def test_identical_photos_are_not_trusted():
    photo = seen(around(1), cloud(200))[0]
    found = chain([photo] * 4)
    assert found.arrangement == Arrangement.ONE_PLACE and not any(found.trusted)
    assert all("same as the others" in reason for reason in found.reasons)


def test_black_photos_have_no_cameras():
    black = features_of(torch.zeros(3, 64, 96), focal=None, lens="one")
    found = chain([black, black])
    assert found.cameras == [None, None] and found.arrangement == Arrangement.NO_CAMERA and not any(found.trusted)


def test_features_lie_where_the_picture_shows_them():
    """Pixels and the half pixel between the conventions: a picture shifted by 8 pixels shifts its features by 8."""
    pattern = torch.rand(1, 3, 20, 30, generator=torch.Generator().manual_seed(0))
    image = F.interpolate(pattern, scale_factor=12, mode="bicubic")[0].clamp(0, 1)
    first, second = (features_of(image[:, :, left : left + 320], focal=None, lens="") for left in (0, 8))
    alike = first.descriptors @ second.descriptors.T
    strength, partner = alike.max(dim=1)
    moved = (first.places - second.places[partner])[strength > 0.98]
    assert len(moved) > 50 and torch.allclose(moved.median(dim=0).values, torch.tensor([8.0, 0.0]), atol=0.1)


# ---- bundle adjustment -----------------------------------------------------------------------------------------------


def test_the_adjustment_finds_exact_observations_again():
    found = adjust(perturbed(bundle(), 0.02), lenses(), steps=40)
    assert np.abs(found.misses()).max() < 1e-4 and found.focal == pytest.approx([500.0, 500.0], rel=0.05)


def test_told_focal_lengths_stay():
    start = dataclasses.replace(perturbed(bundle(), 0.01), focal=np.full(2, 480.0))
    assert adjust(start, lenses(told=480.0, deviation=1e-6), steps=10).focal == pytest.approx([480.0, 480.0], rel=1e-3)


def test_derivatives_are_those_of_differences():
    straight = dataclasses.replace(bundle(cameras=2, points=5), bend=np.array([[-0.12, 0.03], [0.05, -0.01]]))
    here = dataclasses.replace(straight, offsets=straight.offsets + straight.misses())
    here = perturbed(here, 1e-5)  # misses far below the tolerance, where weights are constant
    of_camera, of_point, _ = _jacobians(here)
    step = 1e-6

    def moved(**changes: np.ndarray) -> np.ndarray:
        return (dataclasses.replace(here, **changes).misses() - here.misses()) / step

    for axis in range(3):
        vector = np.eye(3)[axis] * step
        turn = rotations_of(np.tile(vector, (2, 1)))
        turned = moved(rotations=turn @ here.rotations, shifts=np.einsum("nij,nj->ni", turn, here.shifts))
        assert turned == pytest.approx(of_camera[:, :, axis], rel=1e-3, abs=1e-2)
        assert moved(shifts=here.shifts + vector) == pytest.approx(of_camera[:, :, 3 + axis], rel=1e-3, abs=1e-2)
        assert moved(points=here.points + vector) == pytest.approx(of_point[:, :, axis], rel=1e-3, abs=1e-2)
    assert moved(focal=here.focal * np.exp(step)) == pytest.approx(of_camera[:, :, 6], rel=1e-3, abs=1e-2)
    for coefficient in range(2):
        assert moved(bend=here.bend + step * np.eye(2)[coefficient]) == pytest.approx(
            of_camera[:, :, 7 + coefficient], rel=1e-3, abs=1e-2
        )


def test_points_behind_a_camera_do_no_harm():
    exact = bundle()
    points = exact.points.copy()
    points[0] = [100.0, 0.0, 0.0]  # behind the first camera
    found = adjust(dataclasses.replace(exact, points=points), lenses(), steps=10)
    assert np.isfinite(found.points).all() and np.abs(found.misses()).reshape(4, -1, 2)[:, 1:].max() < 1.0
