"""Laws of raymaps and of the canonical frame: exact inverse, equivariance under similarities, goldens, hard
captures.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from conftest import shared_path
from helpers.scenes.moved_cameras import moved
from helpers.scenes.random_cameras import random_cameras, random_rotations
from hypothesis import given
from hypothesis import strategies as st

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import CanonicalFrame, axes_of, from_unit_range, raymaps_of, to_unit_range

SEEDS = st.integers(0, 10_000)
FROM_OPENGL = torch.tensor([1.0, -1.0, -1.0, 1.0])


def golden(name: str) -> dict[str, torch.Tensor]:
    with np.load(shared_path(f"golden/reference/{name}.npz")) as arrays:
        return {key: torch.from_numpy(np.asarray(arrays[key])) for key in arrays.files}


def rotation_about_z(angle: float) -> torch.Tensor:
    cosine, sine = math.cos(angle), math.sin(angle)
    return torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)


# ---- rays -----------------------------------------------------------------------------------------------------------


def test_golden_rays_from_cameras() -> None:
    arrays = golden("rays_from_cameras")
    cameras = Pinholes(
        camera_to_world=arrays["c2w"] * FROM_OPENGL,
        focal=torch.cat([arrays["fx"], arrays["fy"]], dim=1),
        principal=torch.cat([arrays["cx"], arrays["cy"]], dim=1),
        width=64,
        height=64,
    )
    raymaps = raymaps_of(cameras)
    assert torch.equal(raymaps[:, :3], arrays["origins"])
    assert (raymaps[:, 3:] - arrays["directions"]).abs().max() < 1e-6


@given(seed=SEEDS)
def test_a_raymap_holds_centre_and_direction_of_every_pixel(seed: int) -> None:
    cameras = random_cameras(seed)
    raymaps = raymaps_of(cameras)
    points = (raymaps[:, :3] + 2.5 * raymaps[:, 3:]).permute(0, 2, 3, 1)
    for index in range(len(cameras)):
        pixels, depth = cameras[index].project(points[index].reshape(-1, 3))
        assert torch.allclose(pixels[0].reshape(5, 7, 2), cameras.pixel_centers(), atol=1e-9)
        assert (depth > 0).all()


@given(seed=SEEDS)
def test_rays_turn_scale_and_shift_with_the_world(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    turn, shift = random_rotations(1, generator)[0], torch.randn(3, generator=generator, dtype=torch.float64)
    cameras = random_cameras(seed)
    raymaps, other = raymaps_of(cameras), raymaps_of(moved(cameras, scale=0.3, turn=turn, shift=shift))
    expected = 0.3 * torch.einsum("ij,njhw->nihw", turn, raymaps[:, :3]) + shift[:, None, None]
    assert torch.allclose(other[:, :3], expected, atol=1e-12)
    assert torch.allclose(other[:, 3:], torch.einsum("ij,njhw->nihw", turn, raymaps[:, 3:]), atol=1e-12)


def test_unit_range_and_back() -> None:
    cameras = random_cameras(3)
    raymaps = CanonicalFrame.of(cameras).apply(raymaps_of(cameras))
    ranged = to_unit_range(raymaps)
    assert ranged.min() >= 0 and ranged.max() <= 1
    assert torch.allclose(from_unit_range(ranged), raymaps, atol=1e-14)
    stretched = torch.cat([raymaps[:, :3], 0.5 * raymaps[:, 3:]], dim=1)
    assert torch.allclose(from_unit_range(to_unit_range(stretched)), raymaps, atol=1e-14), (
        "directions come back with unit length"
    )
    assert torch.isfinite(from_unit_range(torch.full((1, 6, 2, 2), 0.5))).all(), "a zero direction stays finite"


# ---- canonical frame ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("case", "reference"), [("eval_small", 0), ("eval_big", 0), ("train", 2)])
def test_golden_canonical_frame(case: str, reference: int) -> None:
    """The golden's heading and rescaling were drawn; both are recovered from it, and all else must follow."""
    arrays = golden("canonical_frame")
    pose_scale = float(arrays[f"{case}_pose_scale"])
    pose = arrays["c2w"] * FROM_OPENGL
    pose[:, :, 3] *= pose_scale
    count = len(pose)
    cameras = Pinholes(
        camera_to_world=pose, focal=torch.ones(count, 2), principal=torch.ones(count, 2), width=4, height=4
    )
    raymaps = torch.cat([arrays["origins"] * pose_scale, arrays["directions"]], dim=1)

    plain = CanonicalFrame.of(cameras, reference=reference)
    turn = arrays[f"{case}_rot"][0, 0] @ plain.rotation.T
    heading = math.atan2(float(turn[1, 0]), float(turn[0, 0]))
    extent = CanonicalFrame.of(cameras, reference=reference, heading_radians=heading).scale / (1 + 1e-6)
    scale = float(arrays[f"{case}_scale"][0, 0])
    fill = 1.0 if extent >= 1 else (1 - (scale - 1e-6)) / (1 - extent)
    assert 0 <= fill <= 1
    frame = CanonicalFrame.of(cameras, reference=reference, heading_radians=heading, fill=fill)

    assert torch.allclose(frame.rotation, arrays[f"{case}_rot"][0, 0], atol=1e-6)
    assert torch.allclose(frame.center, arrays[f"{case}_center"][0, 0], atol=1e-6)
    assert frame.scale == pytest.approx(scale, abs=1e-5)
    found = frame.apply(raymaps)
    assert (found[:, :3] - arrays[f"{case}_o"][0]).abs().max() < 5e-6
    assert (found[:, 3:] - arrays[f"{case}_d"][0]).abs().max() < 1e-6
    assert torch.allclose(frame.invert(found), raymaps, atol=5e-6)


