"""From photos to views without files: which photos are used, which views are generated together, and what each pass
sees.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from helpers.textured_box import cameras_on_an_arc, render
from helpers.tiny_models import tiny_model
from hypothesis import given
from hypothesis import strategies as st

from fb_core.completion import duration, fly_through
from fb_core.completion.duration import SquareSequence, expected_seconds
from fb_core.completion.fly_through import choose_context, find_cameras, generate, plan_passes, room_beside
from fb_core.data.photos.photo import Photo
from fb_core.evaluation.self_consistency import photo_of
from fb_core.geometry.pose_solver.verdict import Arrangement
from fb_core.geometry.viewpoints.camera_paths import path_cameras
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.registration.choice import Registration

FEW = SamplingConfig(steps=2, guidance_known=1.0, guidance_unknown=1.0)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Fillerbuster:
    return tiny_model(tmp_path_factory.mktemp("tiny"), image_size=16)


def photos_of(count: int, *, known: bool = True, width: int = 32, height: int = 24) -> list[Photo]:
    cameras = cameras_on_an_arc(count, width=width, height=height)
    return [
        photo_of(picture, name=f"p{index}", device="one", camera=cameras[index].to(torch.float64) if known else None)
        for index, picture in enumerate(render(cameras))
    ]


# ---- cameras ---------------------------------------------------------------------------------------------------------


def answers(monkeypatch: pytest.MonkeyPatch, verdicts: dict[str, list[str]]) -> list[str]:
    """Registration answers with these verdicts; returns the methods that were asked, in order."""
    asked: list[str] = []

    def register(photos, *, method, model, seed, sampling, on_progress):
        asked.append(method)
        cameras = tuple(
            None if verdict == "no camera" else cameras_on_an_arc(1).to(torch.float64) for verdict in verdicts[method]
        )
        nans = (math.nan,) * len(photos)
        rays = torch.zeros(len(photos), 6, 4, 4) if method == "model" else None
        return Registration(
            cameras=cameras,
            verdicts=tuple(verdicts[method]),
            reasons=("",) * len(photos),
            residuals_degrees=nans,
            raymaps=rays,
            arrangement=Arrangement.APART,
        )

    monkeypatch.setattr(fly_through, "register", register)
    return asked


@pytest.mark.parametrize(
    ("by_model", "by_features", "asked", "taken", "used"),
    [
        (["ok", "ok", "ok", "doubtful"], ["ok"] * 4, ["model"], "model", [0, 1, 2]),  # three quarters are enough
        (
            ["ok", "ok", "doubtful", "doubtful"],
            ["ok", "ok", "ok", "no camera"],
            ["model", "features"],
            "features",
            [0, 1, 2],
        ),
        (["ok", "ok", "doubtful", "doubtful"], ["no camera"] * 4, ["model", "features"], "model", [0, 1]),
        (["doubtful"] * 4, ["no camera"] * 4, ["model", "features"], "model", []),
        (
            ["known", "doubtful", "doubtful", "doubtful"],
            ["known", "ok", "no camera", "ok"],
            ["model", "features"],
            "features",
            [0, 1, 3],
        ),
    ],
)
def test_auto_asks_features_where_the_model_is_not_sure(monkeypatch, by_model, by_features, asked, taken, used):
    methods = answers(monkeypatch, {"model": by_model, "features": by_features})
    found = find_cameras(photos_of(4, known=False), method="auto", model=None, seed=0)
    assert (methods, found.method, found.trusted) == (asked, taken, used)
    assert found.raymaps is not None  # kept, whoever found the cameras
    assert set(found.tried) == set(asked)


def test_a_method_that_is_asked_for_is_the_only_one(monkeypatch):
    methods = answers(monkeypatch, {"model": ["doubtful"] * 3, "features": ["ok"] * 3})
    assert find_cameras(photos_of(3, known=False), method="model", model=None, seed=0).trusted == []
    assert find_cameras(photos_of(3, known=False), method="features", model=None, seed=0).raymaps is None
    assert methods == ["model", "features"]


def test_given_cameras_are_taken_as_they_are():
    photos = photos_of(3)
    found = find_cameras(photos, method="auto", model=None, seed=0)
    assert (found.method, found.trusted, found.registration.arrangement) == ("known", [0, 1, 2], Arrangement.APART)
    assert all(found.camera(index) is photo.camera for index, photo in enumerate(photos))
    same = [dataclasses.replace(photo, camera=photos[0].camera) for photo in photos]
    assert find_cameras(same, method="auto", model=None, seed=0).registration.arrangement is Arrangement.ONE_PLACE


def test_context_is_spread_and_never_a_photo_that_is_left_out(monkeypatch):
    photos = photos_of(9)
    found = find_cameras(photos, method="auto", model=None, seed=0)
    verdicts = tuple("doubtful" if index in (0, 8) else "ok" for index in range(9))
    found = dataclasses.replace(found, registration=dataclasses.replace(found.registration, verdicts=verdicts))
    chosen = choose_context(found, 3)
    assert len(chosen) == 3 and {1, 7} <= set(chosen) <= set(range(1, 8))
    assert sorted(choose_context(found, 50)) == list(range(1, 8))


# ---- passes ----------------------------------------------------------------------------------------------------------


@given(views=st.integers(1, 120), room=st.integers(1, 40))
def test_every_view_is_generated_once_and_no_sequence_is_too_long(views, room):
    passes = plan_passes(views, room=room)
    assert sorted(view for chosen in passes.views for view in chosen) == list(range(views))
    assert len(passes.views[0]) == min(views, room)
    assert all(0 < len(chosen) <= room - passes.anchors for chosen in passes.views[1:])
    assert (passes.anchors == 0) == (views <= room or room < 4)


def test_the_first_pass_spans_the_path():
    passes = plan_passes(100, room=10)
    assert passes.views[0][0] == 0 and passes.views[0][-1] == 99
    with pytest.raises(ValueError, match="at least one new view beside the photos, got 0"):
        plan_passes(5, room=0)


def test_room_is_what_sequence_and_memory_leave(model, monkeypatch):
    ask = {"model": model, "views": 32, "side": 16, "sampling": FEW}
    assert room_beside(16, sequence=48, **ask) == 32
    assert room_beside(16, sequence=20, **ask) == 4
    assert room_beside(2, sequence=48, **{**ask, "views": 5}) == 5
    with pytest.raises(ValueError, match="sequence: expected more than the 16 photos"):
        room_beside(16, sequence=16, **ask)
    monkeypatch.setattr(fly_through, "_fits", lambda model, views, side, sampling, prompt: views <= 13)
    assert room_beside(4, sequence=48, **ask) == 8


def test_each_pass_sees_the_photos_and_later_ones_views_of_the_first(model, monkeypatch):
    photos = photos_of(3)
    cameras = [photo.camera for photo in photos if photo.camera is not None]
    path = path_cameras("orbit", cameras, 20, size=16).to(torch.float32)
    passes = plan_passes(20, room=8)
    asked = []
    complete = model.complete

    def recorded(views, **options):
        asked.append((views, options["generator"].initial_seed()))
        return complete(views, **options)

    monkeypatch.setattr(model, "complete", recorded)
    steps = []
    made = generate(
        photos, cameras, path, passes, model, seed=5, sampling=FEW, on_progress=lambda *told: steps.append(told)
    )
    assert made.shape == (20, 3, 16, 16) and bool(((made >= 0) & (made <= 1)).all())
    assert [seed for _, seed in asked] == [5, 6, 7]
    for number, (views, _) in enumerate(asked):
        known = int((views.image_known.flatten(1).mean(dim=1) > 0.99).sum())
        assert known == (3 if number == 0 else 5) and len(views) == known + len(passes.views[number])
        assert torch.equal(views.images[:3], asked[0][0].images[:3])
    first = passes.views[0]
    assert torch.equal(asked[1][0].images[3:5], made[[first[0], first[-1]]])
    assert steps[-1] == ("generating views", 6, 6) and [done for _, done, _ in steps] == [1, 2, 3, 4, 5, 6]
    again = generate(photos, cameras, path, passes, model, seed=5, sampling=FEW)
    assert torch.equal(made, again)


@pytest.mark.parametrize(("width", "height"), [(48, 24), (24, 48), (32, 32)])
def test_photos_are_cut_to_their_central_square_with_the_camera_of_that_square(model, monkeypatch, width, height):
    photos = photos_of(2, width=width, height=height)
    cameras = [photo.camera for photo in photos if photo.camera is not None]
    asked = []
    monkeypatch.setattr(model, "complete", lambda views, **options: asked.append(views) or views)
    generate(
        photos,
        cameras,
        path_cameras("orbit", cameras, 2, size=16).to(torch.float32),
        plan_passes(2, room=2),
        model,
        seed=0,
        sampling=FEW,
    )
    short = min(width, height)
    left, top = (width - short) // 2, (height - short) // 2
    cut = cameras[0].cropped(left, top, short, short).scaled(16, 16)
    assert torch.allclose(asked[0].raymaps[0, 3:], cut.directions()[0].movedim(-1, 0).float(), atol=1e-5)
    mean = photos[0].load()[:, top : top + short, left : left + short].mean(dim=(1, 2))
    assert torch.allclose(asked[0].images[0].mean(dim=(1, 2)), mean, atol=0.02)


# ---- how long --------------------------------------------------------------------------------------------------------


def test_more_work_is_expected_to_take_longer(model):
    def seconds(views: int = 8, side: int = 32, **options) -> float:
        sequence = SquareSequence(views=views, known=2, side=side)
        return expected_seconds(model, sequence, dataclasses.replace(FEW, **options))

    once = seconds()
    assert once > 0
    assert seconds(steps=20) > 2 * once * 0.5 and seconds(views=32) > 2 * once and seconds(side=64) > 2 * once
    assert seconds(guidance_unknown=7.0) > once and seconds(window=4, rounds=8) > once


@pytest.mark.parametrize(
    ("busy", "threads", "cores", "slower"), [(0.0, 1, 2, 1.0), (0.0, 8, 2, 1.0), (7.0, 1, 2, 4.0), (6.0, 2, 16, 1.0)]
)
def test_a_busy_machine_is_expected_to_take_longer(monkeypatch, busy, threads, cores, slower):
    monkeypatch.setattr(duration.os, "getloadavg", lambda: (busy, busy, busy), raising=False)
    monkeypatch.setattr(duration, "usable_cores", lambda: cores)
    assert duration._crowd(threads) == slower
