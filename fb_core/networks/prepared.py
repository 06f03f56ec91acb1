"""A transformer bound to all that stays constant while one set of views is sampled, so that a step computes only what changes.

Computed once instead of at every step: the patch projection of the conditioning channels, the keys and values of the text in every
block, the position embeddings, and the modulations of the whole time grid (which reads the modulation layers, a quarter of the
released weights, once instead of at every step). What the branches of guidance share, the noisy latents' tokens and the
modulations, is computed once for all of them.
"""

import copy
from collections.abc import Sequence

import torch
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.networks.blocks import KeysValues
from fb_core.networks.dit import DiT, Modulation


class Prepared:
    """The velocity of noisy latents under one or more conditionings (the branches of guidance).

    Up to rounding, `prepared(state, time)[b]` is `dit(cat([state, conditioning[b]]), time, text[b])`.
    """

    @torch.no_grad()
    def __init__(
        self,
        dit: DiT,
        conditioning: Float[Tensor, "b n c h w"],
        times: Sequence[float],
        *,
        text: Float[Tensor, "texts words t"] | None = None,
        branches_at_once: int | None = None,
    ):
        """Compute the constants.

        Args:
            dit: the network; its weights must not change afterwards.
            conditioning: the channels that follow the noisy ones, for b branches of n views.
            times: every time in [0, 1] at which a velocity will be asked for; others work too, but are computed when asked for.
            text: one embedding for all branches or one for each; None for a network without text.
            branches_at_once: branches that are evaluated as one batch; None is all of them, 1 needs the least memory.

        Raises ValueError if the conditioning has no branch or other channels than the network expects, or if the texts are not one or b.
        """
        noisy, expected = dit.config.out_channels, dit.config.in_channels - dit.config.out_channels
        branches, views, channels, height, width = conditioning.shape
        if not branches or channels != expected:
            raise ValueError(f"conditioning: expected branches of {expected} channels, got {branches} of {channels}.")
        if text is not None and len(text) not in (1, branches):
            raise ValueError(f"text: expected one embedding or one for each of {branches} branches, got {len(text)}.")
        if branches_at_once is not None and branches_at_once < 1:
            raise ValueError(f"branches_at_once: expected at least 1, got {branches_at_once}.")
        self.dit = dit
        self.branches = branches
        self.branches_at_once = branches_at_once or branches
        self._size = height, width
        self._tokens = rearrange(dit.embed_patches(conditioning, first_channel=noisy), "b (n places) d -> b n places d", n=views)
        self._contexts = dit.text_context(text)
        self._times = {time: step for step, time in enumerate(times)}
        grid = torch.tensor(list(times), dtype=torch.float32, device=conditioning.device)
        self._modulations = dit.modulate(grid) if self._times else None
        self._positions: dict[int, Tensor] = {}

    @torch.no_grad()
    def __call__(self, state: Float[Tensor, "n z h w"], time: float, views: Int[Tensor, "n"] | None = None) -> Float[Tensor, "b n z h w"]:
        """The velocity of every branch, in the state's precision.

        `views` says which of the prepared views the state's are, for a window of them that is a sequence of its own; None is all.
        """
        tokens = self._tokens if views is None else self._tokens[:, views]
        count = len(state)
        if count != tokens.shape[1]:
            raise ValueError(f"state: expected {tokens.shape[1]} views, got {count}.")
        if count not in self._positions:
            self._positions[count] = self.dit.positions(count, *self._size, device=state.device)
        shared = self.dit.embed_patches(state[None], bias=False) + self._positions[count]
        modulation = self._modulation(time, state.device)
        velocities = []
        for first in range(0, self.branches, self.branches_at_once):
            part = slice(first, min(first + self.branches_at_once, self.branches))
            together = shared + rearrange(tokens[part], "b n places d -> b (n places) d")
            patches = self.dit.run_blocks(together, modulation, [self._context(context, part) for context in self._contexts])
            velocities.append(self.dit.unpatchify(patches, count, *self._size))
        return torch.cat(velocities).to(state.dtype)

    def only(self, branches: slice) -> "Prepared":
        """The same with some of its branches; shares all constants, so it costs nothing."""
        chosen = copy.copy(self)
        chosen._tokens = self._tokens[branches]
        chosen.branches = len(chosen._tokens)
        chosen.branches_at_once = min(self.branches_at_once, chosen.branches)
        chosen._contexts = [
            context if context is None or len(context[0]) == 1 else KeysValues(*(x[branches] for x in context))
            for context in self._contexts
        ]
        return chosen

    def _modulation(self, time: float, device: torch.device) -> Modulation:
        step = self._times.get(time)
        if step is None or self._modulations is None:
            return self.dit.modulate(torch.tensor([time], dtype=torch.float32, device=device))
        blocks, final = self._modulations
        return Modulation(blocks[..., step : step + 1, :], final[..., step : step + 1, :])

    @staticmethod
    def _context(context: KeysValues | None, part: slice) -> KeysValues | None:
        if context is None:
            return None
        count = part.stop - part.start
        return KeysValues(*(x.expand(count, -1, -1, -1) if len(x) == 1 else x[part] for x in context))
