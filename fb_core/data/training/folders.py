"""Which data a training reads: the folders that a person names, put together as the recipe wants them."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass

import torch

from fb_core.data.meshes.mesh_views import MeshConfig, MeshPool, find_meshes
from fb_core.data.training.captioned_images import CaptionedConfig, CaptionedImages
from fb_core.data.training.capture_sequences import CaptureConfig, CaptureSource, find_captures
from fb_core.data.training.mixed_sources import Alternating, AnyOf, InTurn, Later, SeveralPerRow, turn
from fb_core.data.training.named_data import TrainingData
from fb_core.data.training.sequences import Encode, PoolConfig, RoomPool
from fb_core.data.training.task import Source
from fb_core.sampling.randomness import mixed

_logger = logging.getLogger(__name__)
_SOURCES = 101  # streams of a seed that the choice of resolutions does not share


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """What a step does at one image size (paper, appendix "Hyperparameters")."""

    image_size: int
    """Side of the views in pixels."""
    views: int
    """Views per sequence."""
    sequences: int = 1
    """Sequences in a row of the batch."""
    images: int = 1
    """Captioned pictures in a row of the batch."""


def multi_view_source(
    data: TrainingData,
    pool: PoolConfig,
    *,
    seed: int,
    device: torch.device | str = "cpu",
    encode: Encode | None = None,
    with_images: bool = True,
) -> Source:
    """Rooms, or the captures and meshes that were named. Raises ValueError for a folder that holds none."""
    sources: list[Source] = []
    if data.captures is not None:
        sources.append(
            CaptureSource(find_captures(data.captures), CaptureConfig(image_size=pool.image_size), device=device)
        )
    if data.meshes is not None:
        config = MeshConfig(image_size=pool.image_size, supersample=pool.supersample)
        sources.append(
            MeshPool(find_meshes(data.meshes), config, seed=seed, device=device, encode=encode, with_images=with_images)
        )
    if data.rooms or not sources:
        sources.append(RoomPool(pool, seed=seed, device=device, encode=encode, with_images=with_images))
    return sources[0] if len(sources) == 1 else AnyOf(sources)


def training_source(
    data: TrainingData,
    pool: PoolConfig,
    *,
    single_share: float,
    per_row: int,
    seed: int,
    device: torch.device | str = "cpu",
    encode: Encode | None = None,
) -> Source:
    """Multi-view data, with steps of captioned pictures among them where there are some and the recipe wants them."""
    source = multi_view_source(data, pool, seed=seed, device=device, encode=encode)
    if not single_share:
        return source
    if data.images is None:
        _logger.warning(
            "no captioned pictures were named: every step is multi-view (the recipe wants %g %% of them single)",
            100 * single_share,
        )
        return source
    config = CaptionedConfig(image_size=pool.image_size, per_row=per_row)
    return Alternating(
        source, CaptionedImages(data.images, config, seed=seed, device=device), single_share=single_share
    )


def resolution_of(resolutions: tuple[Resolution, ...], *, seed: int, step: int) -> Resolution:
    """The resolution of a step, counted from where they begin; each has the same odds (paper).

    The paper assigns one to each process. Then what is learned depends on how many processes there are, and the largest
    pictures are waited for by all; so here all processes do a step at one size.
    """
    return resolutions[turn(len(resolutions), seed=mixed(seed, _SOURCES), step=step)[0]]


def at_resolutions(
    first: Source,
    resolutions: tuple[Resolution, ...],
    from_step: int,
    data: TrainingData,
    pool: PoolConfig,
    *,
    single_share: float,
    seed: int,
    device: torch.device | str = "cpu",
    encode: Encode | None = None,
) -> Source:
    """``first`` until a step, from then on the same data at the resolution of each step (:func:`resolution_of`)."""
    shared = {"single_share": single_share, "seed": seed, "device": device, "encode": encode}
    sources = [
        _at_resolution(one, data, pool, among=len(resolutions), number=number, **shared)  # type: ignore[arg-type]
        for number, one in enumerate(resolutions)
    ]
    then = InTurn(sources, views=[one.views for one in resolutions], seed=mixed(seed, _SOURCES))
    return Later(first, then, from_step=from_step)


def _at_resolution(
    resolution: Resolution,
    data: TrainingData,
    pool: PoolConfig,
    *,
    among: int,
    number: int,
    single_share: float,
    seed: int,
    device: torch.device | str,
    encode: Encode | None,
) -> Source:
    """The data at one of ``among`` resolutions; pools of all together hold as many pixels as the one that they
    follow.
    """
    smaller = max(8, round(pool.rooms * (pool.image_size / resolution.image_size) ** 2 / among))
    size, rooms = resolution.image_size, min(pool.rooms, smaller)
    pool = dataclasses.replace(pool, image_size=size, rooms=rooms, views=max(pool.views, resolution.views))
    then = multi_view_source(data, pool, seed=seed, device=device, encode=encode)
    if resolution.sequences > 1:
        then = SeveralPerRow(then, resolution.sequences)
    if single_share and data.images is not None:
        single = CaptionedImages(
            data.images,
            CaptionedConfig(image_size=size, per_row=resolution.images),
            seed=mixed(seed, _SOURCES, number),
            device=device,
        )
        then = Alternating(then, single, single_share=single_share)
    return then
