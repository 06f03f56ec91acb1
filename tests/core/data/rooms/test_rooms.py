"""Procedural rooms: determinism, exact rays, cameras in free space, coverage, and the capture on disk."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.bare_rooms import GREY, bare_room

from fb_core.data.rooms import room_captures
from fb_core.data.rooms.furniture import Material, Solid
from fb_core.data.rooms.ray_caster import _render, cast, render
from fb_core.data.rooms.room import FAMILIES, Room, make_room
from fb_core.data.rooms.room_cameras import CAMERA_CLEARANCE_METRES, cameras_by_angles, training_cameras
from fb_core.data.rooms.room_captures import (
    COVERED_SHARE,
    UNCOVERED_SHARE,
    casual_capture,
    covered_share,
    visible,
)
from fb_core.geometry.cameras import Pinholes

UP = torch.tensor([0.0, 0.0, 1.0])


def ray(room: Room, origin: tuple, direction: tuple):
    """One ray's hits."""
    return cast(
        room,
        torch.tensor([origin], dtype=torch.float32),
        torch.nn.functional.normalize(torch.tensor([direction], dtype=torch.float32)),
    )


def tensors_of(room: Room) -> list[torch.Tensor]:
    return [value for field in dataclasses.fields(room) if isinstance(value := getattr(room, field.name), torch.Tensor)]


@pytest.fixture(scope="module")
def capture() -> room_captures.RoomCapture:
    return casual_capture(3, views=10, size=32, held_out=6)


# ---- determinism ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("family", list(FAMILIES))
def test_a_seed_gives_one_room_whatever_ran_before(family):
    first = make_room(5, FAMILIES[family])
    make_room(6, FAMILIES[family])
    np.random.seed(1234)
    torch.manual_seed(99)
    again = make_room(5, FAMILIES[family])
    assert all(torch.equal(a, b) for a, b in zip(tensors_of(first), tensors_of(again), strict=True))
    assert not torch.equal(first.size, make_room(6, FAMILIES[family]).size)


def test_families_are_different_streams_and_grow_more_varied():
    sizes = [make_room(0, family).size for family in FAMILIES.values()]
    assert not torch.allclose(sizes[0], sizes[1]) and not torch.allclose(sizes[1], sizes[2])
    solids = [sum(len(make_room(seed, family).kinds) for seed in range(8)) for family in FAMILIES.values()]
    assert solids[0] < solids[1] < solids[2]


def test_training_cameras_depend_on_their_generator_alone():
    room = make_room(1, FAMILIES["narrow"])
    draws = []
    for noise in (0, 1):
        torch.manual_seed(noise)
        draws.append(training_cameras(room, 5, size=16, generator=torch.Generator().manual_seed(7)))
    assert torch.equal(draws[0].camera_to_world, draws[1].camera_to_world) and torch.equal(
        draws[0].focal, draws[1].focal
    )


def test_captures_are_repeatable(capture):
    torch.manual_seed(5)
    again = casual_capture(3, views=10, size=32, held_out=6)
    assert torch.equal(capture.images.rgb, again.images.rgb)
    assert torch.equal(capture.held_out_images.depth, again.held_out_images.depth)
    assert torch.equal(capture.points.positions, again.points.positions)


# ---- exact rays -----------------------------------------------------------------------------------------------------


def test_empty_room_has_the_distances_of_a_box():
    room = bare_room()
    for direction, distance, normal in (
        ((1, 0, 0), 1.5, (-1, 0, 0)),
        ((-1, 0, 0), 2.5, (1, 0, 0)),
        ((0, 1, 0), 2.8, (0, -1, 0)),
        ((0, 0, 1), 1.9, (0, 0, -1)),
        ((0, 0, -1), 1.1, (0, 0, 1)),
        ((3, 4, 0), 2.5, (-1, 0, 0)),  # 1.5 m along x
    ):
        hits = ray(room, (0.5, 0.2, 1.1), direction)
        torch.testing.assert_close(hits.distance, torch.tensor([distance]))
        torch.testing.assert_close(hits.normals, torch.tensor([normal], dtype=torch.float32))
        assert hits.solids.tolist() == [0]


def test_z_depth_of_a_wall_is_constant():
    camera = cameras_by_angles(
        torch.tensor([[0.5, 0.2, 1.5]]), torch.zeros(1), torch.zeros(1), torch.tensor([60.0]), size=16
    )
    images = render(bare_room(), camera)
    torch.testing.assert_close(images.depth, torch.full((1, 16, 16), 1.5))
    torch.testing.assert_close(images.normals, torch.tensor([-1.0, 0, 0])[None, :, None, None].expand(1, 3, 16, 16))