def test_golden_random_frame_is_the_same_similarity() -> None:
    arrays = golden("canonical_frame")
    rotation, center = arrays["random_rot"][0, 0], arrays["random_center"][0, 0]
    frame = CanonicalFrame(rotation=rotation, center=center, scale=float(arrays["random_scale"][0, 0]))
    found = frame.apply(torch.cat([arrays["origins"], arrays["directions"]], dim=1))
    assert (found - torch.cat([arrays["random_o"][0], arrays["random_d"][0]], dim=1)).abs().max() < 2e-6


@given(
    seed=SEEDS,
    exponent=st.integers(-6, 6),
    heading=st.floats(0, 2 * math.pi),
    reference=st.integers(0, 3),
    fill=st.sampled_from([0, 0.3, 1]),
)
def test_inverse_is_exact_and_origins_fill_the_cube(
    seed: int, exponent: int, heading: float, reference: int, fill: float
) -> None:
    """At scene scales 1e-6 to 1e6, in float64: back to the rounding of the origins."""
    scale = 10.0**exponent
    cameras = random_cameras(seed, count=4, scale=scale)
    frame = CanonicalFrame.of(cameras, reference=reference, heading_radians=heading, fill=fill)
    raymaps = raymaps_of(cameras)
    canonical = frame.apply(raymaps)
    origins = canonical[:, :3]
    assert origins.abs().max() <= 1
    if fill == 1:
        assert origins.abs().max() > 1 - 1e-5
    assert origins[reference].abs().max() < 1e-12
    assert torch.allclose(canonical[:, 3:].norm(dim=1), torch.ones(()).double(), atol=1e-12)
    assert torch.allclose(frame.invert(canonical), raymaps, rtol=1e-12, atol=1e-12 * max(scale, 1))
    assert torch.allclose(frame.apply(frame.invert(canonical)), canonical, atol=1e-9)


@given(seed=SEEDS)
def test_the_reference_camera_stands_upright(seed: int) -> None:
    cameras = random_cameras(seed, count=3)
    frame = CanonicalFrame.of(cameras, reference=1)
    right, down, forward = (frame.rotation @ cameras.rotations[1]).T
    assert torch.allclose(down, torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64), atol=1e-12), "its up is +z"
    assert torch.allclose(right, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), atol=1e-12)
    assert torch.allclose(forward, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), atol=1e-12)


@given(seed=SEEDS, exponent=st.integers(-6, 6))
def test_canonical_raymaps_do_not_depend_on_the_world_frame(seed: int, exponent: int) -> None:
    """Invariance under rotation, shift and (with fill 1) scale of the world: what the network sees is the capture
    alone.
    """
    generator = torch.Generator().manual_seed(seed)
    turn, shift = random_rotations(1, generator)[0], torch.randn(3, generator=generator, dtype=torch.float64)
    cameras = random_cameras(seed, count=4)
    other = moved(cameras, scale=10.0**exponent, turn=turn, shift=10.0**exponent * shift)
    one = CanonicalFrame.of(cameras).apply(raymaps_of(cameras))
    two = CanonicalFrame.of(other).apply(raymaps_of(other))
    assert torch.allclose(one, two, atol=1e-9)


