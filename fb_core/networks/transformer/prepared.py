"""A transformer bound to all that stays constant while one set of views is sampled, so that a step computes only what
changes.

Computed once instead of at every step: the patch projection of the conditioning channels, the keys and values of the
text in every block, all that other tokens see of known ones that stand apart, the position embeddings, and the
modulations of the whole time grid (which reads the modulation layers, a quarter of the released weights, once instead
of at every step). What the branches of guidance share, the noisy latents' tokens and the modulations, is computed once
for all of them.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fb_core.networks.shared_results import SharedResults
from fb_core.networks.transformer.attention import Attention, KeysValues
from fb_core.networks.transformer.blocks import Modulation
from fb_core.networks.transformer.dit import NO_FACTS, DiT, TokenFacts
from fb_core.networks.transformer.known_tokens import Stream, streams
from fb_core.networks.transformer.ray_frames import RayFrames


@dataclass(frozen=True, kw_only=True)
class _Apart:
    """Known tokens that stand apart, in some branches."""

    known: Bool[Tensor, "b n h w"]
    """Which tokens they are."""
    told: Float[Tensor, "b n z lh lw"]
    """Their latents."""
    others: Stream
    """The tokens that are not known."""
    looked_up: dict[Attention, list[KeysValues]]
    """All that the others see of the known ones."""


@dataclass(frozen=True, kw_only=True)
class _Bound:
    """What is the same at every step, for some branches of some views."""

    tokens: Float[Tensor, "b tokens d"]
    """The projected conditioning."""
    contexts: list[KeysValues | None]
    """Keys and values of the text in every block."""
    frames: RayFrames | None
    """What attention is told in."""
    apart: _Apart | None
    """None where no known token stands apart."""
    asked: Int[Tensor, "some"] | None
    """Places of the tokens whose velocity matters; None is all."""


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
        shared: SharedResults | None = None,
    ):
        """Compute the constants.

        Args:
            dit: the network; its weights must not change afterwards.
            conditioning: the channels that follow the noisy ones, for b branches of n views.
            times: every time in [0, 1] at which a velocity will be asked for; others work too, but are computed when
                asked for.
            text: one embedding for all branches or one for each; None for a network without text.
            branches_at_once: branches that are evaluated as one batch; None is all of them, 1 needs the least memory.
            facts: what is known of the tokens of every branch, for networks that read it.
            shared: keys and values of known tokens, to be used again where the same ones are known in another sampling.

        Raises ValueError if the conditioning has no branch or other channels than the network expects, or if the texts
        are not one or b.
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
        joint = dit.config.known_tokens == "joint"
        self._asked = facts.asked if joint and facts.asked is not None and not bool(facts.asked.all()) else None
        self._shared = shared
        self._told = conditioning[:, :, :noisy] if dit.known_of(facts) is not None else None
        self._bound: dict[tuple[int, int], _Bound] = {}
        self._tokens = rearrange(
            dit.embed_patches(conditioning, first_channel=noisy), "b (n places) d -> b n places d", n=views
        )
        self._contexts = dit.text_context(text)
        self._times = {time: step for step, time in enumerate(times)}
        grid = torch.tensor(list(times), dtype=torch.float32, device=conditioning.device)
        self._modulations = dit.modulate(grid) if self._times else None
        self._positions: dict[int, Tensor] = {}

    @torch.no_grad()
    def __call__(
        self, state: Float[Tensor, "n z h w"], time: float, views: Int[Tensor, "n"] | None = None
    ) -> Float[Tensor, "b n z h w"]:
        """The velocity of every branch, in the state's precision.

        `views` says which of the prepared views the state's are, for a window of them that is a sequence of its own;
        None is all.
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
            velocities.append(self._velocity(state, shared, modulation, time, self._bound_to(part, views)))
        return torch.cat(velocities).to(state.dtype)

    def _velocity(
        self,
        state: Float[Tensor, "n z h w"],
        shared: Float[Tensor, "1 tokens d"],
        modulation: Modulation,
        time: float,
        bound: _Bound,
    ) -> Float[Tensor, "b n z h w"]:
        """The velocity of some branches, given what their tokens share."""
        tokens, apart = shared + bound.tokens, bound.apart
        if apart is None:
            patches = self.dit.run_blocks(tokens, modulation, bound.contexts, bound.frames, bound.asked)
            return self.dit.unpatchify(patches, len(state), *self._size)
        patches = self.dit.run_unknown(tokens, apart.others, apart.looked_up, modulation, bound.contexts, bound.frames)
        velocity = self.dit.unpatchify(patches, len(state), *self._size)
        leading = self.dit.leading_to(apart.told, state[None], torch.full((1,), time, device=state.device))
        return self.dit.where_known(apart.known, leading.expand_as(velocity), velocity)

    def _bound_to(self, part: slice, views: Int[Tensor, "m"] | None) -> _Bound:
        """What is the same at every step, remembered for whole sets of views."""
        remembered = self._bound.get((part.start, part.stop)) if views is None else None
        if remembered is not None:
            return remembered

        def chosen(values: Tensor) -> Tensor:
            return values[part] if views is None else values[part][:, views]

        frames, known = (None if values is None else chosen(values) for values in self._facts[:2])
        facts = TokenFacts(frames=frames, known=known)
        frames, known = self.dit.frames_of(facts), self.dit.known_of(facts)
        told_tokens = chosen(self._tokens)
        count, tokens = told_tokens.shape[1], rearrange(told_tokens, "b n places d -> b (n places) d")
        contexts = [self._context(context, part) for context in self._contexts]
        apart = None
        if known is not None and self._told is not None:
            known_latents = chosen(self._told)
            stream, others = streams(rearrange(known, "b n h w -> b (n h w)"))
            clean = self.dit.embed_patches(known_latents, bias=False) + self._positions[count] + tokens
            apart = _Apart(
                known=known,
                told=known_latents,
                others=others,
                looked_up=self._looked_up(clean, stream, contexts, frames),
            )
        asked = self._asked
        if asked is not None:
            asked = (asked if views is None else asked[views]).flatten().nonzero()[:, 0]
        bound = _Bound(tokens=tokens, contexts=contexts, frames=frames, apart=apart, asked=asked)
        if views is None:
            self._bound[part.start, part.stop] = bound
        return bound

    def _looked_up(
        self,
        tokens: Float[Tensor, "b tokens d"],
        stream: Stream,
        contexts: Sequence[KeysValues | None],
        frames: RayFrames | None,
    ) -> dict[Attention, list[KeysValues]]:
        """All that other tokens see of known ones, computed or shared."""
        compute = partial(self.dit.run_known, tokens, stream, contexts, frames)
        if self._shared is None:
            return compute()
        half = torch.is_autocast_enabled(tokens.device.type) and torch.get_autocast_dtype(tokens.device.type)
        deciding = [stream.taken(tokens), None if frames is None else frames.chosen(stream.places).frame]
        deciding += [values for context in contexts if context is not None for values in context]
        return self._shared.of(compute, self.dit, f"known tokens {half} {stream.scenes}", *deciding)

    def only(self, branches: slice) -> Prepared:
        """The same with some of its branches; shares all constants, so it costs nothing."""
        chosen = copy.copy(self)
        chosen._tokens = self._tokens[branches]
        frames, known = (None if values is None else values[branches] for values in self._facts[:2])
        chosen._facts = TokenFacts(frames=frames, known=known)
        chosen._told = None if self._told is None else self._told[branches]
        chosen._bound = {}
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
