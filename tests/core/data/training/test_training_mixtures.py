"""Captioned pictures, and mixtures of training data: rows of each source, resolutions in turn, all stages on them."""

from __future__ import annotations

import dataclasses
import io
import logging

import numpy as np
import pytest
import torch
from helpers.folders.training_sources import TASK, assert_same, cube_and_no_mesh, draws

from fb_core.data.training.captioned_images import CaptionedConfig, CaptionedImages
from fb_core.data.training.capture_sequences import (
    CaptureConfig,
    CaptureSource,
)
from fb_core.data.training.folders import Resolution, Wanted, at_resolutions, multi_view_source, resolution_of
from fb_core.data.training.mixed_sources import Alternating, AnyOf, Later, SeveralPerRow
from fb_core.data.training.named_data import TrainingData
from fb_core.data.training.sequences import PoolConfig, RoomPool
from fb_core.data.training.task import Source


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    return cube_and_no_mesh(tmp_path_factory.mktemp("meshes"))


# ---- captioned pictures ----


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Two shards of six pictures whose red channel is their number; one is damaged, one has its caption in JSON."""
    webdataset = pytest.importorskip("webdataset", reason="needs the extra `train`")
    folder = tmp_path_factory.mktemp("shards")
    for shard in range(2):
        with webdataset.TarWriter(str(folder / f"{shard:03d}.tar")) as writer:
            for number in range(6 * shard, 6 * shard + 6):
                caption = {"json": {"caption": f"number {number}"}} if number == 4 else {"txt": f"number {number}"}
                writer.write(
                    {"__key__": f"s{number:03d}", "png": b"damaged" if number == 8 else png(number), **caption}
                )
    return folder


def png(number: int) -> bytes:
    from PIL import Image

    pixels = np.full((20, 30, 3), 10 * number, dtype=np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def numbers_of(batch) -> list[int]:
    return [round(float(image[0, 0, 8, 8]) * 25.5) for image in batch.images]


def captioned(shards, **changes) -> CaptionedImages:
    return CaptionedImages(str(shards), CaptionedConfig(**{"image_size": 16, "per_row": 2} | changes), seed=0)


def test_captions_stay_with_their_pictures_and_rays_are_unknown(shards):
    source = captioned(shards)
    assert isinstance(source, Source)
    seen = []
    for step in range(3):
        source.advance(step)
        batch = source.sequences(range(2), TASK, draws(step))
        assert batch.images.shape == (4, 1, 3, 16, 16) and not batch.rays_known.any() and not batch.rays_truth.any()
        assert [f"number {number}" for number in numbers_of(batch)] == list(batch.captions)
        seen += numbers_of(batch)
    assert set(range(12)) - {8} == set(seen)  # one epoch: each row has a shard of its own


def test_a_damaged_sample_is_named_and_its_neighbour_stands_in(shards, caplog):
    source = captioned(shards, per_row=6)
    with caplog.at_level(logging.WARNING):
        numbers = sorted(numbers_of(source.sequences(range(2), TASK, draws())))
    assert "s008" in caplog.text and "001.tar" in caplog.text and len(numbers) == 12 and 8 not in numbers


def test_a_stream_is_entered_anywhere_as_if_it_had_been_read_from_the_start(shards):
    walked, jumped = captioned(shards), captioned(shards)
    for step in range(12):  # four epochs
        walked.advance(step)
        batch = walked.sequences(range(2), TASK, draws(step))
    jumped.advance(11)
    assert_same(batch, jumped.sequences(range(2), TASK, draws(11)))
    walked.advance(1)  # and back
    jumped.advance(1)
    assert_same(walked.sequences(range(2), TASK, draws(1)), jumped.sequences(range(2), TASK, draws(1)))


def test_two_processes_read_what_one_would(shards):
    whole = captioned(shards).sequences(range(4), TASK, draws())  # fewer shards than rows: samples are split
    parts = [captioned(shards).sequences(range(rank, 4, 2), TASK, draws()) for rank in range(2)]
    assert sorted(numbers_of(whole)) == sorted(numbers_of(parts[0]) + numbers_of(parts[1]))
    assert torch.equal(whole.images[2:4], parts[1].images[:2])
    assert len(set(numbers_of(whole))) == 7  # the damaged one has its neighbour's place


def test_a_shard_that_ends_early_is_named(shards, tmp_path, caplog):
    for name in ("000.tar", "001.tar"):
        content = (shards / name).read_bytes()
        (tmp_path / name).write_bytes(content[: 3000 if name == "001.tar" else len(content)])
    source = captioned(tmp_path)
    with caplog.at_level(logging.WARNING):
        for step in range(4):
            source.advance(step)
            source.sequences(range(2), TASK, draws(step))
    assert "001.tar" in caplog.text
    (tmp_path / "000.tar").write_bytes(b"no tar at all" * 100)
    (tmp_path / "001.tar").unlink()
    with pytest.raises(
        ValueError, match=r"8 shards in a row could not be read, the last being .*000.tar|finds no samples"
    ):
        captioned(tmp_path).sequences(range(1), TASK, draws())


def test_no_shards_are_told(tmp_path):
    with pytest.raises(ValueError, match="expected WebDataset shards"):
        captioned(tmp_path)


# ---- mixtures ----


@pytest.fixture(scope="module")
def rooms() -> RoomPool:
    pool = RoomPool(PoolConfig(rooms=2, views=4, image_size=16, supersample=1), seed=0)
    pool.advance(0)
    return pool


def test_rows_of_a_mixture_come_from_each_source(rooms, tiny_capture):
    both = AnyOf([rooms, CaptureSource([tiny_capture], CaptureConfig(image_size=16))])
    batch = both.sequences(range(8), TASK, draws())
    assert batch.images.shape == (8, 3, 3, 16, 16) and batch.image_latents is None
    assert (batch.image_truth.flatten(1).mean(dim=1) == 1).any() and (
        batch.image_truth.flatten(1).mean(dim=1) < 1
    ).any()
    parts = [both.sequences(range(rank, 8, 2), TASK, draws()) for rank in range(2)]
    assert torch.equal(batch.images[1::2], parts[1].images)


def test_every_second_step_is_single_view_and_takes_the_next_batch(rooms, shards):
    single = captioned(shards)
    source, seen = Alternating(rooms, single, single_share=0.5), []
    for step in range(12):
        source.advance(step)
        batch = source.sequences(range(2), TASK, draws(step))
        seen.append(batch.images.shape[1])
        if batch.captions:
            single_alone = captioned(shards)
            single_alone.advance(step // 2)
            assert_same(batch, single_alone.sequences(range(2), TASK, draws(step)))
    assert seen == [3, 1] * 6


def test_later_steps_have_another_resolution_and_several_sequences_in_a_row(rooms):
    large = RoomPool(PoolConfig(rooms=2, views=4, image_size=32, supersample=1), seed=0)
    source = Later(rooms, SeveralPerRow(large, 2), from_step=5, views=2)
    shapes = []
    for step in (4, 5):
        source.advance(step)
        shapes.append(tuple(source.sequences(range(2), TASK, draws(step)).images.shape))
    assert shapes == [(2, 3, 3, 16, 16), (4, 2, 3, 32, 32)]


def test_named_folders_replace_rooms(tiny_capture, meshes):
    pool = PoolConfig(rooms=2, views=4, image_size=16, supersample=1)
    assert isinstance(multi_view_source(TrainingData(), pool, seed=0), RoomPool)
    assert isinstance(multi_view_source(TrainingData(captures=tiny_capture), pool, seed=0), CaptureSource)
    assert (
        len(multi_view_source(TrainingData(captures=tiny_capture, meshes=meshes, rooms=True), pool, seed=0).sources)
        == 3
    )


def test_resolutions_have_equal_odds():
    from method_configs.presets import PAPER

    drawn = [resolution_of(PAPER.resolutions, seed=0, step=step) for step in range(1000)]
    assert all(drawn.count(one) == 200 for one in PAPER.resolutions)
    assert all(20 < drawn[::5].count(one) < 60 for one in PAPER.resolutions), "in a random order"
    assert drawn != [resolution_of(PAPER.resolutions, seed=1, step=step) for step in range(1000)]


RESOLUTIONS = (
    Resolution(image_size=16, views=3, sequences=2, images=4),
    Resolution(image_size=32, views=2, images=4),
    Resolution(image_size=48, views=1, images=4),
)


def resolved_source(shards=None) -> Source:
    pool = PoolConfig(rooms=4, views=4, image_size=32, supersample=1, renewed_per_step=0.5)
    data = TrainingData(images=None if shards is None else str(shards))
    share = 0.0 if shards is None else 0.5
    first = multi_view_source(data, pool, seed=3)
    wanted = Wanted(data=data, pool=pool, single_share=share, seed=3)
    return at_resolutions(first, RESOLUTIONS, wanted, from_step=2)


@pytest.mark.parametrize("singles", [False, True])
def test_any_number_of_processes_sees_the_same_resolutions_and_rows(shards, singles):
    """A step's size is a function of (seed, step), whoever asks for which rows, and wherever a training is resumed."""
    batch, sizes = 4, []
    alone = resolved_source(shards if singles else None)
    shared = {w: [resolved_source(shards if singles else None) for _ in range(w)] for w in (2, 4)}
    for step in range(9):
        alone.advance(step, range(batch))
        whole = alone.sequences(range(batch), TASK, draws(step))
        sizes.append(whole.images.shape[-1])
        each = len(whole.images) // batch
        for count, sources in shared.items():
            for rank, source in enumerate(sources):
                rows = range(rank, batch, count)
                source.advance(step, rows)
                part = source.sequences(rows, TASK, draws(step))
                mine = [row * each + k for row in rows for k in range(each)]
                assert torch.equal(part.images, whole.images[mine]) and torch.equal(part.raymaps, whole.raymaps[mine])
                assert torch.equal(part.image_known, whole.image_known[mine])
    assert sizes[:2] == [32, 32] and sorted(sizes[2:5]) == sorted(sizes[5:8]) == [16, 32, 48]
    resumed = resolved_source(shards if singles else None)
    resumed.advance(8, range(batch))
    assert_same(resumed.sequences(range(batch), TASK, draws(8)), whole)


