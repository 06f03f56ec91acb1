"""What is unknown decides nothing: the canonical frame, the answer of a completion and recovered cameras follow the
known rays alone.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.scenes.moved_cameras import moved
from helpers.scenes.random_cameras import random_cameras, random_rotations
from helpers.tiny_models import tiny_model

from fb_core.geometry.known_rays import axes_of_some, frame_of_known_rays
from fb_core.geometry.pose_solver.solver import recover_cameras
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.views import Views

QUICK = SamplingConfig(steps=2, guidance_unknown=3.0)
GARBAGE = (torch.nan, torch.inf, 0.0, 1e30, -7.0)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Fillerbuster:
    return tiny_model(tmp_path_factory.mktemp("known_rays"))


def sized(seed: int, count: int, width: int, height: int):
    """Random cameras whose pictures have a size; float64."""
    cameras = random_cameras(seed, count=count)
    centre = cameras.principal.new_tensor([width / 2, height / 2]).expand(count, 2).clone()
    return dataclasses.replace(
        cameras, width=width, height=height, focal=torch.full_like(cameras.focal, float(width)), principal=centre
    )


def masks(seed: int, height: int, width: int) -> torch.Tensor:
    """Rays of four views: known in part at random, not at all, in a window, all of them."""
    known = torch.zeros(4, 1, height, width, dtype=torch.float64)
    known[0] = (torch.rand(1, height, width, generator=seeded(seed), dtype=torch.float64) < 0.3).double()
    known[2, :, height // 3 :, : width // 2] = 0.5
    known[3] = 1.0
    return known


def elsewhere(seed: int, cameras, *, shift: float = 20.0):
    """The same cameras in a world that is turned, larger and far away."""
    turn = random_rotations(1, seeded(seed + 1))[0].double()
    return moved(cameras, scale=3.0, turn=turn, shift=torch.tensor([shift, -shift, 2 * shift], dtype=torch.float64))


def frame_of(raymaps: torch.Tensor, known: torch.Tensor) -> CanonicalFrame:
    frame = frame_of_known_rays(raymaps, known)
    assert frame is not None
    return frame


@pytest.mark.parametrize("size", range(16, 71))
def test_the_frame_is_that_of_the_cameras_at_any_size_whatever_stands_in_unknown_rays(size: int) -> None:
    width, height = size, 16 + (7 * size) % 55
    cameras, known = sized(size, 4, width, height), masks(size, height, width)
    raymaps, seen = raymaps_of(cameras), [0, 2, 3]
    expected = CanonicalFrame.of(cameras[seen])
    frames = [frame_of(torch.where(known > 0, raymaps, garbage), known) for garbage in GARBAGE]
    for frame in frames:
        assert torch.equal(frame.rotation, frames[0].rotation) and torch.equal(frame.center, frames[0].center)
        assert frame.scale == frames[0].scale
    assert torch.allclose(frames[0].rotation, expected.rotation, atol=1e-9)
    assert torch.allclose(frames[0].center, expected.center, atol=1e-12) and frames[0].scale == pytest.approx(
        expected.scale, rel=1e-9
    )
    other = raymaps_of(elsewhere(size, cameras))
    assert torch.allclose(frame_of(other, known).apply(other), frames[0].apply(raymaps), atol=1e-9)


@pytest.mark.parametrize("size", [*range(16, 36), 47, 48, 49, 63, 64, 65, 70])
def test_the_frame_in_single_precision(size: int) -> None:
    """In a world of another unit too."""
    cameras, known = sized(size, 4, size, size + size % 5), masks(size, size + size % 5, size).float()
    for there in (cameras, elsewhere(size, cameras)):
        frame, expected = frame_of(raymaps_of(there.to(torch.float32)), known), CanonicalFrame.of(there[[0, 2, 3]])
        assert torch.allclose(frame.rotation.double(), expected.rotation, atol=1e-4)
        assert torch.allclose(frame.center.double(), expected.center, atol=1e-5)
        assert frame.scale == pytest.approx(expected.scale, rel=1e-4)


@pytest.mark.parametrize("size", [(16, 16), (17, 22), (22, 17), (33, 33), (70, 18)])
def test_a_completion_is_the_same_to_the_bit_whatever_stands_in_unknown_rays(model, size) -> None:
    width, height = size
    known, images = masks(3, height, width).float(), torch.rand(4, 3, height, width, generator=seeded(1))
    views = dataclasses.replace(Views.known(images, sized(3, 4, width, height).to(torch.float32)), rays_known=known)
    views = dataclasses.replace(views, image_known=known.flip(0))
    answers = []
    for garbage in GARBAGE:
        told = torch.where(known > 0, views.raymaps, garbage)
        answers.append(model.complete(dataclasses.replace(views, raymaps=told), generator=seeded(), sampling=QUICK))
    assert bool(torch.isfinite(answers[0].images).all()) and bool(torch.isfinite(answers[0].raymaps).all())
    for answer in answers[1:]:
        assert torch.equal(answer.images, answers[0].images) and torch.equal(answer.raymaps, answers[0].raymaps)
    given = (known > 0).expand_as(views.raymaps)
    assert torch.equal(answers[0].raymaps[given], views.raymaps[given]), (
        "a ray that is known in part comes back as given"
    )


@pytest.mark.parametrize("size", [*range(16, 24), 33, 47, 70])
def test_a_moved_turned_scaled_world_changes_nothing_but_the_world(model, size: int) -> None:
    """Also where rays are known in part, and with fractional masks."""
    cameras, known = sized(size, 4, size, size), masks(size, size, size)
    images = torch.rand(4, 3, size, size, generator=seeded(1))
    answers = []
    for there in (cameras, elsewhere(size, cameras)):
        views = dataclasses.replace(Views.known(images, there), raymaps=raymaps_of(there), rays_known=known.float())
        answers.append(
            model.complete(
                dataclasses.replace(views, image_known=known.flip(0).float()), generator=seeded(), sampling=QUICK
            )
        )
    assert torch.allclose(answers[0].images, answers[1].images, atol=1e-5)
    frames = [frame_of(raymaps_of(there), known) for there in (cameras, elsewhere(size, cameras))]
    one, two = (frame.apply(answer.raymaps) for frame, answer in zip(frames, answers, strict=True))
    assert torch.allclose(one, two, atol=1e-5)


@pytest.mark.parametrize(
    "pixels", [[(3, 4)], [(3, 4), (3, 9)], [(2, 2), (2, 5), (2, 11)], [(1, 1), (8, 8)], [(0, 0), (0, 9), (9, 0)]]
)
def test_rays_that_tell_no_camera_still_move_and_turn_with_the_world(pixels) -> None:
    cameras = sized(5, 3, 20, 17)
    known = torch.zeros(3, 1, 17, 20, dtype=torch.float64)
    for row, column in pixels:
        known[1:, :, row, column] = 1.0
    seen = []
    for there in (cameras, elsewhere(5, cameras)):
        raymaps = raymaps_of(there)
        seen.append(torch.where(known > 0, frame_of(raymaps, known).apply(raymaps), 0.0))
    assert torch.allclose(seen[0], seen[1], atol=1e-9)


def test_no_known_ray_no_frame() -> None:
    assert frame_of_known_rays(torch.full((2, 6, 16, 16), torch.nan), torch.zeros(2, 1, 16, 16)) is None


@pytest.mark.parametrize("seed", range(10))
def test_axes_from_some_rays_of_a_shifted_lens(seed: int) -> None:
    """Any window of a picture, in float32: exact for any principal point."""
    camera = sized(seed, 1, 60, 40).cropped(-7, 11, 60, 40)
    there = torch.rand(40, 60, generator=seeded(seed)) < 0.2
    directions = raymaps_of(camera)[0, 3:, there].float()
    axes = axes_of_some(directions, there)
    assert axes is not None and torch.allclose(axes.double(), camera.rotations[0], atol=2e-5)


@pytest.mark.parametrize("garbage", GARBAGE)
def test_recovered_cameras_do_not_look_at_rays_without_weight(garbage: float) -> None:
    known = masks(4, 24, 24).float()[[0, 2, 3]]
    raymaps = raymaps_of(sized(4, 3, 24, 24).to(torch.float32))
    wanted = recover_cameras(torch.where(known > 0, raymaps, 0.25), weights=known)
    got = recover_cameras(torch.where(known > 0, raymaps, garbage), weights=known)
    assert torch.equal(got.cameras.camera_to_world, wanted.cameras.camera_to_world) and torch.equal(
        got.cameras.focal, wanted.cameras.focal
    )
    assert (
        got.verdicts == wanted.verdicts
        and torch.equal(got.inliers, wanted.inliers)
        and torch.equal(got.rejected, wanted.rejected)
    )


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_views_of_any_precision_come_back_in_theirs(model, dtype: torch.dtype) -> None:
    cameras, known = sized(6, 3, 33, 20), masks(6, 20, 33)[[3, 2, 0]]
    images = torch.rand(3, 3, 20, 33, generator=seeded(1)).double()
    views = dataclasses.replace(Views.known(images, cameras), image_known=known, rays_known=known.flip(0)).to(dtype)
    done, single = (
        model.complete(some, generator=seeded(), sampling=QUICK) for some in (views, views.to(torch.float32))
    )
    assert {getattr(done, field.name).dtype for field in dataclasses.fields(Views)} == {dtype}
    whole, given = (views.image_known == 1).expand_as(images), (views.rays_known > 0).expand_as(views.raymaps)
    assert torch.equal(done.images[whole], views.images[whole]) and torch.equal(
        done.raymaps[given], views.raymaps[given]
    )
    assert torch.allclose(done.images.float(), single.images, atol=max(float(torch.finfo(dtype).eps), 1e-5))


def test_torchs_default_precision_changes_no_bit(model) -> None:
    cameras = sized(6, 3, 33, 20).to(torch.float32)
    images = torch.rand(3, 3, 20, 33, generator=seeded(1))
    known = masks(6, 20, 33)[[3, 2, 0]].float()
    views = dataclasses.replace(Views.known(images, cameras), image_known=known)
    sampling = dataclasses.replace(QUICK, sample_posterior=True, window=2, rounds=2)
    wanted = model.complete(views, generator=seeded(), sampling=sampling).images
    torch.set_default_dtype(torch.float64)
    try:
        got = model.complete(views, generator=seeded(), sampling=sampling).images
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(got, wanted)
