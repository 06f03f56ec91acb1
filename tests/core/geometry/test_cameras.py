"""Laws of pinhole cameras: projection and its inverse, equivariance, resizing, looking at things; at hard scales and
angles.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers.scenes.random_cameras import random_cameras, random_rotations
from hypothesis import given
from hypothesis import strategies as st

from fb_core.geometry.cameras import Pinholes

SEEDS = st.integers(0, 10_000)


def random_depth(cameras: Pinholes, seed: int, scale: float = 1.0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed + 1)
    shape = (len(cameras), cameras.height, cameras.width)
    return scale * (0.2 + 3 * torch.rand(shape, generator=generator, dtype=torch.float64))


def projected_own_pixels(cameras: Pinholes, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Each camera's own points in its own image, as (n, h, w, 2) pixels and (n, h, w) depth."""
    found = [cameras[index].project(points[index].reshape(-1, 3)) for index in range(len(cameras))]
    shape = (len(cameras), cameras.height, cameras.width)
    return torch.cat([pixels for pixels, _ in found]).reshape(*shape, 2), torch.cat(
        [depth for _, depth in found]
    ).reshape(shape)


@given(seed=SEEDS, exponent=st.integers(-6, 6))
def test_project_undoes_unproject_at_every_scene_scale(seed: int, exponent: int) -> None:
    scale = 10.0**exponent
    cameras = random_cameras(seed, scale=scale)
    depth = random_depth(cameras, seed, scale)
    pixels, found = projected_own_pixels(cameras, cameras.unproject(depth))
    assert torch.allclose(pixels, cameras.pixel_centers().expand_as(pixels), rtol=0, atol=1e-8)
    assert torch.allclose(found, depth, rtol=1e-10, atol=0)


@given(seed=SEEDS)
def test_unprojected_points_lie_on_their_rays(seed: int) -> None:
    cameras = random_cameras(seed)
    depth = random_depth(cameras, seed)
    toward = cameras.unproject(depth) - cameras.centers[:, None, None]
    directions = cameras.directions()
    assert torch.allclose(torch.nn.functional.normalize(toward, dim=-1), directions, atol=1e-12)
    forward = cameras.rotations[:, :, 2]
    assert torch.allclose(torch.einsum("nhwi,ni->nhw", toward, forward), depth, atol=1e-12), (
        "depth is along the axis, not distance"
    )


@given(seed=SEEDS)
def test_directions_are_unit(seed: int) -> None:
    directions = random_cameras(seed).directions()
    assert torch.allclose(directions.norm(dim=-1), torch.ones(()).double(), atol=1e-14)


@given(seed=SEEDS)
def test_moving_cameras_and_points_together_changes_no_pixel(seed: int) -> None:
    """Equivariance under every similarity: x -> s Q x + t."""
    generator = torch.Generator().manual_seed(seed)
    cameras = random_cameras(seed)
    points = 5 * torch.randn(11, 3, generator=generator, dtype=torch.float64)
    turn, shift, scale = (
        random_rotations(1, generator)[0],
        torch.randn(3, generator=generator, dtype=torch.float64),
        3.7,
    )
    pose = torch.cat([turn @ cameras.rotations, (scale * cameras.centers @ turn.T + shift)[..., None]], dim=2)
    moved = Pinholes(
        camera_to_world=pose,
        focal=cameras.focal,
        principal=cameras.principal,
        width=cameras.width,
        height=cameras.height,
    )
    pixels, depth = cameras.project(points)
    pixels_moved, depth_moved = moved.project(scale * points @ turn.T + shift)
    assert torch.allclose(pixels_moved, pixels, rtol=1e-8, atol=1e-8)
    assert torch.allclose(depth_moved, scale * depth, rtol=1e-10, atol=1e-10)
    assert torch.allclose(moved.directions(), cameras.directions() @ turn.T, atol=1e-12)


