"""Training sequences from scenes that are rendered while training goes on: a pool that is renewed, and the pool of
procedural rooms.

Everything is a function of (seed, step, row): the scenes that are in the pool, the views of each sequence, masks and
frames. Processes that share a batch each draw rows of their own, ``range(part, batch, parts)``, and render only the
scenes that these rows can draw from.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.rooms.ray_caster import render_batch
from fb_core.data.rooms.room import FAMILIES, make_room
from fb_core.data.rooms.room_cameras import training_cameras
from fb_core.data.training.task import Draw, Sequences, TaskConfig, draw_task, stacked, task_order, training_frame
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of

Encode = Callable[[Float[Tensor, "n 3 h w"]], Float[Tensor, "n 16 lh lw"]]
"""The image autoencoder's encoder."""

_SCENES_AT_ONCE = 8  # rendered together


@dataclass(frozen=True, kw_only=True)
class PoolConfig:
    """Which rooms are rendered, and how many stay at hand."""

    families: tuple[str, ...] = ("narrow",)
    """The curriculum: room families that follow one another, or take turns."""
    take_turns: bool = False
    """Every room is of another family than the one before it, instead of ``family_rooms`` of each."""
    family_rooms: int = 10_000
    """Rooms of one family before the next one begins."""
    rooms: int = 400
    """Rooms in the pool."""
    views: int = 20
    """Views per room."""
    image_size: int = 64
    """Side of the square views in pixels."""
    renewed_per_step: float = 0.25
    """Rooms replaced per training step."""
    supersample: int = 2
    """Rays per pixel side."""

    def __post_init__(self) -> None:
        unknown = [family for family in self.families if family not in FAMILIES]
        if unknown or not self.families:
            raise ValueError(f"room families: expected some of {sorted(FAMILIES)}, got {list(self.families)}")
        if self.image_size % 16 or self.image_size < 16:
            raise ValueError(f"image size: expected a multiple of 16 of at least 16, got {self.image_size}")


class RenderedScene(NamedTuple):
    """A rendered scene of v views."""

    cameras: Pinholes
    images: Float[Tensor, "v 3 h w"] | None = None
    """What they see; None without images."""
    distance: Float[Tensor, "v 1 h w"] | None = None
    """How far along each pixel's ray that is, in scene units, where the pool knows it."""


@dataclass(frozen=True, kw_only=True)
class PoolSize:
    """How much a pool holds."""

    scenes: int
    """At hand."""
    views: int
    """Of each scene."""
    image_size: int
    """Side of the square views in pixels."""
    renewed_per_step: float
    """Scenes replaced per training step."""


