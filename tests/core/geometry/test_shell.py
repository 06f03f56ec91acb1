"""Laws of the shell: known surfaces come back, it turns and scales with the scene, and every ray from inside hits."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from fb_core.geometry.shell import Shell, fit_shell, intersect, sphere

CENTER = torch.tensor([0.3, -0.2, 0.1])


def directions(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)


def on_box(unit: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """Distance from the middle of a box to its wall along unit directions."""
    return (half / unit.abs().clamp(min=1e-9)).min(dim=1).values


def rotation(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    q, r = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    q = q * torch.sign(torch.diagonal(r))
    return q * torch.det(q)


def test_points_of_a_sphere_give_that_sphere():
    shell = fit_shell(CENTER + 2.5 * directions(500), center=CENTER, fallback_radius=1.0)
    assert torch.allclose(shell.radius(directions(200, seed=1)), torch.full((200,), 2.5), atol=1e-4)


def test_points_of_a_box_give_nearly_that_box():
    half = torch.tensor([2.0, 1.5, 1.2])
    unit = directions(4000)
    shell = fit_shell(CENTER + unit * on_box(unit, half)[:, None], center=CENTER, fallback_radius=1.0)
    probe = directions(500, seed=2)
    error = (shell.radius(probe) / on_box(probe, half) - 1).abs()
    assert error.median() < 0.02 and error.quantile(0.95) < 0.08


def test_unseen_directions_take_the_radii_of_the_seen_ones_nearby():
    unit = directions(2000)
    seen = unit[unit[:, 0] > 0]
    radius = torch.where(seen[:, 2] > 0, 3.0, 1.0)
    shell = fit_shell(seen * radius[:, None], center=torch.zeros(3), fallback_radius=1.0)
    behind = shell.radius(torch.nn.functional.normalize(torch.tensor([[-0.5, 0.0, 0.85], [-0.5, 0.0, -0.85]]), dim=1))
    assert 2.3 < behind[0] <= 3.0 and 1.0 <= behind[1] < 1.3


def test_nothing_unseen_stands_close_to_where_people_stood():
    unit = directions(20000)
    wall = 2.0 * unit[unit[:, 0] > 0.3]
    stray = 0.4 * unit[unit[:, 0] < -0.7][:200]  # splats close before a camera: 3 % of the points
    standing = torch.tensor([[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0]])
    points, behind = torch.cat([wall, stray]), torch.tensor([[-1.0, 0.0, 0.0]])
    options = {"center": torch.zeros(3), "fallback_radius": 1.0}
    assert float(fit_shell(points, **options).radius(behind)) < 0.5
    assert float(fit_shell(points, standing=standing, **options).radius(behind)) > 0.3 + 0.55 * 2.0
    ahead = unit[unit[:, 0] > 0.5]
    assert torch.allclose(
        fit_shell(points, standing=standing, **options).radius(ahead), fit_shell(points, **options).radius(ahead)
    )


def test_what_is_seen_close_by_stays_close():
    """A desk before the camera is no stray: it is seen as densely as the rest."""
    unit = directions(4000)
    points = torch.where((unit[:, :1] > 0.8), 0.5, 2.0) * unit
    shell = fit_shell(points, center=torch.zeros(3), fallback_radius=1.0, standing=torch.zeros(1, 3))
    assert float(shell.radius(torch.tensor([[1.0, 0.0, 0.0]]))) < 0.55


@pytest.mark.parametrize("stray", [[-50.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0]])
def test_a_stray_camera_does_not_move_the_shell_beyond_what_was_seen(stray: list[float]) -> None:
    unit = directions(4000)
    points, behind = 2.0 * unit[unit[:, 0] > 0.3], torch.tensor([[-1.0, 0.0, 0.0]])
    options = {"center": torch.zeros(3), "fallback_radius": 1.0}
    standing = torch.tensor([[0.1, 0.0, 0.0], stray])
    assert 1.2 < float(fit_shell(points, standing=standing, **options).radius(behind)) < 1.7 * 2.0
    nobody = fit_shell(points, standing=torch.empty(0, 3), **options)
    assert torch.equal(nobody.log_radius, fit_shell(points, **options).log_radius)


def test_a_few_stray_points_do_not_move_the_shell():
    unit = directions(1000)
    points = 2.0 * unit
    points[:10] *= 1000.0
    shell = fit_shell(points, center=torch.zeros(3), fallback_radius=1.0)
    assert float((shell.radius(directions(300, seed=3)) - 2.0).abs().max()) < 0.02


def test_floor_and_ceiling_go_on_where_they_were_not_seen():
    half, up = torch.tensor([2.0, 1.5, 1.2]), torch.tensor([0.0, 0.0, 1.0])
    unit = directions(6000)
    seen = unit[unit[:, 0] > 0.2]
    points = seen * on_box(seen, half)[:, None]
    behind = directions(2000, seed=4)
    behind = behind[
        (behind[:, 0] < 0) & (half[2] / behind[:, 2].abs() < on_box(behind, half) + 1e-4)
    ]  # rays to the unseen floor, ceiling
    truth = on_box(behind, half)
    errors = {}
    for name, axis in (("with", up), ("without", None)):
        shell = fit_shell(points, center=torch.zeros(3), fallback_radius=1.0, up=axis)
        errors[name] = float((shell.radius(behind) / truth).log().abs().mean())
    assert errors["with"] < 0.1 and errors["with"] < 0.6 * errors["without"]


def test_points_without_a_flat_top_have_no_ceiling():
    points, up = 2.5 * directions(2000), torch.tensor([0.0, 0.6, 0.8])
    scattered = points * (0.5 + torch.rand(2000, 1, generator=torch.Generator().manual_seed(0)))
    probe = directions(200, seed=1)
    for cloud in (points, scattered):
        with_up = fit_shell(cloud, center=torch.zeros(3), fallback_radius=1.0, up=up).radius(probe)
        assert torch.allclose(
            with_up, fit_shell(cloud, center=torch.zeros(3), fallback_radius=1.0).radius(probe), rtol=0.05
        )


def test_few_points_give_a_sphere_at_their_median_distance_and_none_the_fallback():
    few = fit_shell(
        CENTER + directions(5) * torch.tensor([1.0, 2.0, 3.0, 4.0, 50.0])[:, None], center=CENTER, fallback_radius=9.0
    )
    assert torch.allclose(few.radius(directions(20)), torch.tensor(3.0), atol=1e-5)
    for nothing in (torch.empty(0, 3), torch.full((4, 3), torch.nan), CENTER[None]):
        assert torch.allclose(
            fit_shell(nothing, center=CENTER, fallback_radius=9.0).radius(directions(20)), torch.tensor(9.0), atol=1e-4
        )


def test_a_radius_that_is_no_length_is_refused():
    for radius in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="radius must be a positive"):
            sphere(CENTER, radius)


@settings(max_examples=6)
@given(seed=st.integers(0, 1000), factor=st.floats(0.01, 100.0))
def test_the_shell_turns_and_scales_with_the_scene(seed: int, factor: float):
    half = torch.tensor([2.0, 1.5, 1.2])
    unit = directions(1500, seed=5)
    points = unit * on_box(unit, half)[:, None]
    turn, probe = rotation(seed), directions(200, seed=6)
    plain = fit_shell(points, center=torch.zeros(3), fallback_radius=1.0).radius(probe)
    moved = fit_shell(factor * points @ turn.T + CENTER, center=CENTER, fallback_radius=1.0).radius(probe @ turn.T)
    assert torch.allclose(moved / factor, plain, rtol=0.03)  # the table's axes do not turn: equal up to its resolution


@given(seed=st.integers(0, 1000))
def test_a_ray_from_inside_always_hits_the_surface(seed: int):
    generator = torch.Generator().manual_seed(seed)
    shell = Shell(center=CENTER, log_radius=torch.rand(49, 96, generator=generator))
    start = directions(64, seed=seed)
    origins = CENTER + start * shell.radius(start)[:, None] * torch.rand(64, 1, generator=generator) * 0.999
    rays = directions(64, seed=seed + 1)
    distance = intersect(shell, origins, rays)
    assert bool(torch.isfinite(distance).all()) and float(distance.min()) >= 0
    offset = origins + distance[:, None] * rays - CENTER
    jump = (offset.norm(dim=1) / shell.radius(offset / offset.norm(dim=1, keepdim=True)) - 1).abs()
    assert float(jump.max()) < 1e-3


def test_rays_against_a_sphere_have_the_closed_form_distance():
    shell = sphere(CENTER, 2.0)
    origins = CENTER + 1.5 * directions(300, seed=8) * torch.rand(300, 1)
    rays = directions(300, seed=9)
    along = ((origins - CENTER) * rays).sum(dim=1)
    expected = -along + (along**2 + 4.0 - ((origins - CENTER) ** 2).sum(dim=1)).sqrt()
    assert torch.allclose(intersect(shell, origins, rays), expected, atol=1e-4)


def test_a_ray_from_outside_meets_the_far_wall_or_nothing():
    shell = sphere(torch.zeros(3), 1.0)
    origins = torch.tensor([[-3.0, 0.0, 0.0], [-3.0, 0.0, 0.0], [-3.0, 2.0, 0.0]])
    rays = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    distance = intersect(shell, origins, rays)
    assert float(distance[0]) == pytest.approx(4.0, abs=1e-4)
    assert torch.isinf(distance[1:]).all()


def test_contains_knows_inside_from_outside():
    shell = sphere(CENTER, 2.0)
    points = CENTER + torch.tensor([[1.0, 0, 0], [0, 1.9, 0], [0, 0, 2.1], [0, 0, 0]])
    assert shell.contains(points).tolist() == [True, True, False, True]
    assert shell.contains(points, margin=0.9).tolist() == [True, False, False, True]
