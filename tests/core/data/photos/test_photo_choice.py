"""Which photos show nothing, and which of many cover the scene."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.exif_photos import as_tensor, save, scene
from helpers.folders.films import pan
from helpers.folders.photos import made

from fb_core.data.photos.choice import choose_by_coverage, doubtful, require_two_views
from fb_core.data.photos.collection import read_photos
from fb_core.data.photos.photo import Photo
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.paths import spread_subset

# ---- which photos ---------------------------------------------------------------------------------------------------


def test_photos_that_show_nothing_or_the_same_are_named(tmp_path: Path) -> None:
    save(tmp_path / "0.png", scene(0, 240, 320))
    save(tmp_path / "1.jpg", scene(0, 240, 320))  # another compression of the same
    save(tmp_path / "2.png", np.zeros_like(scene()))
    save(tmp_path / "3.png", np.full_like(scene(), 250))
    noise = np.random.default_rng(0).integers(0, 6, scene().shape).astype(np.uint8)
    save(tmp_path / "4.png", noise)
    save(tmp_path / "5.png", scene(5))
    photos = read_photos(tmp_path)
    assert doubtful(photos) == {"1": "the same picture as 0", "2": "black", "3": "of one colour", "4": "black"}
    require_two_views(photos)


@pytest.mark.parametrize(
    ("pictures", "told"),
    [(["same"] * 4, "the same picture as 0"), (["black"] * 4, "black"), (["same", "black"], "black")],
)
def test_identical_and_black_photos_cannot_tell_cameras(tmp_path: Path, pictures: list[str], told: str) -> None:
    for index, kind in enumerate(pictures):
        save(tmp_path / f"{index}.png", scene(0) if kind == "same" else np.zeros_like(scene()))
    with pytest.raises(ValueError, match=f"at least 2 different pictures.*{told}") as error:
        require_two_views(read_photos(tmp_path))
    assert "\n" not in str(error.value)


def test_a_small_step_to_the_side_is_not_the_same_picture() -> None:
    first, second = (made(as_tensor(array), name) for array, name in zip(pan([0, 2]), "ab", strict=True))
    assert doubtful([first, second]) == {}


def clusters(members: int, kinds: int) -> list[Photo]:
    """Photos of a few places, each taken often and almost alike."""
    generator = torch.Generator().manual_seed(0)
    return [
        made(
            (as_tensor(scene(kind)) + 0.05 * torch.randn(3, 60, 80, generator=generator)).clamp(0, 1), f"{kind}_{index}"
        )
        for kind in range(kinds)
        for index in range(members)
    ]


def test_every_place_is_chosen_before_any_twice() -> None:
    photos = clusters(10, 4)
    chosen = choose_by_coverage(photos, 4)
    assert [photos[index].name[0] for index in chosen] == ["0", "1", "2", "3"]


def test_the_choice_is_ascending_without_repetition_and_all_when_few() -> None:
    photos = clusters(5, 3)
    for count in (1, 2, 7, 14):
        chosen = choose_by_coverage(photos, count)
        assert len(chosen) == count and chosen == sorted(set(chosen))
    assert choose_by_coverage(photos, 15) == choose_by_coverage(photos, 99) == list(range(15))


def test_photos_alike_are_chosen_evenly_in_time() -> None:
    photos = clusters(40, 1)
    gaps = np.diff(choose_by_coverage(photos, 5))
    assert gaps.min() >= 3


def test_doubtful_photos_come_last() -> None:
    photos = [
        *clusters(1, 3),
        made(torch.zeros(3, 60, 80), "black"),
        made(as_tensor(scene(0)), "twin"),
        made(as_tensor(scene(0)), "triplet"),
    ]
    names = [photos[index].name for index in choose_by_coverage(photos, 4)]
    assert "black" not in names and "triplet" not in names
    assert len(choose_by_coverage(photos, 5)) == 5


def test_with_known_poses_place_and_direction_decide() -> None:
    angles = torch.arange(12, dtype=torch.float64) * torch.pi / 6
    centers = torch.stack([angles.cos(), angles.sin(), torch.zeros(12, dtype=torch.float64)], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    cameras = Pinholes.looking_at(centers, torch.zeros_like(centers), up=up, fov_degrees=60.0, width=80, height=60)
    same = as_tensor(scene(0))
    photos = [made(same, str(index), camera=cameras[index]) for index in range(12)]
    chosen = choose_by_coverage(photos, 4)
    assert chosen == sorted(spread_subset([cameras], 4))
    assert np.diff(chosen).tolist() == [3, 3, 3], "a quarter of the circle apart, though all look alike"


def test_a_hundred_photos(tmp_path: Path) -> None:
    for index in range(100):
        save(tmp_path / f"IMG_{index}.jpg", scene(index, 24, 32))
    photos = read_photos(tmp_path)
    assert [photo.name for photo in photos] == [f"IMG_{index}" for index in range(100)]
    assert len(choose_by_coverage(photos, 16)) == 16


def test_the_most_photos_are_those_that_cover(tmp_path: Path) -> None:
    for index in range(8):
        save(tmp_path / f"{index}.jpg", scene(index))
    photos = read_photos(tmp_path)
    assert [photo.name for photo in read_photos(tmp_path, most=3)] == [
        photos[index].name for index in choose_by_coverage(photos, 3)
    ]


def test_real_photos(shared_path, tmp_path: Path) -> None:
    """Three portrait photos without EXIF data and without their poses."""
    for path in sorted((shared_path("data/fox") / "images").iterdir())[:3]:
        shutil.copy(path, tmp_path)
    photos = read_photos(tmp_path)
    assert [photo.size for photo in photos] == [(1920, 1080)] * 3 and doubtful(photos) == {}
    assert photos[0].load(128).shape == (3, 128, 72)
