"""What `fillerbuster eval consistency` holds runs against: true films are right, the same spoilt ones are not."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers import textured_box

from fb_core.data.capture.captures import read_capture
from fb_core.data.rooms.room_captures import rooms
from fb_core.evaluation.metrics.correspondences import sift_matches
from fb_core.evaluation.metrics.relative_rotation import accuracy, frame_pairs, judge_pairs
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.camera_paths import path_cameras
from method_configs.evaluations.true_films import (
    PAINTED,
    PHOTOS,
    TRUE_FILM,
    Film,
    blurred,
    photo_pairs,
    true_films,
    turned,
)

SPOILT = ("cameras shuffled", "blurred", "frames that disagree")


def within_five(film: Film) -> float:
    """Share of its pairs."""
    return accuracy(judge_pairs(cache(film.pictures), film.cameras, film.pairs, sift_matches))["rra_5"]


@pytest.fixture(scope="module")
def films_of_a_room(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Film]:
    """A film of a procedural room, as a run of its capture asks for one."""
    folder = tmp_path_factory.mktemp("room") / "capture"
    rooms(0, folder, views=6, size=32, held_out=2)
    frames = read_capture(folder).frames
    cameras = [frame.camera for frame in frames]
    pipeline = SimpleNamespace(
        datamanager=SimpleNamespace(train_dataset=SimpleNamespace(image_filenames=[one.image_path for one in frames]))
    )
    path = path_cameras("ellipse", cameras, 60, size=160, fov_degrees=75.0)
    film = Film(pictures=lambda _: torch.zeros(3, 160, 160), cameras=path, pairs=frame_pairs(60, most_apart=6, count=3))
    return true_films(folder, pipeline, cameras, film, seed=0, controls=True)


def test_a_painted_room_is_right_and_spoilt_films_of_it_are_not(films_of_a_room: dict[str, Film]):
    """At least 95 % within 5 degrees where every wall can be matched; near chance or clearly lower where not."""
    assert list(films_of_a_room) == [TRUE_FILM, PAINTED, *(f"{PAINTED}, {how}" for how in SPOILT)]
    found = {name: within_five(film) for name, film in films_of_a_room.items() if name != TRUE_FILM}
    assert found[PAINTED] == 1.0
    assert found[f"{PAINTED}, cameras shuffled"] == 0.0
    assert found[f"{PAINTED}, blurred"] <= 0.5 and found[f"{PAINTED}, frames that disagree"] <= 0.5


def test_paint_keeps_the_room_below_it(films_of_a_room: dict[str, Film]):
    plain, painted = (films_of_a_room[name].pictures(3) for name in (TRUE_FILM, PAINTED))
    paint = (painted - 0.4 * plain) / 0.6
    assert float(paint.amin()) > -1e-5 and float(paint.amax()) < 1 + 1e-5
    assert torch.allclose(paint[0], paint[1], atol=1e-5) and float(paint[0].std()) > 0.05, "grey noise"


def photos_of_a_box() -> tuple[SimpleNamespace, list[Pinholes]]:
    """The pipeline of a run on photos of a textured room, as far as their pairs need one; one photo has a mask."""
    ring = textured_box.cameras_on_an_arc(8)
    cameras = [ring[index] for index in range(len(ring))]

    def view(index: int, camera: Pinholes) -> SimpleNamespace:
        known = torch.ones(1, camera.height, camera.width)
        known[:, :10] = 0.0 if index == 0 else 1.0
        return SimpleNamespace(image=textured_box.render(camera)[0], known=known)

    return SimpleNamespace(datamanager=SimpleNamespace(captured_view=view)), cameras


def test_photos_of_a_capture_without_a_room(tiny_capture: Path):
    pipeline, cameras = photos_of_a_box()
    asked = Film(pictures=lambda _: torch.zeros(3, 8, 8), cameras=cameras, pairs=[(0, 1)] * 4)
    films = true_films(tiny_capture, pipeline, cameras, asked, seed=0, controls=True)
    assert list(films) == [PHOTOS, *(f"{PHOTOS}, {how}" for how in SPOILT)] and len(films[PHOTOS].pairs) == 4
    assert float(films[PHOTOS].pictures(0)[:, :10].abs().max()) == 0, "what is not known is not judged"
    found = {name: within_five(film) for name, film in films.items()}
    assert found[PHOTOS] == 1.0, "all cameras lie within 50 degrees, so that chance is no small share"
    assert found[f"{PHOTOS}, cameras shuffled"] <= 0.5 and found[f"{PHOTOS}, frames that disagree"] <= 0.5
    assert list(true_films(tiny_capture, pipeline, cameras, asked, seed=0, controls=False)) == [PHOTOS]


def test_pairs_of_photos_look_about_the_same_way():
    angles = torch.tensor([0.0, 20.0, 40.0, 180.0]).deg2rad()
    targets = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    ring = Pinholes.looking_at(torch.zeros(4, 3), targets, up=textured_box.UP, fov_degrees=60.0, width=16, height=16)
    cameras = [ring[index] for index in range(4)]
    assert photo_pairs(cameras, 20, 0) == [(0, 1), (1, 2)] and len(photo_pairs(cameras, 1, 0)) == 1
    assert photo_pairs([cameras[0], cameras[3]], 20, 0) == []


def test_photos_that_look_into_all_directions_are_left_out(tiny_capture: Path, caplog: pytest.LogCaptureFixture):
    targets = torch.tensor([[1.0, 0, 0], [-1, 0, 0]])
    both = Pinholes.looking_at(torch.zeros(2, 3), targets, up=textured_box.UP, fov_degrees=60.0, width=16, height=16)
    pipeline, _ = photos_of_a_box()
    asked = Film(pictures=lambda _: torch.zeros(3, 8, 8), cameras=both, pairs=[(0, 1)])
    assert true_films(tiny_capture, pipeline, [both[0], both[1]], asked, seed=0, controls=True) == {}
    assert "no two photos look the same way within 25 degrees, so none are judged" in caplog.text


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turned_picture_is_what_a_turned_camera_sees(axis: int):
    camera = textured_box.cameras_on_an_arc(1, width=200, height=150)
    degrees = torch.zeros(3)
    degrees[axis] = 6.0
    angle = math.radians(6.0)
    cross = torch.zeros(3, 3)
    one, other = (axis + 1) % 3, (axis + 2) % 3
    cross[other, one], cross[one, other] = angle, -angle
    pose = torch.cat([camera.rotations @ torch.linalg.matrix_exp(cross), camera.centers[:, :, None]], dim=2)
    there = Pinholes(
        camera_to_world=pose, focal=camera.focal, principal=camera.principal, width=camera.width, height=camera.height
    )
    wanted, got = textured_box.render(there)[0], turned(textured_box.render(camera)[0], camera, degrees)
    inner = (slice(None), slice(30, 120), slice(40, 160))
    assert (
        float((wanted - got)[inner].abs().mean())
        < 0.01
        < float((wanted - textured_box.render(camera)[0])[inner].abs().mean())
    )


def test_a_blurred_picture_keeps_its_mean_and_size():
    picture = torch.rand(3, 40, 30, generator=torch.Generator().manual_seed(0))
    found = blurred(picture)
    assert found.shape == picture.shape and float(found.std()) < 0.3 * float(picture.std())
    assert float((found.mean() - picture.mean()).abs()) < 0.01