class ViewPool(ABC):
    """Rendered scenes of some square views each, renewed step by step."""

    def __init__(
        self,
        size: PoolSize,
        *,
        device: torch.device | str = "cpu",
        encode: Encode | None = None,
        with_images: bool = True,
        with_distance: bool = False,
    ):
        """With ``encode`` (the frozen image autoencoder) the latents of every view are kept, so that they are made
        once.

        Without images (black ones stand in) nothing is rendered: enough for the raymap autoencoder. ``with_distance``
        is for pools that give the distances of what is seen.
        """
        self.scenes, self.views, self.image_size = scenes, views, image_size = size.scenes, size.views, size.image_size
        self.renewed_per_step = size.renewed_per_step
        self.with_images, self.device, self._encode = with_images, torch.device(device), encode
        self._latents: list[Tensor | None] = [None] * scenes
        self._images = torch.zeros((scenes, views, 3, image_size, image_size), dtype=torch.uint8, device=self.device)
        shape = (scenes, views, 1, image_size, image_size)
        self._distance = (
            torch.zeros(shape, dtype=torch.float16, device=self.device) if with_distance and with_images else None
        )
        self._cameras: list[Pinholes | None] = [None] * scenes
        self._ids = [-1] * scenes

    @abstractmethod
    def render(self, numbers: list[int]) -> list[RenderedScene]:
        """Some scenes, counted from the beginning of the training."""

    def slots(self, row: int, batch: int) -> range:
        """Places in the pool that row ``row`` of a batch draws from: every g-th, g being the greatest common divisor of
        batch and scenes.

        So n processes that share a batch render an n-th of the scenes each (where n divides g), and draw what one alone
        would draw.
        """
        stride = math.gcd(self.scenes, batch)
        return range(row % stride, self.scenes, stride)

    def advance(self, step: int, rows: range | None = None) -> None:
        """Bring the pool to its state at ``step``: scenes number [k, k + scenes) with k = floor(step *
        renewed_per_step).

        With ``rows`` only those that these rows draw from.
        """
        first = math.floor(step * self.renewed_per_step)
        todo = [scene for scene in range(first, first + self.scenes) if self._ids[scene % self.scenes] != scene]
        if rows is not None:
            stride = math.gcd(self.scenes, rows.stop)
            mine = {row % stride for row in rows}
            todo = [scene for scene in todo if scene % self.scenes % stride in mine]
        for start in range(0, len(todo), _SCENES_AT_ONCE):
            numbers = todo[start : start + _SCENES_AT_ONCE]
            for number, (cameras, images, distance) in zip(numbers, self.render(numbers), strict=True):
                self._keep(number, cameras, images)
                if self._distance is not None and distance is not None:
                    self._distance[number % self.scenes] = distance.to(self._distance)

    def _keep(self, number: int, cameras: Pinholes, images: Tensor | None) -> None:
        slot = number % self.scenes
        self._cameras[slot], self._ids[slot] = cameras, number
        if images is not None:
            self._images[slot] = (images.clamp(0, 1) * 255).round().to(torch.uint8)
            if self._encode is not None:
                self._latents[slot] = self._encode(self._images[slot].float() / 255)

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """A random view for each of these rows of a batch, for the image autoencoder."""
        return torch.stack([self._image(self.slots(row, rows.stop), draw(row)) for row in rows])

    def _image(self, slots: range, generator: torch.Generator) -> Float[Tensor, "3 h w"]:
        slot = slots[int(torch.randint(len(slots), (), generator=generator))]
        return self._images[slot, int(torch.randint(self.views, (), generator=generator))].float() / 255

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """A random view's raymap for each of these rows of a batch, in the frame of the sequence that the view would be
        part of.
        """
        return torch.stack(
            [self._frame(task, self.slots(row, rows.stop), draw(row)).raymaps(row % task.views) for row in rows]
        )

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """Training sequences for these rows of a batch."""
        return stacked([self._sequence(task, self.slots(row, rows.stop), draw(row)) for row in rows])

    def _frame(self, task: TaskConfig, slots: range, generator: torch.Generator) -> _Framed:
        slot = slots[int(torch.randint(len(slots), (), generator=generator))]
        chosen = torch.randperm(self.views, generator=generator)[: task.views]
        cameras = self._cameras[slot]
        assert cameras is not None, "advance() renders the pool before sequences are drawn"
        chosen = chosen[task_order(cameras[chosen], task, generator=generator)]
        cameras = cameras[chosen].to(self.device)
        frame = training_frame(cameras, task, generator=generator)
        return _Framed(slot, chosen.to(self.device), cameras, frame)

    def _sequence(self, task: TaskConfig, slots: range, generator: torch.Generator) -> dict[str, Tensor]:
        framed = self._frame(task, slots, generator)
        slot, chosen = framed.slot, framed.chosen
        image_known, rays_known = draw_task(len(chosen), self.image_size, task, generator=generator, device=self.device)
        latents = self._latents[slot]
        extras = {} if latents is None else {"image_latents": latents[chosen]}
        if self._distance is not None:
            extras["distance"] = self._distance[slot, chosen].float() / framed.frame.scale
        return extras | {
            "images": self._images[slot, chosen].float() / 255,
            "raymaps": framed.raymaps(),
            "image_known": image_known,
            "rays_known": rays_known,
        }


class _Framed(NamedTuple):
    """Views of one scene in a canonical frame."""

    slot: int
    chosen: Tensor
    cameras: Pinholes
    frame: CanonicalFrame

    def raymaps(self, view: int | None = None) -> Tensor:
        """[n, 6, h, w] of all views, or [6, h, w] of one."""
        return (
            self.frame.apply(raymaps_of(self.cameras))
            if view is None
            else self.frame.apply(raymaps_of(self.cameras[[view]]))[0]
        )


class RoomPool(ViewPool):
    """Procedural rooms, rendered on the training's device."""

    def __init__(
        self,
        config: PoolConfig,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        encode: Encode | None = None,
        with_images: bool = True,
    ):
        size = PoolSize(
            scenes=config.rooms,
            views=config.views,
            image_size=config.image_size,
            renewed_per_step=config.renewed_per_step,
        )
        super().__init__(size, device=device, encode=encode, with_images=with_images, with_distance=encode is not None)
        self.config, self.seed = config, seed

    def render(self, numbers: list[int]) -> list[RenderedScene]:
        """Rooms of the families that the curriculum has for these numbers."""
        config = self.config
        rooms, cameras = [], []
        for number in numbers:
            turn = (
                number % len(config.families)
                if config.take_turns
                else min(number // config.family_rooms, len(config.families) - 1)
            )
            family = config.families[turn]
            room = make_room(self.seed * 1_000_003 + number, FAMILIES[family])
            generator = torch.Generator().manual_seed(self.seed * 7_000_003 + number)
            cameras.append(training_cameras(room, config.views, size=config.image_size, generator=generator))
            rooms.append(room.to(self.device))
        if not self.with_images:
            return [RenderedScene(group) for group in cameras]
        rendered = render_batch(rooms, [group.to(self.device) for group in cameras], supersample=config.supersample)
        return [
            RenderedScene(group, images.rgb, _distances(group, images.depth))
            for group, images in zip(cameras, rendered, strict=True)
        ]


def _distances(cameras: Pinholes, depth: Float[Tensor, "v h w"]) -> Float[Tensor, "v 1 h w"]:
    """Distances along the rays from z-depth."""
    return (depth / cameras.cosines().to(depth))[:, None]
