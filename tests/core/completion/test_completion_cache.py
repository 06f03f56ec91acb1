"""The cache of generated rounds: what a key depends on, what is found again, broken files, full disks, and a model that
need not load.
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import logging
import math
import struct
from pathlib import Path

import pytest
import torch
from helpers.scenes.completions import MeanFiller, box_points, captured, room_cameras, small
from helpers.tiny_models import save_tiny_model
from hypothesis import given, settings
from hypothesis import strategies as st

from fb_core.completion.inpainters.lazy_inpainter import LazyInpainter
from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import PlannedRound, plan_completion
from fb_core.completion.results import cache as completion_cache
from fb_core.completion.results.cache import CompletionCache, round_key
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.rounds import run_completion
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.sampling.guidance import GuidanceVariant
from fb_core.views import Views

SAMPLING = SamplingConfig(steps=4)


def sequence() -> Views:
    """Three known views, one of them in part, and two to generate."""
    cameras = room_cameras(5, 8)
    mask = torch.ones(3, 1, 8, 8)
    mask[1, :, :4] = 0
    images = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    known = Views.cat([Views.known(images[i : i + 1], cameras[i], mask=mask[i : i + 1]) for i in range(3)])
    return Views.cat([known, *(Views.unknown(camera) for camera in cameras[3:])])


def key(views: Views | None = None, **changes) -> str:
    options = {"seed": 1, "sampling": SAMPLING, "model_hash": "0123456789abcdef", **changes}
    return round_key(sequence() if views is None else views, **options)


# ---- keys ------------------------------------------------------------------------------------------------------------


def test_a_key_is_the_same_everywhere():
    """The key by hand: the options as sorted JSON, then masks and known values as little-endian floats."""
    ones = torch.ones(1, 1, 2, 2)
    values = torch.arange(24.0).reshape(1, 6, 2, 2) / 32
    views = Views(images=values[:, :3], image_known=ones, raymaps=values, rays_known=ones)
    options = {"seed": 1, "model_hash": "0123456789abcdef"}
    sampling = {
        name: value
        for name, value in dataclasses.asdict(SAMPLING).items()
        if name not in ("memory_budget_bytes", "views_at_once")
    }
    told = {
        "version": 2,
        "seed": 1,
        "sampling": sampling,
        "model": "0123456789abcdef",
        "prompt": "",
        "shape": [1, 3, 2, 2],
    }
    parts = [json.dumps(told, sort_keys=True).encode()]
    for numbers in ([1.0] * 4, range(12), [1.0] * 4, range(24)):
        scale = 32 if isinstance(numbers, range) else 1
        parts.append(struct.pack(f"<{len(numbers)}f", *(number / scale for number in numbers)))
    assert round_key(views, sampling=SAMPLING, **options) == hashlib.sha256(b"".join(parts)).hexdigest()


def test_what_sampling_starts_from_counts_as_far_as_it_is_told():
    views, half = sequence(), dataclasses.replace(SAMPLING, strength=0.5)
    told = views.image_known.clone()
    told[4, ..., :4] = 1
    start = dataclasses.replace(views, images=torch.full_like(views.images, 0.25), image_known=told)
    louder = dataclasses.replace(start, images=torch.where(told > 0, start.images, math.nan))
    brighter = dataclasses.replace(start, images=start.images + 0.25)
    keys = [
        key(),
        key(sampling=half, current=start),
        key(sampling=half, current=brighter),
        key(sampling=SAMPLING, current=start),
    ]
    assert len(set(keys)) == 4 and key(sampling=half, current=louder) == keys[1]


def test_what_stands_in_unknown_pixels_and_how_tensors_lie_in_memory_do_not_count():
    views = sequence()
    noisy = dataclasses.replace(views, images=torch.where(views.image_known > 0, views.images, math.nan))
    strided = dataclasses.replace(
        views, images=views.images.to(memory_format=torch.channels_last), raymaps=views.raymaps.double()
    )
    assert key(noisy) == key(strided) == key()


@settings(max_examples=8)
@given(place=st.tuples(*(st.integers(0, limit) for limit in (4, 2, 7, 7))))
def test_every_known_pixel_counts(place):
    views = sequence()
    images = views.images.clone()
    images[place] = torch.nextafter(images[place], torch.tensor(2.0))
    known = bool(views.image_known[place[0], 0, place[2], place[3]] > 0)
    assert (key(dataclasses.replace(views, images=images)) != key(views)) == known


@pytest.mark.parametrize("field", ["image_known", "rays_known"])
def test_masks_count(field):
    mask = getattr(sequence(), field).clone()
    mask[0, 0, 0, 0] = 0
    assert key(dataclasses.replace(sequence(), **{field: mask})) != key()


def test_cameras_order_and_number_of_views_count():
    views = sequence()
    raymaps = views.raymaps.clone()
    raymaps[4, 0, 0, 0] += 1e-6
    assert (
        len(
            {
                key(),
                key(dataclasses.replace(views, raymaps=raymaps)),
                key(views[[1, 0, 2, 3, 4]]),
                key(views[[0, 1, 2, 3]]),
            }
        )
        == 4
    )


def test_seed_prompt_weights_and_each_sampling_option_count():
    changed = [
        {"steps": 5},
        {"guidance_unknown": 1.0},
        {"guidance_known": 1.2},
        {"guidance_text": 3.0},
        {"guidance": GuidanceVariant(rescale=0.5)},
        {"solver": "euler"},
        {"shift": 3.0},
        {"window": 3},
        {"rounds": 2},
        {"known": "imposed"},
        {"sample_posterior": True},
        {"reference_compatible": True},
    ]
    keys = [key(sampling=dataclasses.replace(SAMPLING, **change)) for change in changed]
    keys += [key(), key(seed=2), key(prompt="a kitchen"), key(model_hash="fedcba9876543210")]
    assert len(set(keys)) == len(keys)


def test_how_the_work_is_cut_does_not_count():
    assert key(sampling=dataclasses.replace(SAMPLING, memory_budget_bytes=10**9, views_at_once=2)) == key()


def test_a_new_version_finds_nothing_of_the_old(monkeypatch):
    before = key()
    monkeypatch.setattr(completion_cache, "VERSION", 10**6)
    assert key() != before


# ---- files -----------------------------------------------------------------------------------------------------------

NAME = "ab" * 32
IMAGES = torch.randint(0, 256, (2, 8, 8, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)


def test_what_was_kept_is_found_and_nothing_else_is_left(tmp_path: Path):
    cache = CompletionCache(tmp_path / "new" / "cache")
    assert cache.find(NAME, views=2, size=8) is None and not cache.folder.exists()
    cache.keep(NAME, IMAGES)
    found = cache.find(NAME, views=2, size=8)
    assert found is not None and torch.equal(found, IMAGES)
    assert [path for path in cache.folder.rglob("*") if path.is_file()] == [cache.path(NAME)]


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "text", "swapped"])
def test_a_broken_file_is_ignored_with_a_warning_and_replaced(tmp_path: Path, caplog, damage: str):
    cache = CompletionCache(tmp_path)
    cache.keep(NAME, IMAGES)
    path, whole = cache.path(NAME), cache.path(NAME).read_bytes()
    if damage == "swapped":
        cache.keep("cd" * 32, 255 - IMAGES)
    flipped = whole[:-5] + bytes([whole[-5] ^ 1]) + whole[-4:]
    damaged = {"empty": b"", "cut": whole[:-7], "flipped": flipped, "text": b"not a cache file", "swapped": b""}[damage]
    path.write_bytes(cache.path("cd" * 32).read_bytes() if damage == "swapped" else damaged)
    with caplog.at_level(logging.WARNING):
        assert cache.find(NAME, views=2, size=8) is None
    assert len(caplog.records) == 1 and "generated again" in caplog.text
    cache.keep(NAME, IMAGES)
    found = cache.find(NAME, views=2, size=8)
    assert found is not None and torch.equal(found, IMAGES)


def test_pictures_of_another_size_are_not_taken(tmp_path: Path, caplog):
    cache = CompletionCache(tmp_path)
    cache.keep(NAME, IMAGES)
    assert cache.find(NAME, views=3, size=8) is None and "expected 3 pictures of 8x8" in caplog.text


def test_a_full_disk_is_said_and_leaves_nothing(tmp_path: Path, caplog, monkeypatch):
    def full(tensors, path, metadata):
        Path(path).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(completion_cache, "save_file", full)
    cache = CompletionCache(tmp_path)
    cache.keep(NAME, IMAGES)
    assert "No space left on device" in caplog.text and "the run goes on" in caplog.text
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path, caplog):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="expected a folder, got the file"):
        CompletionCache(tmp_path / "file")
    CompletionCache(tmp_path / "file" / "below").keep(NAME, IMAGES)
    assert "could not keep" in caplog.text


# ---- rounds ----------------------------------------------------------------------------------------------------------


def complete(
    config: CompletionConfig, model, done: CompletedViews | None = None
) -> tuple[list[CompletedViews], list[int]]:
    """The rounds, and the numbers of those that came from the cache."""
    found: list[int] = []

    def note(planned: PlannedRound) -> None:
        found.append(planned.number)

    plan, views = plan_completion(room_cameras(), box_points(), config, size=16), captured(room_cameras())
    context = [views[index] for index in plan.context]
    return list(run_completion(plan, context, model, config, done=done, on_found=note)), found


def test_a_second_run_generates_nothing_and_gives_the_same_views(tmp_path: Path):
    plain, _ = complete(small(), MeanFiller())
    first, _ = complete(small(cache_dir=tmp_path), MeanFiller())
    model = MeanFiller()
    again, found = complete(small(cache_dir=tmp_path), model)
    assert model.asked == [] and found == [0, 1, 2]
    for expected, kept, loaded in zip(plain, first, again, strict=True):
        assert torch.equal(expected.images, kept.images) and torch.equal(kept.images, loaded.images)
        assert (
            torch.equal(kept.cameras.camera_to_world, loaded.cameras.camera_to_world) and kept.origins == loaded.origins
        )


def test_a_changed_option_generates_and_does_not_disturb_what_is_kept(tmp_path: Path):
    complete(small(cache_dir=tmp_path), MeanFiller())
    for change in ({"seed": 1}, {"steps": 3}, {"context_views": 3}):
        model = MeanFiller()
        _, found = complete(small(cache_dir=tmp_path, **change), model)
        assert found == [] and len(model.asked) == 3
    assert complete(small(cache_dir=tmp_path), MeanFiller())[1] == [0, 1, 2]


def test_rounds_that_are_shared_are_found_and_the_others_generated(tmp_path: Path):
    complete(small(densify_rounds=1, cache_dir=tmp_path), MeanFiller())
    model = MeanFiller()
    _, found = complete(small(densify_rounds=2, cache_dir=tmp_path), model)
    assert found == [0, 1] and len(model.asked) == 1


def test_a_round_whose_file_is_broken_is_generated_to_the_same_bits(tmp_path: Path):
    first, _ = complete(small(cache_dir=tmp_path), MeanFiller())
    files = sorted(tmp_path.rglob("*.safetensors"))
    assert len(files) == 3
    files[0].write_bytes(b"")
    model = MeanFiller()
    again, found = complete(small(cache_dir=tmp_path), model)
    assert len(model.asked) == 1 and len(found) == 2
    assert all(torch.equal(one.images, other.images) for one, other in zip(first, again, strict=True))


def test_an_interrupted_run_goes_on_from_its_bank_and_the_cache(tmp_path: Path):
    rounds, _ = complete(small(cache_dir=tmp_path), MeanFiller())
    model = MeanFiller()
    rest, found = complete(small(cache_dir=tmp_path), model, done=CompletedViews.cat(rounds[:1]))
    assert found == [1, 2] and model.asked == [] and torch.equal(rest[0].images, rounds[1].images)


# ---- the model -------------------------------------------------------------------------------------------------------


def test_the_model_loads_only_when_a_round_is_missing(tmp_path: Path):
    folder = save_tiny_model(tmp_path / "model", image_size=16)
    config = small(anchor_views=2, densify_rounds=1, densify_views=1, cache_dir=tmp_path / "cache", model=folder)
    model = LazyInpainter(folder, "cpu")
    first, _ = complete(config, model)
    assert model.loaded
    weights = [path for path in folder.glob("*.safetensors")]
    again = LazyInpainter(folder, "cpu")
    for path in weights:  # nothing of the weights is read any more
        path.unlink()
    second, found = complete(config, again)
    assert not again.loaded and found == [0, 1]
    assert all(torch.equal(one.images, other.images) for one, other in zip(first, second, strict=True))


def test_a_lazy_model_says_of_itself_what_the_model_says(tmp_path: Path):
    folder = save_tiny_model(tmp_path / "model", image_size=32)
    lazy, model = LazyInpainter(folder, "cpu"), Fillerbuster.from_pretrained(folder)
    assert (lazy.size, lazy.model_hash, lazy.recommended_sampling) == (
        model.size,
        model.model_hash,
        model.recommended_sampling,
    )
    bundled, theirs = LazyInpainter(None, "cpu"), Fillerbuster.from_pretrained()
    assert (bundled.size, bundled.model_hash, bundled.recommended_sampling) == (
        theirs.size,
        theirs.model_hash,
        theirs.recommended_sampling,
    )
    with pytest.raises(ValueError, match="no folder"):
        LazyInpainter(tmp_path / "absent", "cpu")
