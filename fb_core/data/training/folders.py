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


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What a training wants of its data, at every size."""

    data: TrainingData
    """Where they lie."""
    pool: PoolConfig
    """Which rooms are rendered."""
    single_share: float = 0.0
    """Share of the steps that are of captioned pictures."""
    seed: int
    """Decides every draw."""
    device: torch.device | str = "cpu"
    """Where data are made."""
    encode: Encode | None = None
    """The frozen image autoencoder, where latents of rendered views are kept."""

    def multi_view(self) -> Source:
        """The multi-view data (:func:`multi_view_source`)."""
        return multi_view_source(self.data, self.pool, seed=self.seed, device=self.device, encode=self.encode)


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


def training_source(wanted: Wanted, *, per_row: int) -> Source:
    """Multi-view data, with steps of captioned pictures among them where there are some and the recipe wants them, so
    many in a row of the batch.
    """
    source, single_share = wanted.multi_view(), wanted.single_share
    if not single_share:
        return source
    if wanted.data.images is None:
        _logger.warning(
            "no captioned pictures were named: every step is multi-view (the recipe wants %g %% of them single)",
            100 * single_share,
        )
        return source
    config = CaptionedConfig(image_size=wanted.pool.image_size, per_row=per_row)
    pictures = CaptionedImages(wanted.data.images, config, seed=wanted.seed, device=wanted.device)
    return Alternating(source, pictures, single_share=single_share)


def resolution_of(resolutions: tuple[Resolution, ...], *, seed: int, step: int) -> Resolution:
    """The resolution of a step, counted from where they begin; each has the same odds (paper).

    The paper assigns one to each process. Then what is learned depends on how many processes there are, and the largest
    pictures are waited for by all; so here all processes do a step at one size.
    """
    return resolutions[turn(len(resolutions), seed=mixed(seed, _SOURCES), step=step)[0]]


def at_resolutions(first: Source, resolutions: tuple[Resolution, ...], wanted: Wanted, *, from_step: int) -> Source:
    """``first`` until a step, from then on the same data at the resolution of each step (:func:`resolution_of`)."""
    sources = [
        _at_resolution(one, wanted, among=len(resolutions), number=number) for number, one in enumerate(resolutions)
    ]
    then = InTurn(sources, views=[one.views for one in resolutions], seed=mixed(wanted.seed, _SOURCES))
    return Later(first, then, from_step=from_step)


def _at_resolution(resolution: Resolution, wanted: Wanted, *, among: int, number: int) -> Source:
    """The data at one of ``among`` resolutions; pools of all together hold as many pixels as the one that they
    follow.
    """
    pool = wanted.pool
    smaller = max(8, round(pool.rooms * (pool.image_size / resolution.image_size) ** 2 / among))
    size, rooms = resolution.image_size, min(pool.rooms, smaller)
    pool = dataclasses.replace(pool, image_size=size, rooms=rooms, views=max(pool.views, resolution.views))
    then = dataclasses.replace(wanted, pool=pool).multi_view()
    if resolution.sequences > 1:
        then = SeveralPerRow(then, resolution.sequences)
    if wanted.single_share and wanted.data.images is not None:
        single = CaptionedImages(
            wanted.data.images,
            CaptionedConfig(image_size=size, per_row=resolution.images),
            seed=mixed(wanted.seed, _SOURCES, number),
            device=wanted.device,
        )
        then = Alternating(then, single, single_share=wanted.single_share)
    return then
