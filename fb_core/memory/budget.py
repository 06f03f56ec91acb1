"""How much memory a completion needs, before anything runs, and how the work is cut to stay inside a budget.

`estimate` runs the very code of the three phases (encode, denoise, decode) on the meta device, which computes and
allocates nothing, and counts the bytes that are alive at once. The cut depends on sizes and budget only, never on what
happens to be free, unless the work would not fit otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import torch
from torch import Tensor

from fb_core.checkpoint import ModelConfig, autoencoder_dtype
from fb_core.conditioning import (
    CONDITIONING_CHANNELS,
    LATENT_CHANNELS,
    STATE_CHANNELS,
    decode_in_chunks,
    encode_in_chunks,
)
from fb_core.machine.resources import free_memory_bytes
from fb_core.memory.live_bytes import LiveBytes
from fb_core.networks.text import WORDS
from fb_core.networks.transformer.dit import NO_FACTS, DiT, DiTConfig, TokenFacts
from fb_core.networks.transformer.prepared import Prepared
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.networks.weights import without_weights
from fb_core.sampling import SamplingConfig, guided, integrate, tiled, time_grid

GIB = 2**30
AUTOENCODER_BYTES = 2 * GIB
"""What the autoencoders may take for their activations when no budget is given."""
MOST_VIEWS_AT_ONCE = 16
"""More views in one batch make an autoencoder no faster."""
TILES = (512, 256, 128, 64)
"""Sides of tiles in pixels that are tried when one whole view does not fit through a decoder."""
SIDE_MULTIPLE = 16
"""Views are padded to multiples of this: 8 of the autoencoders times a patch of 2."""
_HELD_CHANNELS = {"encoding": 29, "denoising": 12, "decoding": 26}
"""float32 values per pixel and view that `Fillerbuster` holds beside a running network: the padded input (11), its
copies in the canonical frame, masked copies, the answer as far as it is there.
"""
_OWN_CHANNELS = {"encoding": 36, "denoising": 0, "decoding": 47}
"""The most that it holds while no network runs: where views are brought into the canonical frame, and where they are
pasted.
"""


@dataclass(frozen=True, kw_only=True)
class Cut:
    """How the work is cut. Only rounding depends on it."""

    views_encoded: int
    """Views that pass through an encoder together."""
    views_decoded: int
    """Views that pass through a decoder together."""
    tile: int | None
    """Side in pixels of the tiles in which views are decoded; None decodes whole views."""
    branches: int
    """Branches of guidance that the transformer evaluates as one batch."""


@dataclass(frozen=True, kw_only=True)
class MemoryEstimate:
    """Bytes that a completion needs at most, phase by phase, with the cut that they hold for."""

    weights: int
    """The networks."""
    encoding: int
    """Encoding of what is known, beside the weights."""
    denoising: int
    """Denoising, beside the weights."""
    decoding: int
    """Decoding and pasting, beside the weights."""
    cut: Cut
    """How the work is cut."""
    shared: int = 0
    """Kept for further calls (`fb_core.networks.shared_results`)."""

    def beside(self, shared: int, budget: int | None) -> MemoryEstimate:
        """The same with so much kept for further calls, where the budget has room for it; else nothing is kept."""
        fits = budget is None or self.peak + shared <= budget
        return dataclasses.replace(self, shared=shared if fits else 0)

    @property
    def working(self) -> int:
        """The most that any phase needs, beside the weights."""
        return max(self.encoding, self.denoising, self.decoding)

    @property
    def peak(self) -> int:
        """Bytes needed in all."""
        return self.weights + self.working + self.shared


def estimate(
    views: int,
    size: tuple[int, int],
    dtype: torch.dtype = torch.float32,
    *,
    model: ModelConfig,
    sampling: SamplingConfig = SamplingConfig(),
    prompted: bool = False,
) -> MemoryEstimate:
    """Memory of completing so many views of a size (height, width) in pixels, with the transformer in `dtype`, cut to
    fit the budget.

    Raises ValueError for no views or pixels, and, if `sampling.memory_budget_bytes` does not suffice however the work
    is cut, one that says what would fit.
    """
    if views < 1 or min(size) < 1:
        raise ValueError(
            f"estimate: expected at least one view of at least one pixel, got {views} of {size[1]}x{size[0]}."
        )
    fitted = _fitted(views, _padded(size), dtype, model, sampling, prompted)
    if isinstance(fitted, MemoryEstimate):
        return fitted
    raise ValueError(_refusal(views, size, dtype, model, sampling, prompted, least=fitted))


def uncut(
    views: int,
    size: tuple[int, int],
    free: int | None,
    *,
    model: ModelConfig,
    sampling: SamplingConfig = SamplingConfig(),
    prompted: bool = False,
) -> Cut | None:
    """The cut of work that is so small that no estimate is needed to know that it fits; None if that is not sure.

    `estimate` takes seconds at its first call, which imports torch's shape rules; a demo of small views should not wait
    for them.
    """
    autoencoders, working = bound(views, size, model=model, sampling=sampling, prompted=prompted)
    if autoencoders > AUTOENCODER_BYTES or working > AUTOENCODER_BYTES or (free is not None and working > free):
        return None
    at_once = sampling.views_at_once or min(views, MOST_VIEWS_AT_ONCE)
    return Cut(views_encoded=at_once, views_decoded=at_once, tile=None, branches=_branch_count(sampling, prompted))


def bound(
    views: int,
    size: tuple[int, int],
    *,
    model: ModelConfig,
    sampling: SamplingConfig = SamplingConfig(),
    prompted: bool = False,
) -> tuple[int, int]:
    """Generous closed form, in float32 and uncut: bytes of the autoencoders' activations, and of all working memory
    (without weights).
    """
    height, width = _padded(size)
    pixels = height * width
    at_once = sampling.views_at_once or min(views, MOST_VIEWS_AT_ONCE)
    vaes = (model.image_vae, model.raymap_vae)
    widest = max(max(vae.widths[0], vae.widths[1], vae.widths[2] // 4 + 1, vae.widths[3] // 16 + 1) for vae in vaes)
    autoencoders = 4 * 8 * widest * pixels * at_once + 8 * 9 * max(max(vae.widths) for vae in vaes) ** 2
    transformer = model.transformer
    tokens = views * pixels // (model.image_vae.factor * transformer.patch) ** 2
    branches = _branch_count(sampling, prompted)
    constants = 8 * transformer.depth * transformer.width * (6 * sampling.steps + 4 * WORDS * branches)
    denoising = (
        4 * branches * tokens * (transformer.width * (24 + 8 * transformer.mlp_ratio) + 24 * transformer.in_channels)
        + constants
    )
    return autoencoders, max(autoencoders, denoising) + 4 * max(_OWN_CHANNELS.values()) * views * pixels


def available_bytes(device: torch.device) -> int | None:
    """Memory that is free on a device, with what torch holds in reserve there; None where it cannot be told.

    Beside a CPU it is what this process may still take, within the limits of containers too.
    """
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return free_memory_bytes() if device.type == "cpu" else None


def _padded(size: tuple[int, int]) -> tuple[int, int]:
    height, width = (side + -side % SIDE_MULTIPLE for side in size)
    return height, width


@lru_cache(maxsize=256)
def _fitted(
    views: int, size: tuple[int, int], dtype: torch.dtype, model: ModelConfig, sampling: SamplingConfig, prompted: bool
) -> MemoryEstimate | int:
    """The fastest cut that fits, or the bytes that the thriftiest cut needs."""
    weights, budget = _weight_bytes(model, dtype), sampling.memory_budget_bytes
    values = 4 * views * size[0] * size[1]
    held = {phase: channels * values for phase, channels in _HELD_CHANNELS.items()}
    room = {
        phase: AUTOENCODER_BYTES if budget is None else budget - weights - held_bytes
        for phase, held_bytes in held.items()
    }

    views_encoded, encoding = _most_views(
        partial(_encoding_bytes, model, dtype, size), views, sampling.views_at_once, room["encoding"]
    )
    tile, views_decoded, decoding = None, 1, 0
    for tile in (None, *(side for side in TILES if side < max(size))):
        bytes_of = partial(_decoding_bytes, model, dtype, size, tile)
        views_decoded, decoding = _most_views(bytes_of, views, sampling.views_at_once, room["decoding"])
        if decoding <= room["decoding"]:
            break
    branches, denoising = 0, 0
    for branches in range(_branch_count(sampling, prompted), 0, -1):
        denoising = _denoising_bytes(views, size, dtype, model, sampling, prompted, branches)
        if budget is None or denoising <= room["denoising"]:
            break
    networks = {"encoding": encoding, "denoising": denoising, "decoding": decoding}
    phases = {phase: max(held[phase] + network, _OWN_CHANNELS[phase] * values) for phase, network in networks.items()}
    cut_estimate = MemoryEstimate(
        weights=weights,
        **phases,
        cut=Cut(views_encoded=views_encoded, views_decoded=views_decoded, tile=tile, branches=branches),
    )
    return cut_estimate if budget is None or cut_estimate.peak <= budget else cut_estimate.peak


def _most_views(bytes_of: Callable[[int], int], views: int, asked: int | None, room: int) -> tuple[int, int]:
    """How many views at a time fit into `room` (at least 1), and the bytes that they need."""
    if asked is not None:
        return asked, bytes_of(min(asked, views))
    one = bytes_of(1)
    if views == 1 or one >= room:
        return 1, one
    each = max(bytes_of(2) - one, 1)  # scratch for weights is needed once, whatever the number
    count = max(1, min(views, MOST_VIEWS_AT_ONCE, 1 + (room - one) // each))
    return count, one + (count - 1) * each


def _branch_count(sampling: SamplingConfig, prompted: bool) -> int:
    return 1 + sampling.guides + (prompted and sampling.guidance_text != 0)


# The phases, on the meta device ------------------------------------------------------------------------------------


@lru_cache(maxsize=64)
def _weight_bytes(model: ModelConfig, dtype: torch.dtype) -> int:
    networks = (
        _network(lambda: DiT(model.transformer), dtype),
        _network(lambda: VAE(model.image_vae), autoencoder_dtype(dtype)),
        _network(lambda: VAE(model.raymap_vae), torch.float32),
    )
    return sum(value.numel() * value.element_size() for network in networks for value in network.parameters())


def _network(build: Callable[[], torch.nn.Module], dtype: torch.dtype) -> torch.nn.Module:
    return without_weights(build).to(dtype).requires_grad_(False)


@lru_cache(maxsize=64)
def _vaes(model: ModelConfig, dtype: torch.dtype) -> tuple[VAE, VAE]:
    def made(config: VAEConfig, precision: torch.dtype) -> VAE:
        return without_weights(lambda: VAE(config)).to(precision).requires_grad_(False)

    return made(model.image_vae, autoencoder_dtype(dtype)), made(model.raymap_vae, torch.float32)


def _meta(*shape: int) -> Tensor:
    return torch.empty(shape, device="meta")


@lru_cache(maxsize=256)
@torch.no_grad()
def _encoding_bytes(model: ModelConfig, dtype: torch.dtype, size: tuple[int, int], views: int) -> int:
    peaks = []
    for vae in _vaes(model, dtype):
        pixels = _meta(views, vae.config.in_channels, *size)
        with LiveBytes() as live:
            encode_in_chunks(vae, pixels, views)
        peaks.append(live.peak)
    return max(peaks)


@lru_cache(maxsize=256)
@torch.no_grad()
def _decoding_bytes(model: ModelConfig, dtype: torch.dtype, size: tuple[int, int], tile: int | None, views: int) -> int:
    peaks = []
    for vae in _vaes(model, dtype):
        latents = _meta(views, LATENT_CHANNELS, size[0] // vae.config.factor, size[1] // vae.config.factor)
        with LiveBytes() as live:
            decode_in_chunks(vae, latents, views, tile)
        peaks.append(live.peak)
    return max(peaks)


@lru_cache(maxsize=256)
@torch.no_grad()
def _denoising_bytes(
    views: int,
    size: tuple[int, int],
    dtype: torch.dtype,
    model: ModelConfig,
    sampling: SamplingConfig,
    prompted: bool,
    branches: int,
) -> int:
    """Two steps of a network with one block; what the other blocks keep (modulations, text) is added."""
    config, latent = model.transformer, (size[0] // model.image_vae.factor, size[1] // model.image_vae.factor)
    dit = without_weights(lambda: DiT(dataclasses.replace(config, depth=1))).to(dtype).requires_grad_(False)
    count, times = _branch_count(sampling, prompted), time_grid(sampling.steps, shift=sampling.shift)
    conditioning, noise = _meta(views, CONDITIONING_CHANNELS, *latent), _meta(views, STATE_CHANNELS, *latent)
    with LiveBytes() as live:
        channels = torch.stack([conditioning] * count)
        texts = (
            torch.empty(count if prompted else 1, WORDS, config.text_width or 0, device="meta")
            if config.text_width
            else None
        )
        prepared = Prepared(
            dit, channels, times[:-1], text=texts, branches_at_once=branches, facts=_facts(config, count, views, latent)
        )
        predict = tiled(prepared, window=sampling.window, rounds=1)
        scale = torch.empty_like(noise) + 1
        field = guided(
            predict, scale, text_scale=1.0 if prompted and sampling.guidance_text else None, variant=sampling.guidance
        )
        integrate(field, noise + 1, [*times[:2], 0.0] if len(times) > 2 else times, solver=sampling.solver)
    norms = 3 if config.text_width else 2
    block_bytes = 4 * norms * 2 * config.width * sampling.steps
    if texts is not None:
        block_bytes += 2 * texts.shape[0] * WORDS * config.width * dtype.itemsize
    if config.known_tokens == "apart":  # at most: keys and values of all tokens, should all be known
        tokens = views * latent[0] * latent[1] // config.patch**2
        block_bytes += 2 * count * tokens * config.width * dtype.itemsize
    return live.peak + (config.depth - 1) * block_bytes + conditioning.numel() * 4


def _facts(config: DiTConfig, branches: int, views: int, latent: tuple[int, int]) -> TokenFacts:
    """Ray frames where the network reads them; no known tokens, which would only make the work less."""
    if not config.ray_frames:
        return NO_FACTS
    return TokenFacts(frames=_meta(branches, views, latent[0] // config.patch, latent[1] // config.patch, 4, 4))


# What would fit ----------------------------------------------------------------------------------------------------


def _refusal(
    views: int,
    size: tuple[int, int],
    dtype: torch.dtype,
    model: ModelConfig,
    sampling: SamplingConfig,
    prompted: bool,
    *,
    least: int,
) -> str:
    """One sentence that names the need, the budget and the nearest tasks that fit it."""

    def fits(count: int, side: tuple[int, int], precision: torch.dtype) -> bool:
        return isinstance(_fitted(count, _padded(side), precision, model, sampling, prompted), MemoryEstimate)

    def scaled(steps: int) -> tuple[int, int]:
        """The size in the same proportions whose longer side is so many times 16."""
        height, width = (SIDE_MULTIPLE * max(1, round(side * steps / max(size))) for side in size)
        return height, width

    offers = []
    count = _largest(views - 1, lambda n: fits(n, size, dtype))
    if count:
        offers.append(f"{count} {'view' if count == 1 else 'views'} of this size")
    steps = _largest(max(size) // SIDE_MULTIPLE - 1, lambda k: fits(views, scaled(k), dtype))
    if steps:
        height, width = scaled(steps)
        offers.append(f"{views} views of {width}x{height}")
    if dtype == torch.float32 and fits(views, size, torch.bfloat16):
        offers.append("the same in bfloat16")
    budget = sampling.memory_budget_bytes or 0
    return (
        f"memory budget: {views} views of {size[1]}x{size[0]} in {str(dtype).removeprefix('torch.')} need at least "
        f"{least / GIB:.2f} GiB, got {budget / GIB:.2f} GiB; "
        + (
            f"what would fit: {', or '.join(offers)}."
            if offers
            else "not even one view of 16x16 would fit; use a smaller model."
        )
    )


def _largest(limit: int, fits: Callable[[int], bool]) -> int:
    """The largest number from 1 to `limit` that fits, given that smaller ones fit too; 0 if none does."""
    low, high = 0, max(limit, 0)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low