def test_solids_are_hit_where_formulas_say():
    box = Solid(kind="box", center=(1.0, 0.0, 0.5), half=(0.3, 0.3, 0.5), heading=math.pi / 4, material=GREY)
    drum = Solid(kind="cylinder", center=(0.0, 2.0, 0.4), half=(0.25, 0.25, 0.4), heading=0.3, material=GREY)
    ball = Solid(kind="sphere", center=(-1.0, 0.0, 1.0), half=(0.5, 0.5, 0.5), material=GREY)
    room = bare_room(ball, drum, box)  # any order: the room sorts them by kind
    edge = ray(room, (0, 1e-4, 0.5), (1, 0, 0))
    torch.testing.assert_close(edge.distance, torch.tensor([1 - 0.3 * math.sqrt(2)]), atol=2e-4, rtol=0)
    torch.testing.assert_close(edge.normals, torch.tensor([[-math.sqrt(0.5), math.sqrt(0.5), 0.0]]))
    side, lid = ray(room, (0, 0, 0.4), (0, 1, 0)), ray(room, (0.1, 2.1, 2.0), (0, 0, -1))
    torch.testing.assert_close(side.distance, torch.tensor([1.75]))
    torch.testing.assert_close(side.normals, torch.tensor([[0.0, -1.0, 0.0]]), atol=1e-6, rtol=0)
    torch.testing.assert_close(lid.distance, torch.tensor([1.2]))
    torch.testing.assert_close(lid.normals, torch.tensor([[0.0, 0.0, 1.0]]))
    front, tangent = ray(room, (0, 0, 1.0), (-1, 0, 0)), ray(room, (0, 0.4, 1.0), (-1, 0, 0))
    torch.testing.assert_close(front.distance, torch.tensor([0.5]))
    torch.testing.assert_close(tangent.distance, torch.tensor([0.7]))  # 3-4-5 triangle of radius 0.5
    torch.testing.assert_close(tangent.normals, torch.tensor([[0.6, 0.8, 0.0]]))
    assert [hits.solids.item() for hits in (edge, side, front)] == [1, 2, 3]


@pytest.mark.parametrize("family", list(FAMILIES))
def test_normals_are_unit_and_face_the_camera(family):
    room = make_room(2, FAMILIES[family])
    cameras = training_cameras(room, 6, size=24, generator=torch.Generator().manual_seed(0))
    images = render(room, cameras)
    torch.testing.assert_close(images.normals.norm(dim=1), torch.ones(6, 24, 24))
    assert ((images.normals.permute(0, 2, 3, 1) * cameras.directions()).sum(-1) < 1e-4).all()
    assert images.rgb.min() >= 0 and images.rgb.max() <= 1 and (images.depth > 0).all()


@pytest.mark.parametrize("seed", [0, 4])
def test_depth_agrees_with_triangles(seed):
    """The readable twin: trimesh casts the same rays at the room's mesh."""
    pytest.importorskip("rtree")
    from trimesh.ray.ray_triangle import RayMeshIntersector

    room = make_room(seed, FAMILIES["wide"])
    cameras = training_cameras(room, 4, size=10, generator=torch.Generator().manual_seed(seed))
    directions = cameras.directions().reshape(-1, 3)
    origins = cameras.centers.repeat_interleave(100, dim=0)
    hits = cast(room, origins, directions)
    places, rays, _ = RayMeshIntersector(room.mesh()).intersects_location(
        origins.numpy(), directions.numpy(), multiple_hits=True
    )
    distances = np.full(len(origins), np.inf)
    np.minimum.at(distances, rays, np.linalg.norm(places - origins.numpy()[rays], axis=1))
    error = (hits.distance - torch.from_numpy(distances)).abs()
    is_flat = room.kinds[hits.solids] == 0
    assert (
        error[is_flat].median() < 1e-4 and (error[is_flat] < 1e-3).float().mean() > 0.98
    )  # a facet may win or lose at an outline
    assert (~is_flat).any() and error[~is_flat].median() < 0.01  # round solids are faceted
    z_depth = hits.distance.view(4, 10, 10) * torch.einsum(
        "nhwi,ni->nhw", cameras.directions(), cameras.rotations[..., 2]
    )
    torch.testing.assert_close(render(room, cameras).depth, z_depth, atol=1e-4, rtol=1e-4)


def test_mesh_is_watertight_and_looks_inwards():
    mesh = bare_room().mesh()
    assert mesh.is_watertight and mesh.volume == pytest.approx(-4 * 6 * 3)


# ---- pictures -------------------------------------------------------------------------------------------------------


