"""Training sequences from procedural rooms: a pool of rendered rooms that is renewed while training goes on.

Everything is a function of (seed, step, row): the rooms that are in the pool, the views of each sequence, masks and frames. Processes that
share a batch each draw rows of their own, ``range(part, batch, parts)``, and render only the rooms that these rows can draw from.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.ray_caster import render_batch
from fb_core.data.room_cameras import training_cameras
from fb_core.data.rooms import FAMILIES, make_room
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of
from fb_core.masks import drop_conditioning, partly_known

_ROOMS_AT_ONCE = 8  # rendered together
Draw = Callable[[int], torch.Generator]
"""The generator, on the CPU, of a row of the batch."""


@dataclass(frozen=True, kw_only=True)
class PoolConfig:
    """Which rooms are rendered, and how many stay at hand."""

    families: tuple[str, ...] = ("narrow",)
    """The curriculum: room families that follow one another."""
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


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """A batch of b sequences of n posed views, all in canonical frames."""

    images: Float[Tensor, "b n 3 h w"]
    """RGB in [0, 1]."""
    raymaps: Float[Tensor, "b n 6 h w"]
    """Canonical raymaps: origins in [-1, 1]^3, unit directions."""
    image_known: Float[Tensor, "b n 1 h w"]
    """What the network is told of the images (1 = known)."""
    rays_known: Float[Tensor, "b n 1 h w"]
    """What the network is told of the rays (1 = known)."""
    image_latents: Float[Tensor, "b n 16 lh lw"] | None = None
    """Latents of the whole images where the pool keeps them."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """How views become a training task (paper, appendix "Training recipe")."""

    views: int = 12
    """Views per sequence."""
    known_share: tuple[float, float] = (0.25, 0.75)
    """Range of the share of views whose image is known."""
    partial_share: float = 0.15
    """Odds that a view that would be known or unknown is partly known instead."""
    ray_task: float = 0.25
    """Odds that rays are to be recovered from images instead of images from rays (paper: 0.25)."""
    dropout: float = 0.1
    """Odds that conditioning is dropped: images, rays or both (paper: 0.1)."""
    random_heading: bool = True
    """Turn the canonical frame by a random heading (paper); off, the heading is 0 as in inference."""
    random_fill: bool = True
    """Rescale small scenes at random (paper); off, they fill the cube as in inference."""


class RoomPool:
    """Rendered rooms, renewed step by step."""

    def __init__(
        self,
        config: PoolConfig,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        encode: Callable[[Float[Tensor, "n 3 h w"]], Float[Tensor, "n 16 lh lw"]] | None = None,
        with_images: bool = True,
    ):
        """With ``encode`` (the frozen image autoencoder) the latents of every view are kept, so that they are made once.

        Without images (black ones stand in) nothing is rendered: enough for the raymap autoencoder.
        """
        self._with_images = with_images
        self.config, self.seed, self.device, self._encode = config, seed, torch.device(device), encode
        self._latents: list[Tensor | None] = [None] * config.rooms
        shape = (config.rooms, config.views, 3, config.image_size, config.image_size)
        self._images = torch.zeros(shape, dtype=torch.uint8, device=self.device)
        self._cameras: list[Pinholes | None] = [None] * config.rooms
        self._ids = [-1] * config.rooms

    def slots(self, row: int, batch: int) -> range:
        """Places in the pool that row ``row`` of a batch draws from: every g-th, g being the greatest common divisor of batch and rooms.

        So n processes that share a batch render an n-th of the rooms each (where n divides g), and draw what one alone would draw.
        """
        stride = math.gcd(self.config.rooms, batch)
        return range(row % stride, self.config.rooms, stride)

    def advance(self, step: int, rows: range | None = None, on_room: Callable[[int, int], None] | None = None) -> None:
        """Bring the pool to its state at ``step``: rooms number [k, k + rooms) with k = floor(step * renewed_per_step).

        With ``rows`` only those that these rows draw from.
        """
        first = math.floor(step * self.config.renewed_per_step)
        todo = [room for room in range(first, first + self.config.rooms) if self._ids[room % self.config.rooms] != room]
        if rows is not None:
            stride = math.gcd(self.config.rooms, rows.stop)
            mine = {row % stride for row in rows}
            todo = [room for room in todo if room % self.config.rooms % stride in mine]
        for start in range(0, len(todo), _ROOMS_AT_ONCE):
            self._render(todo[start : start + _ROOMS_AT_ONCE])
            if on_room is not None:
                on_room(min(start + _ROOMS_AT_ONCE, len(todo)), len(todo))

    def _render(self, numbers: list[int]) -> None:
        config = self.config
        rooms, cameras = [], []
        for number in numbers:
            family = config.families[min(number // config.family_rooms, len(config.families) - 1)]
            room = make_room(self.seed * 1_000_003 + number, FAMILIES[family])
            generator = torch.Generator().manual_seed(self.seed * 7_000_003 + number)
            cameras.append(training_cameras(room, config.views, size=config.image_size, generator=generator))
            rooms.append(room.to(self.device))
            self._cameras[number % config.rooms], self._ids[number % config.rooms] = cameras[-1], number
        if not self._with_images:
            return
        rendered = render_batch(rooms, [group.to(self.device) for group in cameras], supersample=config.supersample)
        for number, images in zip(numbers, rendered, strict=True):
            slot = number % config.rooms
            self._images[slot] = (images.rgb.clamp(0, 1) * 255).round().to(torch.uint8)
            if self._encode is not None:
                self._latents[slot] = self._encode(self._images[slot].float() / 255)

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """A random view for each of these rows of a batch, for the image autoencoder."""
        return torch.stack([self._image(self.slots(row, rows.stop), draw(row)) for row in rows])

    def _image(self, slots: range, generator: torch.Generator) -> Float[Tensor, "3 h w"]:
        slot = slots[int(torch.randint(len(slots), (), generator=generator))]
        return self._images[slot, int(torch.randint(self.config.views, (), generator=generator))].float() / 255

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """A random view's raymap for each of these rows of a batch, in the frame of the sequence that the view would be part of."""
        return torch.stack([self._frame(task, self.slots(row, rows.stop), draw(row)).raymaps(row % task.views) for row in rows])

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """Training sequences for these rows of a batch."""
        parts = [self._sequence(task, self.slots(row, rows.stop), draw(row)) for row in rows]
        return Sequences(**{name: torch.stack([part[name] for part in parts]) for name in parts[0]})

    def _frame(self, task: TaskConfig, slots: range, generator: torch.Generator) -> _Framed:
        slot = slots[int(torch.randint(len(slots), (), generator=generator))]
        chosen = torch.randperm(self.config.views, generator=generator)[: task.views]
        cameras = self._cameras[slot]
        assert cameras is not None, "advance() renders the pool before sequences are drawn"
        cameras = cameras[chosen].to(self.device)
        turn, fill = torch.rand(2, generator=generator).tolist()
        frame = CanonicalFrame.of(
            cameras, heading_radians=2 * math.pi * turn if task.random_heading else 0.0, fill=fill if task.random_fill else 1.0
        )
        return _Framed(slot, chosen.to(self.device), cameras, frame)

    def _sequence(self, task: TaskConfig, slots: range, generator: torch.Generator) -> dict[str, Tensor]:
        framed = self._frame(task, slots, generator)
        slot, chosen = framed.slot, framed.chosen
        image_known, rays_known = draw_task(len(chosen), self.config.image_size, task, generator=generator)
        latents = self._latents[slot]
        kept = {} if latents is None else {"image_latents": latents[chosen]}
        return kept | {
            "images": self._images[slot, chosen].float() / 255,
            "raymaps": framed.raymaps(),
            "image_known": image_known.to(self.device),
            "rays_known": rays_known.to(self.device),
        }


