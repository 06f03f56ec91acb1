"""Laws of camera recovery: it inverts raymaps, moves with the world, agrees with a slow optimiser, and its covariances
are honest.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from conftest import shared_path
from helpers.scenes.moved_cameras import moved
from helpers.scenes.pose_scenes import rotation_degrees, scattered, smaller, spoiled
from helpers.scenes.random_cameras import random_rotations
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.rays import coarse_to_fine
from fb_core.geometry.pose_solver.solver import (
    Arrangement,
    PoseSolving,
    Verdict,
    recover_cameras,
    recover_cameras_from_rays,
)
from fb_core.geometry.raymap import raymaps_of

FREE = PoseSolving(principal="free")
SHARED = PoseSolving(focal="shared", square_pixels=True)


def off_centre(cameras: Pinholes, right: float, down: float) -> Pinholes:
    shift = cameras.principal.new_tensor([right, down])
    return dataclasses.replace(cameras, principal=cameras.principal + shift)


# ---- laws -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "solving", [PoseSolving(), FREE, SHARED, PoseSolving(square_pixels=True), PoseSolving(focal="shared")]
)
def test_inverse_of_raymaps(solving: PoseSolving) -> None:
    cameras = scattered(
        6, width=40, height=30, fov_degrees=(55.0, 55.0) if solving.focal == "shared" else (30.0, 100.0)
    )
    found = recover_cameras(raymaps_of(cameras), solving=solving)
    assert found.verdicts == (Verdict.OK,) * 6 and found.arrangement is Arrangement.APART and set(found.reasons) == {""}
    assert rotation_degrees(found.cameras, cameras).max() < 1e-9
    assert torch.allclose(found.cameras.centers, cameras.centers, atol=1e-12)
    assert torch.allclose(found.cameras.focal, cameras.focal, rtol=1e-10)
    assert torch.allclose(found.cameras.principal, cameras.principal, atol=1e-8)
    assert (
        found.inliers.all() and (found.inlier_share == 1).all() and (found.rejected == 0).all() and found.trusted.all()
    )
    assert found.residual_degrees.max() < 1e-9


def test_unequal_focal_lengths_and_windows_with_known_principal_points() -> None:
    whole = scattered(4, width=60, height=40)
    whole = dataclasses.replace(whole, focal=whole.focal * torch.tensor([1.0, 1.3], dtype=torch.float64))
    for left, top in ((0, 0), (35, 22), (-10, 5), (200, -150)):
        window = whole.cropped(left, top, 24, 16)
        found = recover_cameras(raymaps_of(window), principal=window.principal)
        assert rotation_degrees(found.cameras, window).max() < 1e-8
        assert torch.allclose(found.cameras.focal, window.focal, rtol=1e-8)
        assert torch.equal(found.cameras.principal, window.principal)


def test_unknown_principal_points_are_found() -> None:
    cameras = off_centre(scattered(4, width=40, height=30), 9.0, -5.0)
    found = recover_cameras(raymaps_of(cameras), solving=FREE)
    assert torch.allclose(found.cameras.principal, cameras.principal, atol=1e-8)
    assert rotation_degrees(found.cameras, cameras).max() < 1e-9
    centred = recover_cameras(raymaps_of(cameras))
    assert rotation_degrees(centred.cameras, cameras).min() > 1, "taking them for centred is another camera"


def test_half_a_pixel_matters_and_is_right() -> None:
    """A fit that counted pixels from 0 would be off by about half a pixel's angle."""
    cameras = scattered(3, width=16, height=16)
    found = recover_cameras(raymaps_of(cameras).float())
    assert rotation_degrees(found.cameras, cameras).max() < 1e-4
    assert torch.allclose(found.cameras.directions(), cameras.directions().float(), atol=2e-6)


@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), exponent=st.integers(-3, 3))
def test_moves_with_the_world(seed: int, exponent: int) -> None:
    """Equivariance under similarities, with noise and outliers: the same camera, moved, to 1e-4 (and far better)."""
    generator = torch.Generator().manual_seed(seed)
    cameras = scattered(2, width=24, height=18, seed=seed)
    raymaps = spoiled(raymaps_of(cameras), degrees=1.0, origins=0.01, outliers=0.2, generator=generator)
    turn, shift = random_rotations(1, generator)[0], torch.randn(3, generator=generator, dtype=torch.float64)
    scale = 10.0**exponent
    there = torch.cat(
        [
            scale * torch.einsum("ij,njhw->nihw", turn, raymaps[:, :3]) + shift[:, None, None],
            torch.einsum("ij,njhw->nihw", turn, raymaps[:, 3:]),
        ],
        dim=1,
    )
    found, found_there = recover_cameras(raymaps), recover_cameras(there)
    expected = moved(found.cameras, scale=scale, turn=turn, shift=shift)
    assert rotation_degrees(found_there.cameras, expected).max() < 1e-4
    assert (found_there.cameras.centers - expected.centers).abs().max() < 1e-4 * max(scale, 1.0)
    assert torch.allclose(found_there.cameras.focal, expected.focal, rtol=1e-6)
    assert (found.inliers == found_there.inliers).float().mean() > 0.999


