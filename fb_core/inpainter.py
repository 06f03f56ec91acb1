"""Fillerbuster: complete any mix of known, partly known and unknown images and raymaps of one scene (paper, section
3.1).
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core import checkpoint
from fb_core.conditioning import (
    LATENT_CHANNELS,
    Encoding,
    decode_in_chunks,
    encode_in_chunks,
    encode_known,
    encode_null,
    only_known,
    split,
    unsplit,
)
from fb_core.geometry.known_rays import frame_of_known_rays
from fb_core.geometry.raymap import from_unit_range, to_unit_range
from fb_core.given_views import Job, as_given, check_current, check_views, padded, working
from fb_core.machine.precision import in_own_precision, resolved
from fb_core.memory.budget import Cut, MemoryEstimate, available_bytes, estimate, uncut
from fb_core.networks.shared_results import SharedResults
from fb_core.networks.text import TextEncoder
from fb_core.sampling.denoising import Denoising
from fb_core.sampling.integration.trajectory import OnStep, SamplingInterrupted, counted
from fb_core.sampling.options import SamplingConfig
from fb_core.sampling.preview import Progress
from fb_core.sampling.randomness import noise_of, posterior_generators, random_orders
from fb_core.sampling.starts import Start, joining
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
        self.shared: SharedResults | None = None
        """What further calls may use again of one that was told the same, to the same bits; None keeps nothing."""
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
        needed = estimate(views, size, self.dit.dtype, model=self.config, sampling=sampling, prompted=prompted)
        return needed.beside(0 if self.shared is None else self.shared.limit_bytes, sampling.memory_budget_bytes)

    @torch.no_grad()
    @in_own_precision
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
        job, start, text = self._asked(views, sampling, prompt, current)
        seed = None if resume is None else resume.seed
        seed = int(torch.randint(0, 2**62, (), generator=generator)) if seed is None else seed
        denoising = self._denoising(job, start, text, seed)
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
        return as_given(self._decode(job, latents), views)

    @torch.no_grad()
    @in_own_precision
    def complete_often(
        self,
        views: Views,
        *,
        generators: Sequence[torch.Generator],
        sampling: SamplingConfig | None = None,
        on_step: OnStep | None = None,
        prompt: str | None = None,
        current: Views | None = None,
    ) -> list[Views]:
        """Several answers to one question, each to the bit what `complete` gives with its generator.

        What is known is encoded, and shown to the network, once for all of them: known tokens that stand apart
        (`DiTConfig.known_tokens`) cost nothing in all samples but the first. Raises as `complete` does.
        """
        job, start, text = self._asked(views, sampling, prompt, current)
        denoising, answers = None, []
        for number, generator in enumerate(generators):
            seed = int(torch.randint(0, 2**62, (), generator=generator))
            if denoising is None or job.sampling.sample_posterior:  # else nothing of what is known depends on the seed
                denoising = self._denoising(job, start, text, seed).bound()
            else:
                height, width = denoising.noise.shape[-2:]
                noise = noise_of(seed, len(denoising.noise), (height, width)).to(self.device)
                denoising = denoising.redrawn(noise, random_orders(seed))
            latents = denoising.run(on_step=counted(on_step, number, len(generators)))
            answers.append(as_given(self._decode(job, latents), views))
        return answers

    def recover_raymaps(
        self, images: Float[Tensor, "n 3 h w"], *, generator: torch.Generator, sampling: SamplingConfig | None = None
    ) -> Float[Tensor, "n 6 h w"]:
        """Raymaps of photos without poses (paper, "Raymap prediction"), in a canonical frame of their own: the cube
        [-1, 1]^3.

        None samples as `recommended_sampling.for_poses()` says. Raises as `complete` does.
        """
        sampling = self.recommended_sampling.for_poses() if sampling is None else sampling
        return self.complete(Views.unposed(images), generator=generator, sampling=sampling).raymaps

    def _asked(
        self, views: Views, sampling: SamplingConfig | None, prompt: str | None, current: Views | None
    ) -> tuple[Job, Start, Float[Tensor, "texts words t"] | None]:
        """What `complete` is asked, looked at and made ready."""
        check_views(views)
        if current is not None:
            check_current(current, views)
        sampling = self.recommended_sampling if sampling is None else sampling
        text = self._text_of(prompt if sampling.guidance_text else None)
        job = self._job(views, sampling, prompt)
        return job, self._start(job, current), text

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
            free = None if free is None else max(0, free - (self.shared.room_bytes if self.shared else 0))
            cut = uncut(views, size, free, model=self.config, sampling=sampling, prompted=bool(prompt))
            if cut is not None:
                return cut
        expected = self.estimate(views, size, sampling, prompt=prompt)
        if free is not None and expected.working > free:
            tight = dataclasses.replace(sampling, memory_budget_bytes=expected.weights + free)
            expected = self.estimate(views, size, tight, prompt=prompt)
        _logger.debug("%d views of %dx%d: %.2f GiB, %s", views, size[1], size[0], expected.peak / 2**30, expected.cut)
        return expected.cut

    @in_own_precision
    def denoising(self, views: Views, *, seed: int, sampling: SamplingConfig | None = None) -> Denoising:
        """What `complete` would denoise, with the start and the velocity of its trajectory, for measurements."""
        check_views(views)
        sampling = self.recommended_sampling if sampling is None else sampling
        job = self._job(views, sampling, None)
        return self._denoising(job, Start(sampling=sampling), self._text_of(None), seed)

    def _job(self, views: Views, sampling: SamplingConfig, prompt: str | None) -> Job:
        """The views as the networks take them, their frame, and how the work is cut."""
        cut, shared = self._cut(len(views), views.size, sampling, prompt), self.shared
        if shared is not None and sampling.memory_budget_bytes is not None:
            if not self.estimate(len(views), views.size, sampling, prompt=prompt).shared:
                shared.forget()
                shared = None
        ready = working(views, self.device)
        frame = frame_of_known_rays(ready.raymaps, ready.rays_known)
        return Job(views=padded(ready), frame=frame, cut=cut, sampling=sampling, shared=shared)

    def _start(self, job: Job, current: Views | None) -> Start:
        """What denoising starts from and is told as a guess, of views that there are already."""
        sampling = job.sampling
        if current is None:
            return Start(sampling=sampling)
        current = padded(working(current, self.device), mode="replicate")
        guess = current if sampling.guess != "start" else None
        if sampling.guess == "told":
            sampling = dataclasses.replace(sampling, strength=1.0)
        if sampling.strength < 1:
            joined = joining(current, job.views)
            if joined is not None:
                latents = self._encoded(current, job)
                return Start(sampling=sampling, latents=latents, joined=joined, guess=guess)
            sampling = dataclasses.replace(sampling, strength=1.0)  # they tell nothing that is not known anyway
        return Start(sampling=sampling, guess=guess)

    def _denoising(self, job: Job, start: Start, text: Tensor | None, seed: int) -> Denoising:
        """What is known of the views, encoded, with all draws."""
        views, guess, sampling = job.views, start.guess, start.sampling
        vaes = {"image_vae": self.image_vae, "raymap_vae": self.raymap_vae}
        conditioning = encode_known(
            views.images,
            views.image_known,
            to_unit_range(job.canonical(torch.where(views.rays_known > 0, views.raymaps, 0.0))).float(),
            views.rays_known,
            **vaes,
            encoding=Encoding(
                views_at_once=job.cut.views_encoded,
                generators=posterior_generators(seed, len(views)) if sampling.sample_posterior else None,
                precision=resolved(sampling.precision, self.device),
                shared=job.shared,
            ),
            transformer=self.dit.config,
            guess=None if guess is None else (guess.images, sampling.belief * guess.image_known),
        )
        height, width = conditioning.channels.shape[-2:]
        return Denoising(
            dit=self.dit,
            conditioning=conditioning,
            null=encode_null(conditioning, **vaes, pixels=views.size) if sampling.guides else None,
            noise=noise_of(seed, len(views), (height, width)).to(self.device),
            orders=random_orders(seed),
            sampling=sampling,
            text=text,
            current=start.latents,
            counts=start.joined,
            branches_at_once=job.cut.branches,
            shared=job.shared,
        )

    def _encoded(self, current: Views, job: Job) -> Float[Tensor, "n 32 h w"]:
        """Latents of current views, where known pixels and rays take the place of the current ones."""
        views, at_once = job.views, job.cut.views_encoded
        # A mask below 1 says when a pixel joins, not how dark it is.
        whole = (current.image_known > 0).to(current.image_known)
        images = only_known(views.images, views.image_known) + (1 - views.image_known) * only_known(
            current.images, whole
        )
        raymaps = torch.where(views.rays_known > 0, views.raymaps, current.raymaps.to(views.raymaps))
        there = views.rays_known.maximum(current.rays_known) > 0
        raymaps01 = to_unit_range(job.canonical(torch.where(there, raymaps, 0.0))).clamp(0, 1).float()
        # As in what is known; 0 of the world would be a place that depends on the world.
        raymaps01 = torch.where(there, raymaps01, 0.0)
        return unsplit(
            encode_in_chunks(self.image_vae, images, at_once), encode_in_chunks(self.raymap_vae, raymaps01, at_once)
        )

    def _decode(self, job: Job, latents: Tensor) -> Views:
        """Pixels and rays of the latents, with what is known pasted back; views that are wholly known are not
        decoded.
        """
        views, frame, cut = job.views, job.frame, job.cut
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


__all__ = ["BUNDLED_MODEL", "LATENT_CHANNELS", "Fillerbuster", "SamplingConfig", "noise_of"]
