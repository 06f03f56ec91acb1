"""Lenses that photos do not tell, or tell wrongly: what their features determine is found, what they do not is never
called ok.

Scenes are points that known cameras see through known lenses, with noise.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch
from helpers.scenes.features import around, bundle, cloud, lenses, perturbed, seen

from fb_core.evaluation.metrics.pose_metrics import aligned, pose_errors
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.bundle_adjustment import adjust, radial, straight_places
from fb_core.geometry.features.chain import FeatureCameras, chain
from fb_core.geometry.features.pairs import PhotoFeatures
from fb_core.geometry.features.trust import borne_out, deviations_of, flat, plane_doubt, surplus_of_a_plane
from fb_core.geometry.pose_solver.verdict import Arrangement

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
FALSE_DEGREES, FALSE_SHARE = 3.0, 0.1  # errors of a camera that must not be called ok


def zoomed(cameras: Pinholes, factors: list[float]) -> Pinholes:
    return dataclasses.replace(cameras, focal=cameras.focal * torch.tensor(factors, dtype=torch.float64)[:, None])


def each(cameras: Pinholes) -> list[Pinholes]:
    return [cameras[index] for index in range(len(cameras))]


def photos_of(
    cameras: Pinholes, points: torch.Tensor, *, told: float | None = None, noise: float = 0.3
) -> list[PhotoFeatures]:
    return [
        one
        for number, camera in enumerate(each(cameras))
        for one in seen(camera, points, told=told, noise=noise, wrong=0.05, seed=number)
    ]


def bent(photos: list[PhotoFeatures], focal: float, bend: tuple[float, float]) -> list[PhotoFeatures]:
    """As a lens with radial distortion pictures them."""
    result = []
    for photo in photos:
        middle = torch.tensor([photo.size[1] / 2, photo.size[0] / 2])
        plane = (photo.places - middle) / focal
        factor, _ = radial((plane**2).sum(dim=1).numpy(), np.tile(bend, (len(plane), 1)))
        result.append(
            dataclasses.replace(photo, places=(middle + plane * torch.from_numpy(factor)[:, None] * focal).float())
        )
    return result


def false_oks(found: FeatureCameras, truth: Pinholes) -> list[int]:
    """Cameras that are called ok and lie, after the alignment by all that are, farther off than is allowed."""
    ok = [camera if trusted else None for camera, trusted in zip(found.cameras, found.trusted, strict=True)]
    similarity = aligned(ok, each(truth))
    if similarity is None:
        return []
    extent = float((truth.centers - truth.centers.mean(dim=0)).norm(dim=1).max())
    wrong = []
    for index, camera in enumerate(ok):
        if camera is None:
            continue
        placed = similarity.cameras(camera)
        cosine = (torch.trace(placed.rotations[0].T @ truth.rotations[index]) - 1) / 2
        turned = math.degrees(math.acos(min(1.0, float(cosine))))
        off = float((placed.centers[0] - truth.centers[index]).norm()) / extent
        if turned > FALSE_DEGREES or (off > FALSE_SHARE and found.arrangement == Arrangement.APART):
            wrong.append(index)
    return wrong


def focal_lengths(found: FeatureCameras) -> list[float]:
    return [math.nan if camera is None else float(camera.focal[0, 0]) for camera in found.cameras]


# ---- lenses ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "factors",
    [
        pytest.param([0.6, 1.0, 1.9] * 2, id="three lenses"),
        pytest.param([1.0, 1.0, 1.7, 1.0, 1.0, 1.0], id="one zoomed photo"),
    ],
)
def test_lenses_of_which_nothing_is_told_have_their_own_focal_lengths(factors: list[float]):
    truth = zoomed(around(len(factors), arc_degrees=60.0, focal=450.0), factors)
    found = chain(photos_of(truth, cloud(160)))
    result = pose_errors(found.cameras, each(truth))
    assert not false_oks(found, truth) and sum(found.trusted) >= len(factors) - 1
    assert result["rotation_degrees"] < 0.5 and result["center"] < 0.05 and result["focal_percent"] < 2
    assert any("focal lengths" in note for note in found.notes)


@pytest.mark.parametrize(("zoom", "told"), [(0.75, None), (1.8, 500.0)])
def test_one_zoomed_photo_before_a_wall_is_not_one_from_nearer_by(zoom: float, told: float | None):
    """A bundle adjustment moves the camera and the wall's points until nearly everything agrees."""
    views, points = wall_views(6)
    truth = zoomed(views, [1.0, 1.0, zoom, 1.0, 1.0, 1.0])
    found = chain(photos_of(truth, points, told=told, noise=0.2))
    assert not false_oks(found, truth), (found.reasons, found.notes)
    assert [found.trusted[index] for index in (0, 1, 3, 4, 5)] == [True] * 5, found.reasons
    assert [focal_lengths(found)[index] for index in (0, 1, 3, 4, 5)] == pytest.approx([500.0] * 5, rel=0.01)


