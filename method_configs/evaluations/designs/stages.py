"""Designs of training that are compared with the product's own, and are no part of it: a network that predicts the data
under a loss of the velocity, and a teacher of depth that is dropped after the training.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from fb_core.networks.transformer.dit import NO_FACTS, DiT, DiTConfig, TokenFacts
from fb_core.training.kept_batches import KeptBatches
from fb_core.training.run.stage import Stage
from fb_core.training.stages.dit_stage import DiTStage, Drawn, Encoded

LEAST_TIME = 0.05
"""Least time that what a `PredictsData` says is divided by. Times of training lie below it in 0.2 % of the draws, those
of sampling never.
"""


class KeptStage(DiTStage):
    """Trains on batches that are kept; noise, times and the places of views are drawn anew by the seed."""

    def __init__(self, network: DiT, batches: KeptBatches, **options: Any):
        """``options``: those of a `DiTStage`."""
        super().__init__(network, **options)
        self.batches = batches

    def encoded(self, step: int, rows: range) -> Encoded:
        """The whole batch; a part of it is not kept. Raises ValueError for a part of the batch."""
        if rows != range(self.batches.stage.batch):
            raise ValueError(f"kept batches: expected all rows at once, {range(self.batches.stage.batch)}, got {rows}")
        return self.batches.get(step).encoded


class PredictsData(DiT):
    """A transformer whose last layer says what the data are, told as the velocity that leads there.

    v = (z_t - x) / max(t, LEAST_TIME): for the true data x this is the true velocity at all times from LEAST_TIME on.
    """

    def __init__(self, config: DiTConfig):
        """Raises ValueError for known tokens that stand apart, whose velocity is not the network's."""
        super().__init__(config)
        if config.known_tokens != "joint":
            raise ValueError(
                f"a network that predicts the data: expected known tokens joint, got {config.known_tokens}"
            )

    def data(
        self,
        sequence: Float[Tensor, "b n c h w"],
        time: Float[Tensor, "b"],
        text: Float[Tensor, "b words t"] | None = None,
        index: Float[Tensor, "b n"] | None = None,
        facts: TokenFacts = NO_FACTS,
    ) -> Float[Tensor, "b n z h w"]:
        """What the last layer says."""
        return super().forward(sequence, time, text, index, facts)

    def forward(
        self,
        sequence: Float[Tensor, "b n c h w"],
        time: Float[Tensor, "b"],
        text: Float[Tensor, "b words t"] | None = None,
        index: Float[Tensor, "b n"] | None = None,
        facts: TokenFacts = NO_FACTS,
    ) -> Float[Tensor, "b n z h w"]:
        """The velocity."""
        said = self.data(sequence, time, text, index, facts)
        return (sequence[:, :, : self.config.out_channels] - said) / time.clamp(min=LEAST_TIME).view(-1, 1, 1, 1, 1)


class PredictsDataStage(KeptStage):
    """Trains a `PredictsData`: the loss of the velocity, whose target is divided by the same clamped time.

    So the loss is that of the data, weighted by 1 / max(t, LEAST_TIME)^2, and 0 for a perfect network at every time.
    """

    def losses(self, drawn: Drawn) -> dict[str, Tensor]:
        """See `DiTStage.losses`."""
        share = (drawn.times / drawn.times.clamp(min=LEAST_TIME)).view(-1, 1, 1, 1, 1)
        return super().losses(dataclasses.replace(drawn, velocity=drawn.velocity * share))


class DepthDrawn(NamedTuple):
    """What is drawn for a training with a teacher of depth."""

    drawn: Drawn
    log_distance: Float[Tensor, "b n 1 h w"]


class DepthHead(nn.Module):
    """Log distances at the latents of a token, from what the token's velocity is made of."""

    def __init__(self, config: DiTConfig):
        super().__init__()
        self.patch = config.patch
        self.linear = nn.Linear(config.width, config.patch**2)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, tokens: Float[Tensor, "b tokens d"], views: int, rows: int) -> Float[Tensor, "b n 1 h w"]:
        """``rows``: tokens in a column of a view."""
        sides = {"n": views, "h": rows, "p": self.patch, "q": self.patch}
        return rearrange(self.linear(tokens), "b (n h w) (p q) -> b n 1 (h p) (w q)", **sides)


class DepthTaughtStage(Stage):
    """Trains a transformer that also tells a head how far everything is. The head is optimised beside it, and no part
    of what is kept.
    """

    name = "dit"

    def __init__(self, stage: KeptStage, *, weight: float = 0.1):
        """``weight`` of the squared error of log distances."""
        self.inner, self.network, self.weight = stage, stage.network, weight
        self.critic: DepthHead = DepthHead(stage.network.config)

    @property
    def batch(self) -> int:
        """Rows of a batch."""
        return self.inner.batch

    def draw(self, step: int, rows: range) -> DepthDrawn:
        """What the transformer learns from, and the rooms' exact distances, which are told to the loss alone.

        Raises ValueError for batches without distances.
        """
        log_distance = self.inner.batches.get(step).log_distance
        if log_distance is None:
            raise ValueError("a teacher of depth: expected data with exact distances, such as rooms")
        return DepthDrawn(self.inner.draw(step, rows), log_distance.repeat_interleave(self.inner.config.draws, dim=0))

    def losses(self, drawn: DepthDrawn) -> dict[str, Tensor]:
        """Those of the transformer, and the squared error of the log distances."""
        seen: list[Tensor] = []
        last: nn.Module = self.inner.network.proj_out_2
        hook = last.register_forward_pre_hook(partial(_look, seen))
        try:
            losses = self.inner.losses(drawn.drawn)
        finally:
            hook.remove()
        _, views, _, height, _ = drawn.log_distance.shape
        said = self.critic(seen[-1], views, height // self.inner.network.config.patch)
        depth = F.mse_loss(said.float(), drawn.log_distance)
        return losses | {"loss": losses["loss"] + self.weight * depth, "depth": depth}


def _look(seen: list[Tensor], _: nn.Module, inputs: tuple[Tensor, ...]) -> None:
    seen.append(inputs[0])
