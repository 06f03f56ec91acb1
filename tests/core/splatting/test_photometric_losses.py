"""Masked photometric terms and normal losses: closed forms, a readable twin, and who gets which gradient."""

from __future__ import annotations

import math

import pytest
import torch
from pytorch_msssim import ssim as reference_ssim

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.normals import normal_picture, unit_or_zero
from fb_core.splatting.normal_losses import alignment_loss, blended_normals, gaussian_normals, total_variation
from fb_core.splatting.photometric import known_mean, l1, psnr, ssim


def unit(*shape: int) -> torch.Tensor:
    return unit_or_zero(torch.randn(*shape, 3, dtype=torch.float64))


def test_ssim_equals_the_library_in_values_and_gradients() -> None:
    first, second = (
        torch.rand(20, 33, 3, dtype=torch.float64, requires_grad=True),
        torch.rand(20, 33, 3, dtype=torch.float64),
    )
    ours = ssim(first, second)
    theirs = reference_ssim(first.permute(2, 0, 1)[None], second.permute(2, 0, 1)[None], data_range=1.0)
    assert ours.item() == pytest.approx(theirs.item(), abs=1e-7)
    gradients = [torch.autograd.grad(value, first)[0] for value in (ours, theirs)]
    assert torch.allclose(*gradients, atol=1e-8)


def test_ssim_laws() -> None:
    image = torch.rand(16, 24, 3, dtype=torch.float64)
    assert ssim(image, image) == pytest.approx(1.0)
    other = torch.rand_like(image)
    assert ssim(image, other) == pytest.approx(ssim(other, image).item())
    assert ssim(image, other, torch.ones(16, 24, 1, dtype=torch.float64)) == pytest.approx(ssim(image, other).item())
    for height, width in ((1, 1), (4, 30), (10, 10), (11, 12)):
        small = torch.rand(height, width, 3)
        assert ssim(small, small) == pytest.approx(1.0, abs=1e-5)


def test_l1_and_psnr_in_closed_form() -> None:
    first, second = torch.zeros(4, 6, 3), torch.zeros(4, 6, 3)
    second[:, :2] = 0.1
    known = torch.zeros(4, 6, 1)
    known[:, :2] = 1.0
    assert l1(first, second) == pytest.approx(0.1 / 3) and l1(first, second, known) == pytest.approx(0.1)
    assert psnr(first, second, known) == pytest.approx(20.0) and psnr(first, second) == pytest.approx(
        20 + 10 * math.log10(3)
    )
    assert psnr(first, first) == pytest.approx(120.0)
    assert known_mean(second, torch.zeros_like(known)) == 0
    assert known_mean(second, known * 0.01) == pytest.approx(0.1), "a faint mask still gives a mean"


def test_alignment_is_zero_for_equal_normals_and_closed_form_for_opposite() -> None:
    normals = unit(5, 7)
    for form in ("squared", "absolute"):
        assert alignment_loss(normals, normals, form=form) == 0
    assert alignment_loss(normals, -normals) == pytest.approx(8.0), "|2n|^2 on both sides"
    axis = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(5, 7, 3)
    assert alignment_loss(axis, -axis, form="absolute") == pytest.approx(2 / 3), (
        "one of three channels differs by 1, twice"
    )


@pytest.mark.parametrize("form", ["squared", "absolute"])
def test_alignment_pulls_both_sides(form: str) -> None:
    rendered, surface = unit(5, 7).requires_grad_(), unit(5, 7).requires_grad_()
    alignment_loss(rendered, surface, form=form).backward()
    assert torch.allclose(rendered.grad, -surface.grad) and rendered.grad.abs().sum() > 0


def test_alignment_counts_known_pixels_with_both_normals() -> None:
    rendered, surface = unit(4, 4), unit(4, 4)
    known = torch.ones(4, 4, 1, dtype=torch.float64)
    known[0] = 0.0
    rendered[1, 2], surface[2, 3] = 0.0, 0.0
    counted = torch.ones(4, 4, dtype=torch.bool)
    counted[0], counted[1, 2], counted[2, 3] = False, False, False
    expected = 2 * (rendered - surface)[counted].square().sum(-1).mean()
    assert alignment_loss(rendered, surface, known).item() == pytest.approx(expected.item())
    assert alignment_loss(rendered * 0, surface) == 0, "nothing rendered, nothing to align"


def test_total_variation() -> None:
    flat = normal_picture(unit(1, 1)).expand(6, 8, 3)
    assert total_variation(flat) == 0
    step = torch.zeros(6, 8, 3)
    step[:, 4:] = 1.0
    assert total_variation(step) == pytest.approx(1 / 7)
    known = torch.ones(6, 8, 1)
    known[:, 3] = 0.0
    assert total_variation(step, known) == 0, "the only pair across the step is not known on both sides"


def a_camera() -> Pinholes:
    return Pinholes.looking_at(
        torch.tensor([[0.5, -3.0, 1.0]], dtype=torch.float64),
        torch.zeros(1, 3, dtype=torch.float64),
        up=torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64),
        fov_degrees=60.0,
        width=8,
        height=8,
    )


def test_gaussian_normals_face_the_camera_and_follow_the_shortest_axis() -> None:
    camera = a_camera()
    means, quats = torch.randn(50, 3, dtype=torch.float64), torch.randn(50, 4, dtype=torch.float64) * 7
    scales = torch.randn(50, 3, dtype=torch.float64)
    normals = gaussian_normals(means, quats, scales, camera)
    assert torch.allclose(normals.norm(dim=-1), torch.ones(50, dtype=torch.float64))
    in_camera = (means - camera.centers[0]) @ camera.rotations[0]
    assert ((normals * in_camera).sum(-1) <= 0).all()
    assert torch.allclose(gaussian_normals(means, -3 * quats, scales, camera), normals), "q, -q and 3q are one rotation"
    unturned = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(3, 4)
    flat = 1.0 - torch.eye(3, dtype=torch.float64)
    axes = gaussian_normals(torch.zeros(3, 3, dtype=torch.float64), unturned, flat, camera) @ camera.rotations[0].T
    assert torch.allclose(axes.abs(), torch.eye(3, dtype=torch.float64))


def test_gaussian_normals_give_gradients_to_rotations_alone() -> None:
    tensors = [torch.randn(9, size, dtype=torch.float64, requires_grad=True) for size in (3, 4, 3)]
    normals = gaussian_normals(*tensors, a_camera())
    means, quats, scales = torch.autograd.grad(normals[:, 0].sum(), tensors, allow_unused=True)
    assert means is None and scales is None and quats.abs().sum() > 0


def test_quarter_turn() -> None:
    """Closed form: a disc flat along x, turned by 90 degrees about z, is flat along y."""
    quat = torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]], dtype=torch.float64)
    flat = torch.tensor([[-5.0, 0.0, 0.0]], dtype=torch.float64)
    normal = (
        gaussian_normals(torch.zeros(1, 3, dtype=torch.float64), quat, flat, a_camera()) @ a_camera().rotations[0].T
    )
    assert torch.allclose(normal, torch.tensor([[0.0, -1.0, 0.0]], dtype=torch.float64), atol=1e-12)


def test_blended_normals_guard_the_empty_pixel() -> None:
    composited = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.3, -0.4]]], requires_grad=True)
    normals = blended_normals(composited)
    assert torch.allclose(normals, torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.6, -0.8]]]))
    normals.sum().backward()
    assert composited.grad.isfinite().all()
