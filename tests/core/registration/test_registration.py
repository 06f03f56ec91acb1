"""Photos to cameras: in windows of any size, beside known cameras, upright, with verdicts; what raymaps cannot tell is
said.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers.raymap_oracle import SIDE, UP, Oracle, photos_of, ring
from helpers.scenes.recovered_cameras import each
from helpers.tiny_models import tiny_model

from fb_core.evaluation.metrics.pose_metrics import pose_errors
from fb_core.evaluation.self_consistency import self_consistency
from fb_core.evaluation.uncalibrated import UncalibratedTask, evaluate_uncalibrated, summary
from fb_core.geometry.gravity import turn_between, upright
from fb_core.geometry.pose_solver.solver import PoseSolving, recover_cameras
from fb_core.geometry.raymap import raymaps_of
from fb_core.inpainter import SamplingConfig
from fb_core.registration.by_raymaps import Square
from fb_core.registration.choice import register


@pytest.mark.parametrize(("count", "at_once"), [(2, 3), (2, 16), (3, 3), (5, 16), (9, 4), (7, 3), (20, 8)])
def test_any_number_of_photos_in_any_window(count, at_once):
    cameras = ring(count)
    photos = photos_of(cameras)
    oracle = Oracle(photos, cameras)
    found = register(photos, method="model", model=oracle, seed=0, views_at_once=at_once)
    errors = pose_errors(found.cameras, each(cameras))
    assert max(oracle.windows) <= at_once and set(found.verdicts) == {"ok"} and set(found.reasons) == {""}
    assert errors["rotation_degrees"] < 0.01 and errors["center"] < 0.01 and errors["focal_percent"] < 0.1
    assert (
        found.raymaps is not None
        and found.raymaps.shape == (count, 6, SIDE, SIDE)
        and bool(found.raymaps.isfinite().all())
    )


def test_the_world_is_upright_and_of_unit_extent():
    cameras = ring(6)
    photos = photos_of(cameras)
    found = register(photos, method="model", model=Oracle(photos, cameras), seed=3)
    centers = torch.cat([camera.centers for camera in found.cameras if camera is not None])
    assert float(centers.mean(dim=0).norm()) < 1e-4 and float(centers.norm(dim=1).max()) == pytest.approx(1.0, abs=1e-3)
    assert all(float(-camera.rotations[0, 2, 1]) > 0.9 for camera in found.cameras if camera is not None)


@pytest.mark.parametrize("at_once", [3, 16])
def test_known_cameras_stay_and_the_others_join_their_world(at_once):
    cameras = ring(8)
    photos = photos_of(cameras)
    mixed = [
        dataclasses.replace(photo, camera=cameras[index]) if index in (0, 3, 5) else photo
        for index, photo in enumerate(photos)
    ]
    found = register(mixed, method="model", model=Oracle(photos, cameras), seed=0, views_at_once=at_once)
    for index, (camera, verdict) in enumerate(zip(found.cameras, found.verdicts, strict=True)):
        assert camera is not None and verdict == ("known" if index in (0, 3, 5) else "ok")
        assert camera is mixed[index].camera or torch.allclose(
            camera.camera_to_world, cameras[index].camera_to_world, atol=0.02
        )


@pytest.mark.parametrize("size", [(48, 36), (36, 48), (31, 53), (40, 40)])
def test_squares_and_back(size):
    cameras = ring(2, width=size[0], height=size[1])
    photo = photos_of(cameras)[0]
    square = Square.of(photo, SIDE)
    back = square.outside(square.inside(cameras[0]))
    assert (back.width, back.height) == size
    assert torch.allclose(back.focal, cameras.focal[:1]) and torch.allclose(back.principal, cameras.principal[:1])
    assert torch.allclose(square.inside(cameras[0]).principal[0], square.principal)


def test_a_told_focal_length_stands_where_raymaps_scatter():
    cameras = ring(6)
    photos = photos_of(cameras, told=True)
    longer = [dataclasses.replace(photo, focal_prior=1.3 * float(cameras.focal[0, 0])) for photo in photos]
    found = register(longer, method="model", model=Oracle(photos, cameras, noise=0.02), seed=0)
    assert [float(camera.focal[0, 0]) for camera in found.cameras if camera is not None] == pytest.approx(
        [1.3 * float(cameras.focal[0, 0])] * 6, rel=0.01
    )


def test_a_weakly_told_focal_length_yields_to_the_rays():
    cameras = ring(4).to(torch.float64)
    told = 1.3 * cameras.focal[:, 0]
    solving = PoseSolving(focal="shared", square_pixels=True, focal_deviation=0.5)
    found = recover_cameras(raymaps_of(cameras), focal=told, solving=solving)
    assert torch.allclose(found.cameras.focal, cameras.focal, rtol=1e-3)
    unknown = recover_cameras(raymaps_of(cameras), focal=torch.full((4,), math.nan), solving=solving)
    assert torch.allclose(unknown.cameras.focal, cameras.focal, rtol=1e-6)


def test_raymaps_that_fit_no_camera_are_doubted():
    cameras = ring(5)
    photos = photos_of(cameras)
    found = register(photos, method="model", model=Oracle(photos, cameras, noise=0.3), seed=0)
    assert not set(found.verdicts) & {"ok", "known"} and all(found.reasons)


@pytest.mark.parametrize(("count", "at_once"), [(2, 16), (5, 3)])
def test_a_model_that_understands_nothing_raises_nothing(tmp_path, count, at_once):
    photos = photos_of(ring(count))
    sampling = SamplingConfig(steps=1, window=2, guidance_unknown=1.0, guidance_known=1.0)
    found = register(
        photos, method="model", model=tiny_model(tmp_path), seed=0, sampling=sampling, views_at_once=at_once
    )
    assert len(found.cameras) == count and not set(found.verdicts) & {"ok", "known"}


def test_photos_without_features_have_no_cameras():
    found = register(photos_of(ring(3)), method="features", model=None, seed=0)
    assert found.cameras == (None, None, None) and set(found.verdicts) == {"no camera"} and found.raymaps is None


@pytest.mark.parametrize(
    ("count", "options", "sentence"),
    [
        (1, {}, "at least two photos, got 1"),
        (2, {"views_at_once": 2}, "views_at_once: expected at least 3 .*, got 2"),
        (2, {"method": "model"}, "needs a model"),
    ],
)
def test_what_cannot_be_is_refused(count, options, sentence):
    with pytest.raises(ValueError, match=sentence):
        register(photos_of(ring(2))[:count], **{"method": "features", "model": None, "seed": 0} | options)


def test_cameras_in_one_place_keep_their_scale():
    cameras = ring(3)
    here = dataclasses.replace(
        cameras, camera_to_world=torch.cat([cameras.rotations, torch.ones(3, 3, 1, dtype=torch.float64)], dim=2)
    )
    similarity = upright([here])
    assert similarity.scale == 1.0 and torch.allclose(
        similarity.points(here.centers), torch.zeros(3, 3, dtype=torch.float64), atol=1e-12
    )


def test_the_smallest_turn_between_opposite_directions():
    turn = turn_between(UP, -UP)
    assert torch.allclose(turn @ UP, -UP) and float(torch.linalg.det(turn)) == pytest.approx(1.0)


def test_an_oracle_is_consistent_with_itself():
    cameras = ring(6, width=40, height=40)
    photos = photos_of(cameras)
    images = [photo.load() for photo in photos]
    errors = self_consistency(
        images, each(cameras), method="model", model=Oracle(photos, cameras), seed=0, views_at_once=4
    )
    assert errors["rotation_degrees"] < 0.01 and errors["trusted_share"] == 1.0


def test_the_evaluation_in_miniature(tmp_path):
    task = UncalibratedTask(rooms=1, views=3, path=2, sides=(32,), loops=1)
    rows = summary(list(evaluate_uncalibrated(tiny_model(tmp_path), task)))
    by = {(row["part"], row["method"]): row for row in rows}
    assert by["cameras", "model"]["trusted_share"] == 0.0 and by["cameras", "identity"]["found_share"] == 1.0
    assert by["fly-through", "features at 32"]["rooms"] == 0 and by["fly-through", "true cameras"]["rooms"] == 1
    assert ("closed loop", "generated views") in by
