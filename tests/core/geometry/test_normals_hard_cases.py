"""Hard cases of normals from depth, by name: holes, steps, grazing planes, scales and 10 000 random depths; never NaN
or infinite.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.scenes.plane_depths import camera, plane_depth
from helpers.scenes.random_cameras import random_rotations

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.normals import normals_from_depth, unit_or_zero


def checked(depth: torch.Tensor, cameras: Pinholes) -> torch.Tensor:
    """Normals, after checking that they and their gradient are finite, of length one or zero, and face the camera."""
    depth = depth.detach().clone().requires_grad_()
    normals = normals_from_depth(depth, cameras)
    assert normals.isfinite().all()
    lengths = normals.detach().norm(dim=-1)
    assert (((lengths - 1).abs() < 1e-5) | (lengths == 0)).all()
    rays = (cameras.pixel_centers() - cameras.principal[:, None, None]) / cameras.focal[:, None, None]
    rays = torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1)
    assert ((normals * rays).sum(dim=-1) <= 1e-5 * rays.norm(dim=-1)).all()
    weights = torch.randn(normals.shape, generator=torch.Generator().manual_seed(0), dtype=normals.dtype)
    (normals * weights).sum().backward()
    assert depth.grad is not None and depth.grad.isfinite().all()
    return normals.detach()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [(3, 3), (24, 32)])
def test_depth_with_holes(dtype: torch.dtype, size: tuple[int, int]) -> None:
    """Holes of every kind and share: a normal stands exactly where a pixel and its four neighbours have depth."""
    cameras = camera(*size).to(dtype)
    generator = torch.Generator().manual_seed(0)
    for share in (0.0, 0.1, 0.5, 0.9, 1.0):
        depth = torch.rand(1, *size, generator=generator, dtype=dtype) + 1
        kinds = torch.tensor([0.0, -1.0, torch.nan, torch.inf, -torch.inf], dtype=dtype)
        holes = torch.rand(1, *size, generator=generator) < share
        depth = torch.where(holes, kinds[torch.randint(0, 5, (1, *size), generator=generator)], depth)
        normals = checked(depth, cameras)
        solid = ~holes
        expected = torch.zeros_like(solid)
        expected[:, 1:-1, 1:-1] = (
            solid[:, 1:-1, 1:-1] & solid[:, 2:, 1:-1] & solid[:, :-2, 1:-1] & solid[:, 1:-1, 2:] & solid[:, 1:-1, :-2]
        )
        assert torch.equal(normals.norm(dim=-1) > 0, expected)


@pytest.mark.parametrize("ratio", [1.001, 10.0, 1e6])
def test_depth_with_a_step(ratio: float) -> None:
    """Two walls that face the camera: away from the step their normal is exact, at the step it leans across but stays a
    unit vector.
    """
    cameras = camera().to(torch.float32)
    depth = torch.ones(1, 24, 32)
    depth[..., 16:] = ratio
    normals = checked(depth, cameras)[0, 1:-1, 1:-1]
    straight = torch.tensor([0.0, 0.0, -1.0])
    columns = torch.arange(1, 31)
    away = (columns < 15) | (columns > 16)
    assert (normals[:, away] - straight).abs().max() < 1e-3
    leaning = normals[:, ~away]
    assert (leaning.norm(dim=-1) - 1).abs().max() < 1e-5
    if ratio >= 10:
        assert leaning[..., 2].abs().max() < 0.5, "a wall seen from its edge"


@pytest.mark.parametrize("degrees", [80.0, 89.0, 89.9, 89.99])
def test_grazing_planes(degrees: float) -> None:
    """Planes nearly parallel to the middle ray keep their normal wherever the camera sees their front."""
    cameras = camera()
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    normal = torch.stack([angle.sin(), torch.zeros_like(angle), -angle.cos()])
    depth = plane_depth(cameras, normal, -1.0)
    depth = torch.where((depth > 0) & (depth < 1e6), depth, 0.0)
    for dtype, tolerance in ((torch.float64, 1e-6), (torch.float32, 0.05)):
        normals = checked(depth.to(dtype), cameras.to(dtype))
        seen = normals.norm(dim=-1) > 0
        assert seen.any()
        assert (normals[seen].double() - normal).norm(dim=-1).median() < tolerance


def test_depths_at_the_ends_of_float32() -> None:
    depth = torch.full((1, 24, 32), 1.0)
    depth[:, :, 16:] = 1e30
    checked(depth, camera().to(torch.float32))
    checked(torch.full((1, 24, 32), 1e-30), camera().to(torch.float32))
    checked(torch.full((1, 24, 32), 1e30), camera().to(torch.float32))


@pytest.mark.parametrize("fov_degrees", [2.0, 150.0])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_fields_of_view_and_scene_scales(fov_degrees: float, scale: float) -> None:
    focal = 16 / float(torch.tan(torch.deg2rad(torch.tensor(fov_degrees / 2, dtype=torch.float64))))
    cameras = camera(focal=(focal, focal))
    normal = unit_or_zero(torch.tensor([0.1, -0.1, -1.0], dtype=torch.float64))
    depth = plane_depth(cameras, normal, -3.0)
    depth = torch.where(depth > 0, depth, 0.0)
    normals = checked((scale * depth).float(), cameras.to(torch.float32))
    seen = normals.norm(dim=-1) > 0
    # Depth differences of neighbours are about 3e-4 of the depth at 2 degrees, its rounding 6e-8: that limits the
    # normal.
    assert (normals[seen] - normal.float()).norm(dim=-1).max() < (5e-2 if fov_degrees < 10 else 1e-3)


def test_far_away_cameras_change_nothing() -> None:
    """Origins 1e5 away: normals from depth never see them; in world coordinates only the rotation counts."""
    still = camera().to(torch.float32)
    turn = random_rotations(1, torch.Generator().manual_seed(0)).float()
    pose = torch.cat([turn, torch.full((1, 3, 1), 1e5)], dim=2)
    far = dataclasses.replace(still, camera_to_world=pose)
    depth = torch.rand(1, 24, 32) + 1
    assert torch.equal(normals_from_depth(depth, far), normals_from_depth(depth, still))
    world = torch.einsum("nij,nhwj->nhwi", far.rotations, normals_from_depth(depth, far))
    assert ((world.norm(dim=-1) - 1).abs() < 1e-5)[:, 1:-1, 1:-1].all()


def test_ten_thousand_random_depths() -> None:
    """2 000 depths of each of five kinds at scales 1e-6 to 1e6: smooth, rough, stepped, full of holes, nearly empty."""
    generator = torch.Generator().manual_seed(0)
    height, width, count = 6, 7, 2000
    half_angle = torch.deg2rad(75 ** torch.rand(count, 1, generator=generator))
    cameras = Pinholes(
        camera_to_world=torch.cat([random_rotations(count, generator).float(), torch.zeros(count, 3, 1)], dim=2),
        focal=(width / 2 / half_angle.tan()).expand(-1, 2),
        principal=torch.rand(count, 2, generator=generator) * torch.tensor([7.0, 6.0]),
        width=width,
        height=height,
    )
    scale = 10 ** (torch.rand(count, 1, 1, generator=generator) * 12 - 6)

    def noise() -> torch.Tensor:
        return torch.rand(count, height, width, generator=generator)

    smooth = 1 + 0.01 * noise()
    stepped = torch.where(noise() < 0.5, 1.0, 1 + 100 * noise())
    kinds = (
        smooth,
        (8 * noise()).exp(),
        stepped,
        torch.where(noise() < 0.3, torch.nan, stepped),
        torch.where(noise() < 0.95, 0.0, smooth),
    )
    for depth in kinds:
        checked(scale * depth, cameras)