def test_a_zoomed_photo_that_nothing_else_confirms_makes_a_pair_of_three_doubtful():
    """Before a wall two of three photos fit together whatever one of them was zoomed by."""
    views, points = wall_views(3)
    found = chain(photos_of(zoomed(views, [1.0, 1.5, 1.0]), points, told=500.0, noise=0.6))
    assert not false_oks(found, views)


def test_three_photos_of_a_wall_by_three_lenses_tell_of_none():
    """One lens explains them to a twentieth of a pixel, from other places: two homographies are fewer numbers than
    three cameras with a focal length each.
    """
    views, points = wall_views(3)
    found = chain(photos_of(zoomed(views, [0.6, 1.0, 1.5]), points, noise=0.1))
    assert not any(found.trusted) and all(found.reasons), found.reasons


@pytest.mark.parametrize("same_lens", [False, True])
def test_a_tag_that_nothing_bears_out_is_believed_of_no_photo_that_looks_straight_at_a_wall(same_lens: bool):
    """Photo 3 was zoomed, or not: its features cannot tell, and its tag is one witness. The device's lens and size,
    which other photos have too, bear it out.
    """
    views, points = wall_views(7)
    truth = views if same_lens else zoomed(views, [1.0, 1.0, 1.0, 0.6, 1.0, 1.0, 1.0])
    photos = photos_of(truth, points, told=500.0, noise=0.1)
    found = chain([dataclasses.replace(photo, same_lens=same_lens) for photo in photos])
    assert [index for index in range(7) if not found.trusted[index]] == ([] if same_lens else [3]), found.reasons
    assert not false_oks(found, truth)


def test_four_photos_of_a_wall_do_not_tell_which_of_them_lies():
    """Photo 2 was zoomed. With the tags all are explained as well as with the truth; counted, nothing is left over."""
    generator = np.random.default_rng(1037)
    centers, targets = (torch.from_numpy(generator.uniform(-1, 1, (4, 3))) for _ in range(2))
    centers, targets = centers * torch.tensor([1.5, 0.6, 0.7]), targets * torch.tensor([0.4, 0.0, 0.3])
    targets[:, 1] = 3.0
    views = Pinholes.looking_at(centers, targets, up=UP, fov_degrees=50.0, width=640, height=480)
    views = dataclasses.replace(views, focal=torch.full((4, 2), 500.0, dtype=torch.float64))
    points = cloud(200)
    points[:, 1] = 3.0
    found = chain(photos_of(zoomed(views, [1.0, 1.0, 1.3, 1.0]), points, told=500.0, noise=0.6))
    assert not any(found.trusted) and "photos of a plane" in found.reasons[0], found.reasons


def test_one_lens_that_explains_four_photos_of_a_wall_is_believed_without_tags():
    """Three numbers agree that need not; lenses of their own would explain as much, and nobody would think of them."""
    views, points = wall_views(4)
    found = chain(photos_of(views, points, noise=0.3))
    assert all(found.trusted), found.reasons
    assert not false_oks(found, views)
    assert [borne_out(photos, 1) for photos in (2, 3, 4)] == [False, False, True]
    assert not borne_out(4, 4) and not borne_out(4, 2)


@pytest.mark.parametrize(
    ("photos", "lenses", "surplus"),
    [
        (2, 0, 0),  # the two decompositions of a homography of known lenses
        (3, 0, 2),
        (3, 1, 1),
        (3, 3, -1),
        (4, 4, 0),
        (6, 6, 2),
    ],
)
def test_what_a_plane_tells_is_counted(photos: int, lenses: int, surplus: int):
    assert surplus_of_a_plane(photos, lenses) == surplus and bool(plane_doubt(photos, lenses)) == (surplus <= 0)


@pytest.mark.parametrize(("depth", "is_flat"), [(0.0, True), (0.3, False)])
def test_a_wall_is_known_from_a_room(depth: float, is_flat: bool):
    views, points = wall_views(4)
    points[:, 1] += depth * cloud(len(points), seed=1)[:, 0]
    assert flat(*matched(views[[0, 3]], points)) == is_flat


def matched(cameras: Pinholes, points: torch.Tensor) -> list[np.ndarray]:
    """Places of the points in each picture, with noise, and some that are wrong."""
    generator = np.random.default_rng(0)
    pixels = cameras.project(points)[0].numpy() + 0.5 * generator.standard_normal((len(cameras), len(points), 2))
    pixels[1, ::20] += 40.0
    return list(pixels)


