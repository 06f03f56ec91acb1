"""Laws of camera sampling: measures follow the capture under any similarity; directions go where nothing was seen."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.shell import sphere
from fb_core.geometry.viewpoints.paths import (
    CaptureShape,
    cylinder_centers,
    inward_targets,
    kept_clear,
    outward_directions,
    seen_by,
    sphere_directions,
    spread_subset,
    strided_subset,
    up_of,
)

Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def orbit(count: int = 12, radius: float = 2.0, height: float = 0.5) -> Pinholes:
    """Cameras on a ring that look at the origin from above."""
    angle = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count
    centers = torch.stack([radius * angle.cos(), radius * angle.sin(), torch.full_like(angle, height)], dim=1)
    return Pinholes.looking_at(centers, torch.zeros_like(centers), up=Z, fov_degrees=60.0, width=32, height=24)


def panorama(directions: torch.Tensor, spread: float = 0.2) -> Pinholes:
    """Cameras around the origin that look out along the given directions."""
    centers = spread * torch.randn(len(directions), 3, generator=generator(1), dtype=torch.float64)
    centers[:, 2] *= 0.2
    return Pinholes.looking_at(centers, centers + directions, up=Z, fov_degrees=70.0, width=32, height=32)


def headings(low_degrees: float, high_degrees: float, count: int) -> torch.Tensor:
    angle = torch.deg2rad(torch.linspace(low_degrees, high_degrees, count, dtype=torch.float64))
    return torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], dim=1)


def moved(cameras: Pinholes, rotation: torch.Tensor, factor: float, shift: torch.Tensor) -> Pinholes:
    pose = torch.cat(
        [rotation @ cameras.rotations, (factor * rotation @ cameras.centers[:, :, None]) + shift[:, None]], dim=2
    )
    return dataclasses.replace(cameras, camera_to_world=pose)


def rotation(seed: int) -> torch.Tensor:
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=generator(seed), dtype=torch.float64))
    q = q * torch.sign(torch.diagonal(r))
    return q * torch.det(q)


def test_an_orbit_looks_inward_at_its_focus():
    shape = CaptureShape.of([orbit()])
    assert not shape.outward
    assert torch.allclose(shape.focus, torch.zeros(3, dtype=torch.float64), atol=1e-9)
    assert torch.allclose(shape.center, torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64), atol=1e-9)
    assert shape.radius == pytest.approx(2.0) and shape.half_height == pytest.approx(0.0, abs=1e-9)


def test_a_room_seen_from_its_middle_looks_outward():
    shape = CaptureShape.of([panorama(headings(0, 150, 9))])
    assert shape.outward and torch.equal(shape.focus, shape.center)
    assert 0.05 < shape.radius < 0.6


def test_cameras_side_by_side_that_look_ahead_look_outward():
    centers = torch.zeros(6, 3, dtype=torch.float64)
    centers[:, 1] = torch.linspace(-1, 1, 6, dtype=torch.float64)
    ahead = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    assert CaptureShape.of(
        [Pinholes.looking_at(centers, centers + ahead, up=Z, fov_degrees=60.0, width=16, height=16)]
    ).outward


@settings(max_examples=10)
@given(seed=st.integers(0, 500), factor=st.floats(0.1, 20.0), inward=st.booleans())
def test_the_shape_follows_the_capture_under_any_similarity(seed: int, factor: float, inward: bool):
    capture = orbit() if inward else panorama(headings(0, 200, 9))
    turn, shift = rotation(seed), torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    plain, other = CaptureShape.of([capture]), CaptureShape.of([moved(capture, turn, factor, shift)])
    assert other.outward == plain.outward
    assert torch.allclose(other.up, turn @ plain.up, atol=1e-6)
    assert torch.allclose(other.center, factor * turn @ plain.center + shift, atol=1e-6 * factor)
    assert other.radius == pytest.approx(factor * plain.radius, rel=1e-6)


def test_up_is_true_although_every_camera_looks_down():
    high = orbit(height=3.0)
    assert torch.allclose(up_of([high]), Z, atol=1e-6)
    one = up_of([high[0]])  # a single camera can only offer its own up
    assert torch.allclose(one, -high.rotations[0, :, 1])


def test_photos_of_mixed_sizes_are_measured_together():
    first, second = orbit(6), dataclasses.replace(orbit(6), width=64, height=48)
    assert CaptureShape.of([first, second]).radius == pytest.approx(2.0)


def test_no_camera_and_a_nan_pose_are_refused():
    with pytest.raises(ValueError, match="at least one captured camera"):
        CaptureShape.of([])
    broken = orbit()
    broken.camera_to_world[3, 0, 0] = math.nan
    with pytest.raises(ValueError, match="NaN or infinity"):
        CaptureShape.of([broken])


def test_one_camera_and_identical_cameras_have_a_shape():
    for cameras in (orbit()[0], orbit()[[0, 0, 0]]):
        shape = CaptureShape.of([cameras])
        assert shape.outward and shape.radius == pytest.approx(0.0, abs=1e-9)


def test_anchors_stand_on_the_cylinder_at_equal_angles():
    shape = CaptureShape.of([orbit()])
    centers = cylinder_centers(shape, 8, generator=generator(), radius=3.0, inner_radius=3.0, half_height=0.4, levels=2)
    offset = centers - shape.center
    assert torch.allclose(offset[:, :2].norm(dim=1), torch.full((8,), 3.0, dtype=torch.float64))
    assert torch.allclose(offset[:, 2].abs(), torch.full((8,), 0.4, dtype=torch.float64))
    angle = torch.atan2(offset[:, 1], offset[:, 0])
    step = (angle.roll(-1) - angle) % (2 * math.pi)
    assert torch.allclose(step, torch.full((8,), math.pi / 4, dtype=torch.float64), atol=1e-6) or torch.allclose(
        2 * math.pi - step, torch.full((8,), math.pi / 4, dtype=torch.float64), atol=1e-6
    )


def test_densified_views_fill_the_ring_and_the_seed_decides():
    shape = CaptureShape.of([orbit()])
    options = {"radius": 2.0, "inner_radius": 1.0, "half_height": 0.0, "levels": 1}
    centers = cylinder_centers(shape, 50, generator=generator(3), **options)
    distance = (centers - shape.center).norm(dim=1)
    assert 1.0 <= float(distance.min()) < 1.2 and 1.8 < float(distance.max()) <= 2.0
    assert torch.equal(centers, cylinder_centers(shape, 50, generator=generator(3), **options))
    assert not torch.equal(centers, cylinder_centers(shape, 50, generator=generator(4), **options))
    assert cylinder_centers(shape, 0, generator=generator(), **options).shape == (0, 3)


def test_blocked_cameras_move_towards_a_captured_one_until_they_are_clear():
    shell = sphere(torch.zeros(3), 1.0)
    centers = torch.tensor([[0.0, 0.5, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.4]])
    refuges = torch.tensor([[0.0, 0.0, 0.0]])
    points = torch.tensor([[0.0, 0.0, 0.42]])
    result = kept_clear(centers, shell=shell, points=points, clearance=0.1, refuges=refuges)
    assert torch.equal(result[0], centers[0])
    assert shell.contains(result, margin=0.9).all()
    assert float((result[2] - points[0]).norm()) >= 0.1
    assert (
        torch.allclose(result[1, 1:], torch.zeros(2)) and float(result[1, 0]) > 0.5
    )  # on the straight way home, not all of it


def test_a_camera_with_no_clear_place_goes_where_somebody_stood():
    points = torch.tensor([[0.1, 0.0, 0.0]])
    result = kept_clear(
        torch.tensor([[0.5, 0.0, 0.0]]),
        shell=sphere(torch.zeros(3), 9.0),
        points=points,
        clearance=5.0,
        refuges=torch.zeros(1, 3),
    )
    assert torch.equal(result, torch.zeros(1, 3))


def test_seen_by_is_the_frustum():
    camera = Pinholes.looking_at(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), up=Z.float(), fov_degrees=90.0, width=10, height=10
    )
    points = torch.tensor([[2.0, 0, 0], [-2.0, 0, 0], [2.0, 1.9, 0], [2.0, 2.1, 0], [2.0, 0, -1.9]])
    assert seen_by([camera], points).tolist() == [True, False, True, False, True]


def test_sphere_directions_are_unit_and_balanced():
    directions = sphere_directions(500, like=Z)
    assert torch.allclose(directions.norm(dim=1), torch.ones(500, dtype=torch.float64))
    assert float(directions.mean(dim=0).norm()) < 1e-2


def look(seed: int, need: torch.Tensor, surface: torch.Tensor, count: int = 8, pitch: float = 30.0):
    return outward_directions(
        torch.zeros(count, 3), surface=surface, need=need, up=Z.float(), half_angle_radians=math.radians(30),
        max_pitch_degrees=pitch, generator=generator(seed),
    )  # fmt: skip


@given(seed=st.integers(0, 1000))
def test_generated_views_look_where_the_capture_did_not(seed: int):
    surface = 3 * sphere_directions(500, like=torch.zeros(1))
    need = torch.where(surface[:, 0] > 0, 0.1, 1.0)
    directions, _ = look(seed, need, surface, count=4)
    assert float(directions[:, 0].max()) < 0.3
    assert torch.allclose(directions.norm(dim=1), torch.ones(4), atol=1e-5)


def test_eight_views_cover_the_horizon_that_is_needed():
    surface = 3 * sphere_directions(800, like=torch.zeros(1))
    level = surface[:, 2].abs() < 0.3
    directions, left = look(0, torch.where(level, 1.0, 0.3), surface)
    assert float((left[level] < 1.0).float().mean()) > 0.95
    assert float(directions[:, 2].abs().max()) <= math.sin(math.radians(30)) + 0.01


def test_level_views_stay_level_and_none_is_fine():
    surface = 3 * sphere_directions(200, like=torch.zeros(1))
    directions, _ = look(1, torch.ones(200), surface, pitch=0.0)
    assert float(directions[:, 2].abs().max()) < 0.01
    assert look(1, torch.ones(200), surface, count=0)[0].shape == (0, 3)


def test_inward_targets_surround_the_focus_and_keep_their_distance():
    shape = CaptureShape.of([orbit()])
    centers = cylinder_centers(
        shape, 40, generator=generator(), radius=2.0, inner_radius=1.0, half_height=0.2, levels=2
    )
    targets = inward_targets(centers, shape=shape, spread=0.7, generator=generator(1))
    assert float((targets - centers).norm(dim=1).min()) >= 0.3 * shape.radius
    assert float((targets - shape.focus)[:, :2].norm(dim=1).max()) <= 0.7 * shape.radius + 1e-9
    assert float((targets - shape.focus)[:, 2].abs().max()) <= 0.35 * shape.radius + 1e-9


def test_spread_subset_has_no_repeats_and_starts_with_the_most_level_camera():
    cameras = [orbit()[index] for index in range(12)]
    chosen = spread_subset(cameras, 4)
    assert len(set(chosen)) == 4
    centers = torch.cat([cameras[index].centers for index in chosen])
    assert float(torch.pdist(centers).min()) > 2.0  # four of a ring of radius 2 are a quarter turn apart, more or less
    tilted = [*cameras[:3], orbit(height=0.0)[3], *cameras[4:]]
    assert spread_subset(tilted, 3)[0] == 3


def test_more_views_asked_for_than_there_are():
    cameras = [orbit(3)]
    assert sorted(spread_subset(cameras, 16)) == [0, 1, 2]
    assert strided_subset(3, 16) == [0, 1, 2]
    assert strided_subset(100, 4) == [0, 33, 66, 99]
    assert sorted(spread_subset([orbit()[[0, 0, 0, 0]]], 3)) == sorted(set(spread_subset([orbit()[[0, 0, 0, 0]]], 3)))
