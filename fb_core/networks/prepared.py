"""A transformer bound to all that stays constant while one set of views is sampled, so that a step computes only what changes.

Computed once instead of at every step: the patch projection of the conditioning channels, the keys and values of the text in every
block, all that other tokens see of known ones that stand apart, the position embeddings, and the modulations of the whole time grid
(which reads the modulation layers, a quarter of the released weights, once instead of at every step). What the branches of guidance
share, the noisy latents' tokens and the modulations, is computed once for all of them.
"""

import copy
from collections.abc import Sequence

import torch
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.networks.blocks import Attention, KeysValues, Modulation
from fb_core.networks.dit import NO_FACTS, DiT, TokenFacts
from fb_core.networks.known_tokens import streams


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
        facts: TokenFacts = NO_FACTS,
    ):
        """Compute the constants.

        Args:
            dit: the network; its weights must not change afterwards.
            conditioning: the channels that follow the noisy ones, for b branches of n views.
            times: every time in [0, 1] at which a velocity will be asked for; others work too, but are computed when asked for.
            text: one embedding for all branches or one for each; None for a network without text.
            branches_at_once: branches that are evaluated as one batch; None is all of them, 1 needs the least memory.
            facts: what is known of the tokens of every branch, for networks that read it.

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
        self._facts = facts
        self._told = conditioning[:, :, :noisy] if dit.known_of(facts) is not None else None
        self._apart: dict[tuple[int, int], dict[Attention, list[KeysValues]]] = {}
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
        count, expected = len(state), self._tokens.shape[1] if views is None else len(views)
        if count != expected:
            raise ValueError(f"state: expected {expected} views, got {count}.")
        if count not in self._positions:
            self._positions[count] = self.dit.positions(count, *self._size, device=state.device)
        shared = self.dit.embed_patches(state[None], bias=False) + self._positions[count]
        modulation = self._modulation(time, state.device)
        velocities = []
        for first in range(0, self.branches, self.branches_at_once):
            part = slice(first, min(first + self.branches_at_once, self.branches))
            velocities.append(self._velocity(state, shared, modulation, time, part, views))
        return torch.cat(velocities).to(state.dtype)

    def _velocity(
        self,
        state: Float[Tensor, "n z h w"],
        shared: Float[Tensor, "1 tokens d"],
        modulation: Modulation,
        time: float,
        part: slice,
        views: Int[Tensor, "m"] | None,
    ) -> Float[Tensor, "b n z h w"]:
        """The velocity of some branches, given what their tokens share."""
        told_tokens = rearrange(self._tokens[part] if views is None else self._tokens[part][:, views], "b n places d -> b (n places) d")
        contexts = [self._context(context, part) for context in self._contexts]
        facts = self._facts_of(part, views)
        known, frames = self.dit.known_of(facts), self.dit.frames_of(facts)
        if known is None or self._told is None:
            return self.dit.unpatchify(self.dit.run_blocks(shared + told_tokens, modulation, contexts, frames), len(state), *self._size)
        told = self._told[part] if views is None else self._told[part][:, views]
        apart, others = streams(rearrange(known, "b n h w -> b (n h w)"))
        looked_up = self._apart.get((part.start, part.stop)) if views is None else None
        if looked_up is None:
            clean = self.dit.embed_patches(told, bias=False) + self._positions[len(state)] + told_tokens
            looked_up = self.dit.run_known(clean, apart, contexts, frames)
            if views is None:
                self._apart[part.start, part.stop] = looked_up
        patches = self.dit.run_unknown(shared + told_tokens, others, looked_up, modulation, contexts, frames)
        velocity = self.dit.unpatchify(patches, len(state), *self._size)
        leading = self.dit.leading_to(told, state[None], torch.full((1,), time, device=state.device))
        return self.dit.where_known(known, leading.expand_as(velocity), velocity)

    def _facts_of(self, part: slice, views: Tensor | None) -> TokenFacts:
        frames, known = (
            None if values is None else values[part] if views is None else values[part][:, views] for values in self._facts[:2]
        )
        return TokenFacts(frames=frames, known=known)

    def only(self, branches: slice) -> "Prepared":
        """The same with some of its branches; shares all constants, so it costs nothing."""
        chosen = copy.copy(self)
        chosen._tokens = self._tokens[branches]
        frames, known = (None if values is None else values[branches] for values in self._facts[:2])
        chosen._facts = TokenFacts(frames=frames, known=known)
        chosen._told = None if self._told is None else self._told[branches]
        chosen._apart = {}
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