def test_rooms_of_different_tables_render_together_as_alone():
    """Padding (which a GPU run uses) changes nothing."""
    both = [make_room(0, FAMILIES["narrow"]), make_room(1, FAMILIES["wide"])]
    cameras = [training_cameras(room, 3, size=12, generator=torch.Generator().manual_seed(1)) for room in both]
    together = _render(both, cameras, 2)
    for room, group, images in zip(both, cameras, together, strict=True):
        alone = render(room, group, supersample=2)
        torch.testing.assert_close(images.rgb, alone.rgb)
        torch.testing.assert_close(images.depth, alone.depth)
        torch.testing.assert_close(images.normals, alone.normals)


def test_chunks_do_not_show(monkeypatch):
    room = make_room(3, FAMILIES["medium"])
    cameras = training_cameras(room, 3, size=16, generator=torch.Generator().manual_seed(0))
    whole = render(room, cameras)
    monkeypatch.setattr("fb_core.data.rooms.ray_caster.CPU_PAIRS", 1000)
    torch.testing.assert_close(render(room, cameras).rgb, whole.rgb)


def test_colour_does_not_depend_on_the_viewpoint():
    room = make_room(8, FAMILIES["narrow"])
    room = dataclasses.replace(room, waves=room.waves * 0.2)  # no wave so fine that its damping by distance matters
    points = cast(
        room, torch.tensor([[0.0, 0.0, 1.5]]).expand(40, 3), torch.nn.functional.normalize(torch.randn(40, 3), dim=-1)
    ).points
    colours = []
    for eye in ((0.0, 0.0, 1.5), (0.15, -0.1, 1.3)):
        eyes = torch.tensor([eye]).expand(40, 3)
        colours.append(render(room, Pinholes.looking_at(eyes, points, up=UP, fov_degrees=1.0, width=1, height=1)).rgb)
        seen = visible(
            room, points, Pinholes.looking_at(eyes, points, up=UP, fov_degrees=1.0, width=1, height=1)
        ).diagonal()
    assert seen.sum() > 30
    torch.testing.assert_close(colours[0][seen], colours[1][seen], atol=5e-3, rtol=0)


def test_fine_patterns_fade_instead_of_aliasing():
    stripes = Material(
        base=(1.0, 1.0, 1.0),
        second=(0.0, 0.0, 0.0),
        pattern="stripes",
        waves=((30.0, 0.0), (0.0, 30.0)),
        sharpness=3.0,
        glow=1.0,
    )
    camera = cameras_by_angles(
        torch.tensor([[0.0, 0.0, 1.5]]), torch.zeros(1), torch.zeros(1), torch.tensor([60.0]), size=8
    )
    coarse = render(bare_room(shell=stripes), camera).rgb
    fine = render(bare_room(shell=stripes), camera.scaled(800, 800).cropped(350, 350, 100, 100)).rgb
    assert coarse.std() < 0.02 and abs(float(coarse.mean()) - 0.5) < 0.02
    assert fine.std() > 0.3


def test_corners_are_darker_than_walls():
    camera = cameras_by_angles(
        torch.tensor([[0.0, 0.0, 1.5]]), torch.zeros(1), torch.zeros(1), torch.tensor([110.0]), size=32
    )
    brightness = render(bare_room(), camera).rgb.mean(1)[0]
    corner = brightness[(render(bare_room(), camera).normals[0, 0] < -0.5)].min()
    assert corner < 0.8 * brightness[16, 16]


# ---- cameras --------------------------------------------------------------------------------------------------------


def test_clearance_is_the_signed_distance():
    drum = Solid(kind="cylinder", center=(1.0, 0.0, 0.5), half=(0.3, 0.3, 0.5), material=GREY)
    box = Solid(kind="box", center=(-1.0, 0.0, 0.5), half=(0.3, 0.2, 0.5), heading=math.pi / 2, material=GREY)
    ball = Solid(kind="sphere", center=(0.0, 2.0, 1.5), half=(0.4, 0.4, 0.4), material=GREY)
    points = torch.tensor(
        [
            [0.0, -2.0, 1.4],
            [1.0, 0.0, 0.5],
            [0.4, 0.0, 0.4],
            [1.0, 0.0, 1.2],
            [-1.0, 0.5, 0.9],
            [0.0, 1.5, 1.5],
            [0.0, 2.0, 1.4],
            [3.0, 0.0, 1.0],
        ]
    )
    expected = torch.tensor([1.0, -0.3, 0.3, 0.2, 0.2, 0.1, -0.3, -1.0])
    torch.testing.assert_close(bare_room(drum, box, ball).clearance(points), expected)