def test_of_two_photos_tags_are_believed():
    """Two views tell no focal length at all, so that nothing bears tags out, and nothing else can be had."""
    truth = around(2, arc_degrees=20.0)
    assert chain(photos_of(truth, cloud(120), told=500.0)).trusted == [True, True]


@pytest.mark.parametrize("bend", [(-0.25, 0.05), (-0.1, 0.0), (0.08, 0.0)])
def test_a_lens_that_bends_is_found_and_its_focal_length_is_right(bend: tuple[float, float]):
    truth = around(5, focal=430.0, arc_degrees=60.0)
    found = chain(bent(photos_of(truth, 1.3 * cloud(200)), 430.0, bend))
    assert all(found.trusted) and focal_lengths(found) == pytest.approx([430.0] * 5, rel=0.01)
    radii = np.linspace(0.05, 0.7, 9) ** 2
    assert radial(radii, np.tile(found.bends[0], (9, 1)))[0] == pytest.approx(
        radial(radii, np.tile(bend, (9, 1)))[0], abs=0.006
    )
    assert any("written straightened" in note for note in found.notes)


@pytest.mark.parametrize("told", [None, 500.0])
def test_straight_lenses_stay_straight_and_one(told: float | None):
    truth = around(5, arc_degrees=60.0)
    found = chain(photos_of(truth, cloud(150), told=told))
    assert all(found.trusted) and found.bends == [(0.0, 0.0)] * 5 and not found.notes
    assert len(set(focal_lengths(found))) == 1 and focal_lengths(found)[0] == pytest.approx(500.0, rel=0.01)


@pytest.mark.parametrize("lie", [1.8, 0.6])
def test_a_focal_length_that_is_told_wrongly_is_not_believed(lie: float):
    truth = around(5, arc_degrees=60.0)
    found = chain(photos_of(truth, cloud(150), told=500.0 * lie))
    assert not false_oks(found, truth) and focal_lengths(found) == pytest.approx([500.0] * 5, rel=0.02)
    assert any("contradicts" in note for note in found.notes)


def test_photos_that_were_made_smaller_have_no_other_lens():
    """A smaller copy has another focal length in pixels, and the same one in longer sides."""
    truth, small = around(6, arc_degrees=60.0, focal=450.0), 2 / 3
    photos = photos_of(truth, cloud(160))
    for index in (1, 4):
        places, (height, width) = photos[index].places * small, photos[index].size
        size = (round(height * small), round(width * small))
        photos[index] = dataclasses.replace(photos[index], places=places, size=size, lens="a smaller size")
    found = chain(photos)
    assert all(found.trusted) and not found.notes, (found.reasons, found.notes)
    assert focal_lengths(found) == pytest.approx([450.0, 300.0, 450.0, 450.0, 300.0, 450.0], rel=0.01)


def test_known_cameras_keep_their_lens():
    truth = around(3, arc_degrees=30.0)
    photos = [dataclasses.replace(photo, known=True) for photo in photos_of(truth, cloud(120), told=505.0)]
    assert focal_lengths(chain(photos)) == [505.0] * 3


# ---- verdicts --------------------------------------------------------------------------------------------------------


def wall_views(count: int, *, focal: float = 500.0) -> tuple[Pinholes, torch.Tensor]:
    """Cameras before a plane, and its points."""
    along = torch.linspace(-1, 1, count, dtype=torch.float64)
    centers = torch.stack([1.2 * along, 0 * along, 0.3 * (3 * along).sin()], dim=1)
    targets = torch.stack([0.3 * along, 0 * along + 3, 0 * along], dim=1)
    views = Pinholes.looking_at(centers, targets, up=UP, fov_degrees=50.0, width=640, height=480)
    points = cloud(160)
    points[:, 1] = 3.0
    return dataclasses.replace(views, focal=torch.full((count, 2), focal, dtype=torch.float64)), points


def turn_at_arms_length(count: int, *, arm: float) -> tuple[Pinholes, torch.Tensor]:
    """Once around, looking outwards to walls about 3 away."""
    angles = torch.arange(count, dtype=torch.float64) * 2 * math.pi / count
    outwards = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    centers = arm * outwards + torch.stack([0 * angles, 0 * angles, 0.1 * (3 * angles).sin()], dim=1)
    views = Pinholes.looking_at(centers, centers + 3 * outwards, up=UP, fov_degrees=60.0, width=640, height=480)
    points = cloud(6000)
    points = points[points[:, 2].abs() < 0.5 * points.abs().amax(dim=1)][
        :1600
    ]  # none above and below, where nobody looks
    return views, points / points.abs().amax(dim=1, keepdim=True) * 3 * (1 + 0.1 * cloud(len(points), seed=1)[:, :1])


