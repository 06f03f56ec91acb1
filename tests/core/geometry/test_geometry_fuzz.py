"""Thousands of draws over the public functions of geometry: finite answers from finite input, one clear sentence for
the rest.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from helpers.fuzz_draws import ALL, FAST, Dice, faults

from fb_core.geometry import gravity, normals, shell, similarity
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features import triangulation
from fb_core.geometry.known_rays import frame_of_known_rays
from fb_core.geometry.pose_solver import solver as pose_solver
from fb_core.geometry.raymap import CanonicalFrame, from_unit_range, raymaps_of, to_unit_range
from fb_core.geometry.viewpoints import camera_paths, paths


def cameras_looking(dice: Dice) -> Any:
    count = dice.of(0, 1, 4)
    centers, targets = dice.places(count), dice.layout(dice.places(count))
    if count and bool(((targets - centers).norm(dim=1) == 0).any()):
        dice.valid = False
    fov = dice.bad(dice.of(1e-3, 30.0, 60.0, 179.0), 0.0, 180.0, -5.0, math.nan, math.inf)
    size = {"width": dice.bad(dice.number(1, 30), 0, -1), "height": dice.bad(dice.number(1, 30), 0, -3)}
    cameras = Pinholes.looking_at(
        centers, targets, up=dice.of(dice.unit(), torch.zeros(3).double()), fov_degrees=fov, **size
    )
    points = dice.places(dice.of(0, 1, 5))
    return cameras, cameras.project(points), cameras.directions(), cameras.world_to_camera, cameras.intrinsics


def cameras_changed(dice: Dice) -> Any:
    cameras = dice.cameras()
    index = dice.of(0, slice(0, 1), [0], torch.tensor([0]), -1)
    changed = dice.of(
        lambda: cameras.scaled(dice.bad(7, 0, -2), dice.bad(9, 0, -1)),
        lambda: cameras.cropped(dice.number(-9, 9), dice.number(-9, 9), dice.bad(5, 0, -1), dice.bad(6, 0, -1)),
        lambda: Pinholes.cat(dice.bad([cameras, cameras], [], [cameras, cameras.scaled(77, 78)])),
        lambda: cameras[index],
    )()
    depth = torch.full((len(changed), changed.height, changed.width), 2.0).to(changed.focal)
    return changed, changed.unproject(depth), raymaps_of(changed)


def canonical_frames(dice: Dice) -> Any:
    cameras = dice.cameras(dice.bad(dice.of(1, 2, 5), 0), side=dice.bad(dice.number(2, 20), 1))
    if dice.chance(0.1):
        dice.valid = False
        cameras = dataclasses.replace(cameras, camera_to_world=cameras.camera_to_world * dice.of(0.0, 2.0, -1.0))
    reference = dice.bad(dice.number(0, max(len(cameras) - 1, 0)), 99, -99)
    options: dict[str, Any] = dict(reference=reference, heading_radians=dice.of(0.0, 3.0), fill=dice.of(0.0, 0.5, 1.0))
    raymaps = raymaps_of(cameras)
    frame = dice.of(
        lambda: CanonicalFrame.of(cameras, **options), lambda: CanonicalFrame.of_raymaps(raymaps, **options)
    )()
    canonical = frame.apply(raymaps)
    return frame, from_unit_range(to_unit_range(canonical)), frame.invert(canonical)


def frames_of_some_rays(dice: Dice) -> Any:
    cameras = dice.cameras(dice.of(0, 1, 2, 5))
    known = dice.mask(len(cameras), 1, cameras.height, cameras.width).to(cameras.focal)
    raymaps = torch.where(known > 0, raymaps_of(cameras), dice.of(math.nan, math.inf, 0.0))
    frame = frame_of_known_rays(raymaps, known)
    return frame and (frame, torch.where(known > 0, frame.apply(raymaps), 0.0))


def capture_shapes(dice: Dice) -> Any:
    groups = [dice.cameras() for _ in range(dice.of(1, 1, 3))]
    groups = dice.bad(groups, [], [groups[0][[]]])
    if len({group.camera_to_world.dtype for group in groups}) > 1:
        groups = [group.to(torch.float64) for group in groups]
    count = dice.bad(dice.number(1, 9), 0, -2)
    subset = paths.spread_subset(groups, count)
    assert len(set(subset)) == len(subset) <= max(count, 1)
    return paths.CaptureShape.of(groups), paths.up_of(groups), gravity.upright(groups)


def cylinders(dice: Dice) -> Any:
    shape = paths.CaptureShape.of([dice.cameras()])
    count = dice.bad(dice.number(0, 9), -1)
    options: dict[str, Any] = dict(
        generator=dice.generator, radius=dice.of(0.0, 1.0, 1e4), inner_radius=0.5, half_height=dice.of(0.0, 2.0)
    )
    centers = paths.cylinder_centers(shape, count, levels=dice.bad(dice.number(1, 4), 0, -1), **options)
    return centers, paths.inward_targets(centers, shape=shape, spread=dice.of(0.0, 1.0), generator=dice.generator)


def looks(dice: Dice) -> Any:
    surface = dice.layout(dice.places(dice.of(0, 1, 50)))
    return paths.outward_directions(
        dice.layout(dice.places(dice.of(0, 1, 5))),
        surface=surface,
        need=dice.of(torch.ones, torch.zeros)(len(surface), dtype=torch.float64),
        up=dice.unit(),
        half_angle_radians=dice.of(0.01, 0.5, 1.5),
        max_pitch_degrees=dice.bad(dice.of(0.0, 20.0, 90.0), -5.0, math.nan),
        generator=dice.generator,
    )


def clearances(dice: Dice) -> Any:
    points = dice.layout(dice.places(dice.of(0, 1, 30)))
    surface = shell.fit_shell(points, center=dice.normal(3), fallback_radius=1.0)
    refuges = dice.places(dice.bad(dice.number(1, 30), 0))
    centers = dice.places(dice.of(0, 1, 30))
    return paths.kept_clear(centers, shell=surface, points=points, clearance=dice.of(0.0, 0.1, 10.0), refuges=refuges)


def sight(dice: Dice) -> Any:
    cameras = [dice.cameras(1).to(torch.float64) for _ in range(dice.of(0, 1, 3))]
    known = dice.of(None, [dice.of(None, torch.rand(5, 4, generator=dice.generator) > 0.5) for _ in cameras])
    seen = paths.seen_by(cameras, dice.layout(dice.places(dice.of(0, 1, 20))), known)
    total, count = dice.number(0, 9), dice.bad(dice.number(0, 12), -1)
    chosen = paths.strided_subset(total, count)
    assert len(chosen) == min(total, max(count, 0)) and all(0 <= index < total for index in chosen)
    return seen, paths.sphere_directions(dice.bad(dice.number(1, 40), 0, -1), like=dice.normal(3))


def fly_throughs(dice: Dice) -> Any:
    kind = dice.bad(dice.of(*camera_paths.PATHS), "zigzag")
    groups = dice.bad([dice.cameras() for _ in range(dice.of(1, 1, 2))], [])
    groups = [group.to(torch.float32) for group in groups]
    fov = dice.bad(dice.of(None, 50.0), 180.0, -1.0, math.nan)
    return camera_paths.path_cameras(
        kind, groups, dice.bad(dice.number(1, 9), 0, -3), size=dice.bad(16, 0, -1), fov_degrees=fov
    )


def ellipses(dice: Dice) -> Any:
    centers = dice.layout(dice.places(dice.bad(dice.number(1, 12), 0)))
    ellipse = camera_paths.Ellipse.fitted(centers, up=dice.unit())
    return ellipse, camera_paths.even_angles(ellipse, dice.number(1, 7), closed=dice.chance(0.5))


def shells(dice: Dice) -> Any:
    center = dice.normal(3)
    points = dice.places(dice.of(0, 1, 5, 17, 200))
    if len(points) and dice.chance(0.2):
        points[0] = dice.of(math.nan, math.inf)  # is left out
    radius = dice.bad(dice.of(1e-3, 1.0, 1e3), 0.0, -1.0, math.nan, math.inf)
    up = dice.of(None, dice.unit())
    surface = dice.of(
        lambda: shell.sphere(center, radius),
        lambda: shell.fit_shell(
            points, center=center, fallback_radius=radius, up=up, bandwidth_degrees=dice.bad(5.0, 0.0, -1.0, math.nan)
        ),
    )()
    count = dice.of(0, 1, 20)
    distance = shell.intersect(surface, dice.places(count), dice.unit(count), samples=dice.bad(16, 0, -1))
    return (
        surface,
        distance.nan_to_num(nan=math.nan, posinf=0.0),
        surface.contains(dice.places(count)),
        surface.radius(dice.unit(count)),
    )


def similarities(dice: Dice) -> Any:
    first, second = dice.cameras(dice.bad(dice.of(1, 2, 5), 0)), None
    second = dice.of(first, dice.cameras(len(first)))
    found = similarity.Similarity.between((first.rotations, first.centers), (second.rotations, second.centers))
    if found.scale == 0:
        dice.valid = False
    return found, found.points(dice.places(3)), found.cameras(first), gravity.turn_between(dice.unit(), dice.unit())


def recovered(dice: Dice) -> Any:
    cameras = dice.cameras(dice.of(0, 1, 2, 3))
    raymaps = raymaps_of(cameras).to(dice.of(torch.float32, torch.float64, torch.float16))
    if dice.chance(0.3):
        raymaps = raymaps + dice.of(1e-3, 1.0) * torch.randn(raymaps.shape, generator=dice.generator).to(raymaps)
    known = dice.mask(len(cameras), 1, cameras.height, cameras.width).to(raymaps)
    raymaps = torch.where(known > 0, raymaps, dice.of(math.nan, 0.0, math.inf))
    dice.valid = True  # rays that fit no camera get a verdict, and all numbers are finite
    focal = dice.of(None, dice.bad(cameras.focal[:, 0].double(), cameras.focal[:, 0] * 0, cameras.focal[:, 0] * -1))
    solving = pose_solver.PoseSolving(
        focal=dice.of("per_view", "shared"),
        square_pixels=dice.chance(0.5),
        principal=dice.of("known", "known", "free"),
        hypotheses=dice.bad(12, 0),
        rays_per_view=dice.bad(64, 3),
    )
    return pose_solver.recover_cameras(
        raymaps, weights=known * dice.bad(1.0, -1.0, math.nan), focal=focal, solving=solving
    )


def recovered_from_rays(dice: Dice) -> Any:
    count, rays = dice.of(0, 1, 3), dice.of(0, 1, 4, 40)
    directions = dice.of(dice.unit(count, rays), torch.zeros(count, rays, 3).double())
    origins, pixels = dice.normal(count, rays, 3), 20 * torch.rand(count, rays, 2, generator=dice.generator).double()
    weights = dice.of(None, dice.mask(count, rays))
    solving = pose_solver.PoseSolving(hypotheses=12)
    return pose_solver.recover_cameras_from_rays(
        origins, directions, pixels, width=20, height=20, weights=weights, solving=solving
    )


def surfaces(dice: Dice) -> Any:
    cameras = dice.cameras(dice.of(0, 1, 2))
    depth = dice.mask(len(cameras), cameras.height, cameras.width).to(cameras.focal) * dice.of(1.0, 1e-6, 1e6, -1.0)
    depth = torch.where(depth > 0.5, depth, dice.of(math.nan, 0.0, math.inf))
    found = normals.normals_from_depth(depth, cameras)
    world = torch.einsum("nij,nhwj->nhwi", cameras.rotations, found)
    picture = normals.normal_picture(found)
    return found, world, normals.normals_of_picture(picture), normals.facing(world, world)


def features(dice: Dice) -> Any:
    photos = []
    for _ in range(dice.of(0, 1, 2, 8)):
        count = dice.of(0, 1, 2, 30)
        directions = dice.unit(count) if count else torch.zeros(0, 3).double()
        photos.append(
            triangulation.Features(
                center=dice.places(1)[0],
                directions=directions.float() if dice.chance(0.2) else directions,
                descriptors=F.normalize(torch.randn(count, 16, generator=torch.Generator().manual_seed(0)), dim=-1),
                colors=torch.rand(count, 3, generator=dice.generator),
            )
        )
    photos = [dataclasses.replace(photo, directions=photo.directions.to(photos[0].directions)) for photo in photos]
    rays = dice.of(0, 1, 6)
    track = torch.arange(rays) // 2
    return triangulation.triangulate(photos), triangulation.nearest_points(
        dice.places(rays), dice.normal(rays, 3), track
    )


def key_points(dice: Dice) -> Any:
    height, width = dice.number(1, 40), dice.number(1, 40)
    image = torch.rand(3, height, width, generator=dice.generator)
    image = dice.of(image, image.round(), torch.zeros_like(image), image.expand(3, height, width))
    known = dice.of(None, dice.mask(1, height, width).float())
    return triangulation.detect(image, known, limit=dice.of(1, 10, 100))


CASES = (
    cameras_looking, cameras_changed, canonical_frames, frames_of_some_rays, capture_shapes, cylinders, looks,
    clearances, sight,
    fly_throughs, ellipses, shells, similarities, recovered, recovered_from_rays, surfaces, features, key_points,
)  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_a_finite_answer_or_one_sentence(case: Callable[[Dice], Any], shapes_unchecked) -> None:
    assert not faults(case, range(FAST))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_a_finite_answer_or_one_sentence_in_the_whole_fuzz(case: Callable[[Dice], Any], shapes_unchecked) -> None:
    """18 cases of 600, 10 800 draws, last run on 2026-11-27 without a fault."""
    assert not faults(case, range(FAST, FAST + ALL))
