"""A moved world changes nothing but the world: planning far from the origin, as geo-referenced captures ask for."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from fb_core.geometry.camera_paths import path_cameras
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.carry_over import carried_over
from fb_core.geometry.paths import CaptureShape, cylinder_centers, distances, kept_clear, seen_by, spread_subset, up_of
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of
from fb_core.geometry.shell import fit_shell, intersect, sphere

FAR = torch.tensor([1e6, -7e5, 3e5], dtype=torch.float64)
NEAR = torch.tensor([4000.0, -3000.0, 500.0])
"""Where float32 still tells a millimetre of a capture in metres."""


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def some_cameras(shift: Tensor, *, inward: bool = True) -> list[Pinholes]:
    """A dozen cameras on a rough ring, one by one; they look at the middle or away from it."""
    angles = torch.arange(12, dtype=torch.float64) * (2 * torch.pi / 12)
    places = torch.stack([2 * angles.cos(), 2 * angles.sin(), 0.2 * angles.cos() + 1], dim=1) + 0.05 * drawn(12, 3)
    aims = 0.1 * drawn(12, 3, seed=1) if inward else 3 * places
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    cameras = Pinholes.looking_at(places, aims, up=up, fov_degrees=70.0, width=32, height=24)
    pose = cameras.camera_to_world.clone()
    pose[:, :, 3] += shift.double()
    cameras = dataclasses.replace(
        cameras, camera_to_world=pose.to(shift.dtype), focal=cameras.focal.to(shift.dtype), principal=cameras.principal.to(shift.dtype)
    )
    return [cameras[[number]] for number in range(12)]


HERE = torch.zeros(3, dtype=torch.float64)


@pytest.mark.parametrize("inward", [True, False])
def test_the_shape_of_a_capture(inward):
    here, there = (CaptureShape.of(some_cameras(shift, inward=inward)) for shift in (HERE, FAR))
    assert here.outward == there.outward
    torch.testing.assert_close(there.center - FAR, here.center, atol=1e-5, rtol=0)
    torch.testing.assert_close(there.focus - FAR, here.focus, atol=1e-5, rtol=0)
    assert there.radius == pytest.approx(here.radius, abs=1e-5) and there.half_height == pytest.approx(here.half_height, abs=1e-5)
    torch.testing.assert_close(up_of(some_cameras(FAR, inward=inward)), up_of(some_cameras(HERE, inward=inward)))
    options = {"radius": 1.0, "inner_radius": 0.5, "half_height": 0.2, "levels": 2}
    placed = [cylinder_centers(shape, 20, generator=torch.Generator().manual_seed(0), **options) for shape in (here, there)]
    torch.testing.assert_close(placed[1] - FAR, placed[0], atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", ["ellipse", "orbit", "spiral"])
@pytest.mark.parametrize("inward", [True, False])
def test_paths(kind, inward):
    here, there = (path_cameras(kind, some_cameras(shift, inward=inward), 9, size=16) for shift in (HERE, FAR))
    torch.testing.assert_close(there.centers - FAR, here.centers, atol=1e-4, rtol=0)
    torch.testing.assert_close(there.rotations, here.rotations, atol=1e-4, rtol=0)


def test_choices():
    points = 1.5 * drawn(200, 3, seed=2)
    assert spread_subset(some_cameras(HERE), 5) == spread_subset(some_cameras(FAR), 5)
    assert torch.equal(seen_by(some_cameras(HERE), points), seen_by(some_cameras(FAR), points + FAR))


@pytest.mark.parametrize("shift, tolerance", [(FAR, 1e-6), (NEAR, 2e-3)])
def test_cameras_are_kept_clear(shift, tolerance):
    """With many points, for which torch.cdist multiplies matrices, and in single precision 5000 units off too."""
    centers, points, refuges = drawn(40, 3, seed=3), 1.2 * drawn(300, 3, seed=4), 0.2 * drawn(30, 3, seed=5)
    here = kept_clear(centers, shell=sphere(HERE, 2.0), points=points, clearance=0.4, refuges=refuges)
    moved = [(values + shift.double()).to(shift.dtype) for values in (centers, points, refuges)]
    there = kept_clear(moved[0], shell=sphere(shift, 2.0), points=moved[1], clearance=0.4, refuges=moved[2])
    same = ((there.double() - shift.double() - here).norm(dim=1) < tolerance).float().mean()
    assert float(same) >= (1.0 if shift.dtype == torch.float64 else 0.9)  # single precision may move a place across the clearance
    apart = (there.double()[:, None] - moved[1].double()).norm(dim=-1).min(dim=1).values
    at_home = (there.double()[:, None] - moved[2].double()).norm(dim=-1).min(dim=1).values < tolerance
    assert bool(((apart > 0.4 - tolerance) | at_home).all())


def test_distances_far_from_the_origin_in_single_precision():
    a, b = drawn(60, 3, seed=6), drawn(70, 3, seed=7)
    exact = (a[:, None] - b).norm(dim=-1)
    moved = [(values + NEAR.double()).float() for values in (a, b)]
    assert float((distances(*moved).double() - exact).abs().max()) < 2e-3
    assert distances(a, b[:0]).shape == (60, 0)


def test_the_shell():
    points = 2 * torch.nn.functional.normalize(drawn(400, 3, seed=8), dim=1)
    here = fit_shell(points, center=HERE, fallback_radius=1.0)
    there = fit_shell(points + FAR, center=FAR, fallback_radius=1.0)
    torch.testing.assert_close(there.log_radius, here.log_radius, atol=1e-6, rtol=0)
    origins, directions = 0.3 * drawn(50, 3, seed=9), torch.nn.functional.normalize(drawn(50, 3, seed=10), dim=1)
    torch.testing.assert_close(intersect(there, origins + FAR, directions), intersect(here, origins, directions), atol=1e-6, rtol=0)


def test_frames_and_what_is_carried_over():
    guesses, frames = [], []
    images = torch.rand(6, 3, 24, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for shift in (HERE, FAR):
        cameras = some_cameras(shift)
        rays = torch.cat([raymaps_of(camera) for camera in cameras])
        guesses.append(carried_over(images, torch.ones_like(rays[:6, :1]), rays[:6], rays[6:], distance=torch.full_like(rays[6:, :1], 2.0)))
        frames.append(CanonicalFrame.of_raymaps(rays).apply(rays))
    torch.testing.assert_close(frames[1], frames[0], atol=1e-5, rtol=0)
    assert float((guesses[1].there == guesses[0].there).double().mean()) > 0.999
    both = guesses[0].there * guesses[1].there
    assert float(((guesses[1].images - guesses[0].images).abs() * both).mean()) < 1e-5
