"""Guesses as conditioning: views that are to be generated come with pixels carried over from known ones, told with a
mask between 0 and 1.

At inference a guess is the splats' render, or pixels carried over by direction. In training it is made of the
sequence's own known views: by direction, or by the true distance with the errors that splats make: surfaces that lie
wrong, scaled scenes, holes, floaters, blur. The mask says how far to believe a guess, see `BELIEF_BY_DIRECTION` and
`BELIEF_OF_RENDERS`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.data.training.task import Draw, Sequences, TaskConfig
from fb_core.geometry.carry_over import BELIEF_BY_DIRECTION, BELIEF_OF_RENDERS, SAME_SURFACE, Carried, carried_over

_JITTER = 0.1
_WORST_DEPTH = 0.12  # relative, of the waves by which surfaces lie wrong
_WORST_SCALE = 0.08
_MOST_FLOATERS = 4


class Guess(NamedTuple):
    """What unknown views of b sequences are guessed to show."""

    images: Float[Tensor, "b n 3 h w"]
    """Colours in [0, 1]; 0 where there is no guess."""
    belief: Float[Tensor, "b n 1 h w"]
    """How far to believe them, below 1; 0 where there is no guess."""


def guesses_of(sequences: Sequences, rows: range, task: TaskConfig, draw: Draw) -> Guess | None:
    """Guesses of the wholly unknown views with known rays of a batch; None for a task without guesses.

    Rows hold equally many sequences. ``draw`` gives a row's generator.
    """
    if task.guess == 0:
        return None
    images = torch.zeros_like(sequences.images)
    belief = torch.zeros_like(sequences.image_known)
    each = len(images) // len(rows)
    for place, row in enumerate(rows):
        generator = draw(row)
        for number in range(place * each, (place + 1) * each):
            given, wanted = _roles(sequences, number)
            if (
                float(torch.rand((), generator=generator)) >= task.guess
                or not bool(given.any())
                or not bool(wanted.any())
            ):
                continue
            images[number, wanted], belief[number, wanted] = _drawn(sequences, number, given, wanted, task, generator)
    return Guess(images, belief)


def _roles(sequences: Sequences, number: int) -> tuple[Bool[Tensor, "n"], Bool[Tensor, "n"]]:
    """(views that tell colours, views that are to be guessed); of both all rays are known."""
    posed = (sequences.rays_known[number] >= 1).flatten(1).all(dim=1)
    shown = (sequences.image_known[number] > 0).flatten(1)
    return posed & shown.any(dim=1), posed & ~shown.any(dim=1)


def _drawn(
    sequences: Sequences,
    number: int,
    given: Bool[Tensor, "n"],
    wanted: Bool[Tensor, "n"],
    task: TaskConfig,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "m 3 h w"], Float[Tensor, "m 1 h w"]]:
    images, known = sequences.images[number, given], sequences.image_known[number, given]
    raymaps = sequences.raymaps[number, given], sequences.raymaps[number, wanted]
    by_depth = sequences.distance is not None and float(torch.rand((), generator=generator)) < task.guess_by_depth
    middle = BELIEF_OF_RENDERS if by_depth else BELIEF_BY_DIRECTION
    belief = middle + _JITTER * (2 * float(torch.rand((), generator=generator)) - 1)
    if not by_depth:
        guess = carried_over(images, known, *raymaps)
    else:
        assert sequences.distance is not None
        distance = sequences.distance[number, wanted]
        worse = float(torch.rand((), generator=generator)) ** 2  # most splats are nearly right
        wrong = 1 + worse * _WORST_DEPTH * _waves(distance, generator)
        wrong = wrong * (1 + worse * _WORST_SCALE * (2 * float(torch.rand((), generator=generator)) - 1))
        guess = carried_over(
            images, known, *raymaps, distance=distance * wrong, known_distance=sequences.distance[number, given],
            same_surface=SAME_SURFACE + 2 * worse * _WORST_DEPTH,
        )  # fmt: skip
        guess = _as_splats_err(guess, worse, generator)
    return guess.images, belief * guess.there


def _waves(like: Float[Tensor, "m 1 h w"], generator: torch.Generator, cells: int = 4) -> Float[Tensor, "m 1 h w"]:
    """Smooth noise, about unit normal, that changes over a ``cells``-th of a picture."""
    coarse = torch.randn(len(like), 1, cells, cells, generator=generator).to(like)
    return F.interpolate(coarse, size=like.shape[-2:], mode="bicubic", align_corners=True)


def _as_splats_err(guess: Carried, worse: float, generator: torch.Generator) -> Carried:
    """Blur, floaters and holes."""
    images, there = guess
    if float(torch.rand((), generator=generator)) < 0.5:  # a few splats stand for many pixels
        weight = F.avg_pool2d(there, 3, stride=1, padding=1)
        images = F.avg_pool2d(images, 3, stride=1, padding=1) / weight.clamp(min=1e-3) * there
    height, width = images.shape[-2:]
    y, x = torch.meshgrid(torch.linspace(0, 1, height), torch.linspace(0, 1, width), indexing="ij")
    x, y = x.to(images), y.to(images)
    for view in range(len(images)):
        for _ in range(int(torch.randint(_MOST_FLOATERS + 1, (), generator=generator) * worse + 0.5)):
            left, top, size, narrow, turn = torch.rand(5, generator=generator).tolist()
            across, down = x - left, y - top
            cosine, sine = math.cos(2 * math.pi * turn), math.sin(2 * math.pi * turn)
            radius = 0.03 + 0.12 * size
            inside = ((across * cosine + down * sine) / radius) ** 2 + (
                (down * cosine - across * sine) / (radius * (0.2 + narrow))
            ) ** 2
            colour = images[view].flatten(1)[:, int(torch.randint(height * width, (), generator=generator))]
            images[view] = torch.where(inside < 1, colour[:, None, None], images[view])
            there[view] = torch.where(inside < 1, torch.ones_like(inside), there[view])
    threshold = 1.0 + 1.5 * torch.rand(len(images), generator=generator).to(images)[:, None, None, None]
    there = there * (_waves(there, generator) < threshold)
    return Carried(images * there, there)