class _Framed(NamedTuple):
    """Views of one room in a canonical frame."""

    slot: int
    chosen: Tensor
    cameras: Pinholes
    frame: CanonicalFrame

    def raymaps(self, view: int | None = None) -> Tensor:
        """[n, 6, h, w] of all views, or [6, h, w] of one."""
        return self.frame.apply(raymaps_of(self.cameras)) if view is None else self.frame.apply(raymaps_of(self.cameras[[view]]))[0]


def draw_task(count: int, size: int, task: TaskConfig, *, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """(image mask, ray mask), each [n, 1, size, size]: one modality is to be completed, the other is known, or dropped.

    The first view is the frame's reference; it stays known whenever any view is, as in inference.
    """
    low, high = task.known_share
    share = low + (high - low) * float(torch.rand((), generator=generator))
    known = min(count, max(1, round(share * count)))
    masks = torch.zeros(count, 1, size, size)
    masks[:known] = 1.0
    partial = torch.rand(count, generator=generator) < task.partial_share
    for view in partial.nonzero()[:, 0].tolist():
        masks[view] = partly_known(size, size, generator=generator)
    everything = torch.ones_like(masks)
    is_ray_task = float(torch.rand((), generator=generator)) < task.ray_task
    image_known, rays_known = (everything, masks) if is_ray_task else (masks, everything)
    drop_images, drop_rays = drop_conditioning(generator, share=task.dropout)
    return image_known * (not drop_images), rays_known * (not drop_rays)
