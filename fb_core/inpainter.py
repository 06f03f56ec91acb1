"""Fillerbuster: complete any mix of known, partly known and unknown images and raymaps of one scene (paper, section 3.1)."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
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
from fb_core.networks.prepared import Prepared
from fb_core.sampler import OnStep, branches, guidance_map, guided, integrate, tiled, time_grid
from fb_core.views import Views

BUNDLED_MODEL = Path(__file__).parent / "pretrained" / "rooms-tiny"
SIDE_MULTIPLE = 16  # 8 of the autoencoders times a patch of 2
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """How a sequence is denoised."""

    steps: int = 24
    """Denoising steps; each evaluates the network once (twice with guidance)."""
    guidance_unknown: float = 7.0
    """Classifier-free guidance scale where content is unknown (paper: 7)."""
    guidance_known: float = 1.1
    """Guidance scale where content is known (paper: 1.1)."""
    solver: str = "ab2"
    """'euler' or 'ab2' (second-order Adams-Bashforth: Euler's error in a third of the steps)."""
    shift: float = 1.0
    """Time shift of the grid; above 1 spends more steps near the noise."""
    window: int | None = None
    """Views denoised together; None is all of them (best for images; the paper uses 8 for poses)."""
    rounds: int = 1
    """Random partitions into windows that are averaged per step."""
    views_at_once: int = 16
    """Views that pass through an autoencoder together; bounds memory."""

    def __post_init__(self) -> None:
        time_grid(self.steps, shift=self.shift)
        if self.solver not in ("euler", "ab2"):
            raise ValueError(f"solver: expected 'euler' or 'ab2', got {self.solver!r}")
        for name in ("rounds", "views_at_once"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected at least 1, got {getattr(self, name)}")


class Fillerbuster:
    """The two autoencoders and the transformer, ready to complete views."""

    def __init__(self, loaded: checkpoint.Loaded, *, model_hash: str = ""):
        self.dit = loaded.dit
        self.image_vae = loaded.image_vae
        self.raymap_vae = loaded.raymap_vae
        self.info: dict = dict(loaded.info)
        """Free-form record of the training (preset, seed, image size, loss)."""
        self.text: Tensor | None = loaded.empty_prompt
        """Embedding [words, width] of the prompt; None for a text-free model."""
        self.model_hash = model_hash
        """Content hash of the weights; part of what identifies a generated view."""
        for module in (self.dit, self.image_vae, self.raymap_vae):
            module.requires_grad_(False).eval()

    @staticmethod
    def from_pretrained(
        folder: Path | str | None = None, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
    ) -> Fillerbuster:
        """Load a model folder (config.json and safetensors); None is the small bundled model.

        Raises ValueError, in one sentence, for a missing folder or file, foreign or truncated weights.
        """
        path = BUNDLED_MODEL if folder is None else Path(folder)
        loaded = checkpoint.load(path, device=device, dtype=dtype)
        return Fillerbuster(loaded, model_hash=checkpoint.model_hash(path))

    @property
    def size(self) -> int:
        """Image side in pixels that the model was trained at (256 where the weights do not say)."""
        return int(self.info.get("image_size", 256))

    @property
    def device(self) -> torch.device:
        """Where the weights are."""
        return next(self.dit.parameters()).device

    @torch.no_grad()
    def complete(
        self,
        views: Views,
        *,
        generator: torch.Generator,
        sampling: SamplingConfig = SamplingConfig(),
        on_step: OnStep | None = None,
    ) -> Views:
        """Fill all that is unknown; known pixels and rays are returned as given, and all masks are 1.

        Args:
            views: 1 or more views with sides of at least 16 pixels (sides that 16 does not divide are padded with unknown pixels).
            generator: decides the sample, on the CPU. Each view's noise depends only on it and on the view's place.
            sampling: steps, guidance, windows.
            on_step: called with (steps done, steps in all).

        Raises:
            ValueError: for no views, views that are too small, or known pixels or rays that are not finite.
        """
        _check(views)
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
            views_at_once=sampling.views_at_once,
        )
        latents = self._denoise(conditioning, padded.size, seed=seed, sampling=sampling, on_step=on_step)
        filled = self._decode(padded, latents, frame, sampling)
        return dataclasses.replace(
            filled, **{f.name: getattr(filled, f.name)[..., :height, :width].to(views.images.device) for f in dataclasses.fields(Views)}
        )

    def _denoise(
        self, conditioning: Conditioning, pixels: tuple[int, int], *, seed: int, sampling: SamplingConfig, on_step: OnStep | None
    ) -> Float[Tensor, "n 32 h w"]:
        """Latents at t = 0."""
        null = encode_null(conditioning, image_vae=self.image_vae, raymap_vae=self.raymap_vae, pixels=pixels)
        partitions = torch.Generator().manual_seed(_mixed(seed, -1))
        scale = guidance_map(conditioning, known=sampling.guidance_known, unknown=sampling.guidance_unknown)
        times = time_grid(sampling.steps, shift=sampling.shift)
        channels = torch.stack([part.channels for part in branches(conditioning, null, scale)])
        text = None if self.text is None else self.text[None]
        prepared = Prepared(self.dit, channels, times[:-1], text=text)
        predict = tiled(prepared, window=sampling.window, rounds=sampling.rounds, generator=partitions)
        noise = noise_of(seed, conditioning.channels.shape[0], tuple(conditioning.channels.shape[-2:])).to(self.device)
        return integrate(guided(predict, scale), noise, times, solver=sampling.solver, on_step=on_step)

    def _decode(self, views: Views, latents: Tensor, frame: CanonicalFrame | None, sampling: SamplingConfig) -> Views:
        """Pixels and rays of the latents, with what is known pasted back; views that are wholly known are not decoded."""
        image_latents, ray_latents = split(latents)
        images = only_known(views.images, views.image_known)
        todo = (views.image_known < 1).flatten(1).any(dim=1)
        if bool(todo.any()):
            known = views.image_known[todo]
            generated = decode_in_chunks(self.image_vae, image_latents[todo], sampling.views_at_once)
            images[todo] = images[todo] + (1 - known) * generated
        raymaps = only_known(views.raymaps, views.rays_known)
        todo = (views.rays_known < 1).flatten(1).any(dim=1)
        if bool(todo.any()):
            recovered = from_unit_range(decode_in_chunks(self.raymap_vae, ray_latents[todo], sampling.views_at_once))
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
            f"complete: expected views of at least {SIDE_MULTIPLE}x{SIDE_MULTIPLE} pixels, got {views.size[1]}x{views.size[0]}; use larger images"
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
    height, width = views.size
    posed = (views.rays_known > 0).flatten(1).float().mean(dim=1) >= 0.5
    if not bool(posed.any()):
        return None
    rows = (views.rays_known > 0)[posed][0, 0]
    last_row, last_column = int(rows.any(dim=1).nonzero().max()), int(rows.any(dim=0).nonzero().max())
    corner = views.raymaps[posed][..., : last_row + 1, : last_column + 1]
    return CanonicalFrame.of_raymaps(corner)


__all__ = ["BUNDLED_MODEL", "LATENT_CHANNELS", "Fillerbuster", "SamplingConfig", "noise_of"]
