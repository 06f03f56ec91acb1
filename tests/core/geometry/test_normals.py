"""Laws of depth-derived normals: goldens, planes and spheres in closed form, equivariance, guarded division."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from conftest import shared_path
from helpers.scenes.plane_depths import camera, plane_depth

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.normals import (
    facing,
    normal_picture,
    normals_from_depth,
    normals_of_picture,
    unit_or_zero,
)


def test_golden_normals() -> None:
    golden = np.load(shared_path("golden/reference/normals.npz"))
    fx, fy, cx, cy = golden["intrinsics"].tolist()
    height, width = golden["depth"].shape
    cameras = Pinholes(
        camera_to_world=torch.eye(4)[None, :3],
        focal=torch.tensor([[fx, fy]]),
        principal=torch.tensor([[cx, cy]]),
        width=width,
        height=height,
    )
    normals = normals_from_depth(torch.from_numpy(golden["depth"])[None], cameras)[0]
    assert torch.allclose(normals, torch.from_numpy(golden["normals_opencv"]), atol=1e-5)
    assert torch.allclose(normal_picture(normals), torch.from_numpy(golden["normals_01_opengl"]), atol=1e-5)


def test_plane_has_its_normal_everywhere() -> None:
    cameras = camera()
    normal = unit_or_zero(torch.tensor([0.2, -0.3, -1.0], dtype=torch.float64))
    normals = normals_from_depth(plane_depth(cameras, normal, -3.0), cameras)[0]
    assert torch.allclose(normals[1:-1, 1:-1], normal.expand(22, 30, 3), atol=1e-12)
    assert normals[0].abs().sum() == 0 and normals[:, -1].abs().sum() == 0
    assert torch.equal(torch.nn.functional.pad(torch.ones(22, 30), (1, 1, 1, 1)) > 0, normals.norm(dim=-1) > 0)


def test_sphere_normals_point_from_its_centre() -> None:
    cameras = camera(height=64, width=64, focal=(300.0, 300.0))
    center, radius = torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64), 2.0
    rays = torch.cat(
        [(cameras.pixel_centers() - cameras.principal[0]) / cameras.focal[0], torch.ones(64, 64, 1)], dim=-1
    )
    squared = rays.square().sum(-1)
    along = rays @ center
    depth = (along - (along.square() - squared * (center.square().sum() - radius**2)).sqrt()) / squared
    normals = normals_from_depth(depth[None], cameras)[0]
    expected = (rays * depth[..., None] - center) / radius
    assert torch.allclose(normals[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-4)


def test_normals_face_the_camera_however_rough_the_depth() -> None:
    cameras = camera()
    depth = torch.rand(1, 24, 32, dtype=torch.float64) * 10 + 1e-3
    normals = normals_from_depth(depth, cameras)[0, 1:-1, 1:-1]
    rays = torch.cat(
        [(cameras.pixel_centers() - cameras.principal[0]) / cameras.focal[0], torch.ones(24, 32, 1)], dim=-1
    )
    assert ((normals * rays[1:-1, 1:-1]).sum(-1) < 0).all()
    assert torch.allclose(normals.norm(dim=-1), torch.ones_like(normals[..., 0]))


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_scale_of_the_scene_changes_nothing(factor: float) -> None:
    cameras = camera().to(torch.float32)
    depth = torch.rand(1, 24, 32) + 1.0
    assert torch.allclose(normals_from_depth(depth * factor, cameras), normals_from_depth(depth, cameras), atol=1e-5)


def test_normals_turn_with_the_camera() -> None:
    """Equivariance: the camera frame moves along, world normals turn."""
    still = camera()
    rotation = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    rotation = rotation * torch.linalg.det(rotation)
    turned = dataclasses.replace(
        still, camera_to_world=torch.cat([rotation[None], torch.ones(1, 3, 1, dtype=torch.float64)], dim=2)
    )
    depth = torch.rand(1, 24, 32, dtype=torch.float64) + 1.0
    inside = normals_from_depth(depth, still)
    assert torch.allclose(normals_from_depth(depth, turned), inside, atol=1e-12)
    in_world = torch.einsum("nij,nhwj->nhwi", turned.rotations, inside)
    assert torch.allclose(in_world, inside @ rotation.T, atol=1e-12)


@pytest.mark.parametrize("hole", [0.0, -1.0, float("nan"), float("inf")])
def test_a_hole_gives_zero_normals_and_finite_gradients(hole: float) -> None:
    cameras = camera()
    depth = torch.full((1, 24, 32), 2.0, dtype=torch.float64)
    depth[0, 10, 12] = hole
    depth.requires_grad_()
    normals = normals_from_depth(depth, cameras)
    assert normals.isfinite().all()
    zero = normals[0, 1:-1, 1:-1].norm(dim=-1) == 0
    assert zero.sum() == 5 and zero[9, 11] and zero[8, 11] and zero[10, 11] and zero[9, 10] and zero[9, 12]
    (normals * torch.randn_like(normals)).sum().backward()
    assert depth.grad.isfinite().all()
    assert depth.grad[0, 10, 12] == 0


def test_nothing_visible_gives_zero() -> None:
    depth = torch.zeros(1, 24, 32, dtype=torch.float64, requires_grad=True)
    normals = normals_from_depth(depth, camera())
    normals.sum().backward()
    assert normals.abs().sum() == 0 and depth.grad.abs().sum() == 0


def test_gradient_is_right() -> None:
    cameras = camera(height=5, width=6, focal=(7.0, 8.0))
    depth = (torch.rand(1, 5, 6, dtype=torch.float64) + 1.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda value: normals_from_depth(value, cameras), depth)


def test_unit_or_zero_has_no_exploding_gradient() -> None:
    vectors = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]], requires_grad=True)
    result = unit_or_zero(vectors)
    assert torch.equal(result[0], torch.zeros(3)) and torch.allclose(result[1], torch.tensor([0.6, 0.0, 0.8]))
    result.sum().backward()
    assert vectors.grad[0].abs().sum() == 0 and vectors.grad.isfinite().all()


def test_picture_is_undone_and_blue_faces_the_camera() -> None:
    normals = unit_or_zero(torch.randn(2, 3, 4, 3))
    picture = normal_picture(normals)
    assert picture.min() >= 0 and picture.max() <= 1
    assert torch.allclose(normals_of_picture(picture), normals, atol=1e-6)
    assert torch.equal(normal_picture(torch.tensor([0.0, 0.0, -1.0])), torch.tensor([0.5, 0.5, 1.0]))
    assert torch.equal(normal_picture(torch.zeros(3)), torch.full((3,), 0.5))


def test_facing_flips_only_what_looks_away() -> None:
    towards = torch.tensor([0.0, 0.0, -1.0])
    normals = torch.tensor([[0.0, 0.6, -0.8], [0.0, 0.6, 0.8]])
    assert torch.equal(facing(normals, towards.expand(2, 3)), torch.tensor([[0.0, 0.6, -0.8], [0.0, -0.6, -0.8]]))


def test_wrong_size_is_refused() -> None:
    with pytest.raises(ValueError, match="depth"):
        normals_from_depth(torch.ones(1, 24, 31, dtype=torch.float64), camera())