def test_same_call_same_bits_and_no_view_depends_on_the_others() -> None:
    generator = torch.Generator().manual_seed(1)
    raymaps = spoiled(
        raymaps_of(scattered(5, width=32, height=32)), degrees=2.0, origins=0.01, outliers=0.3, generator=generator
    )
    torch.manual_seed(7)
    first = recover_cameras(raymaps)
    torch.manual_seed(8)
    again, part = recover_cameras(raymaps), recover_cameras(raymaps[[3, 1]])
    assert torch.equal(first.cameras.camera_to_world, again.cameras.camera_to_world)
    assert torch.equal(first.covariance, again.covariance) and torch.equal(first.inliers, again.inliers)
    assert torch.allclose(first.cameras.camera_to_world[[3, 1]], part.cameras.camera_to_world, atol=1e-9)


def test_lists_of_rays_in_any_order_give_the_same_camera() -> None:
    cameras = scattered(3, width=20, height=12)
    raymaps = raymaps_of(cameras)
    order = torch.randperm(240)[:150]
    rays = raymaps.flatten(2)[..., order].transpose(1, 2)
    pixels = cameras.pixel_centers().reshape(-1, 2)[order].expand(3, -1, -1)
    weights = torch.ones(3, 150, dtype=torch.float64)
    weights[1, ::2] = 0
    found = recover_cameras_from_rays(rays[..., :3], 7 * rays[..., 3:], pixels, width=20, height=12, weights=weights)
    assert rotation_degrees(found.cameras, cameras).max() < 1e-9 and found.trusted.all()
    assert torch.equal(found.inliers, weights > 0)


