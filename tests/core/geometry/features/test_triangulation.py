"""Laws of triangulation with known cameras, and one rendered room from pixels to points."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from fb_core.data.capture.undistort import straight_directions
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.triangulation import Features, detect, matches, nearest_points, triangulate


def _scene(views: int = 6, count: int = 80, seed: int = 0) -> tuple[torch.Tensor, list[Features]]:
    """Points in front of cameras on a line, each with a descriptor of its own, in a different order in every photo."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.0, 6.0])
    descriptors = F.normalize(torch.randn(count, 64, generator=generator), dim=-1)
    photos = []
    for view in range(views):
        order, center = (
            torch.randperm(count, generator=generator),
            torch.tensor([0.3 * view - 1.0, 0.1 * (view % 2), 0.0]),
        )
        photos.append(
            Features(
                center=center,
                directions=F.normalize(points[order] - center, dim=-1),
                descriptors=descriptors[order],
                colors=torch.sigmoid(points[order]),
            )
        )
    return points, photos


def _distance_to(truth: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    return torch.cdist(points.double(), truth.double()).min(dim=1).values


def test_exact_rays_give_the_exact_points_and_colours():
    truth, photos = _scene()
    points, colors = triangulate(photos)
    assert len(points) >= 0.9 * len(truth) and float(_distance_to(truth, points).max()) < 1e-4
    assert torch.allclose(colors, torch.sigmoid(points), atol=1e-4)


def test_a_similarity_of_the_world_moves_the_points_along():
    _, photos = _scene()
    angle, scale, shift = 0.7, 30.0, torch.tensor([5.0, -2.0, 1.0])
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    moved = [
        Features(
            center=scale * turn @ photo.center + shift,
            directions=photo.directions @ turn.T,
            descriptors=photo.descriptors,
            colors=photo.colors,
        )
        for photo in photos
    ]
    expected = scale * triangulate(photos)[0] @ turn.T + shift
    got = triangulate(moved)[0]
    assert len(got) == len(expected) and float(_distance_to(expected, got).max()) < 1e-2


def test_matches_are_mutual_and_right():
    _, photos = _scene(views=2)
    first, second = matches(*photos)
    assert len(first) > 60 and torch.allclose(photos[0].descriptors[first], photos[1].descriptors[second])
    back_second, back_first = matches(photos[1], photos[0])
    forth, back = (
        set(zip(first.tolist(), second.tolist(), strict=True)),
        set(zip(back_first.tolist(), back_second.tolist(), strict=True)),
    )
    assert len(forth & back) >= 0.95 * len(forth)


def test_equal_descriptors_far_from_the_epipolar_plane_do_not_match():
    _, (first, second) = _scene(views=2)
    upwards = F.normalize(second.directions + torch.tensor([0.0, 0.5, 0.0]), dim=-1)
    wrong = Features(center=second.center, directions=upwards, descriptors=second.descriptors, colors=second.colors)
    assert len(matches(first, wrong)[0]) <= 2


def test_points_behind_too_far_or_off_are_not_trusted():
    centers = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64).repeat(4, 1)
    targets = torch.tensor(
        [[0, 0, 5.0], [0, 0, 5.0], [0, 0, 500.0], [0, 0, 5.0]], dtype=torch.float64
    ).repeat_interleave(2, dim=0)
    directions = F.normalize(targets - centers, dim=-1)
    directions[2:4] *= -1  # behind
    directions[7] = F.normalize(
        directions[7] + torch.tensor([0.0, 0.05, 0.0], dtype=torch.float64), dim=-1
    )  # the rays miss each other
    points, good = nearest_points(centers, directions, torch.arange(4).repeat_interleave(2))
    assert good.tolist() == [True, False, False, False]
    assert torch.allclose(points[0], targets[0])


def test_parallel_rays_and_a_single_ray_are_finite_and_not_trusted():
    directions = torch.tensor([[0.0, 0, 1]] * 3, dtype=torch.float64)
    points, good = nearest_points(torch.randn(3, 3, dtype=torch.float64), directions, torch.tensor([0, 0, 1]))
    assert bool(points.isfinite().all()) and not good.any()


def test_a_pure_rotation_no_photos_and_photos_without_features_give_no_points():
    _, photos = _scene(views=3)
    same = [
        Features(center=torch.zeros(3), directions=p.directions, descriptors=p.descriptors, colors=p.colors)
        for p in photos
    ]
    empty = Features(
        center=torch.ones(3), directions=torch.zeros(0, 3), descriptors=torch.zeros(0, 64), colors=torch.zeros(0, 3)
    )
    for case in (same, [], [empty, empty], [photos[0], empty], photos[:1]):
        points, colors = triangulate(case)
        assert points.shape == colors.shape == (0, 3)


