"""What every design of the transformer is asked: unseen rooms, half of whose views it has to generate, encoded once for
all designs.

Networks are called as in training, so designs that are no part of the product (`stages`) are measured like the others.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import Conditioning, decode_in_chunks, encode_in_chunks, encode_known, join, split, unsplit
from fb_core.data.rooms.room import require_family
from fb_core.evaluation.ablations import interval
from fb_core.evaluation.completion import edge_energy, unseen_room
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.flow import at_time, velocity
from fb_core.geometry.carry_over import BELIEF_BY_DIRECTION, carried_over
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of, to_unit_range
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.transformer.embeddings import index_positions
from fb_core.networks.vae import VAE
from fb_core.sampling import integrate, time_grid

_AT_ONCE = 8  # rooms
_SHIFT = 2.0  # of the times of a sample, as in rooms-tiny


@dataclass(frozen=True, kw_only=True)
class DesignTask:
    """What every design is asked."""

    rooms: int = 30
    """Unseen rooms."""
    views: int = 8
    """Views per room."""
    known: int = 4
    """How many of them are given."""
    times: int = 10
    """Equally spaced times of the validation loss."""
    steps: int = 8
    """Steps of a sample."""
    family: str = "narrow"
    """Room family."""
    seed: int = 0
    """Decides rooms, cameras and samples."""

    def __post_init__(self) -> None:
        if not 1 <= self.known < self.views or min(self.rooms, self.times, self.steps) < 1:
            raise ValueError(f"designs: expected 1 <= known < views, and at least one room, time and step, got {self}")
        require_family(self.family)


class AskedRooms(NamedTuple):
    """Unseen rooms, as a network sees them."""

    data: Float[Tensor, "b n 32 h w"]
    """Clean latents, those of known views first."""
    conditioning: Conditioning
    """The known views and all rays."""
    guessed: Conditioning
    """The same with what is carried over by direction told as a guess."""
    noise: Float[Tensor, "b n 32 h w"]
    """Where samples start."""
    hidden: Float[Tensor, "b m 3 hp wp"]
    """The truth of the unknown views."""


@torch.no_grad()
def asked_rooms(task: DesignTask, *, image_vae: VAE, raymap_vae: VAE, size: int, patch: int) -> AskedRooms:
    """Render and encode the rooms, with ray frames for tokens of ``patch`` latents."""
    framed = DiTConfig(patch=patch, text_width=0, ray_frames=True)
    parts = []
    for number in range(task.rooms):
        room = unseen_room(family=task.family, seed=task.seed, number=number, views=task.views, size=size)
        given, hidden = room[: task.known], room[task.known :]
        known = torch.zeros_like(room.images[:, :1])
        known[: task.known] = 1
        rays = to_unit_range(CanonicalFrame.of(room.cameras).apply(raymaps_of(room.cameras)))
        carried = carried_over(given.images, known[: task.known], raymaps_of(given.cameras), raymaps_of(hidden.cameras))
        guess, belief = torch.zeros_like(room.images), torch.zeros_like(known)
        guess[task.known :], belief[task.known :] = carried.images, BELIEF_BY_DIRECTION * carried.there
        sequence = room.images, known, rays, torch.ones_like(known)
        vaes = {"image_vae": image_vae, "raymap_vae": raymap_vae, "transformer": framed}
        latents = unsplit(
            encode_in_chunks(image_vae, room.images, task.views), encode_in_chunks(raymap_vae, rays, task.views)
        )
        parts.append(
            (
                latents,
                encode_known(*sequence, **vaes),
                encode_known(*sequence, **vaes, guess=(guess, belief)),
                hidden.images,
            )
        )
    latents, plain, guessed, hidden = zip(*parts, strict=True)
    data = torch.stack(latents)
    noise = torch.randn(data.shape, generator=torch.Generator().manual_seed(task.seed)).to(data)
    return AskedRooms(data, _stacked(plain), _stacked(guessed), noise, torch.stack(hidden))


def _stacked(parts: Sequence[Conditioning]) -> Conditioning:
    frames = [part.frames for part in parts if part.frames is not None]
    return Conditioning(
        channels=torch.stack([part.channels for part in parts]), frames=torch.stack(frames) if frames else None
    )


@torch.no_grad()
def evaluate(
    network: DiT, asked: AskedRooms, task: DesignTask, *, image_vae: VAE, told_guess: bool = False
) -> dict[str, float]:
    """Over the unknown views of all rooms: PSNR (dB) and edge energy of one sample and of one step from noise, and the
    mean squared error of the image latents' velocity over times (``val``). Known latents count nowhere.

    With ``told_guess`` the network is told what is carried over by direction.
    """
    network = network.eval()
    one, many = time_grid(1), time_grid(task.steps, shift=_SHIFT)
    scores: list[dict[str, float]] = []
    for first in range(0, len(asked.data), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        field = _Bound(network, _chosen(asked.guessed if told_guess else asked.conditioning, part))
        data, noise, hidden = asked.data[part], asked.noise[part], asked.hidden[part]
        pictures = {}
        for name, times in (("sample", many), ("one_step", one)):
            latents = split(integrate(field, noise, times))[0][:, task.known :]
            pictures[name] = decode_in_chunks(image_vae, latents.flatten(0, 1)).unflatten(0, latents.shape[:2])
        losses = _losses(field, data, noise, task)
        for room in range(len(data)):
            own: dict[str, float] = {"val": float(losses[room])}
            for name, views in pictures.items():
                own[f"psnr_{name}"] = float(psnr(views[room], hidden[room]).mean())
                own[f"edges_{name}"] = edge_energy(views[room], hidden[room])
            scores.append(own)
    return {name: statistics.fmean(score[name] for score in scores) for name in scores[0]}


class _Bound:
    """A network's velocity with the conditioning bound."""

    def __init__(self, network: DiT, conditioning: Conditioning):
        self._network, self._conditioning = network, conditioning
        count, views = conditioning.channels.shape[:2]
        self._index = index_positions(network.config.index, count, views, device=conditioning.channels.device)
        self._facts = conditioning.facts(network.config)

    def __call__(self, state: Float[Tensor, "b n 32 h w"], time: float) -> Float[Tensor, "b n 32 h w"]:
        times = state.new_full((len(state),), time)
        return self._network(join(state, self._conditioning), times, None, self._index, self._facts)


def _chosen(conditioning: Conditioning, part: slice) -> Conditioning:
    frames = None if conditioning.frames is None else conditioning.frames[part]
    return Conditioning(channels=conditioning.channels[part], frames=frames)


def _losses(
    field: _Bound, data: Float[Tensor, "b n 32 h w"], noise: Float[Tensor, "b n 32 h w"], task: DesignTask
) -> Float[Tensor, "b"]:
    """Error of the unknown image latents' velocity, room by room."""
    wanted, total = velocity(data, noise), torch.zeros(len(data))
    for time in torch.linspace(1.0, 1.0 / task.times, task.times).tolist():
        error = field(at_time(data, noise, data.new_full((len(data),), time)), time) - wanted
        total += split(error)[0][:, task.known :].square().flatten(1).mean(dim=1)
    return total / task.times


def beside(values: Sequence[float], base: Sequence[float]) -> tuple[float, float]:
    """Mean difference to the base, training by training of the same seed, and how sure it is: from three trainings on
    half the width of its 95 % interval (Student's t), of two half of their distance, of one nan.
    """
    gains = [value - other for value, other in zip(values, base, strict=True)]
    if len(gains) == 2:
        return statistics.fmean(gains), abs(gains[0] - gains[1]) / 2
    return interval(gains)
