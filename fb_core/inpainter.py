"""Fillerbuster: complete any mix of known, partly known and unknown images and raymaps of one scene (paper, section
3.1).
"""

from __future__ import annotations

import dataclasses
import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core import checkpoint
from fb_core.conditioning import (
    LATENT_CHANNELS,
    decode_in_chunks,
    encode_in_chunks,
    encode_known,
    encode_null,
    only_known,
    split,
    unsplit,
)
from fb_core.geometry.known_rays import frame_of_known_rays
from fb_core.geometry.raymap import CanonicalFrame, from_unit_range, to_unit_range
from fb_core.machine.precision import resolved
from fb_core.masks import to_latent_grid
from fb_core.memory.budget import SIDE_MULTIPLE, Cut, MemoryEstimate, available_bytes, estimate, uncut
from fb_core.networks.text import TextEncoder
from fb_core.sampling.denoising import Denoising
from fb_core.sampling.integration.trajectory import OnStep, SamplingInterrupted
from fb_core.sampling.options import SamplingConfig
from fb_core.sampling.preview import Progress
from fb_core.sampling.randomness import noise_of, posterior_generators, random_orders
from fb_core.sampling.starts import known_latents
from fb_core.views import Views

BUNDLED_MODEL = Path(__file__).parent / "pretrained" / "rooms-tiny"
_LATENT_PIXELS = 8  # side of what one latent stands for
_STARTS = 4  # steps in which a mask between 0 and 1 says when a latent joins the sampling
_FARTHEST = {
    "pixels": 1e4,
    "rays": 1e12,
}  # known values beyond are no colours or places, and their squares would overflow
_logger = logging.getLogger(__name__)


_P = ParamSpec("_P")
_R = TypeVar("_R")