def test_pixels_are_taken_evenly() -> None:
    order = coarse_to_fine(16, 16)
    assert torch.equal(order.sort().values, torch.arange(256))
    for count in (4, 16, 64):
        y, x = order[:count] // 16, order[:count] % 16
        step = 16 // math.isqrt(count)
        assert len({(int(a) // step, int(b) // step) for a, b in zip(y, x, strict=True)}) == count
    assert torch.equal(coarse_to_fine(5, 9).sort().values, torch.arange(45))


# ---- robustness -----------------------------------------------------------------------------------------------------


def test_clean_cameras_to_a_hundred_thousandth_of_a_degree() -> None:
    cameras = scattered(16, width=256, height=256, fov_degrees=(40.0, 70.0))
    found = recover_cameras(raymaps_of(cameras).float())
    assert rotation_degrees(found.cameras, cameras).max() <= 1e-5


def test_one_degree_of_noise() -> None:
    cameras = scattered(16, width=256, height=256, fov_degrees=(40.0, 70.0))
    raymaps = spoiled(
        raymaps_of(cameras), degrees=1.0, origins=0.01, outliers=0.0, generator=torch.Generator().manual_seed(0)
    )
    found = recover_cameras(raymaps.float())
    assert rotation_degrees(found.cameras, cameras).median() <= 0.15
    assert (found.residual_degrees - 1).abs().max() < 0.05 and (found.residual_origins - 0.01).abs().max() < 5e-4
    assert found.inlier_share.min() > 0.99


@pytest.mark.parametrize("solving", [PoseSolving(), FREE, PoseSolving(square_pixels=True)])
def test_thirty_percent_in_one_coherent_wrong_block(solving: PoseSolving) -> None:
    """The block is a camera of its own that stands and looks elsewhere."""
    cameras = scattered(16, width=128, height=128, fov_degrees=(40.0, 70.0))
    raymaps = spoiled(
        raymaps_of(cameras), degrees=1.0, origins=0.01, outliers=0.3, generator=torch.Generator().manual_seed(0)
    )
    found = recover_cameras(raymaps.float(), solving=solving)
    assert rotation_degrees(found.cameras, cameras).max() < (0.5 if solving.principal == "known" else 1.5)
    side = round(128 * math.sqrt(0.3))
    assert found.inliers[:, :side, :side].float().mean() < 0.01
    assert found.inliers[:, side:, side:].float().mean() > 0.99
    assert (found.inlier_share - 0.7).abs().max() < 0.02


def test_shared_focal_is_more_accurate_and_ignores_views_without_a_camera() -> None:
    cameras = scattered(12, width=64, height=64, fov_degrees=(50.0, 50.0))
    raymaps = spoiled(
        raymaps_of(cameras), degrees=3.0, origins=0.03, outliers=0.1, generator=torch.Generator().manual_seed(0)
    )
    raymaps[3, 3:] = torch.nn.functional.normalize(torch.randn(3, 64, 64, dtype=torch.float64), dim=0)
    raymaps[5, 3] *= -1
    own, shared = recover_cameras(raymaps), recover_cameras(raymaps, solving=SHARED)
    good = [index for index in range(12) if index not in (3, 5)]
    assert [own.verdicts[3], own.verdicts[5]] == [Verdict.NO_CONSENSUS, Verdict.MIRRORED]
    assert all(shared.verdicts[index] is Verdict.OK for index in good)

    def error(found):
        return (found.cameras.focal[good] / cameras.focal[good] - 1).abs().median()

    assert error(shared) < error(own) / 1.5 and error(shared) < 0.003
    assert shared.cameras.focal[good].unique().numel() == 1


def test_a_mask_hides_rays_and_a_weight_is_an_inverse_variance() -> None:
    cameras = scattered(4, width=48, height=48)
    raymaps = raymaps_of(cameras)
    known = (torch.rand(4, 1, 48, 48, generator=torch.Generator().manual_seed(0)) < 0.5).double()
    rubbish = torch.where(known > 0, raymaps, torch.full_like(raymaps, torch.nan))
    found = recover_cameras(rubbish, weights=known)
    assert rotation_degrees(found.cameras, cameras).max() < 1e-9 and (found.rejected == 0).all()
    assert torch.equal(found.inliers, known[:, 0] > 0)
    # Half of the rays are ten times as noisy: saying so makes the camera better.
    noise = torch.randn(4, 3, 48, 48, dtype=torch.float64) * torch.where(known > 0, 0.003, 0.03)
    noisy = torch.cat([raymaps[:, :3], raymaps[:, 3:] + noise], dim=1)
    told = recover_cameras(noisy, weights=torch.where(known > 0, 1.0, 0.01))
    assert (
        rotation_degrees(told.cameras, cameras).mean()
        < rotation_degrees(recover_cameras(noisy).cameras, cameras).mean()
    )
    assert told.inlier_share.min() > 0.99


# ---- against a slow twin, and covariances ---------------------------------------------------------------------------


def test_agrees_with_a_general_optimiser() -> None:
    """The readable twin: scipy's least squares over rotation vector and two focal lengths, on all rays of a noisy
    view.
    """
    cameras = scattered(2, width=20, height=16)
    raymaps = spoiled(
        raymaps_of(cameras), degrees=0.5, origins=0.01, outliers=0.0, generator=torch.Generator().manual_seed(3)
    )
    found = recover_cameras(raymaps)
    for index in range(2):
        inliers = found.inliers[index].flatten().numpy()
        rays = raymaps[index, 3:].flatten(1).numpy()[:, inliers]
        x, y = cameras.pixel_centers().reshape(-1, 2).numpy()[inliers].T

        def misses(parameters, x=x, y=y, rays=rays):
            k = np.stack([(x - 10) / np.exp(parameters[3]), (y - 8) / np.exp(parameters[4]), np.ones_like(x)])
            return (Rotation.from_rotvec(parameters[:3]).as_matrix() @ (k / np.linalg.norm(k, axis=0)) - rays).ravel()

        truth = [
            *Rotation.from_matrix(cameras.rotations[index].numpy()).as_rotvec(),
            *cameras.focal[index].log().tolist(),
        ]
        best = least_squares(misses, truth, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        assert np.allclose(
            Rotation.from_rotvec(best[:3]).as_matrix(), found.cameras.rotations[index].numpy(), atol=1e-7
        )
        assert np.allclose(np.exp(best[3:]), found.cameras.focal[index].numpy(), rtol=1e-7)


@pytest.mark.parametrize("solving", [PoseSolving(), FREE, PoseSolving(square_pixels=True), SHARED])
def test_covariances_are_honest(solving: PoseSolving) -> None:
    """Mean of error^T covariance^-1 error over its degrees of freedom, over 200 noisy views: within 10 % of 1."""
    cameras = scattered(
        200, width=20, height=20, fov_degrees=(60.0, 60.0) if solving.focal == "shared" else (40.0, 80.0)
    )
    raymaps = spoiled(
        raymaps_of(cameras), degrees=1.0, origins=0.01, outliers=0.0, generator=torch.Generator().manual_seed(0)
    )
    found = recover_cameras(raymaps, solving=solving)
    turn = cameras.rotations.transpose(1, 2) @ found.cameras.rotations
    turn = (
        torch.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], dim=1
        )
        / 2
    )
    error = torch.cat(
        [
            turn,
            found.cameras.centers - cameras.centers,
            found.cameras.focal - cameras.focal,
            found.cameras.principal - cameras.principal,
        ],
        dim=1,
    )
    kept = [0, 1, 2, 3, 4, 5] + ([] if solving.focal == "shared" else [6] if solving.square_pixels else [6, 7])
    kept += [8, 9] if solving.principal == "free" else []
    covariance = found.covariance[:, kept][:, :, kept]
    chi_square = torch.einsum("ni,nij,nj->n", error[:, kept], torch.linalg.inv(covariance), error[:, kept]) / len(kept)
    assert abs(float(chi_square.mean()) - 1) < 0.1
    assert (found.covariance[:, 8:] == 0).all() == (solving.principal == "known")
    if solving.focal == "shared":
        assert ((error[0, 6] / found.covariance[0, 6, 6].sqrt()).abs() < 4) and found.covariance[
            :, 6, 6
        ].unique().numel() == 1


# ---- gradients ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("solving", [PoseSolving(), SHARED, FREE])
def test_gradient_is_that_of_finite_differences(solving: PoseSolving) -> None:
    cameras = scattered(2, width=6, height=5, fov_degrees=(60.0, 60.0))
    raymaps = raymaps_of(cameras).requires_grad_()
    probe = torch.randn(2, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def value(rays: torch.Tensor) -> torch.Tensor:
        found = recover_cameras(rays, solving=solving).cameras
        everything = torch.cat([found.camera_to_world.flatten(1), found.focal, found.principal], dim=1)
        return (probe * everything).sum()

    (gradient,) = torch.autograd.grad(value(raymaps), raymaps)
    # A smooth direction in which the rays stay those of some camera: nothing becomes an outlier.
    other = raymaps_of(dataclasses.replace(cameras, focal=cameras.focal * 1.001)) - raymaps.detach()
    other[:, :3] += torch.randn(2, 3, 1, 1, dtype=torch.float64) * 1e-3
    step = 1e-3
    numeric = (value(raymaps.detach() + step * other) - value(raymaps.detach() - step * other)) / (2 * step)
    assert float((gradient * other).sum()) == pytest.approx(float(numeric), rel=1e-3)


# ---- goldens and errors ---------------------------------------------------------------------------------------------


def test_golden_noisy_raymaps() -> None:
    """The original's fit of the same raymaps is the yardstick (it counts pixels from 0): the truth is nearer to us in
    every view.
    """
    with np.load(shared_path("golden/reference/fit_cameras.npz")) as arrays:
        values = {key: torch.from_numpy(arrays[key]).double() for key in arrays.files}
    flip = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    truth = dataclasses.replace(scattered(6, width=32, height=32), camera_to_world=values["c2w_true"] * flip)
    theirs = dataclasses.replace(truth, camera_to_world=values["c2w"] * flip)
    ours = recover_cameras(torch.cat([values["origins"], values["directions"]], dim=1)).cameras
    assert rotation_degrees(ours, truth).max() < rotation_degrees(theirs, truth).min()
    assert (ours.focal[:, :1] - values["fx_true"]).abs().mean() < (values["fx"] - values["fx_true"]).abs().mean()
    assert (ours.centers - truth.centers).norm(dim=1).mean() <= (theirs.centers - truth.centers).norm(dim=1).mean()


def test_nonsense_is_refused(shapes_unchecked) -> None:
    raymaps = raymaps_of(smaller())
    with pytest.raises(ValueError, match="raymaps: expected a shape"):
        recover_cameras(raymaps[:, :5])
    with pytest.raises(ValueError, match="weights: expected a shape"):
        recover_cameras(raymaps, weights=torch.ones(1, 1, 2, 2))
    with pytest.raises(ValueError, match="weights: expected finite"):
        recover_cameras(raymaps, weights=-torch.ones_like(raymaps[:, :1]))
    with pytest.raises(ValueError, match="weights: expected finite"):
        recover_cameras(raymaps, weights=torch.full_like(raymaps[:, :1], torch.nan))
    with pytest.raises(ValueError, match="principal: expected finite"):
        recover_cameras(raymaps, principal=torch.full((1, 2), torch.nan))
    with pytest.raises(ValueError, match="principal: expected None"):
        recover_cameras(raymaps, principal=torch.ones(1, 2), solving=FREE)
    with pytest.raises(ValueError, match="rays_per_view"):
        PoseSolving(rays_per_view=3)
    rays = torch.rand(1, 9, 3)
    with pytest.raises(ValueError, match="as many origins"):
        recover_cameras_from_rays(rays, rays[:, :5], rays[..., :2], width=8, height=8)
    with pytest.raises(ValueError, match="pixels: expected finite"):
        recover_cameras_from_rays(rays, rays, rays[..., :2] * torch.inf, width=8, height=8)