HARD = {
    "a pair whose focal length nothing tells": lambda: (around(2, arc_degrees=20.0), cloud(120)),
    "three photos close to one another": lambda: (around(3, arc_degrees=3.0), cloud(120)),
    "a wall": lambda: wall_views(4),
    "two photos of a wall": lambda: (wall_views(4)[0][[0, 3]], wall_views(4)[1]),
    "a turn at arm's length": lambda: turn_at_arms_length(12, arm=0.5),
    "a turn around the camera, nearly": lambda: turn_at_arms_length(12, arm=0.04),
}


@pytest.mark.parametrize("case", HARD)
def test_what_is_not_determined_is_not_called_ok(case: str):
    truth, points = HARD[case]()
    found = chain(photos_of(truth, points, noise=0.5))
    assert not false_oks(found, truth), (case, found.reasons)
    assert all(reason for trusted, reason in zip(found.trusted, found.reasons, strict=True) if not trusted)


# ---- laws ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bend", [(-0.3, 0.1), (0.2, 0.0), (0.0, 0.0)])
def test_straightening_undoes_bending(bend: tuple[float, float]):
    generator = np.random.default_rng(0)
    straight = generator.uniform(-0.7, 0.7, (200, 2))
    factor, _ = radial((straight**2).sum(axis=1), np.tile(bend, (200, 1)))
    assert straight_places(straight * factor[:, None], np.array(bend)) == pytest.approx(straight, abs=1e-9)


def test_places_that_a_lens_cannot_picture_have_none():
    assert np.isnan(straight_places(np.array([[3.0, 0.0]]), np.array([-0.3, 0.0]))).all()


def test_the_adjustment_finds_bent_lenses():
    bend = np.array([[-0.15, 0.03], [0.06, 0.0]])
    straight = bundle(cameras=6, points=80)
    exact = dataclasses.replace(straight, bend=bend)
    exact = dataclasses.replace(exact, offsets=exact.offsets + exact.misses())
    start = dataclasses.replace(perturbed(exact, 0.01), bend=np.zeros((2, 2)))
    found = adjust(start, lenses(bends=2), steps=60)
    assert np.abs(found.misses()).max() < 0.05 and found.bend == pytest.approx(bend, abs=0.01)


@functools.cache
def noisy(seed: int):
    exact = bundle(cameras=5, points=60)
    noise = 0.5 * np.random.default_rng(seed).standard_normal(exact.offsets.shape)
    return adjust(
        dataclasses.replace(exact, offsets=exact.offsets + noise), lenses(told=500.0, deviation=0.02), steps=20
    )


def test_deviations_are_those_of_repeated_noise():
    """They are pessimistic by a factor of three, since observations of photos err together."""
    found, again = noisy(0), [noisy(seed) for seed in range(1, 13)]
    told = deviations_of(found, lenses(told=500.0, deviation=0.02))
    truth = each(around(5))
    turns = []
    for other in again:
        cameras = [
            dataclasses.replace(
                one, camera_to_world=torch.from_numpy(np.concatenate([r.T, -(r.T @ t)[:, None]], axis=1))[None]
            )
            for one, r, t in zip(truth, other.rotations, other.shifts, strict=True)
        ]
        similarity = aligned(cameras, truth)
        assert similarity is not None
        placed = [similarity.cameras(camera).rotations[0] for camera in cameras]
        turns.append(
            [float((one - two.rotations[0]).norm()) / math.sqrt(2) for one, two in zip(placed, truth, strict=True)]
        )
    scatter = np.degrees(np.sqrt(np.square(turns).mean(axis=0)))
    assert (told.turn_degrees / scatter > 1.2).all() and (told.turn_degrees / scatter < 8).all() and told.sound.all()


def test_deviations_do_not_depend_on_the_world():
    found, known = noisy(0), lenses(told=500.0, deviation=0.02)
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    scale, shift = 7.0, np.array([3.0, -2.0, 9.0])
    moved = dataclasses.replace(
        found,
        points=scale * found.points @ turn.T + shift,
        rotations=found.rotations @ turn.T,
        shifts=scale * found.shifts - np.einsum("nij,j->ni", found.rotations @ turn.T, shift),
    )
    one, other = deviations_of(found, known), deviations_of(moved, known)
    assert one.turn_degrees == pytest.approx(other.turn_degrees, rel=1e-3) and one.shift == pytest.approx(
        other.shift, rel=1e-3
    )
