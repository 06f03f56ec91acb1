"""A model is asked twice for cameras: what it says the same way both times is believed, and nothing else is."""

from __future__ import annotations

import dataclasses
import math

import torch
from helpers.raymap_oracle import Oracle, photos_of, ring
from helpers.scenes.recovered_cameras import anywhere, each

from fb_core.geometry.cameras import Pinholes
from fb_core.registration.choice import register
from fb_core.registration.two_draws import agreement


def elsewhere(cameras: Pinholes, seed: int) -> list[Pinholes | None]:
    """The same cameras in another world."""
    return list(each(anywhere(seed, scale=0.3).cameras(cameras)))


def test_cameras_of_two_worlds_agree():
    cameras = ring(6)
    shares = agreement(elsewhere(cameras, 1), elsewhere(cameras, 2), apart=True)
    assert shares.tolist() == [1.0] * 6


def test_what_belongs_to_other_photos_does_not_agree():
    cameras = ring(6)
    mixed = cameras[[3, 1, 5, 2, 0, 4]]
    assert agreement(each(cameras), each(mixed), apart=True).max() < 0.5


def test_one_wrong_photo_costs_the_others_one_pair():
    cameras = ring(6)
    wrong = elsewhere(cameras, 3)
    wrong[2] = wrong[5]
    shares = agreement(elsewhere(cameras, 1), wrong, apart=True)
    assert shares[2] == 0 and shares[[0, 1, 3, 4]].tolist() == [0.8] * 4


def test_cameras_in_one_place_agree_by_their_turns():
    cameras = ring(5)
    here = dataclasses.replace(
        cameras, camera_to_world=torch.cat([cameras.rotations, torch.ones(5, 3, 1, dtype=torch.float64)], dim=2)
    )
    assert agreement(each(here), elsewhere(here, 1), apart=False).tolist() == [1.0] * 5


def on_a_tripod(seed: int, places: tuple[int, ...] = (0, 0, 0, 0, 0, 4)) -> list[Pinholes | None]:
    """A ring's turns, but each photo from the place of another; places err by a hundredth of the ring's radius."""
    cameras = ring(6)
    centers = cameras.centers[list(places)]
    noise = torch.randn(6, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    centers = centers + 0.01 * float(cameras.centers.std()) * noise
    moved = dataclasses.replace(cameras, camera_to_world=torch.cat([cameras.rotations, centers[:, :, None]], dim=2))
    return elsewhere(moved, seed)


def test_photos_from_a_tripod_beside_one_from_elsewhere_agree():
    assert agreement(on_a_tripod(1), on_a_tripod(2), apart=True).tolist() == [1.0] * 6


def test_who_says_one_place_and_then_another_does_not_agree():
    shares = agreement(on_a_tripod(1), on_a_tripod(2, places=(0, 1, 2, 3, 4, 5)), apart=True)
    assert float(shares.max()) < 0.5


def test_photos_without_two_cameras_have_no_share():
    cameras = each(ring(4))
    missing = [cameras[0], None, cameras[2], cameras[3]]
    shares = agreement(cameras, missing, apart=True)
    assert math.isnan(shares[1]) and shares[[0, 2, 3]].tolist() == [1.0] * 3
    assert agreement(cameras, [None] * 4, apart=True).isnan().all()
    assert agreement([], [], apart=True).shape == (0,)


class Guesser(Oracle):
    """Firm raymaps of good cameras; those of some photos are another camera's each time it is asked."""

    def __init__(self, *args, guessed: tuple[int, ...]):
        super().__init__(*args)
        self.right, self.guessed, self.asked = list(self.truth), guessed, 0

    def complete(self, views, **options):
        self.asked += 1
        count = len(self.right)
        others = [self.right[(at + 2 * self.asked + 1) % count] for at in range(count)]
        self.truth = [others[at] if at in self.guessed else self.right[at] for at in range(count)]
        return super().complete(views, **options)


def verdicts_of(count: int, guessed: tuple[int, ...]) -> list[str]:
    cameras = ring(count)
    photos = photos_of(cameras)
    found = register(photos, method="model", model=Guesser(photos, cameras, guessed=guessed), seed=0)
    for verdict, reason in zip(found.verdicts, found.reasons, strict=True):
        assert (verdict == "ok") == (reason == "") and ("asked twice" in reason or verdict == "ok")
    return list(found.verdicts)


def test_a_model_that_only_guesses_is_never_believed():
    assert set(verdicts_of(8, tuple(range(8)))) == {"doubtful"}


def test_photos_that_a_model_knows_are_believed_beside_guessed_ones():
    assert verdicts_of(9, (2, 5, 7)) == ["doubtful" if at in (2, 5, 7) else "ok" for at in range(9)]


def test_guesses_beside_known_cameras_are_doubted():
    cameras = ring(8)
    photos = photos_of(cameras)
    given = (0, 2, 3, 5)
    mixed = [dataclasses.replace(one, camera=cameras[at]) if at in given else one for at, one in enumerate(photos)]
    found = register(mixed, method="model", model=Guesser(photos, cameras, guessed=(1, 4)), seed=0)
    expected = {1: "doubtful", 4: "doubtful"} | dict.fromkeys(given, "known")
    assert list(found.verdicts) == [expected.get(at, "ok") for at in range(8)]


def test_a_model_whose_raymaps_fit_no_camera_is_asked_once():
    cameras = ring(5)
    photos = photos_of(cameras)
    oracle = Oracle(photos, cameras, noise=0.3)
    register(photos, method="model", model=oracle, seed=0)
    assert oracle.windows == [5]
