"""Paths of a fly-through: the ellipse is found again, steps are even, and cameras look where the capture looks."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.camera_paths import PATHS, Ellipse, even_angles, path_cameras, square_fov_degrees

UP = torch.tensor([0.0, 0.0, 1.0])


def looking(centers: torch.Tensor, targets: torch.Tensor, *, width: int = 48, height: int = 32) -> Pinholes:
    return Pinholes.looking_at(centers.float(), targets.float(), up=UP, fov_degrees=60.0, width=width, height=height)


def ring(count: int = 12, *, radius: float = 2.0, inward: bool = True, arc: float = 2 * math.pi) -> Pinholes:
    angles = torch.arange(count) / count * arc
    centers = torch.stack([radius * angles.cos(), radius * angles.sin(), torch.full_like(angles, 0.7)], dim=1)
    return looking(centers, torch.zeros(1, 3).expand(count, 3) if inward else 2 * centers)


def off_ellipse(points: torch.Tensor, ellipse: Ellipse) -> torch.Tensor:
    """Distance of points from a finely drawn curve."""
    return torch.cdist(points.double(), ellipse(torch.linspace(0, 2 * math.pi, 5000)).double()).min(dim=1).values


# ---- the fit ---------------------------------------------------------------------------------------------------------


@given(
    tilt=st.floats(-1.0, 1.0),
    heading=st.floats(0, 3.1),
    ratio=st.floats(0.3, 1.0),
    start=st.floats(0, 6.2),
    arc=st.floats(4.0, 6.2),
    count=st.integers(6, 40),
)
def test_an_ellipse_anywhere_in_space_is_found_again(tilt, heading, ratio, start, arc, count):
    along = torch.tensor([math.cos(heading), math.sin(heading), 0.0])
    across = F.normalize(torch.tensor([-math.sin(heading), math.cos(heading), tilt]), dim=0)
    true = Ellipse(center=torch.tensor([3.0, -2.0, 1.0]), first=2.5 * along, second=2.5 * ratio * across)
    points = true(start + torch.linspace(0, arc, count))
    found = Ellipse.fitted(points, up=UP)
    assert float(off_ellipse(points, found).max()) < 0.02
    assert torch.allclose(found.center, true.center, atol=0.02)
    lengths = sorted([float(found.first.norm()), float(found.second.norm())], reverse=True)
    assert lengths == pytest.approx([2.5, 2.5 * ratio], abs=0.03)


def test_noise_moves_the_ellipse_little_and_least_squares_less_than_moments():
    true = Ellipse(center=torch.zeros(3), first=torch.tensor([3.0, 0, 0]), second=torch.tensor([0, 1.5, 0.0]))
    angles = torch.linspace(0, 4.2, 30)  # two thirds of the way round: the mean of the centres is no centre
    points = true(angles) + 0.02 * torch.randn(30, 3)
    found = Ellipse.fitted(points, up=UP)
    assert float(off_ellipse(points, found).max()) < 0.1
    assert float(found.center.norm()) < 0.1 < float(points.mean(dim=0).norm())


def test_the_way_round_is_counter_clockwise_from_above():
    for cameras in (ring(12), ring(12, arc=-2 * math.pi), ring(3), ring(4, arc=1.0)):
        ellipse = Ellipse.fitted(cameras.centers, up=UP)
        assert float(torch.linalg.cross(ellipse.first, ellipse.second) @ UP) > 0
        assert float(ellipse.first.norm()) >= float(ellipse.second.norm())
        assert float(ellipse.first @ ellipse.second) == pytest.approx(0, abs=1e-5)


def test_a_short_arc_does_not_extrapolate():
    """Twelve photos on a twelfth of a circle: the path stays near them."""
    cameras = ring(12, arc=math.pi / 6)
    path = path_cameras("ellipse", [cameras], 32, size=16)
    extent = float(torch.cdist(cameras.centers, cameras.centers).max())
    assert float(torch.cdist(path.centers, cameras.centers).min(dim=1).values.max()) < extent


def test_a_straight_walk_gets_a_narrow_level_loop_along_it():
    centers = torch.stack([torch.linspace(-2, 2, 9), torch.zeros(9), torch.full((9,), 1.5)], dim=1)
    ellipse = Ellipse.fitted(centers, up=UP)
    assert abs(float(ellipse.first[0])) == pytest.approx(float(ellipse.first.norm()), rel=1e-4)
    assert float(ellipse.second.norm()) == pytest.approx(0.25 * float(ellipse.first.norm()), rel=1e-3)
    assert abs(float(ellipse.second[2])) < 1e-4  # beside the walk, not above it
    upright = Ellipse.fitted(centers[:, [1, 2, 0]], up=UP)  # a walk straight up
    assert bool(torch.isfinite(upright(torch.linspace(0, 6, 20))).all())


# ---- even steps ------------------------------------------------------------------------------------------------------


def test_steps_are_even_and_a_closed_path_does_not_repeat_its_start():
    ellipse = Ellipse(center=torch.zeros(3), first=torch.tensor([4.0, 0, 0]), second=torch.tensor([0, 1.0, 0]))
    fine = even_angles(ellipse, 2000)
    points = ellipse(fine)
    steps = (points - points.roll(1, dims=0)).norm(dim=1)  # with the step that closes the curve
    assert float(steps.max() / steps.min()) < 1.02
    assert float(fine[0]) == 0 and float(fine[-1]) < 2 * math.pi
    assert float(even_angles(ellipse, 9, closed=False)[-1]) == pytest.approx(2 * math.pi)
    assert even_angles(ellipse, 1).tolist() == [0.0]


def test_an_even_circle_has_even_angles():
    circle = Ellipse(center=torch.ones(3), first=torch.tensor([2.0, 0, 0]), second=torch.tensor([0, 2.0, 0]))
    assert torch.allclose(even_angles(circle, 8), torch.arange(8) * math.pi / 4, atol=1e-3)


# ---- where cameras look ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", PATHS)
def test_around_an_object_all_cameras_look_at_it(kind):
    path = path_cameras(kind, [ring()], 17, size=24)
    axes = path.camera_to_world[:, :, 2]
    assert bool(((F.normalize(-path.centers, dim=1) * axes).sum(dim=1) > 0.999).all())
    assert (len(path), path.width, path.height) == (17, 24, 24)
    assert bool((path.camera_to_world[:, 2, 0].abs() < 1e-5).all())  # level


@pytest.mark.parametrize("kind", PATHS)
def test_in_a_room_cameras_look_out_all_around(kind):
    path = path_cameras(kind, [ring(inward=False)], 16, size=16)
    axes = path.camera_to_world[:, :, 2]
    outward = F.normalize(path.centers - torch.tensor([0.0, 0.0, 0.7]), dim=1)
    outward = F.normalize(outward * torch.tensor([1.0, 1.0, 0.0]), dim=1)
    assert bool(((outward * axes).sum(dim=1) > 0.8).all())
    assert float(axes[:, :2].mean(dim=0).norm()) < 0.1  # the ends of a spiral share a heading


def test_cameras_that_look_one_way_are_not_turned_around():
    centers = torch.stack([torch.linspace(-0.5, 0.5, 5), torch.zeros(5), torch.zeros(5)], dim=1)
    forward = torch.tensor([0.0, 1.0, 0.0])
    for kind in PATHS:
        axes = path_cameras(kind, [looking(centers, centers + forward)], 12, size=16).camera_to_world[:, :, 2]
        assert bool((axes @ forward > 0.9).all()), kind


@pytest.mark.parametrize("kind", PATHS)
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_cameras_and_cameras_in_one_place_have_paths(kind, count):
    apart = ring(count)
    turning = looking(torch.ones(count, 3), torch.ones(count, 3) + apart.centers)
    for cameras in (apart, turning):
        path = path_cameras(kind, [cameras], 10, size=16)
        assert bool(torch.isfinite(path.camera_to_world).all())
        assert torch.allclose(path.rotations @ path.rotations.mT, torch.eye(3).expand(10, 3, 3), atol=1e-5)
    if count > 1:  # a turn on the spot looks everywhere
        spot = path_cameras(
            "orbit",
            [looking(torch.ones(4, 3), torch.ones(4, 3) + ring(4).centers * torch.tensor([1.0, 1, 0]))],
            8,
            size=16,
        )
        assert torch.allclose(spot.centers, torch.ones(8, 3), atol=1e-5)
        assert float(spot.camera_to_world[:, :, 2].mean(dim=0).norm()) < 1e-4


def test_an_orbit_keeps_distance_and_height_and_a_spiral_rises():
    cameras = ring()
    orbit = path_cameras("orbit", [cameras], 20, size=16).centers
    assert torch.allclose(orbit[:, :2].norm(dim=1), torch.full((20,), 2.0), atol=1e-3)
    assert torch.allclose(orbit[:, 2], torch.full((20,), 0.7), atol=1e-3)
    spiral = path_cameras("spiral", [cameras], 20, size=16).centers
    assert bool((spiral[1:, 2] > spiral[:-1, 2]).all())
    assert torch.allclose(spiral[:, :2].norm(dim=1), torch.full((20,), 2.0), atol=1e-3)


def test_moving_turning_and_scaling_the_capture_does_the_same_to_the_path():
    cameras = ring(9)
    turn = Pinholes.looking_at(
        torch.zeros(1, 3),
        torch.tensor([[0.3, 0.5, -0.2]]),
        up=torch.tensor([0.2, -0.1, 1.0]),
        fov_degrees=60.0,
        width=4,
        height=4,
    ).rotations[0]
    shift, scale = torch.tensor([5.0, -3.0, 2.0]), 3.0
    moved_centers = scale * cameras.centers @ turn.T + shift
    moved = Pinholes(
        camera_to_world=torch.cat([turn @ cameras.rotations, moved_centers[:, :, None]], dim=2),
        focal=cameras.focal,
        principal=cameras.principal,
        width=cameras.width,
        height=cameras.height,
    )
    before = Ellipse.fitted(cameras.centers, up=UP)
    after = Ellipse.fitted(moved.centers, up=turn @ UP)
    assert float(off_ellipse(scale * before(torch.linspace(0, 6, 20)) @ turn.T + shift, after).max()) < 0.03


def test_the_field_of_view_is_that_of_the_square_that_is_cut():
    wide = looking(torch.zeros(1, 3), torch.ones(1, 3), width=64, height=32)
    assert square_fov_degrees([wide]) == pytest.approx(
        math.degrees(2 * math.atan(math.tan(math.radians(30)) / 2)), rel=1e-5
    )
    tall = looking(torch.zeros(1, 3), torch.ones(1, 3), width=32, height=64)
    assert square_fov_degrees([tall]) == pytest.approx(60.0, rel=1e-5)
    path = path_cameras("orbit", [wide, ring()], 3, size=20, fov_degrees=50.0)
    assert square_fov_degrees([path]) == pytest.approx(50.0, rel=1e-5)


def test_wishes_that_cannot_be_met_are_refused():
    with pytest.raises(
        ValueError, match=r"path: expected ellipse, orbit, spiral or a camera path's \.json file, got 'loop'"
    ):
        path_cameras("loop", [ring()], 4, size=16)
    with pytest.raises(ValueError, match="expected at least one view along the path, got 0"):
        path_cameras("orbit", [ring()], 0, size=16)
    with pytest.raises(ValueError, match="at least one captured camera"):
        path_cameras("orbit", [], 4, size=16)