def test_a_grey_picture_has_no_features():
    places, descriptors, colors = detect(torch.full((3, 32, 48), 0.5))
    assert places.shape == (0, 2) and descriptors.shape == (0, 128) and colors.shape == (0, 3)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_places_of_features_are_exact(turns: int):
    """Round blobs whose middles are known to a fraction of a pixel, in pictures turned by quarters: no direction is
    preferred.
    """
    errors = []
    for seed in range(3):
        generator = np.random.default_rng(seed)
        middles: list[np.ndarray] = []
        while len(middles) < 12:
            middle = generator.uniform([30, 30], [290, 170])
            if all(np.hypot(*(middle - other)) > 45 for other in middles):
                middles.append(middle)
        y, x = np.mgrid[:200, :320] + 0.5  # the first pixel's centre is (0.5, 0.5)
        grey = np.full((200, 320), 0.5)
        for middle in middles:
            sigma, sign = generator.uniform(3, 9), generator.choice([-1, 1])
            grey += sign * 0.4 * np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * sigma**2))
        picture = torch.rot90(torch.tensor(grey).float().clamp(0, 1), turns)
        places = detect(picture.expand(3, -1, -1).contiguous())[0].double().numpy()
        for px, py in middles:
            at = {0: (px, py), 1: (py, 320 - px), 2: (320 - px, 200 - py), 3: (200 - py, px)}[turns]
            offsets = places - np.array(at)
            nearest = offsets[np.argmin(np.hypot(*offsets.T))]
            if np.hypot(*nearest) < 1.5:
                errors.append(nearest)
    errors = np.array(errors)
    assert len(errors) >= 24
    assert np.abs(errors.mean(axis=0)).max() < 0.02, f"mean error {errors.mean(axis=0)} pixels"
    assert np.hypot(*errors.T).max() < 0.25


def test_masked_pixels_give_no_features():
    image = F.interpolate(torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(0)), scale_factor=4)[0]
    known = torch.zeros(1, 128, 128)
    known[..., :64] = 1
    places = detect(image, known)[0]
    assert len(places) > 5 and float(places[:, 0].max()) <= 65


@pytest.mark.parametrize(
    ("model", "distortion"), [("OPENCV", {"k1": 0.1, "p1": 0.01}), ("OPENCV_FISHEYE", {"k1": 0.05}), ("PINHOLE", {})]
)
def test_straight_directions_undo_the_lens(model, distortion):
    import cv2

    camera = Pinholes.looking_at(
        torch.zeros(1, 3),
        torch.tensor([[0.0, 1.0, 0.0]]),
        up=torch.tensor([0.0, 0, 1]),
        fov_degrees=60,
        width=80,
        height=60,
    )
    directions = F.normalize(torch.tensor([[0.0, 0.0, 1.0], [0.2, -0.1, 1.0], [-0.3, 0.2, 1.0]]), dim=-1)
    matrix = camera.intrinsics[0].double().numpy().copy()
    matrix[:2, 2] -= 0.5
    rays = directions.double().numpy()[:, None]
    values = [
        distortion.get(name, 0.0)
        for name in (("k1", "k2", "k3", "k4") if "FISHEYE" in model else ("k1", "k2", "p1", "p2"))
    ]
    import numpy as np

    project = cv2.fisheye.projectPoints if "FISHEYE" in model else cv2.projectPoints
    places, _ = project(rays, np.zeros(3), np.zeros(3), matrix, np.array(values))
    places = torch.from_numpy(places.reshape(-1, 2)).float() + 0.5
    assert torch.allclose(straight_directions(places, camera, model, distortion), directions, atol=1e-4)


@pytest.mark.parametrize("turned", [False, True])
def test_a_patterned_room_from_pixels_to_points(turned: bool):
    """Points lie on the true surfaces: the room's solids are analytic, so the ray caster tells how far each point
    should be.

    With every second camera on its side, an offset that all places share does not cancel.
    """
    from fb_core.data.rooms.ray_caster import render
    from fb_core.data.rooms.room import FAMILIES, Room, make_room

    room: Room = make_room(2, FAMILIES["wide"])
    angles = torch.linspace(0, 1.2, 8)
    centers = torch.stack([0.5 * angles.cos(), 0.5 * angles.sin(), torch.full_like(angles, 1.4)], dim=-1)
    targets = centers + torch.stack([(angles * 0.3).cos(), (angles * 0.3).sin(), torch.full_like(angles, -0.2)], dim=-1)
    cameras = Pinholes.looking_at(centers, targets, up=torch.tensor([0.0, 0, 1]), fov_degrees=70, width=256, height=256)
    if turned:
        poses = cameras.camera_to_world.clone()
        poses[1::2, :, :3] = poses[1::2, :, :3] @ torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        cameras = dataclasses.replace(cameras, camera_to_world=poses)
    images = render(room, cameras).rgb
    photos = []
    for index in range(len(cameras)):
        places, descriptors, colors = detect(images[index])
        directions = straight_directions(places, cameras[index], "PINHOLE", {}) @ cameras.rotations[index].T
        photos.append(
            Features(center=cameras.centers[index], directions=directions, descriptors=descriptors, colors=colors)
        )
    points, _ = triangulate(photos)
    assert len(points) > 30
    pixels, depth = cameras.project(points)
    truth = render(room, cameras).depth
    errors = []
    for index in range(len(cameras)):
        column, row = pixels[index].floor().long().T
        inside = (depth[index] > 0) & (column >= 0) & (column < 256) & (row >= 0) & (row < 256)
        error = (depth[index][inside] - truth[index, row[inside], column[inside]]).abs() / depth[index][inside]
        errors.append(torch.full((len(points),), torch.inf).masked_scatter(inside, error))
    best = torch.stack(errors).min(dim=0).values  # a point may be hidden from some cameras
    assert float(best.median()) < (0.0105 if turned else 0.007) and float((best < 0.05).float().mean()) > 0.8