def test_heading_turns_about_z() -> None:
    cameras = random_cameras(6, count=3)
    plain, turned = CanonicalFrame.of(cameras), CanonicalFrame.of(cameras, heading_radians=0.7)
    assert torch.allclose(turned.rotation, rotation_about_z(0.7) @ plain.rotation, atol=1e-14)


def test_small_captures_interpolate_between_filling_and_leaving() -> None:
    cameras = random_cameras(1, count=4, scale=0.1)
    extent = CanonicalFrame.of(cameras, fill=1.0).scale
    assert extent < 1
    assert CanonicalFrame.of(cameras, fill=0.0).scale == pytest.approx(1.0, rel=1e-5)
    assert CanonicalFrame.of(cameras, fill=0.25).scale == pytest.approx(0.25 * extent + 0.75, rel=1e-5)


def test_large_captures_ignore_fill() -> None:
    cameras = random_cameras(1, count=4, scale=50.0)
    assert CanonicalFrame.of(cameras, fill=0.0).scale == CanonicalFrame.of(cameras, fill=1.0).scale > 1


@pytest.mark.parametrize("place", [0.0, 3.0, 1e5])
def test_all_cameras_in_one_place(place: float) -> None:
    """A panorama: any scale is right, 1 is taken; nothing is divided by zero and the inverse holds."""
    cameras = random_cameras(2, count=4)
    pose = cameras.camera_to_world.clone()
    pose[:, :, 3] = place
    same = Pinholes(camera_to_world=pose, focal=cameras.focal, principal=cameras.principal, width=7, height=5)
    frame = CanonicalFrame.of(same)
    assert frame.scale == pytest.approx(1.0, rel=1e-5)
    canonical = frame.apply(raymaps_of(same))
    assert (canonical[:, :3] == 0).all()
    assert torch.allclose(frame.invert(canonical), raymaps_of(same), atol=1e-12)


def test_rounding_noise_between_coinciding_cameras_is_not_blown_up() -> None:
    cameras = random_cameras(2, count=2).to(torch.float32)
    pose = cameras.camera_to_world.clone()
    pose[:, :, 3] = 1e5
    pose[1, 0, 3] = torch.nextafter(pose[1, 0, 3], torch.tensor(torch.inf))
    nearly = Pinholes(camera_to_world=pose, focal=cameras.focal, principal=cameras.principal, width=7, height=5)
    frame = CanonicalFrame.of(nearly)
    assert frame.scale == pytest.approx(1.0, rel=1e-5)
    assert frame.apply(raymaps_of(nearly))[:, :3].abs().max() < 0.01


def test_one_camera() -> None:
    cameras = random_cameras(8, count=1)
    frame = CanonicalFrame.of(cameras)
    assert torch.allclose(frame.invert(frame.apply(raymaps_of(cameras))), raymaps_of(cameras), atol=1e-14)


def test_origins_far_away_in_float32() -> None:
    """A capture 1e5 away from zero: the canonical raymaps are as exact as the centres are given, back is exact to their
    rounding.
    """
    cameras = random_cameras(9, count=4, scale=2.0)
    pose = cameras.camera_to_world.clone()
    pose[:, :, 3] = (pose[:, :, 3] + 1e5).float().double()
    exact = Pinholes(camera_to_world=pose, focal=cameras.focal, principal=cameras.principal, width=7, height=5)
    rough = exact.to(torch.float32)
    expected = CanonicalFrame.of(exact).apply(raymaps_of(exact))
    frame = CanonicalFrame.of(rough)
    found = frame.apply(raymaps_of(rough))
    assert (found.double() - expected).abs().max() < 2e-6
    assert found[:, :3].abs().max() <= 1
    back = frame.invert(found)
    assert (back - raymaps_of(rough))[:, :3].abs().max() <= 2.0**-7  # one step of float32 at 1e5
    assert (back - raymaps_of(rough))[:, 3:].abs().max() < 1e-6


