"""Fillerbuster: complete any mix of known, partly known and unknown images and raymaps of one scene (paper, section 3.1)."""

from __future__ import annotations

import dataclasses
import logging
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core import checkpoint
from fb_core.conditioning import (
    LATENT_CHANNELS,
    STATE_CHANNELS,
    Conditioning,
    decode_in_chunks,
    encode_known,
    encode_null,
    only_known,
    split,
)
from fb_core.geometry.raymap import CanonicalFrame, from_unit_range, to_unit_range
from fb_core.memory import SIDE_MULTIPLE, Cut, MemoryEstimate, available_bytes, estimate, uncut
from fb_core.networks.prepared import Prepared
from fb_core.networks.text import TextEncoder
from fb_core.sampler import OnStep, SamplingConfig, branches, guidance_map, guided, integrate, tiled, time_grid
from fb_core.views import Views

BUNDLED_MODEL = Path(__file__).parent / "pretrained" / "rooms-tiny"
_logger = logging.getLogger(__name__)


class Fillerbuster:
    """The two autoencoders and the transformer, ready to complete views."""

    def __init__(self, loaded: checkpoint.Loaded, *, model_hash: str = "", text_encoder: TextEncoder | None = None):
        self.dit = loaded.dit
        self.image_vae = loaded.image_vae
        self.raymap_vae = loaded.raymap_vae
        self.config = loaded.config
        self.info: dict = dict(loaded.info)
        """Free-form record of the training (preset, seed, image size, loss)."""
        self.text: Tensor | None = loaded.empty_prompt
        """Embedding [words, width] of the empty prompt; None for a text-free model."""
        self.text_encoder = text_encoder
        if text_encoder is not None and self.reads_text and self.text is None:
            self.text = text_encoder.encode([""])[0].to(self.device)
        self.model_hash = model_hash
        """Content hash of the weights; part of what identifies a generated view."""
        for module in (self.dit, self.image_vae, self.raymap_vae):
            module.requires_grad_(False).eval()

    @staticmethod
    def from_pretrained(
        folder: Path | str | None = None,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
        text_encoder: Path | str | None = None,
    ) -> Fillerbuster:
        """Load a model folder (config.json and safetensors); None is the small bundled model.

        `dtype` is the transformer's and the image autoencoder's precision (the latter stays in float32 beside float16); norms, the
        residual stream, guidance and the raymap autoencoder are always in float32. `text_encoder` is a folder with the CLIP text
        model, which prompts need. Raises ValueError, in one sentence, for a missing folder or file, foreign or truncated weights, a
        precision that the device cannot compute, and a text encoder beside a model that reads no text.
        """
        path = BUNDLED_MODEL if folder is None else Path(folder)
        loaded = checkpoint.load(path, device=device, dtype=dtype)
        encoder = None
        if text_encoder is not None:
            if not loaded.config.transformer.text_width:
                raise ValueError(f"text_encoder: the model in {path} reads no text; load it without a text encoder")
            encoder = TextEncoder.from_folder(text_encoder, device=device)
        return Fillerbuster(loaded, model_hash=checkpoint.model_hash(path), text_encoder=encoder)

    @property
    def size(self) -> int:
        """Image side in pixels that the model was trained at (256 where the weights do not say)."""
        return int(self.info.get("image_size", 256))

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.dit.parameters()).device

    @property
    def reads_text(self) -> bool:
        """Whether prompts can have an influence."""
        return bool(self.config.transformer.text_width)

    @property
    def recommended_sampling(self) -> SamplingConfig:
        """How this model samples best, where its folder says (the paper's values otherwise)."""
        return SamplingConfig(**self.info.get("sampling", {}))

    def estimate(
        self, views: int, size: tuple[int, int], sampling: SamplingConfig = SamplingConfig(), *, prompt: str | None = None
    ) -> MemoryEstimate:
        """Memory that `complete` will need for so many views of a size (height, width); see `fb_core.memory.estimate`."""
        prompted = bool(prompt) and sampling.guidance_text != 0
        return estimate(views, size, self.dit.dtype, model=self.config, sampling=sampling, prompted=prompted)

    @torch.no_grad()
    def complete(
        self,
        views: Views,
        *,
        generator: torch.Generator,
        sampling: SamplingConfig = SamplingConfig(),
        on_step: OnStep | None = None,
        prompt: str | None = None,
    ) -> Views:
        """Fill all that is unknown; known pixels and rays are returned as given, and all masks are 1.

        Args:
            views: 1 or more views with sides of at least 16 pixels (sides that 16 does not divide are padded with unknown pixels).
            generator: decides the sample, on the CPU. Each view's noise depends only on it and on the view's place.
            sampling: steps, guidance, windows, memory.
            on_step: called with (steps done, steps in all).
            prompt: says what is to be seen, for models that read text; None and "" cost nothing.

        Raises:
            ValueError: for no views, views that are too small, known pixels or rays that are not finite, a prompt that the model cannot
                read, or too little memory however the work is cut (saying what would fit).
        """
        _check(views)
        text = self._text_of(prompt if sampling.guidance_text else None)
        cut = self._cut(len(views), views.size, sampling, prompt)
        seed = int(torch.randint(0, 2**62, (), generator=generator))
        height, width = views.size
        padded = _padded(views.to(self.device))
        frame = _frame_of(padded)
        canonical = only_known(padded.raymaps, padded.rays_known)
        if frame is not None:
            canonical = only_known(frame.apply(canonical), padded.rays_known)
        conditioning = encode_known(
            padded.images,
            padded.image_known,
            to_unit_range(canonical),
            padded.rays_known,
            image_vae=self.image_vae,
            raymap_vae=self.raymap_vae,
            views_at_once=cut.views_encoded,
            generator=torch.Generator().manual_seed(_mixed(seed, -2)) if sampling.sample_posterior else None,
        )
        del canonical
        null = encode_null(conditioning, image_vae=self.image_vae, raymap_vae=self.raymap_vae, pixels=padded.size)
        latents = self._denoise(conditioning, null, text, seed=seed, sampling=sampling, branches_at_once=cut.branches, on_step=on_step)
        filled = self._decode(padded, latents, frame, cut)
        return dataclasses.replace(
            filled, **{f.name: getattr(filled, f.name)[..., :height, :width].to(views.images.device) for f in dataclasses.fields(Views)}
        )

    def _text_of(self, prompt: str | None) -> Float[Tensor, "texts words t"] | None:
        """Embeddings of the empty prompt and, if there is one, of the prompt; None for a model without text."""
        if prompt and not self.reads_text:
            raise ValueError(f"prompt: this model reads no text; complete without a prompt, got {prompt!r}")
        if not self.reads_text:
            return None
        if self.text is None:
            raise ValueError(
                "complete: this model reads text, but its folder has no embedding of the empty prompt; convert it with a text encoder, "
                "or load it with from_pretrained(..., text_encoder=FOLDER)"
            )
        if not prompt:
            return self.text[None]
        if self.text_encoder is None:
            raise ValueError(
                f"prompt: {prompt!r} needs a text encoder; install fillerbuster[text] and load the model with "
                "from_pretrained(..., text_encoder=FOLDER)"
            )
        return torch.stack([self.text, self.text_encoder.encode([prompt])[0].to(self.text)])

    def _cut(self, views: int, size: tuple[int, int], sampling: SamplingConfig, prompt: str | None) -> Cut:
        """How to cut the work: by the budget, or by what is free if the usual cut would not fit."""
        free = None
        if sampling.memory_budget_bytes is None:
            free = available_bytes(self.device)
            cut = uncut(views, size, free, model=self.config, sampling=sampling, prompted=bool(prompt))
            if cut is not None:
                return cut
        expected = self.estimate(views, size, sampling, prompt=prompt)
        if free is not None and expected.working > free:
            tight = dataclasses.replace(sampling, memory_budget_bytes=expected.weights + free)
            expected = self.estimate(views, size, tight, prompt=prompt)
        _logger.debug("%d views of %dx%d: %.2f GiB, %s", views, size[1], size[0], expected.peak / 2**30, expected.cut)
        return expected.cut

    def _denoise(
        self,
        conditioning: Conditioning,
        null: Conditioning,
        text: Tensor | None,
        *,
        seed: int,
        sampling: SamplingConfig,
        branches_at_once: int | None,
        on_step: OnStep | None,
    ) -> Float[Tensor, "n 32 h w"]:
        """Latents at t = 0. Two texts, the empty and another, make one more branch."""
        partitions = torch.Generator().manual_seed(_mixed(seed, -1))
        scale = guidance_map(conditioning, known=sampling.guidance_known, unknown=sampling.guidance_unknown)
        times = time_grid(sampling.steps, shift=sampling.shift)
        parts = branches(conditioning, null, scale)
        prompted = text is not None and len(text) == 2
        if text is not None and prompted:
            text = torch.stack([text[0]] * len(parts) + [text[1]])
            parts = [*parts, conditioning]
        channels = torch.stack([part.channels for part in parts])
        prepared = Prepared(self.dit, channels, times[:-1], text=text, branches_at_once=branches_at_once)
        predict = tiled(prepared, window=sampling.window, rounds=sampling.rounds, generator=partitions)
        noise = noise_of(seed, conditioning.channels.shape[0], tuple(conditioning.channels.shape[-2:])).to(self.device)
        field = guided(predict, scale, text_scale=sampling.guidance_text if prompted else None)
        return integrate(field, noise, times, solver=sampling.solver, on_step=on_step)

    def _decode(self, views: Views, latents: Tensor, frame: CanonicalFrame | None, cut: Cut) -> Views:
        """Pixels and rays of the latents, with what is known pasted back; views that are wholly known are not decoded."""
        image_latents, ray_latents = split(latents)
        images = only_known(views.images, views.image_known)
        todo = (views.image_known < 1).flatten(1).any(dim=1)
        if bool(todo.any()):
            known = views.image_known[todo]
            generated = decode_in_chunks(self.image_vae, image_latents[todo], cut.views_decoded, cut.tile)
            images[todo] = images[todo] + (1 - known) * generated
        raymaps = only_known(views.raymaps, views.rays_known)
        todo = (views.rays_known < 1).flatten(1).any(dim=1)
        if bool(todo.any()):
            recovered = from_unit_range(decode_in_chunks(self.raymap_vae, ray_latents[todo], cut.views_decoded, cut.tile))
            recovered = recovered if frame is None else frame.invert(recovered)
            raymaps[todo] = torch.where(views.rays_known[todo] > 0, raymaps[todo], recovered)
        ones = torch.ones_like(views.image_known)
        return Views(images=images, image_known=ones, raymaps=raymaps, rays_known=ones)


