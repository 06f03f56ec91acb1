"""Training of the transformer: flow matching on the latents of whole sequences (paper, section 3.1 and appendix)."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import (
    Conditioning,
    assemble,
    encode_frozen,
    frames_for,
    join,
    only_known,
    split,
    unsplit,
    with_guess,
)
from fb_core.data.training.task import Sequences, Source, TaskConfig
from fb_core.flow import at_time, logit_normal_times, masked_loss, velocity
from fb_core.geometry.raymap import to_unit_range
from fb_core.masks import to_latent_grid
from fb_core.networks.transformer.dit import NO_FACTS, DiT, DiTConfig, TokenFacts
from fb_core.networks.transformer.embeddings import index_positions
from fb_core.networks.vae import VAE
from fb_core.training.run.stage import Stage, row_generator
from fb_core.training.stages.guesses import Guess, guesses_of

_GUESSES = 3  # stream of random numbers
EncodeText = Callable[[list[str]], Float[Tensor, "b words t"]]
"""Embeddings of texts."""


@dataclass(frozen=True, kw_only=True)
class DiTLossConfig:
    """How a batch becomes a loss."""

    batch: int = 12
    """Sequences per step."""
    task: TaskConfig = TaskConfig()
    """Views, masks, and which modality is completed."""
    ray_weight: float = 1.0
    """Weight of the raymap channels' loss (paper: 1; its ablation "no-poses": 0)."""
    images_per_row: int = 1
    """Captioned single pictures that stand for one sequence."""
    draws: int = 1
    """Draws of (time, noise) for every sequence, which is encoded once, and whose known tokens are computed once where
    they are apart.
    """
    pure_noise: float = 0.0
    """Share of the draws at time 1 exactly, where the answer is the mean of all that may be there; one step from noise
    needs it.
    """

    def __post_init__(self) -> None:
        if not 0 <= self.pure_noise <= 1:
            raise ValueError(f"training: expected a share of draws of pure noise from 0 to 1, got {self.pure_noise}")
        if self.draws < 1:
            raise ValueError(f"training: expected at least 1 draw of noise for every sequence, got {self.draws}")


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What the transformer is given for some rows of a batch, and what it should answer."""

    inputs: Float[Tensor, "b n 66 h w"]
    """Noisy latents and conditioning."""
    times: Float[Tensor, "b"]
    """Times in (0, 1)."""
    index: Float[Tensor, "b n"]
    """Positions of the views."""
    velocity: Float[Tensor, "b n 32 h w"]
    """Noise minus data."""
    image_weight: Float[Tensor, "b n 1 h w"] | None = None
    """1 where the image's latent has ground truth, else 0; None = everywhere."""
    rays_weight: Float[Tensor, "b n 1 h w"] | None = None
    """The same of the raymap's latent."""
    text: Float[Tensor, "b words t"] | None = None
    """Embeddings of the captions, for networks that read text."""
    facts: TokenFacts = NO_FACTS
    """What is known of the tokens."""


class Encoded(NamedTuple):
    """Rows of a batch as the autoencoders see them, before noise."""

    data: Float[Tensor, "b n 32 h w"]
    """Clean latents."""
    conditioning: Conditioning
    """What the network is told."""
    image_weight: Float[Tensor, "b n 1 h w"] | None
    """See `Drawn`."""
    rays_weight: Float[Tensor, "b n 1 h w"] | None
    """See `Drawn`."""
    captions: tuple[str, ...] | None
    """One text for each sequence; None = the empty one."""


class SharedBatches:
    """Batches that several trainings with the same autoencoders, data and seed share: each is encoded once, the latest
    are remembered.
    """

    def __init__(self, keep: int):
        """``keep``: batches remembered."""
        self._keep = keep
        self._batches: OrderedDict[Hashable, Encoded] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Encoded]) -> Encoded:
        """The batch of this name, made where it is not remembered."""
        if key not in self._batches:
            self._batches[key] = make()
            if len(self._batches) > self._keep:
                self._batches.popitem(last=False)
        return self._batches[key]


