"""Where random numbers come from: every draw depends on (seed, stage, place) alone, never on what was drawn before.

All draws are made on the CPU, so that every device samples the same. Adding a view changes no other view's draws.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.conditioning import STATE_CHANNELS

PARTITIONS, POSTERIORS = -1, -2
"""Stages beside a view's initial noise, whose stage is its place."""

Orders = Callable[[float, int, int], Int[Tensor, "n"]]
"""(time, round, views) -> the order in which views are cut into windows."""


def mixed(seed: int, *places: int) -> int:
    """A seed for one of many independent streams (the finaliser of SplitMix64, once per place)."""
    value = seed
    for place in places:
        value = (value + 0x9E3779B97F4A7C15 * (place + 2)) % 2**64
        value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
        value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) % 2**64
        value = (value ^ (value >> 31)) % 2**63
    return value


def generator_of(seed: int, *places: int) -> torch.Generator:
    """A CPU generator of its own for these places."""
    return torch.Generator().manual_seed(mixed(seed, *places))


def noise_of(seed: int, views: int, latent_size: tuple[int, int]) -> Float[Tensor, "n 32 h w"]:
    """Initial noise on the CPU; a view's noise depends on the seed and its place alone, not on how many views there
    are.
    """
    shape = (STATE_CHANNELS, *latent_size)
    drawn = [torch.randn(shape, generator=generator_of(seed, view), dtype=torch.float32) for view in range(views)]
    return torch.stack(drawn) if drawn else torch.zeros(0, *shape, dtype=torch.float32)


def posterior_generators(seed: int, views: int) -> list[torch.Generator]:
    """One generator per view for samples of the autoencoders' posteriors (first the image's, then the raymap's)."""
    return [generator_of(seed, POSTERIORS, view) for view in range(views)]


def random_orders(seed: int) -> Orders:
    """A random order of the views for every evaluation and round.

    Views are sorted by a random key of their own, so another view more or less leaves the order of the others as it is.
    """

    def order(time: float, number: int, views: int) -> Tensor:
        moment = int.from_bytes(struct.pack("<d", time), "little") >> 2
        evaluation = mixed(seed, PARTITIONS, moment, number)
        return torch.tensor(sorted(range(views), key=lambda view: mixed(evaluation, view)), dtype=torch.long)

    return order


def given_order(time: float, number: int, views: int) -> Int[Tensor, "n"]:
    """The views as they come, in every evaluation."""
    return torch.arange(views)