@given(seed=SEEDS)
def test_matrices_say_the_same_as_project(seed: int) -> None:
    """The slow readable twin: K [R|t] with homogeneous coordinates."""
    cameras = random_cameras(seed)
    points = torch.randn(9, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    pixels, depth = cameras.project(points)
    for index in range(len(cameras)):
        for number, point in enumerate(points):
            in_camera = cameras.world_to_camera[index] @ torch.cat([point, torch.ones(1, dtype=torch.float64)])
            x, y, z = (cameras.intrinsics[index] @ in_camera[:3]).tolist()
            assert depth[index, number].item() == pytest.approx(z, abs=1e-12)
            assert pixels[index, number].tolist() == pytest.approx([x / z, y / z], rel=1e-9)


def test_world_to_camera_is_the_inverse() -> None:
    cameras = random_cameras(4)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(len(cameras), 1, 4)
    product = cameras.world_to_camera @ torch.cat([cameras.camera_to_world, bottom], dim=1)
    assert torch.allclose(product, torch.eye(4, dtype=torch.float64).expand_as(product), atol=1e-14)


def test_points_behind_have_no_positive_depth_and_a_point_at_the_centre_is_finite() -> None:
    camera = Pinholes.looking_at(
        torch.zeros(1, 3),
        torch.tensor([[0.0, 0.0, 1.0]]),
        up=torch.tensor([0.0, -1.0, 0.0]),
        fov_degrees=60,
        width=8,
        height=8,
    )
    pixels, depth = camera.project(torch.tensor([[0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    assert depth[0].tolist() == [-2.0, 0.0, 0.0]
    assert torch.isfinite(pixels).all()


@pytest.mark.parametrize("fov_degrees", [2.0, 60.0, 150.0])
def test_field_of_view_is_as_told(fov_degrees: float) -> None:
    """Closed form: the rays through the left and right image borders span the field of view; also in float32."""
    camera = Pinholes.looking_at(
        torch.zeros(1, 3), torch.eye(3)[:1], up=torch.eye(3)[2], fov_degrees=fov_degrees, width=20, height=10
    )
    half_pixel = camera.focal[0, 0].item()
    assert 2 * math.degrees(math.atan(10 / half_pixel)) == pytest.approx(fov_degrees, rel=1e-5)
    depth = torch.full((1, 10, 20), 2.0)
    pixels, found = projected_own_pixels(camera, camera.unproject(depth))
    assert torch.allclose(pixels, camera.pixel_centers()[None], atol=2e-4)
    assert torch.allclose(found, depth, rtol=1e-5)


def test_first_pixel_centre_is_one_half() -> None:
    camera = random_cameras()[0]
    assert camera.pixel_centers()[0, 0].tolist() == [0.5, 0.5]
    assert camera.pixel_centers()[-1, -1].tolist() == [camera.width - 0.5, camera.height - 0.5]


def test_origins_far_away_in_float32() -> None:
    """Centres 1e5 away: directions do not suffer, and pixels err by no more than the rounding of a coordinate
    (1/128).
    """
    far = random_cameras(5)
    pose = far.camera_to_world.clone()
    pose[:, :, 3] = (pose[:, :, 3] + 1e5).float().double()
    exact = Pinholes(camera_to_world=pose, focal=far.focal, principal=far.principal, width=far.width, height=far.height)
    rough = exact.to(torch.float32)
    assert torch.allclose(rough.directions().double(), exact.directions(), atol=5e-7)
    depth = torch.full((len(far), far.height, far.width), 10.0)
    pixels, _ = projected_own_pixels(rough, rough.unproject(depth))
    bound = 2 * 2.0**-7 / 10.0 * float(rough.focal.max()) * 3
    assert (pixels - rough.pixel_centers()).abs().max() < bound
    points = exact.unproject(depth.double())[0].reshape(-1, 3).float()  # coordinates that float32 can hold
    assert torch.allclose(rough.project(points)[0][0].double(), exact.project(points.double())[0][0], atol=1e-4), (
        "subtract, then rotate"
    )


@given(seed=SEEDS)
def test_resizing_and_cropping_carry_pixels_along(seed: int) -> None:
    cameras = random_cameras(seed)
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    pixels, depth = cameras.project(points)
    scaled, cropped = cameras.scaled(21, 40), cameras.cropped(2, -1, 4, 9)
    assert torch.allclose(
        scaled.project(points)[0], pixels * torch.tensor([21 / 7, 40 / 5], dtype=torch.float64), rtol=1e-10
    )
    assert torch.allclose(
        cropped.project(points)[0], pixels - torch.tensor([2.0, -1.0], dtype=torch.float64), rtol=1e-8, atol=1e-8
    )
    assert torch.equal(scaled.project(points)[1], depth)
    assert (scaled.width, scaled.height, cropped.width, cropped.height) == (21, 40, 4, 9)
    back = scaled.scaled(cameras.width, cameras.height)
    assert torch.allclose(back.intrinsics, cameras.intrinsics, rtol=1e-14)
    window = cameras.cropped(2, 1, 3, 2).directions()
    assert torch.allclose(window, cameras.directions()[:, 1:3, 2:5], atol=1e-14), "cropping keeps each pixel's ray"


@given(seed=SEEDS, exponent=st.integers(-6, 6), double=st.booleans())
def test_looking_at_centres_the_target_upright(seed: int, exponent: int, double: bool) -> None:
    generator = torch.Generator().manual_seed(seed)
    dtype = torch.float64 if double else torch.float32
    centers = 10.0**exponent * torch.randn(4, 3, generator=generator, dtype=dtype)
    targets = 10.0**exponent * torch.randn(4, 3, generator=generator, dtype=dtype)
    up = torch.randn(3, generator=generator, dtype=dtype)
    cameras = Pinholes.looking_at(centers, targets, up=up, fov_degrees=70.0, width=32, height=24)
    assert_rotations(cameras, 1e-12 if double else 1e-6)
    for index in range(4):
        pixels, depth = cameras[index].project(targets[index][None])
        assert pixels[0, 0].tolist() == pytest.approx([16, 12], abs=1e-3)
        assert depth.item() == pytest.approx((targets[index] - centers[index]).norm().item(), rel=1e-4)
    assert torch.allclose(cameras.rotations[:, :, 0] @ up / up.norm(), torch.zeros(4, dtype=dtype), atol=1e-5), (
        "level horizon"
    )
    assert (cameras.rotations[:, :, 1] @ up <= 1e-5 * up.norm()).all(), "image down is not world up"


def assert_rotations(cameras: Pinholes, tolerance: float) -> None:
    product = cameras.rotations.transpose(1, 2) @ cameras.rotations
    assert (product - torch.eye(3, dtype=product.dtype)).abs().max() < tolerance
    assert (torch.linalg.det(cameras.rotations) > 0.99).all()


@given(seed=SEEDS, tilt=st.sampled_from([0.0, 1e-12, 1e-7, 3e-7, 2e-6, 1e-4]), double=st.booleans())
def test_looking_along_up_still_gives_rotations(seed: int, tilt: float, double: bool) -> None:
    """Straight up or down, exactly or nearly: in float32 the cross product alone would lose orthogonality."""
    generator = torch.Generator().manual_seed(seed)
    dtype = torch.float64 if double else torch.float32
    up = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
    side = torch.linalg.cross(up, torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64))
    targets = torch.stack([up + tilt * side, -up - tilt * side])
    cameras = Pinholes.looking_at(
        torch.zeros(2, 3, dtype=dtype), targets.to(dtype), up=up.to(dtype), fov_degrees=50.0, width=8, height=8
    )
    assert_rotations(cameras, 1e-9 if double else 1e-6)


def test_looking_at_refuses_what_has_no_answer() -> None:
    up = torch.tensor([0.0, 0.0, 1.0])
    ones = torch.ones(2, 3)
    with pytest.raises(ValueError, match="at its center or not finite"):
        Pinholes.looking_at(ones, ones, up=up, fov_degrees=60.0, width=8, height=8)
    with pytest.raises(ValueError, match="at its center or not finite"):
        Pinholes.looking_at(ones, ones * torch.nan, up=up, fov_degrees=60.0, width=8, height=8)
    for fov in (0.0, 180.0, -20.0):
        with pytest.raises(ValueError, match="fov_degrees"):
            Pinholes.looking_at(ones, -ones, up=up, fov_degrees=fov, width=8, height=8)


def test_choosing_and_joining() -> None:
    cameras = random_cameras(2, count=5)
    assert len(cameras) == 5
    for index in (3, -2, np.int64(3)):
        assert torch.equal(cameras[index].camera_to_world, cameras.camera_to_world[3:4])
    assert len(cameras[1:4]) == 3
    assert len(cameras[[]]) == 0
    assert len(cameras[torch.tensor([True, False, True, False, False])]) == 2
    joined = Pinholes.cat([cameras[:2], cameras[2:]])
    assert torch.equal(joined.focal, cameras.focal) and torch.equal(joined.camera_to_world, cameras.camera_to_world)
    with pytest.raises(ValueError, match="share one image size"):
        Pinholes.cat([cameras, cameras.scaled(4, 4)])


def test_no_cameras_and_one_pixel() -> None:
    none = random_cameras(count=3)[[]]
    assert none.directions().shape == (0, 5, 7, 3)
    assert none.project(torch.zeros(4, 3, dtype=torch.float64))[0].shape == (0, 4, 2)
    one = random_cameras(count=1, width=1, height=1)
    assert one.directions().shape == (1, 1, 1, 3)
    assert random_cameras().project(torch.zeros(0, 3, dtype=torch.float64))[1].shape == (3, 0)


def test_dtype_follows_and_gradients_flow() -> None:
    cameras = random_cameras().to(torch.float32)
    assert cameras.directions().dtype == cameras.project(torch.zeros(1, 3))[0].dtype == torch.float32
    focal = cameras.focal.clone().requires_grad_()
    free = Pinholes(
        camera_to_world=cameras.camera_to_world, focal=focal, principal=cameras.principal, width=7, height=5
    )
    free.unproject(torch.ones(3, 5, 7)).sum().backward()
    assert focal.grad is not None and torch.isfinite(focal.grad).all()
