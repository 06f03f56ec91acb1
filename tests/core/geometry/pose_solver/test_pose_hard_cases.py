"""Hard cases of camera recovery, each by its name: nothing that comes out, nor any gradient, is ever NaN or
infinite.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.scenes.moved_cameras import moved
from helpers.scenes.pose_scenes import rotation_degrees, scattered, smaller, spoiled
from helpers.scenes.random_cameras import random_rotations

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.solver import (
    Arrangement,
    PoseSolving,
    RecoveredCameras,
    Verdict,
    recover_cameras,
    recover_cameras_from_rays,
)
from fb_core.geometry.raymap import raymaps_of

WAYS = [PoseSolving(), PoseSolving(focal="shared", square_pixels=True), PoseSolving(principal="free")]


def all_finite(found: RecoveredCameras) -> bool:
    cameras = (found.cameras.camera_to_world, found.cameras.focal, found.cameras.principal)
    tensors = (*cameras, found.covariance, found.residual_degrees, found.residual_origins, found.inlier_share)
    proper = torch.linalg.det(found.cameras.rotations) if len(found.cameras) else torch.ones(1)
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors) and bool((proper > 0.999).all())


def recovered(raymaps: torch.Tensor, **arguments) -> RecoveredCameras:
    """Cameras, after checking values and the gradients of everything differentiable."""
    raymaps = raymaps.detach().clone().requires_grad_()
    found = recover_cameras(raymaps, **arguments)
    assert all_finite(found)
    everything = torch.cat(
        [found.cameras.camera_to_world.flatten(1), found.cameras.focal, found.cameras.principal], dim=1
    )
    everything.sum().backward()
    assert raymaps.grad is not None and bool(torch.isfinite(raymaps.grad).all())
    return found


@pytest.mark.parametrize("solving", WAYS)
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_scene_scale_from_a_millionth_to_a_million(scale: float, solving: PoseSolving) -> None:
    cameras = scattered(4, width=24, height=20, scale=scale, fov_degrees=(60.0, 60.0))
    found = recovered(raymaps_of(cameras).float(), solving=solving)
    assert found.trusted.all() and found.inliers.all() and found.arrangement is Arrangement.APART
    assert rotation_degrees(found.cameras, cameras).max() < 1e-4
    assert (found.cameras.centers - cameras.centers).abs().max() < 1e-6 * scale


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_global_similarities_at_every_scale(scale: float) -> None:
    """Equivariance to 1e-4 in float32, with noise."""
    generator = torch.Generator().manual_seed(0)
    raymaps = spoiled(
        raymaps_of(scattered(4, width=24, height=20)), degrees=0.3, origins=0.01, outliers=0.1, generator=generator
    )
    turn = random_rotations(1, generator)[0]
    shift = scale * torch.randn(3, generator=generator, dtype=torch.float64)
    origins = scale * torch.einsum("ij,njhw->nihw", turn, raymaps[:, :3]) + shift[:, None, None]
    there = torch.cat([origins, torch.einsum("ij,njhw->nihw", turn, raymaps[:, 3:])], dim=1)
    found, found_there = recover_cameras(raymaps.float()), recovered(there.float())
    expected = moved(found.cameras.to(torch.float64), scale=scale, turn=turn, shift=shift)
    assert (found_there.cameras.rotations - expected.rotations).abs().max() <= 1e-4
    assert (found_there.cameras.centers - expected.centers).abs().max() <= 1e-4 * scale
    assert (found_there.cameras.focal / expected.focal - 1).abs().max() <= 1e-4


def test_origins_a_hundred_thousand_away_in_float32() -> None:
    """Their rounding there is 0.008: centres are that good, rotations do not care, and noisy origins average
    beyond it.
    """
    cameras = scattered(4, width=24, height=20)
    far = moved(cameras, shift=torch.tensor([1e5, -1e5, 1e5], dtype=torch.float64))
    found = recovered(raymaps_of(far).float())
    assert found.trusted.all() and found.inliers.all() and found.arrangement is Arrangement.APART
    assert rotation_degrees(found.cameras, far).max() < 1e-4
    assert (found.cameras.centers - far.centers).abs().max() < 0.008
    noisy = spoiled(
        raymaps_of(far), degrees=0.5, origins=0.05, outliers=0.2, generator=torch.Generator().manual_seed(0)
    )
    found = recovered(noisy.float())
    assert (found.cameras.centers - far.centers).abs().max() < 0.02 and rotation_degrees(found.cameras, far).max() < 0.5


def test_all_cameras_at_one_point() -> None:
    cameras = scattered(5, width=24, height=20)
    pose = cameras.camera_to_world.clone()
    pose[:, :, 3] = pose[0, :, 3]
    turning = dataclasses.replace(cameras, camera_to_world=pose)
    found = recovered(raymaps_of(turning).float())
    assert found.trusted.all() and found.arrangement is Arrangement.ONE_PLACE
    assert rotation_degrees(found.cameras, turning).max() < 1e-4
    noisy = spoiled(
        raymaps_of(turning), degrees=0.5, origins=0.01, outliers=0.0, generator=torch.Generator().manual_seed(0)
    )
    assert recovered(noisy).arrangement is Arrangement.ONE_PLACE
    apart = spoiled(
        raymaps_of(cameras), degrees=0.5, origins=0.01, outliers=0.0, generator=torch.Generator().manual_seed(0)
    )
    assert recovered(apart).arrangement is Arrangement.APART


def test_duplicate_cameras() -> None:
    raymaps = raymaps_of(scattered(2, width=24, height=20))[[0, 0, 1, 0]].float()
    for solving in WAYS[:1] + WAYS[2:]:
        found = recovered(raymaps, solving=solving)
        assert found.trusted.all() and found.arrangement is Arrangement.APART
        assert torch.equal(found.cameras.camera_to_world[0], found.cameras.camera_to_world[3])
    twice = recovered(raymaps[[0, 0]], solving=WAYS[1])
    assert twice.trusted.all() and twice.arrangement is Arrangement.ONE_PLACE


@pytest.mark.parametrize("solving", WAYS)
@pytest.mark.parametrize(
    ("degrees", "tolerance"), [(2.0, 2e-4), (10.0, 1e-4), (120.0, 1e-4), (150.0, 1e-4), (170.0, 1e-3)]
)
def test_field_of_view_from_2_to_150_degrees(degrees: float, tolerance: float, solving: PoseSolving) -> None:
    if solving.principal == "free" and degrees < 10:
        tolerance = 0.05  # turning and moving the principal point are nearly the same there
    cameras = scattered(4, width=32, height=24, fov_degrees=(degrees, degrees))
    found = recovered(raymaps_of(cameras).float(), solving=solving)
    assert found.trusted.all() and found.inliers.all()
    assert rotation_degrees(found.cameras, cameras).max() < tolerance
    assert (found.cameras.focal / cameras.focal - 1).abs().max() < 1e-5


@pytest.mark.parametrize("degrees", [2.0, 150.0])
def test_extreme_fields_of_view_with_noise_and_outliers(degrees: float) -> None:
    cameras = scattered(8, width=64, height=64, fov_degrees=(degrees, degrees))
    raymaps = spoiled(
        raymaps_of(cameras),
        degrees=degrees / 100,
        origins=0.01,
        outliers=0.25,
        generator=torch.Generator().manual_seed(0),
    )
    found = recovered(raymaps.float())
    assert found.trusted.all()
    assert (found.cameras.focal / cameras.focal - 1).abs().max() < 0.02
    assert rotation_degrees(found.cameras, cameras).max() < 0.5


@pytest.mark.parametrize("spread", [0.0, 1e-9, 1e-7])
def test_nearly_parallel_rays(spread: float) -> None:
    """An orthographic camera has no focal length: said so, not invented."""
    raymaps = raymaps_of(smaller(3)).float()
    raymaps[1, 3:] = torch.tensor([0.6, 0.0, 0.8])[:, None, None] + spread * torch.randn(3, 10, 12)
    found = recovered(raymaps)
    assert found.verdicts == (Verdict.OK, Verdict.PARALLEL, Verdict.OK) and "parallel" in found.reasons[1]
    assert not found.inliers[1].any() and found.inliers[0].all()


def test_parallel_up_to_noise() -> None:
    cameras = scattered(3, width=24, height=24, fov_degrees=(0.01, 0.01))
    raymaps = spoiled(
        raymaps_of(cameras), degrees=1.0, origins=0.0, outliers=0.0, generator=torch.Generator().manual_seed(0)
    )
    assert set(recovered(raymaps).verdicts) == {Verdict.PARALLEL}
    clean = recovered(raymaps_of(cameras))
    assert clean.trusted.all() and (clean.cameras.focal / cameras.focal - 1).abs().max() < 1e-5, (
        "a telescope is a camera"
    )


@pytest.mark.parametrize("solving", WAYS)
@pytest.mark.parametrize("axis", ["world", "image", "all three"])
def test_mirrored_handedness_is_reported_and_not_returned(axis: str, solving: PoseSolving) -> None:
    cameras = scattered(3, width=24, height=20, fov_degrees=(50.0, 50.0))
    raymaps = raymaps_of(cameras)
    mirrored = {
        "world": raymaps * torch.tensor([1.0, 1, -1, 1, 1, -1], dtype=torch.float64)[:, None, None],
        "image": raymaps.flip(3),
        "all three": torch.cat([raymaps[:, :3], -raymaps[:, 3:]], dim=1),
    }[axis]
    raymaps[1] = spoiled(
        mirrored[1:2], degrees=0.5, origins=0.01, outliers=0.2, generator=torch.Generator().manual_seed(0)
    )[0]
    found = recovered(raymaps, solving=solving)
    assert found.verdicts == (Verdict.OK, Verdict.MIRRORED, Verdict.OK) and "left-handed" in found.reasons[1]
    assert torch.equal(found.cameras.rotations[1], torch.eye(3, dtype=torch.float64)) and not found.inliers[1].any()
    good = [0, 2]
    assert rotation_degrees(found.cameras[good], cameras[good]).max() < 1e-8


def test_nan_rays_are_rejected_with_their_count() -> None:
    cameras = scattered(4, width=24, height=20)
    raymaps = raymaps_of(cameras).float()
    raymaps[1, 0, :3, :5] = torch.nan
    raymaps[1, 4, 10] = torch.inf
    raymaps[2, 3:, 4, 4] = 0.0
    raymaps[3] = torch.nan
    found = recovered(raymaps)
    assert found.rejected.tolist() == [0, 15 + 24, 1, 480]
    assert found.verdicts == (Verdict.OK, Verdict.OK, Verdict.OK, Verdict.NO_RAYS)
    assert "39 rejected" in found.reasons[1] and "480 rejected" in found.reasons[3]
    assert not found.inliers[1, :3, :5].any() and found.inliers[1].sum() == 480 - 39
    assert rotation_degrees(found.cameras[[0, 1, 2]], cameras[[0, 1, 2]]).max() < 1e-4


@pytest.mark.parametrize("solving", WAYS)
def test_all_rays_masked(solving: PoseSolving) -> None:
    raymaps = raymaps_of(scattered(3, width=24, height=20, fov_degrees=(50.0, 50.0))).float()
    weights = torch.ones(3, 1, 24, 20).transpose(2, 3).contiguous()
    weights[1] = 0
    found = recovered(raymaps, weights=weights, solving=solving)
    assert found.verdicts == (Verdict.OK, Verdict.NO_RAYS, Verdict.OK) and "masked" in found.reasons[1]
    nothing = recovered(raymaps, weights=torch.zeros_like(weights), solving=solving)
    assert set(nothing.verdicts) == {Verdict.NO_RAYS} and nothing.arrangement is Arrangement.NO_CAMERA
    assert nothing.covariance.diagonal(dim1=1, dim2=2)[:, :3].min() > 9, "half a turn either way"


@pytest.mark.parametrize("solving", WAYS)
def test_one_camera_and_none(solving: PoseSolving) -> None:
    found = recovered(raymaps_of(smaller(1)), solving=solving)
    assert found.trusted.all() and found.arrangement is Arrangement.ONE_CAMERA
    none = recover_cameras(torch.zeros(0, 6, 8, 8), solving=solving)
    assert len(none.cameras) == 0 and none.arrangement is Arrangement.NO_CAMERA and none.inliers.shape == (0, 8, 8)


def test_too_few_rays_and_rays_on_a_line() -> None:
    raymaps = raymaps_of(smaller(4))
    weights = torch.zeros(4, 1, 10, 12)
    weights[0, 0, 2, :3] = 1
    weights[1, 0, 4] = 1
    weights[2, 0, range(10), range(10)] = 1
    weights[3, 0, [0, 0, 9, 9], [0, 11, 0, 11]] = 1
    found = recovered(raymaps, weights=weights.double())
    assert found.verdicts == (Verdict.TOO_FEW_RAYS, Verdict.ON_A_LINE, Verdict.ON_A_LINE, Verdict.OK)
    assert [reason.split()[0] for reason in found.reasons[:2]] == ["3", "all"]


def test_rays_of_no_camera() -> None:
    generator = torch.Generator().manual_seed(0)
    found = recovered(torch.randn(6, 6, 24, 20, generator=generator))
    assert set(found.verdicts) <= {Verdict.NO_CONSENSUS, Verdict.PARALLEL}
    half = raymaps_of(scattered(4, width=24, height=20))
    half[:, 3:, :14] = torch.randn(4, 3, 14, 24, generator=generator, dtype=torch.float64)
    assert set(recovered(half).verdicts) <= {Verdict.NO_CONSENSUS, Verdict.PARALLEL}, "70 % of rubbish is too much"


def test_tiny_and_huge_directions_and_half_precision() -> None:
    cameras = scattered(3, width=24, height=20)
    raymaps = raymaps_of(cameras).float()
    for factor in (1e-30, 1e30):
        scaled = torch.cat([raymaps[:, :3], raymaps[:, 3:] * factor], dim=1)
        scaled[:, 3:, :3, :5] = scaled[:, 3:, :3, :5].flip(1)
        found = recover_cameras(scaled)
        assert rotation_degrees(found.cameras, cameras).max() < 1e-4
        assert not found.inliers[:, :3, :5].all() and found.inliers[:, 3:].all() and found.inliers[:, :, 5:].all()
    for dtype, degrees in ((torch.bfloat16, 0.2), (torch.float16, 0.02)):
        found = recover_cameras(raymaps.to(dtype))
        assert found.cameras.focal.dtype == torch.float32 and found.inliers.all() and all_finite(found)
        assert rotation_degrees(found.cameras, cameras).max() < degrees


def test_a_small_known_corner_of_a_large_raymap() -> None:
    cameras = scattered(2, width=200, height=150)
    weights = torch.zeros(2, 1, 150, 200)
    weights[:, :, -9:, -11:] = 1
    found = recovered(raymaps_of(cameras), weights=weights.double())
    assert found.trusted.all() and rotation_degrees(found.cameras, cameras).max() < 1e-6
    assert torch.equal(found.inliers, weights[:, 0] > 0)


def test_a_raymap_of_two_by_two_pixels() -> None:
    cameras = scattered(3, width=2, height=2)
    assert rotation_degrees(recovered(raymaps_of(cameras)).cameras, cameras).max() < 1e-8


# ---- ten thousand draws ---------------------------------------------------------------------------------------------

BATCH = 500
LIGHT = PoseSolving(hypotheses=3, rays_per_view=48)


def drawn(batch: int, generator: torch.Generator) -> tuple[Pinholes, torch.Tensor, torch.Tensor]:
    """Cameras at scales 1e-6 to 1e6 with fields of view from 2 to 150 degrees, and 8x6 raymaps with random masks and
    broken rays.
    """

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    scale = 10 ** (uniform(BATCH, 1) * 12 - 6)
    half_angle = torch.deg2rad(1 * 75 ** uniform(BATCH, 1))
    focal = 4 / torch.tan(half_angle) * (0.8 + 0.4 * uniform(BATCH, 2))
    cameras = Pinholes(
        camera_to_world=torch.cat(
            [random_rotations(BATCH, generator), (scale * (uniform(BATCH, 3) * 2 - 1))[..., None]], dim=2
        ),
        focal=focal,
        principal=torch.tensor([8.0, 6.0], dtype=torch.float64) * (uniform(BATCH, 2) * 1.6 - 0.3),
        width=8,
        height=6,
    )
    raymaps = raymaps_of(cameras)
    weights = (uniform(BATCH, 1, 6, 8) < 0.8).double()
    raymaps = torch.where(uniform(BATCH, 1, 6, 8) < 0.05, torch.nan, raymaps)
    return cameras, raymaps if batch % 2 else raymaps.float(), weights.to(raymaps if batch % 2 else torch.float32)


def test_ten_thousand_random_cameras() -> None:
    """Every one of 10 000 is recovered from a few dozen rays: finite, proper, no worse than the rounding of what came
    in.
    """
    generator = torch.Generator().manual_seed(0)
    count = 0
    for batch in range(20):
        cameras, raymaps, weights = drawn(batch, generator)
        found = recover_cameras(raymaps, weights=weights, principal=cameras.principal, solving=LIGHT)
        assert all_finite(found) and found.trusted.all()
        exact = raymaps.dtype == torch.float64
        assert rotation_degrees(found.cameras, cameras).max() < (1e-7 if exact else 2e-3)
        assert (found.cameras.focal / cameras.focal - 1).abs().max() < (1e-8 if exact else 1e-4)
        scale = cameras.centers.norm(dim=1, keepdim=True)
        assert ((found.cameras.centers - cameras.centers).abs() / scale).max() < (1e-12 if exact else 1e-6)
        broken = (~torch.isfinite(raymaps).all(dim=1) & (weights[:, 0] > 0)).flatten(1).sum(dim=1)
        assert torch.equal(found.rejected, broken)
        count += len(cameras)
    assert count == 10_000


def test_lists_of_rays_with_gaps_and_rubbish() -> None:
    cameras = scattered(3, width=20, height=12)
    rays = raymaps_of(cameras).flatten(2).transpose(1, 2).clone()
    pixels = cameras.pixel_centers().reshape(1, -1, 2).expand(3, -1, -1).clone()
    rays[0, ::7] = torch.nan
    rays[1, :40, 3:] = -rays[1, :40, 3:]
    weights = torch.ones(3, 240, dtype=torch.float64)
    weights[2, 5:] = 0
    pixels[2, 100:] = torch.nan
    found = recover_cameras_from_rays(rays[..., :3], rays[..., 3:], pixels, width=20, height=12, weights=weights)
    assert (
        found.verdicts[:2] == (Verdict.OK, Verdict.OK) and found.verdicts[2] is Verdict.ON_A_LINE and all_finite(found)
    )
    assert found.rejected.tolist() == [35, 0, 0] and not found.inliers[1, :40].any()
    assert rotation_degrees(found.cameras[[0, 1]], cameras[[0, 1]]).max() < 1e-8