@pytest.mark.parametrize("fov_degrees", [2.0, 150.0])
def test_narrow_and_wide_lenses(fov_degrees: float) -> None:
    centers = torch.randn(3, 3, generator=torch.Generator().manual_seed(0))
    cameras = Pinholes.looking_at(centers, -centers, up=torch.eye(3)[2], fov_degrees=fov_degrees, width=9, height=6)
    raymaps = raymaps_of(cameras)
    assert torch.allclose(raymaps[:, 3:].norm(dim=1), torch.ones(()), atol=1e-6)
    for frame in (CanonicalFrame.of(cameras), CanonicalFrame.of_raymaps(raymaps)):
        assert torch.allclose(frame.invert(frame.apply(raymaps)), raymaps, atol=2e-6)


def test_a_rotation_rounded_in_a_file_still_has_an_exact_inverse() -> None:
    cameras = random_cameras(3, count=3)
    pose = cameras.camera_to_world.clone()
    pose[:, :, :3] = (pose[:, :, :3] * 1000).round() / 1000
    rounded = Pinholes(camera_to_world=pose, focal=cameras.focal, principal=cameras.principal, width=7, height=5)
    frame = CanonicalFrame.of(rounded)
    assert torch.allclose(frame.rotation @ frame.rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-14)
    assert torch.allclose(frame.invert(frame.apply(raymaps_of(rounded))), raymaps_of(rounded), atol=1e-13)


def test_bad_poses_are_refused_in_one_sentence() -> None:
    cameras = random_cameras(count=3)

    def broken(row: int, column: int, value: float, camera: int = 0) -> Pinholes:
        pose = cameras.camera_to_world.clone()
        pose[camera, row, column] = value
        return Pinholes(camera_to_world=pose, focal=cameras.focal, principal=cameras.principal, width=7, height=5)

    with pytest.raises(ValueError, match="NaN or infinity"):
        CanonicalFrame.of(broken(0, 3, torch.nan, camera=1))
    with pytest.raises(ValueError, match="expected a rotation"):
        CanonicalFrame.of(broken(0, 0, torch.nan))
    singular = cameras.camera_to_world * torch.tensor([1.0, 1.0, 0.0, 1.0], dtype=torch.float64)
    mirrored = cameras.camera_to_world * torch.tensor([1.0, 1.0, -1.0, 1.0], dtype=torch.float64)
    for pose in (singular, mirrored):
        bad = Pinholes(camera_to_world=pose, focal=cameras.focal, principal=cameras.principal, width=7, height=5)
        with pytest.raises(ValueError, match="expected a rotation"):
            CanonicalFrame.of(bad)
    with pytest.raises(ValueError, match="at least one camera"):
        CanonicalFrame.of(cameras[[]])


# ---- the frame from raymaps alone -----------------------------------------------------------------------------------


@given(seed=SEEDS)
def test_axes_of_recovers_the_rotation_from_directions(seed: int) -> None:
    cameras = random_cameras(seed)
    for camera, directions in zip(cameras.rotations, raymaps_of(cameras)[:, 3:], strict=True):
        assert torch.allclose(axes_of(directions), camera, atol=1e-10)


@given(seed=SEEDS, heading=st.floats(0, 6), fill=st.sampled_from([0, 0.5, 1]))
def test_frame_of_raymaps_is_the_frame_of_the_cameras(seed: int, heading: float, fill: float) -> None:
    cameras = random_cameras(seed, count=4)
    one = CanonicalFrame.of(cameras, reference=2, heading_radians=heading, fill=fill)
    two = CanonicalFrame.of_raymaps(raymaps_of(cameras), reference=2, heading_radians=heading, fill=fill)
    assert torch.allclose(one.rotation, two.rotation, atol=1e-9)
    assert torch.allclose(one.center, two.center, atol=1e-14)
    assert one.scale == pytest.approx(two.scale, rel=1e-9)


@pytest.mark.parametrize(("fov_degrees", "tolerance"), [(2.0, 3e-4), (60.0, 1e-6), (150.0, 1e-6)])
def test_axes_of_in_float32(fov_degrees: float, tolerance: float) -> None:
    """Float32 directions of a narrow lens tell its axes less exactly: 3e-4 radians at 2 degrees."""
    centers = torch.randn(4, 3, generator=torch.Generator().manual_seed(1))
    cameras = Pinholes.looking_at(centers, -centers, up=torch.eye(3)[2], fov_degrees=fov_degrees, width=16, height=16)
    for camera, directions in zip(cameras.rotations, raymaps_of(cameras)[:, 3:], strict=True):
        assert (axes_of(directions) - camera).abs().max() < tolerance