@pytest.mark.parametrize("family", list(FAMILIES))
def test_training_cameras_keep_clear_of_everything(family):
    generator = torch.Generator().manual_seed(0)
    for seed in range(15):
        room = make_room(seed, FAMILIES[family])
        cameras = training_cameras(room, 20, size=16, generator=generator)
        assert room.clearance(cameras.centers).min() >= CAMERA_CLEARANCE_METRES - 1e-5
        fov = 2 * torch.rad2deg(torch.atan(8 / cameras.focal))
        low, high = FAMILIES[family].fov_degrees
        assert fov.min() >= low - 1e-3 and fov.max() <= high + 1e-3
        right = cameras.rotations[..., 0]
        assert right[:, 2].abs().max() < 1e-5  # upright: the horizon is level


def test_headings_and_pitches_are_what_they_say():
    cameras = cameras_by_angles(
        torch.zeros(2, 3),
        torch.tensor([0.0, math.pi / 2]),
        torch.tensor([0.0, 0.5]),
        torch.tensor([60.0, 90.0]),
        size=20,
    )
    torch.testing.assert_close(
        cameras.rotations[0], torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    )
    torch.testing.assert_close(cameras.rotations[1, :, 2], torch.tensor([0.0, math.cos(0.5), math.sin(0.5)]))
    torch.testing.assert_close(cameras.focal[1], torch.tensor([10.0, 10.0]))


# ---- coverage -------------------------------------------------------------------------------------------------------


def test_a_view_covers_itself_and_not_its_back():
    room = make_room(3, FAMILIES["narrow"])
    center = training_cameras(room, 1, size=32, generator=torch.Generator().manual_seed(0)).centers.expand(2, 3)
    cameras = cameras_by_angles(center, torch.tensor([0.0, math.pi]), torch.zeros(2), torch.full((2,), 70.0), size=32)
    assert covered_share(room, cameras[0], cameras[0]).item() > 0.999
    assert covered_share(room, cameras[1], cameras[0]).item() < 0.001
    assert covered_share(room, cameras[1], cameras).item() > 0.999


def test_what_stands_in_front_hides_what_is_behind():
    ball = Solid(kind="sphere", center=(1.0, 0.0, 1.5), half=(0.3, 0.3, 0.3), material=GREY)
    camera = cameras_by_angles(
        torch.tensor([[-1.0, 0.0, 1.5]]), torch.zeros(1), torch.zeros(1), torch.tensor([70.0]), size=16
    )
    places = torch.tensor(
        [[2.0, 0.0, 1.5], [2.0, 1.0, 1.5], [0.7, 0.0, 1.5], [1.3, 0.0, 1.5], [-2.0, 0.0, 1.5], [0.0, 3.0, 1.5]]
    )
    assert visible(bare_room(ball), places, camera)[0].tolist() == [False, True, True, False, False, False]


def test_more_views_never_cover_less(capture):
    shares = [
        covered_share(capture.room, capture.held_out_cameras, capture.cameras[list(range(count))])
        for count in (1, 4, 10)
    ]
    assert (shares[0] <= shares[1]).all() and (shares[1] <= shares[2]).all()
    torch.testing.assert_close(shares[2], capture.covered_share)


def test_held_out_views_are_clearly_covered_or_clearly_not(capture):
    assert capture.covered.tolist() == [True, False] * 3
    assert (capture.covered_share[capture.covered] >= COVERED_SHARE).all()
    assert (capture.covered_share[~capture.covered] <= UNCOVERED_SHARE).all()


@pytest.mark.parametrize("family", list(FAMILIES))
def test_a_capture_is_a_partial_sweep_in_free_space(family):
    capture = casual_capture(11, family=family, views=12, size=16, held_out=2)
    forward = capture.cameras.rotations[..., 2]
    heading = torch.from_numpy(np.unwrap(torch.atan2(forward[:, 1], forward[:, 0]).numpy()))
    assert 140 < math.degrees(float(heading.max() - heading.min())) < 210
    both = torch.cat([capture.cameras.centers, capture.held_out_cameras.centers])
    assert capture.room.clearance(both).min() >= CAMERA_CLEARANCE_METRES - 1e-5
    assert (both - both.mean(0)).norm(dim=-1).max() < 2.0


def test_points_lie_on_surfaces_in_their_colours(capture):
    points = capture.points
    assert len(points) > 1000
    assert capture.room.clearance(points.positions).abs().max() < 0.04
    assert (visible(capture.room, points.positions, capture.cameras, tolerance=0.2).sum(0) >= 2).float().mean() > 0.95
    pixels, depth = capture.cameras.project(points.positions)
    view, inside = 4, ((pixels[4] >= 0) & (pixels[4] < 32)).all(-1) & (depth[4] > 0)
    columns, lines = pixels[view, inside].long().unbind(-1)
    same_place = (capture.images.depth[view, lines, columns] - depth[view, inside]).abs() < 0.03
    seen = capture.images.rgb[view, :, lines, columns].T
    assert (seen - points.colors[inside])[same_place].abs().median() < 0.03