def _in_own_precision(
    method: Callable[Concatenate[Fillerbuster, _P], _R],
) -> Callable[Concatenate[Fillerbuster, _P], _R]:
    """Keep a caller's autocast out: what is computed in which precision is said by the model and by the sampling
    options.
    """

    @functools.wraps(method)
    def called(self: Fillerbuster, /, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        with torch.autocast(self.device.type, enabled=False):
            return method(self, *args, **kwargs)

    return called


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

        `dtype` is the transformer's and the image autoencoder's precision (the latter stays in float32 beside float16);
        norms, the residual stream, guidance and the raymap autoencoder are always in float32. `text_encoder` is a
        folder with the CLIP text model, which prompts need. Raises ValueError, in one sentence, for a missing folder or
        file, foreign or truncated weights, a precision that the device cannot compute, and a text encoder beside a
        model that reads no text.
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
        return checkpoint.image_size_of(self.info)

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
        return SamplingConfig.from_dict(self.info.get("sampling", {}))

    def estimate(
        self, views: int, size: tuple[int, int], sampling: SamplingConfig | None = None, *, prompt: str | None = None
    ) -> MemoryEstimate:
        """Memory that `complete` will need for so many views of a size (height, width); see
        `fb_core.memory.budget.estimate`.
        """
        sampling = self.recommended_sampling if sampling is None else sampling
        prompted = bool(prompt) and sampling.guidance_text != 0
        return estimate(views, size, self.dit.dtype, model=self.config, sampling=sampling, prompted=prompted)

    @torch.no_grad()
    @_in_own_precision
    def complete(
        self,
        views: Views,
        *,
        generator: torch.Generator,
        sampling: SamplingConfig | None = None,
        on_step: OnStep | None = None,
        on_progress: Callable[[Progress], None] | None = None,
        prompt: str | None = None,
        current: Views | None = None,
        resume: SamplingInterrupted | None = None,
    ) -> Views:
        """Fill all that is unknown; known pixels and rays are returned as given, and all masks are 1.

        Args:
            views: 1 or more views with sides of at least 16 pixels (sides that 16 does not divide are padded with
                unknown pixels).
            generator: decides the sample, on the CPU. Each view's noise depends only on it and on the view's place.
            sampling: steps, guidance, windows, memory; None is `recommended_sampling`.
            on_step: called with (steps done, steps in all).
            on_progress: called after every step with the step, the time reached, and a cheap preview that is made only
                when asked for.
            prompt: says what is to be seen, for models that read text; None and "" cost nothing.
            current: views of the same number and size, such as an earlier answer, that sampling starts from at a
                strength below 1, except where `views` knows better. Latents of which they do not know all pixels start
                from noise; the others join them at the strength. With `sampling.guess` they are (also) told as a guess:
                where no pixel is known, theirs are, to be believed as far as `sampling.belief` and their own mask say.
            resume: goes on with an interrupted call that had the same arguments, to the same bits; the generator is not
                drawn from.

        Raises:
            SamplingInterrupted: a KeyboardInterrupt while denoising. Model and arguments are as they were; the error
                holds the trajectory as far as it got, for `resume`.
            ValueError: for no views, views that are too small, pixels or rays in integers, known ones that are not
                finite or far out of range, a prompt that the model cannot read, or too little memory however the work
                is cut (saying what would fit).
        """
        _check(views)
        sampling = self.recommended_sampling if sampling is None else sampling
        if current is not None:
            _check_current(current, views)
        text = self._text_of(prompt if sampling.guidance_text else None)
        cut = self._cut(len(views), views.size, sampling, prompt)
        seed = None if resume is None else resume.seed
        seed = int(torch.randint(0, 2**62, (), generator=generator)) if seed is None else seed
        ready = _working(views, self.device)
        frame, padded = frame_of_known_rays(ready.raymaps, ready.rays_known), _padded(ready)
        started = counts = guess = None
        if current is not None:
            current = _padded(_working(current, self.device), mode="replicate")
            guess = current if sampling.guess != "start" else None
            if sampling.guess == "told":
                sampling = dataclasses.replace(sampling, strength=1.0)
        if current is not None and sampling.strength < 1:
            counts = _counting(current, padded)
            if counts is None:  # they tell nothing that is not known anyway
                sampling = dataclasses.replace(sampling, strength=1.0)
            else:
                started = self._encoded(current, padded, frame, cut)
        denoising = self._denoising(padded, frame, started, counts, text, seed, sampling, cut, guess)
        look = (
            None if on_progress is None else lambda at: on_progress(Progress(trajectory=at, image_vae=self.image_vae))
        )
        try:
            latents = denoising.run(
                on_step=on_step, on_trajectory=look, resume=None if resume is None else resume.trajectory
            )
        except SamplingInterrupted as stopped:
            stopped.seed = seed
            raise
        del denoising
        return _as_given(self._decode(padded, latents, frame, cut), views)

    def recover_raymaps(
        self, images: Float[Tensor, "n 3 h w"], *, generator: torch.Generator, sampling: SamplingConfig | None = None
    ) -> Float[Tensor, "n 6 h w"]:
        """Raymaps of photos without poses (paper, "Raymap prediction"), in a canonical frame of their own: the cube
        [-1, 1]^3.

        None samples as `recommended_sampling.for_poses()` says. Raises as `complete` does.
        """
        sampling = self.recommended_sampling.for_poses() if sampling is None else sampling
        return self.complete(Views.unposed(images), generator=generator, sampling=sampling).raymaps

    def _text_of(self, prompt: str | None) -> Float[Tensor, "texts words t"] | None:
        """Embeddings of the empty prompt and, if there is one, of the prompt; None for a model without text."""
        if prompt and not self.reads_text:
            raise ValueError(f"prompt: this model reads no text; complete without a prompt, got {prompt!r}")
        if not self.reads_text:
            return None
        if self.text is None:
            raise ValueError(
                "complete: this model reads text, but its folder has no embedding of the empty prompt; convert it "
                "with a text encoder, "
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

    @_in_own_precision
    def denoising(self, views: Views, *, seed: int, sampling: SamplingConfig | None = None) -> Denoising:
        """What `complete` would denoise, with the start and the velocity of its trajectory, for measurements."""
        _check(views)
        sampling = self.recommended_sampling if sampling is None else sampling
        ready = _working(views, self.device)
        frame, padded = frame_of_known_rays(ready.raymaps, ready.rays_known), _padded(ready)
        cut = self._cut(len(views), views.size, sampling, None)
        return self._denoising(padded, frame, None, None, self._text_of(None), seed, sampling, cut)

    def _denoising(
        self,
        views: Views,
        frame: CanonicalFrame | None,
        current: Tensor | None,
        counts: Tensor | None,
        text: Tensor | None,
        seed: int,
        sampling: SamplingConfig,
        cut: Cut,
        guess: Views | None = None,
    ) -> Denoising:
        """What is known of the padded views, encoded, with all draws."""
        canonical = torch.where(views.rays_known > 0, views.raymaps, 0.0)
        if frame is not None:
            canonical = frame.apply(canonical)
        vaes = {"image_vae": self.image_vae, "raymap_vae": self.raymap_vae}
        conditioning = encode_known(
            views.images,
            views.image_known,
            to_unit_range(canonical).float(),
            views.rays_known,
            **vaes,
            views_at_once=cut.views_encoded,
            generators=posterior_generators(seed, len(views)) if sampling.sample_posterior else None,
            transformer=self.dit.config,
            guess=None if guess is None else (guess.images, sampling.belief * guess.image_known),
            precision=resolved(sampling.precision, self.device),
        )
        del canonical
        height, width = conditioning.channels.shape[-2:]
        return Denoising(
            dit=self.dit,
            conditioning=conditioning,
            null=encode_null(conditioning, **vaes, pixels=views.size),
            noise=noise_of(seed, len(views), (height, width)).to(self.device),
            orders=random_orders(seed),
            sampling=sampling,
            text=text,
            current=current,
            counts=counts,
            branches_at_once=cut.branches,
        )

    def _encoded(
        self, current: Views, views: Views, frame: CanonicalFrame | None, cut: Cut
    ) -> Float[Tensor, "n 32 h w"]:
        """Latents of current views, where known pixels and rays take the place of the current ones."""
        whole = (current.image_known > 0).to(
            current.image_known
        )  # a mask below 1 says when a pixel joins, not how dark it is
        images = only_known(views.images, views.image_known) + (1 - views.image_known) * only_known(
            current.images, whole
        )
        raymaps = torch.where(views.rays_known > 0, views.raymaps, current.raymaps.to(views.raymaps))
        there = views.rays_known.maximum(current.rays_known) > 0
        raymaps = torch.where(there, raymaps, 0.0)
        raymaps01 = to_unit_range(raymaps if frame is None else frame.apply(raymaps)).clamp(0, 1).float()
        raymaps01 = torch.where(
            there, raymaps01, 0.0
        )  # as in what is known; 0 of the world would be a place that depends on the world
        return unsplit(
            encode_in_chunks(self.image_vae, images, cut.views_encoded),
            encode_in_chunks(self.raymap_vae, raymaps01, cut.views_encoded),
        )

    def _decode(self, views: Views, latents: Tensor, frame: CanonicalFrame | None, cut: Cut) -> Views:
        """Pixels and rays of the latents, with what is known pasted back; views that are wholly known are not
        decoded.
        """
        image_latents, ray_latents = split(latents)
        images = only_known(views.images, views.image_known)
        todo = (views.image_known < 1).flatten(1).any(dim=1)
        if bool(todo.any()):
            known = views.image_known[todo]
            generated = decode_in_chunks(self.image_vae, image_latents[todo], cut.views_decoded, cut.tile)
            images[todo] = images[todo] + (1 - known) * generated
        raymaps = torch.where(views.rays_known > 0, views.raymaps, 0.0)
        todo = (views.rays_known <= 0).flatten(1).any(dim=1)
        if bool(todo.any()):
            recovered = from_unit_range(
                decode_in_chunks(self.raymap_vae, ray_latents[todo], cut.views_decoded, cut.tile)
            ).to(raymaps)
            recovered = recovered if frame is None else frame.invert(recovered)
            raymaps[todo] = torch.where(views.rays_known[todo] > 0, raymaps[todo], recovered)
        ones = torch.ones_like(views.image_known)
        return Views(images=images, image_known=ones, raymaps=raymaps, rays_known=ones)


def _check(views: Views) -> None:
    if len(views) == 0:
        raise ValueError("complete: expected at least one view, got none")
    if min(views.size) < SIDE_MULTIPLE:
        raise ValueError(
            f"complete: expected views of at least {SIDE_MULTIPLE}x{SIDE_MULTIPLE} pixels, got "
            f"{views.size[1]}x{views.size[0]}; "
            "use larger images"
        )
    for what, values, known in (("pixels", views.images, views.image_known), ("rays", views.raymaps, views.rays_known)):
        if not bool(torch.isfinite(known).all()) or float(known.min()) < 0 or float(known.max()) > 1:
            raise ValueError(f"complete: the mask of known {what} must lie in [0, 1] (1 = known)")
        if not values.is_floating_point():
            raise ValueError(
                f"complete: expected {what} in floating-point numbers, got {values.dtype}; colours are in [0, 1]"
            )
        broken = int(((~torch.isfinite(values)) & (known > 0)).any(dim=1).sum())
        if broken:
            raise ValueError(
                f"complete: {broken} known {what} are NaN or infinite; mark them as unknown (mask 0) or repair them"
            )
        far = int(((values.abs() > _FARTHEST[what]) & (known > 0)).any(dim=1).sum())
        if far:
            raise ValueError(
                f"complete: {far} known {what} are beyond {_FARTHEST[what]:g}; mark them as unknown (mask 0) or scale "
                "them"
            )


def _check_current(current: Views, views: Views) -> None:
    if len(current) != len(views) or current.size != views.size:
        expected, got = (f"{len(some)} views of {some.size[1]}x{some.size[0]}" for some in (views, current))
        raise ValueError(f"current: expected {expected} like the views to be completed, got {got}")
    pixels, rays = only_known(current.images, current.image_known), only_known(current.raymaps, current.rays_known)
    if not bool(torch.isfinite(pixels).all() & torch.isfinite(rays).all()):
        raise ValueError(
            "current: pixels or rays are NaN or infinite; pass whole views, such as an earlier answer of complete"
        )


def _counting(current: Views, views: Views) -> Float[Tensor, "n 32 h w"] | None:
    """1 at the latents that are wholly known in current views or in those to be completed; None where the current ones
    add nothing.

    Where the least known pixel of a latent has a mask between 0 and 1 in the current views it is that, in quarters: it
    starts in between.
    """
    rays_known = views.rays_known.maximum(current.rays_known)
    known = known_latents(to_latent_grid(views.image_known), to_latent_grid(views.rays_known))
    there = (views.image_known >= 1).to(current.image_known).maximum(current.image_known)
    least = -F.max_pool2d(-there, kernel_size=_LATENT_PIXELS)
    told = (least * _STARTS).floor() / _STARTS
    rays = (to_latent_grid(rays_known) == 1).to(told)
    counts = unsplit(*(part.expand(-1, LATENT_CHANNELS, -1, -1).to(known) for part in (told, rays)))
    return None if torch.equal(counts, known) else counts


def _padded(views: Views, *, mode: str = "constant") -> Views:
    """Sides brought up to multiples of 16 with pixels and rays that are unknown."""
    height, width = views.size
    extra = (0, -width % SIDE_MULTIPLE, 0, -height % SIDE_MULTIPLE)
    if not any(extra):
        return views
    return dataclasses.replace(
        views, **{f.name: F.pad(getattr(views, f.name), extra, mode=mode) for f in dataclasses.fields(Views)}
    )


def _working(views: Views, device: torch.device) -> Views:
    """As the networks take them: float32; raymaps that are more exact stay so until they are in the canonical frame."""
    exact = torch.float32 if device.type == "mps" else torch.promote_types(views.raymaps.dtype, torch.float32)
    single = {f.name: getattr(views, f.name).to(device, torch.float32) for f in dataclasses.fields(Views)}
    return dataclasses.replace(views, **single | {"raymaps": views.raymaps.to(device, exact)})


def _as_given(filled: Views, views: Views) -> Views:
    """Cut to the size of the views, on their device and in their precision; what they know keeps its bits."""
    height, width = views.size
    cut = {
        f.name: getattr(filled, f.name)[..., :height, :width].to(getattr(views, f.name))
        for f in dataclasses.fields(Views)
    }
    cut["images"] = torch.where(views.image_known < 1, cut["images"], views.images)
    cut["raymaps"] = torch.where(views.rays_known > 0, views.raymaps, cut["raymaps"])
    return Views(**cut)


__all__ = ["BUNDLED_MODEL", "LATENT_CHANNELS", "Fillerbuster", "SamplingConfig", "noise_of"]
