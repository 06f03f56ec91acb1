"""About how long a completion takes on a machine, before it starts: counted products over the rate that the machine
reaches in one.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from functools import lru_cache

import torch

from fb_core.checkpoint import ModelConfig
from fb_core.inpainter import Fillerbuster
from fb_core.machine.resources import usable_cores
from fb_core.memory.budget import GIB, SIDE_MULTIPLE
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.networks.weights import without_weights
from fb_core.sampling.options import SamplingConfig

_OVERHEAD = 2.2  # a step takes so many times what its products alone would take (docs/speed_and_accuracy.md)
_TRIAL_SECONDS = 0.05


@dataclass(frozen=True, kw_only=True)
class SquareSequence:
    """Square views that the model is to complete together."""

    views: int
    """Of the sequence."""
    known: int
    """Views of it that have a picture."""
    side: int
    """Of the views, pixels."""
    recovers_rays: bool = False
    """Whether raymaps are decoded instead of pictures."""


def expected_seconds(model: Fillerbuster, sequence: SquareSequence, sampling: SamplingConfig) -> float:
    """:func:`seconds_of` a model that is loaded; where it stands decides the machine."""
    return seconds_of(model.config, model.device, model.dit.dtype, sequence, sampling)


def seconds_of(
    model: ModelConfig,
    device: torch.device,
    dtype: torch.dtype,
    sequence: SquareSequence,
    sampling: SamplingConfig,
) -> float:
    """Seconds that completing a sequence takes, right within a factor of two or so; no weights are needed to tell.

    Args:
        model: the networks' architecture.
        device: where they run.
        dtype: the transformer's precision.
        sequence: what is completed.
        sampling: steps, window and rounds.
    """
    views = sequence.views
    size = -(-sequence.side // SIDE_MULTIPLE) * SIDE_MULTIPLE
    config = model.transformer
    tokens = (size // (model.image_vae.factor * config.patch)) ** 2
    window = min(sampling.window or views, views)
    passes = sampling.steps * (sampling.rounds * -(-views // window) if window < views else 1)
    branches = 1 if sampling.guidance_known == sampling.guidance_unknown == 1 else 2
    per_token = (
        2 * (4 + 2 * config.mlp_ratio) * config.width**2 + 4 * config.width * tokens * window
    )  # projections; attention
    a_pass = config.depth * per_token * tokens * window
    encoded = views * (coding_flops(model.image_vae, size)[0] + coding_flops(model.raymap_vae, size)[0])
    decoder = model.raymap_vae if sequence.recovers_rays else model.image_vae
    decoded = (views if sequence.recovers_rays else views - sequence.known) * coding_flops(decoder, size)[1]
    rate = _rate(str(device), dtype)
    return _OVERHEAD * (branches * passes * a_pass + encoded + decoded) / rate


def seconds_of_products(products: float, device: str = "cpu") -> float:
    """Seconds of work that takes as long as so many floating-point operations of large products."""
    return products / _rate(device, torch.float32)


def duration_in_words(seconds: float, memory: int | None = None) -> str:
    """What is expected, in round numbers, such as ``about 40 s, up to 0.6 GiB of memory``; without the memory where it
    is not given.
    """
    takes = (
        f"{max(1, seconds):.0f} s"
        if seconds < 90
        else f"{seconds / 60:.0f} min"
        if seconds < 5400
        else f"{seconds / 3600:.1f} h"
    )
    return f"about {takes}" + ("" if memory is None else f", up to {max(memory / GIB, 0.1):.1f} GiB of memory")


@lru_cache(maxsize=8)
@torch.no_grad()
def coding_flops(config: VAEConfig, size: int) -> tuple[int, int]:
    """Floating-point operations of encoding and of decoding one view of this side in pixels."""
    from torch.utils.flop_counter import FlopCounterMode

    vae = without_weights(lambda: VAE(config))
    counts = []
    latent = size // config.factor
    for run, shape in (
        (vae.encode, (1, config.in_channels, size, size)),
        (vae.decode, (1, config.latent_channels, latent, latent)),
    ):
        with FlopCounterMode(display=False) as counter:
            run(torch.empty(shape, device="meta"))
        counts.append(counter.get_total_flops())
    return counts[0], counts[1]


@lru_cache(maxsize=4)
@torch.no_grad()
def _rate(device: str, dtype: torch.dtype) -> float:
    """Floating-point operations per second of a large product, the best of a few, in the share of the processor that is
    free.

    A trial is too short to tell that share: it falls into one slice of the scheduler or between two.
    """
    own = torch.device(device).type == "cpu"
    clock = time.thread_time if own else time.perf_counter
    left, right = (torch.ones(512, 512, device=device, dtype=dtype) for _ in range(2))
    best, began = float("inf"), clock()
    while best == float("inf") or clock() - began < _TRIAL_SECONDS:
        start = clock()
        product = left @ right
        float(product[0, 0])  # waits for a GPU
        best = min(best, max(clock() - start, 1e-6))
    return 2 * 512**3 / best / (_crowd(torch.get_num_threads()) if own else 1.0)


def _crowd(threads: int) -> float:
    """By how much so many threads are slowed down by what else the machine does; 1 where it does not tell."""
    try:
        busy = os.getloadavg()[0]
    except (AttributeError, OSError):  # Windows
        busy = 0.0
    return max(1.0, (busy + threads) / max(usable_cores(), threads))
