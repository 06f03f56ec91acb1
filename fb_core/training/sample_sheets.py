"""Looks at a training from outside: what the averaged weights make of unseen rooms, as a sheet and as numbers.

Nothing is drawn here that the training draws.
"""

from __future__ import annotations

import importlib.util
import logging
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from fb_core.checkpoint import Loaded, ModelConfig
from fb_core.conditioning import encode_in_chunks
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of, to_unit_range
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.masks import training_mixture
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.training.run.loop import OnSheet

if TYPE_CHECKING:
    from fb_core.evaluation.completion import RoomViews

_logger = logging.getLogger(__name__)
_DPI = 80
_Network = TypeVar("_Network", DiT, VAE)
_VALIDATED_ROOMS = 4


@dataclass(frozen=True, kw_only=True)
class UnseenRooms:
    """Rooms that no training sees."""

    family: str
    """Of rooms."""
    views: int
    """Of each room."""
    size: int
    """Side of the views in pixels."""

    def room(self, number: int) -> RoomViews:
        """One of them, the same every time."""
        from fb_core.evaluation.completion import unseen_room

        return unseen_room(family=self.family, seed=0, number=number, views=self.views, size=self.size)


def room_sheet(
    config: DiTConfig,
    unseen: UnseenRooms,
    *,
    image_vae: VAE,
    raymap_vae: VAE,
    sampling: SamplingConfig,
    device: torch.device,
) -> OnSheet:
    """Sheets of the transformer: the second half of an unseen room's views, completed from the first half.

    The number is ``val``, the validation loss of the paper's table 2, over four unseen rooms.
    """

    @cache
    def unseen_rooms() -> list[RoomViews]:
        return [unseen.room(number) for number in range(_VALIDATED_ROOMS)]

    def draw(path: Path, state: dict[str, Tensor]) -> dict[str, float]:
        from fb_core.evaluation.ablations import conditional_validation_loss
        from fb_core.evaluation.completion import complete_hidden

        architecture = ModelConfig(transformer=config, image_vae=image_vae.config, raymap_vae=raymap_vae.config)
        dit = _with_weights(DiT(config), state, device)
        model = Fillerbuster(Loaded(dit=dit, image_vae=image_vae, raymap_vae=raymap_vae, config=architecture))
        rooms, views, size = unseen_rooms(), unseen.views, unseen.size
        masks = training_mixture(views, size, size, generator=torch.Generator().manual_seed(0), in_order=True)
        losses = [conditional_validation_loss(model, each, masks, seed=number) for number, each in enumerate(rooms)]
        room, known = rooms[0], max(1, views // 2)
        given, hidden = room[:known], room[known:]
        completed = complete_hidden(model, given, hidden.cameras, sampling, seed=0)
        _write(path, {"Known": given.images, "Generated": completed, "Truth": hidden.images})
        return {"val": sum(losses) / len(losses)}

    return draw


def reconstruction_sheet(config: VAEConfig, unseen: UnseenRooms, *, device: torch.device) -> OnSheet:
    """Sheets of an autoencoder: an unseen room's views (or the directions of their rays) before and after;
    ``mean_error`` is over them.
    """

    def draw(path: Path, state: dict[str, Tensor]) -> dict[str, float]:
        network = _with_weights(VAE(config), state, device)
        room = unseen.room(0)
        is_image = config.in_channels == 3
        values = (
            room.images if is_image else to_unit_range(CanonicalFrame.of(room.cameras).apply(raymaps_of(room.cameras)))
        )
        with torch.no_grad():
            decoded = network.decode(encode_in_chunks(network, values.to(device), 16)).to(values)
        rows = {"Truth": values, "Reconstructed": decoded}
        _write(path, rows if is_image else {f"{name} directions": value[:, 3:] for name, value in rows.items()})
        return {"mean_error": float((decoded - values).abs().mean())}

    return draw


def _with_weights(network: _Network, state: dict[str, Tensor], device: torch.device) -> _Network:
    network.load_state_dict(state)
    return network.to(device).eval().requires_grad_(False)


def _write(path: Path, rows: dict[str, Tensor]) -> None:
    """One strip of pictures per row; where matplotlib is missing, a line in the log instead."""
    if importlib.util.find_spec("matplotlib") is None:
        _logger.info("no %s, because matplotlib is not installed", path.name)
        return
    from fb_core.evaluation.figures.contact_sheet import Strip, write_contact_sheet

    strips = [Strip(heading=heading, pictures=list(pictures)) for heading, pictures in rows.items()]
    write_contact_sheet(
        path, strips, title=f"Step {int(path.stem)}", subtitle="an unseen room, by the averaged weights", dpi=_DPI
    )