def noise_of(seed: int, views: int, latent_size: tuple[int, int]) -> Float[Tensor, "n 32 h w"]:
    """Initial noise on the CPU; a view's noise depends on the seed and its place alone, not on how many views there are."""
    draws = [
        torch.randn(STATE_CHANNELS, *latent_size, generator=torch.Generator().manual_seed(_mixed(seed, view))) for view in range(views)
    ]
    return torch.stack(draws)


def _mixed(seed: int, stream: int) -> int:
    """A seed for one of many independent streams (the finaliser of SplitMix64)."""
    value = (seed + 0x9E3779B97F4A7C15 * (stream + 2)) % 2**64
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) % 2**64
    return (value ^ (value >> 31)) % 2**63


def _check(views: Views) -> None:
    if len(views) == 0:
        raise ValueError("complete: expected at least one view, got none")
    if min(views.size) < SIDE_MULTIPLE:
        raise ValueError(
            f"complete: expected views of at least {SIDE_MULTIPLE}x{SIDE_MULTIPLE} pixels, got {views.size[1]}x{views.size[0]}; "
            "use larger images"
        )
    for what, values, known in (("pixels", views.images, views.image_known), ("rays", views.raymaps, views.rays_known)):
        if not bool(torch.isfinite(known).all()) or float(known.min()) < 0 or float(known.max()) > 1:
            raise ValueError(f"complete: the mask of known {what} must lie in [0, 1] (1 = known)")
        broken = int(((~torch.isfinite(values)) & (known > 0)).any(dim=1).sum())
        if broken:
            raise ValueError(f"complete: {broken} known {what} are NaN or infinite; mark them as unknown (mask 0) or repair them")


def _padded(views: Views) -> Views:
    """Sides brought up to multiples of 16 with pixels and rays that are unknown."""
    height, width = views.size
    extra = (0, -width % SIDE_MULTIPLE, 0, -height % SIDE_MULTIPLE)
    if not any(extra):
        return views
    return dataclasses.replace(views, **{f.name: F.pad(getattr(views, f.name), extra) for f in dataclasses.fields(Views)})


def _frame_of(views: Views) -> CanonicalFrame | None:
    """The canonical frame of the posed views, upright in the first of them; None when no view has all of its rays."""
    posed = (views.rays_known > 0).flatten(1).float().mean(dim=1) >= 0.5
    if not bool(posed.any()):
        return None
    rows = (views.rays_known > 0)[posed][0, 0]
    last_row, last_column = int(rows.any(dim=1).nonzero().max()), int(rows.any(dim=0).nonzero().max())
    corner = views.raymaps[posed][..., : last_row + 1, : last_column + 1]
    return CanonicalFrame.of_raymaps(corner)


__all__ = ["BUNDLED_MODEL", "LATENT_CHANNELS", "Fillerbuster", "SamplingConfig", "noise_of"]