class DiTStage(Stage):
    """Trains the transformer with frozen autoencoders."""

    name = "dit"

    def __init__(
        self,
        network: DiT,
        *,
        image_vae: VAE,
        raymap_vae: VAE,
        pool: Source,
        config: DiTLossConfig,
        seed: int,
        encode_text: EncodeText | None = None,
        shared: SharedBatches | None = None,
        encoding: torch.dtype = torch.float32,
    ):
        """``shared`` is for trainings side by side that differ in nothing but the network, the task, and the losses'
        weights; the autoencoders compute in the precision ``encoding``.

        Raises ValueError for a network that reads text without ``encode_text`` (``TextEncoder.encode``).
        """
        if network.config.text_width and encode_text is None:
            raise ValueError(
                "dit: this transformer reads text, so training needs a folder with the CLIP text model (a clone of "
                "openai/clip-vit-large-patch14); give one, or choose a preset without text"
            )
        self.network: DiT = network
        self.image_vae, self.raymap_vae = (vae.eval().requires_grad_(False) for vae in (image_vae, raymap_vae))
        self.pool, self.config, self.seed = pool, config, seed
        self._encode_text = encode_text if network.config.text_width else None
        self._shared, self._encoding = shared, encoding
        self._empty_prompt: Tensor | None = None

    @property
    def batch(self) -> int:
        """Sequences per step (a row of single images holds several)."""
        return self.config.batch

    @torch.no_grad()
    def draw(self, step: int, rows: range) -> Drawn:
        """Latents of these rows of a step's batch, on their way between data and noise."""
        data, conditioning, image_weight, rays_weight, captions = self.encoded(step, rows)
        noises, positions = ([row_generator(self.seed, step, row, stream) for row in rows] for stream in (1, 2))
        mode, (count, views, *latent), draws = self.network.config.index, data.shape, self.config.draws
        each = count // len(rows) * draws
        if draws > 1:
            data = data.repeat_interleave(draws, dim=0)
            conditioning = conditioning.repeated(draws)
            image_weight, rays_weight = (
                w if w is None else w.repeat_interleave(draws, dim=0) for w in (image_weight, rays_weight)
            )
            captions = captions if captions is None else tuple(caption for caption in captions for _ in range(draws))
        facts = conditioning.facts(self.network.config)._replace(sequences_per_scene=draws)
        times = torch.cat([self._times(each, generator) for generator in noises]).to(data.device)
        noise = torch.cat([torch.randn(each, views, *latent, generator=generator) for generator in noises]).to(data)
        index = torch.cat(
            [index_positions(mode, each // draws, views, generator=generator) for generator in positions]
        ).to(data.device)
        index = index.repeat_interleave(draws, dim=0)
        return Drawn(
            inputs=join(at_time(data, noise, times), conditioning),
            times=times,
            index=index,
            velocity=velocity(data, noise),
            image_weight=image_weight,
            rays_weight=rays_weight,
            text=self._text(captions, len(data), data.device),
            facts=facts,
        )

    def _times(self, count: int, generator: torch.Generator) -> Float[Tensor, "count"]:
        times = logit_normal_times(count, generator=generator)
        if self.config.pure_noise == 0:
            return times
        return torch.where(
            torch.rand(count, generator=generator) < self.config.pure_noise, torch.ones_like(times), times
        )

    def encoded(self, step: int, rows: range) -> Encoded:
        """These rows of a step's batch before noise, from what is shared if anything is."""
        if self._shared is None:
            return self.encode(self.sequences(step, rows), step, rows)
        frames = self.network.config.ray_frames and self.network.config.patch
        return self._shared.get(
            (step, rows, self.config.task, frames), lambda: self.encode(self.sequences(step, rows), step, rows)
        )

    def sequences(self, step: int, rows: range) -> Sequences:
        """The views of these rows of a step's batch, and what of them is known."""
        self.pool.advance(step, rows)
        return self.pool.sequences(rows, self.config.task, partial(row_generator, self.seed, step))

    @torch.no_grad()
    def encode(self, sequences: Sequences, step: int, rows: range) -> Encoded:
        """Their latents, with the guesses of this step."""
        guess = guesses_of(sequences, rows, self.config.task, partial(row_generator, self.seed, step, stream=_GUESSES))
        vaes = {"image_vae": self.image_vae, "raymap_vae": self.raymap_vae}
        data, conditioning = encode_sequences(
            sequences, **vaes, guess=guess, transformer=self.network.config, precision=self._encoding
        )
        image_weight, rays_weight = (_latent_weight(truth) for truth in (sequences.image_truth, sequences.rays_truth))
        return Encoded(data, conditioning, image_weight, rays_weight, sequences.captions)

    def _text(
        self, captions: tuple[str, ...] | None, count: int, device: torch.device
    ) -> Float[Tensor, "b words t"] | None:
        if self._encode_text is None:
            return None
        if captions is not None:
            return self._encode_text(list(captions)).to(device)
        if self._empty_prompt is None:
            self._empty_prompt = self._encode_text([""]).to(device)
        return self._empty_prompt.expand(count, -1, -1)

    def losses(self, drawn: Drawn) -> dict[str, Tensor]:
        """Velocity errors of both modalities and their weighted sum."""
        predicted = self.network(drawn.inputs, drawn.times, drawn.text, drawn.index, drawn.facts)
        image_error, ray_error = (
            masked_loss(got, wanted, weight)
            for got, wanted, weight in zip(
                split(predicted), split(drawn.velocity), (drawn.image_weight, drawn.rays_weight), strict=True
            )
        )
        return {"loss": image_error + self.config.ray_weight * ray_error, "image": image_error, "rays": ray_error}


def _latent_weight(truth: Float[Tensor, "b n 1 h w"] | None) -> Float[Tensor, "b n 1 lh lw"] | None:
    """1 for latent cells whose pixels all have ground truth."""
    if truth is None:
        return None
    whole = (to_latent_grid(truth.flatten(0, 1)) > 1 - 1e-4).float()
    return rearrange(whole, "(b n) c h w -> b n c h w", b=len(truth))


@torch.no_grad()
def encode_sequences(
    sequences: Sequences,
    *,
    image_vae: VAE,
    raymap_vae: VAE,
    guess: Guess | None = None,
    transformer: DiTConfig | None = None,
    precision: torch.dtype = torch.float32,
) -> tuple[Tensor, Conditioning]:
    """(clean latents [b, n, 32, h, w], conditioning) of a batch.

    Latents that the pool kept are used. A view that is wholly known conditions with its clean latent, and all wholly
    unknown ones share one latent, so that only partly known and guessed views are encoded twice. Ray frames come along
    for a ``transformer`` that attends in them. The autoencoders compute in ``precision``.
    """
    batch = sequences.images.shape[0]
    parts = []
    for vae, values, known, latents, guessed in (
        (image_vae, sequences.images, sequences.image_known, sequences.image_latents, guess),
        (raymap_vae, to_unit_range(sequences.raymaps), sequences.rays_known, None, None),
    ):
        values, known = values.flatten(0, 1), known.flatten(0, 1)
        clean = encode_frozen(vae, values, 256, precision) if latents is None else latents.flatten(0, 1)
        nothing = encode_frozen(vae, torch.zeros_like(values[:1]), 1, precision)
        conditions = only_known(values, known)
        if guessed is not None:
            conditions, known = with_guess(
                conditions, known, guessed.images.flatten(0, 1), guessed.belief.flatten(0, 1)
            )
        share = known.flatten(1).mean(dim=1)
        masked = torch.where((share > 0)[:, None, None, None], clean, nothing)
        partial = (share > 0) & (share < 1)
        if bool(partial.any()):
            masked[partial] = encode_frozen(vae, conditions[partial], 256, precision)
        parts.append(
            [rearrange(x, "(b n) c h w -> b n c h w", b=batch) for x in (clean, masked, to_latent_grid(known))]
        )
    (image, image_masked, image_known), (rays, rays_masked, rays_known) = parts
    frames = frames_for(transformer, sequences.raymaps, sequences.rays_known)
    return unsplit(image, rays), assemble(image_masked, rays_masked, image_known, rays_known, frames)
