"""Features and their matches are the same to the bit on any number of threads; mutual matches as defined."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from fb_core.data.photos.photo import Photo
from fb_core.geometry.features.pairs import features_of, match_pairs, verified_pair
from fb_core.geometry.features.triangulation import mutual_matches
from fb_core.machine.parallel import fixed_workers, in_order
from fb_core.registration import by_features


def shifted_pictures(count: int) -> list[torch.Tensor]:
    """Parts of one picture of random blots, each a little further to the right."""
    noise = torch.rand(1, 3, 40, 80, generator=torch.Generator().manual_seed(0))
    wide = F.interpolate(noise, scale_factor=6, mode="bicubic")[0].clamp(0, 1)
    return [wide[:, :, 24 * number : 24 * number + 260].contiguous() for number in range(count)]


def photos_of(pictures: list[torch.Tensor]) -> list[Photo]:
    nothing_told = {"source": Path("none.jpg"), "focal_prior": None, "device": "", "seconds": None, "camera": None}
    return [
        Photo(
            name=str(number), size=tuple(picture.shape[1:]), thumbnail=picture,
            pixels=lambda picture=picture: (picture, torch.ones_like(picture[:1])), **nothing_told,
        )
        for number, picture in enumerate(pictures)
    ]  # fmt: skip


@pytest.mark.parametrize("workers", [2, 3])
def test_matches_are_the_same_on_any_number_of_threads(workers):
    features = [features_of(picture, focal=None, lens="one") for picture in shifted_pictures(5)]
    with fixed_workers(1):
        wanted = match_pairs(features, lambda *_: None)
    told = []
    with fixed_workers(workers):
        got = match_pairs(features, lambda done, total: told.append((done, total)))
    assert list(got) == list(wanted) and len(wanted) >= 4
    assert all(np.array_equal(got[pair], wanted[pair]) for pair in wanted)
    assert told == [(number, 10) for number in range(10)]


def test_features_are_the_same_on_any_number_of_threads(monkeypatch):
    seen = []

    def looked_at(features, **_):
        seen.append(features)
        raise InterruptedError

    monkeypatch.setattr(by_features, "chain", looked_at)
    for workers in (1, 3):
        told = []
        with fixed_workers(workers), pytest.raises(InterruptedError):
            by_features.recover_with_features(
                photos_of(shifted_pictures(4)), on_progress=lambda *what, told=told: told.append(what)
            )
        assert told == [("looking for features", number, 4) for number in range(4)]
    for one, other in zip(*seen, strict=True):
        assert torch.equal(one.places, other.places) and torch.equal(one.descriptors, other.descriptors)
        assert len(one.places) > 100


@pytest.mark.parametrize("workers", [2, 3])
def test_motions_are_the_same_on_any_number_of_threads(workers):
    features = [features_of(picture, focal=300.0, lens="one") for picture in shifted_pictures(4)]
    matches = match_pairs(features, lambda *_: None)
    motions = []
    for count in (1, workers):
        each = in_order(lambda match: verified_pair(features, *match, [300.0] * 4), matches.items(), count)
        motions.append([None if pair is None else (pair.rotation, pair.translation, pair.matches) for pair in each])
    assert any(motion is not None for motion in motions[0])
    for one, other in zip(*motions, strict=True):
        assert (one is None) == (other is None)
        assert one is None or all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_small_copies_are_made_where_somebody_asks_for_them(monkeypatch):
    counts = []

    def looked_at(features, **_):
        counts.append([len(of_photo.coarse) for of_photo in features])
        raise InterruptedError

    monkeypatch.setattr(by_features, "chain", looked_at)
    for count in (3, 17):
        with pytest.raises(InterruptedError):
            by_features.recover_with_features(photos_of(shifted_pictures(1) * count))
    assert set(counts[0]) == {0} and min(counts[1]) > 0


def test_mutual_matches_are_each_others_best_and_clear():
    generator = torch.Generator().manual_seed(1)
    first = F.normalize(torch.rand(60, 16, generator=generator), dim=1)
    second = F.normalize(first[10:50] + 0.05 * torch.rand(40, 16, generator=generator), dim=1)
    second = torch.cat([second, second[:3]])  # twins, of which neither is clear
    similar = first @ second.T
    rows, columns = mutual_matches(similar, ratio=0.8)
    wanted = []
    for row in range(len(first)):
        order = similar[row].argsort(descending=True)
        best, next_best = (float(similar[row, order[place]]) for place in (0, 1))
        distances = [max(0.0, 2 - 2 * value) ** 0.5 for value in (best, next_best)]
        if int(similar[:, order[0]].argmax()) == row and best > 0.75 and distances[0] < 0.8 * distances[1]:
            wanted.append((row, int(order[0])))
    assert list(zip(rows.tolist(), columns.tolist(), strict=True)) == wanted and len(wanted) > 20
    nothing = mutual_matches(torch.zeros(4, 5), ratio=0.8)
    assert len(nothing[0]) == len(nothing[1]) == 0
