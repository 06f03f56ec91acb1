"""The denoising of one sequence, put together: prepared network, tiling, guidance, known latents, start, solver."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from einops import reduce
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.conditioning import STATE_CHANNELS, Conditioning, stacked_facts
from fb_core.machine.precision import resolved
from fb_core.networks.shared_results import SharedResults
from fb_core.networks.transformer.dit import DiT
from fb_core.networks.transformer.prepared import Prepared
from fb_core.sampling.guidance import branches, guidance_map, guided
from fb_core.sampling.integration.solvers import VelocityField
from fb_core.sampling.integration.trajectory import OnStep, OnTrajectory, Trajectory, integrate
from fb_core.sampling.options import SamplingConfig
from fb_core.sampling.randomness import Orders
from fb_core.sampling.reference import reference_field
from fb_core.sampling.starts import imposed, known_channels, reference_started, started
from fb_core.sampling.tiling import tiled


@dataclass(frozen=True, kw_only=True)
class Denoising:
    """All that decides the latents of one sequence."""

    dit: DiT
    """The network."""
    conditioning: Conditioning
    """What is known."""
    null: Conditioning | None
    """That nothing is known; None where the guidance scale is 1 everywhere, which asks for no such branch."""
    noise: Float[Tensor, "n 32 h w"]
    """Noise of every view, on the network's device."""
    orders: Orders
    """Orders of the views in windows."""
    sampling: SamplingConfig
    """Options."""
    text: Float[Tensor, "texts words t"] | None = None
    """The empty prompt, and a prompt if there is one; None for a network without text."""
    current: Float[Tensor, "n 32 h w"] | None = None
    """Latents that sampling starts from at a strength below 1."""
    counts: Float[Tensor, "n 32 h w"] | None = None
    """1 where these count, 0 where sampling starts from noise all the same; None is 1 everywhere. What they tell in
    part starts in between (`SamplingConfig.joins_at`). Not looked at when sampling as the original does.
    """
    branches_at_once: int | None = None
    """Branches of guidance in one batch; None is all."""
    prepared: Prepared | None = None
    """The network bound to what is known, which other draws of noise may share; None makes it when it is needed."""
    shared: SharedResults | None = None
    """What other samplings computed of the same known tokens, and may use of this one."""

    def __post_init__(self) -> None:
        if self.sampling.strength < 1 and self.current is None:
            raise ValueError(
                f"strength: starting at time {self.sampling.strength:g} needs views to start from, got none; pass "
                "current views"
            )

    def run(
        self,
        *,
        on_step: OnStep | None = None,
        on_trajectory: OnTrajectory | None = None,
        resume: Trajectory | None = None,
    ) -> Float[Tensor, "n 32 h w"]:
        """Latents at t = 0."""
        solver = "euler" if self.sampling.reference_compatible else self.sampling.solver
        with self._precision():
            return integrate(
                self.field(),
                self.start(),
                self.times,
                solver=solver,
                on_step=on_step,
                on_trajectory=on_trajectory,
                resume=resume,
            )

    def bound(self) -> Denoising:
        """The same with the network bound to what is known: other draws (`redrawn`) need not do that again."""
        with self._precision():
            return dataclasses.replace(self, prepared=self._prepared())

    def redrawn(self, noise: Float[Tensor, "n 32 h w"], orders: Orders) -> Denoising:
        """The same question with other draws."""
        return dataclasses.replace(self, noise=noise, orders=orders)

    def _precision(self) -> torch.autocast:
        half = resolved(self.sampling.precision, self.noise.device) == torch.bfloat16
        return torch.autocast(self.noise.device.type, torch.bfloat16, enabled=half)

    @property
    def times(self) -> list[float]:
        """The times of the sampling: from 1 where anything starts from noise, and then through the strength."""
        return self.sampling.times_from_noise_through(self._shares) if self._from_noise_too else self.sampling.times

    @property
    def _from_noise_too(self) -> bool:
        return self.counts is not None and not bool((self.counts == 1).all())

    @property
    def _shares(self) -> list[float]:
        """How much the current views tell of latents of which they tell anything, each once."""
        return [] if self.counts is None else [share for share in self.counts.unique().tolist() if share > 0]

    def start(self) -> Float[Tensor, "n 32 h w"]:
        """Where the trajectory starts."""
        sampling = self.sampling
        if self.current is None or sampling.strength == 1:
            return self.noise
        if sampling.reference_compatible:
            return reference_started(self.current, self.noise, strength=sampling.strength, steps=sampling.steps)
        if self._from_noise_too:
            return self.noise
        current = self.current
        if sampling.known == "imposed":
            current = self.conditioning.channels[:, :STATE_CHANNELS].where(
                known_channels(self.conditioning) > 0, current
            )
        return started(current, self.noise, sampling.strength)

    def _scale(self) -> Float[Tensor, "n 32 h w"]:
        sampling = self.sampling
        return guidance_map(self.conditioning, known=sampling.guidance_known, unknown=sampling.guidance_unknown)

    def _prepared(self) -> Prepared:
        """The network under the branches of guidance."""
        parts, text = branches(self.conditioning, self.null, self._scale()), self.text
        if text is not None and self._prompted:
            text = torch.stack([text[0]] * len(parts) + [text[1]])
            parts = [*parts, self.conditioning]
        channels = torch.stack([part.channels for part in parts])
        facts = stacked_facts(parts, self.dit.config)._replace(asked=self._asked())
        return Prepared(
            self.dit,
            channels,
            self.times[:-1],
            text=text,
            branches_at_once=self.branches_at_once,
            facts=facts,
            shared=self.shared,
        )

    def _asked(self) -> Bool[Tensor, "n h w"] | None:
        """Tokens whose velocity matters: where known latents are imposed, those that show an unknown one."""
        sampling, patch = self.sampling, self.dit.config.patch
        mixes = sampling.guidance.rescale > 0 or sampling.guidance.optimized_scale  # the latents of a view
        if sampling.known != "imposed" or sampling.reference_compatible or mixes:
            return None
        unknown = known_channels(self.conditioning) <= 0
        return reduce(unknown, "n z (h p) (w q) -> n h w", "any", p=patch, q=patch)

    @property
    def _prompted(self) -> bool:
        return self.text is not None and len(self.text) == 2

    def field(self) -> VelocityField:
        """The guided velocity."""
        sampling, variant, scale = self.sampling, self.sampling.guidance, self._scale()
        prepared = self._prepared() if self.prepared is None else self.prepared
        guides = prepared.branches - self._prompted == 2
        text_scale = sampling.guidance_text if self._prompted else None
        if sampling.reference_compatible:
            cut = {"window": sampling.window, "rounds": sampling.rounds, "orders": self.orders}
            return reference_field(prepared, scale, text_scale=text_scale, **cut)

        def cut_up(network: Prepared):
            return tiled(network, window=sampling.window, rounds=sampling.rounds, orders=self.orders)

        unguided = cut_up(prepared.only(slice(1, None))) if guides and variant.is_limited else None
        field = guided(cut_up(prepared), scale, text_scale=text_scale, variant=variant, unguided=unguided)
        if sampling.known == "imposed":
            field = imposed(
                field,
                self.conditioning.channels[:, :STATE_CHANNELS],
                self.noise,
                known_channels(self.conditioning),
            )
        if self.current is not None and self.counts is not None and self._from_noise_too:
            for share in self._shares:
                mask = (self.counts == share).to(self.counts)
                field = imposed(field, self.current, self.noise, mask, until=sampling.joins_at(share))
        return field