def test_all_three_stages_learn_from_captures_and_captioned_pictures(tiny_capture, shards, tmp_path):
    """Adversarial autoencoders, then a transformer that changes its resolution on the way and ends in a model
    folder.
    """
    from fb_core.networks.transformer.dit import DiTConfig
    from fb_core.networks.vae import VAEConfig
    from fb_core.training.recipe import STAGES, Recipe, export, run_stage
    from fb_core.training.run.options import LoopConfig
    from fb_core.training.stages.dit_stage import DiTLossConfig
    from fb_core.training.stages.vae_stage import VAELossConfig

    small = {"widths": (8, 8, 8, 8), "encoder_resnets": 1, "decoder_resnets": 1, "norm": "none"}
    loop, loss = (
        LoopConfig(steps=3, save_every=3, warmup_steps=1),
        VAELossConfig(batch=2, adversarial=0.5, adversarial_from=1),
    )
    pool = PoolConfig(rooms=2, views=4, image_size=32, supersample=1)
    recipe = Recipe(
        name="own", image_vae=VAEConfig(**small), raymap_vae=VAEConfig(in_channels=6, **small), pool=pool,
        vae_pool=pool,
        dit=DiTConfig(heads=1, head_dim=16, depth=1, text_width=0), image_vae_loop=loop, raymap_vae_loop=loop,
        dit_loop=LoopConfig(steps=4, save_every=4, warmup_steps=1), image_vae_loss=loss, raymap_vae_loss=loss,
        dit_loss=DiTLossConfig(batch=2, images_per_row=2, task=dataclasses.replace(TASK, views=2)),
        single_view_share=0.5,
        resolutions=(Resolution(image_size=16, views=3, sequences=2, images=4),), resolutions_from=2,
        data=TrainingData(captures=tiny_capture, images=str(shards)),
    )  # fmt: skip
    runs = [run_stage(recipe, stage, tmp_path) for stage in STAGES]
    assert [run.step for run in runs] == [3, 3, 4] and all(
        np.isfinite(list(run.smoothed.values())).all() for run in runs
    )
    assert set(runs[0].smoothed) == {"loss", "l1", "kl", "critic", "adversarial"}
    export(recipe, tmp_path, tmp_path / "model")
    assert (tmp_path / "model/config.json").is_file()
