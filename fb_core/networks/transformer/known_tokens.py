"""Known tokens apart: tokens of which everything is known are noise-free, have time 0 and attend to one another alone;
all others attend to all. So keys and values of known tokens are the same at every step of a sampling and for every draw
of noise of a training sequence.

Sequences differ in how many of their tokens are known, so the tokens of one kind stand in one long row, a `Stream`:
what works on single tokens does so on the whole row, and attention goes scene by scene. A scene is one sequence, or
several that show the same known tokens.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import torch
from einops import rearrange, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fb_core.networks.transformer.attention import Attention, KeysValues
from fb_core.networks.transformer.cpu_kernels import attended
from fb_core.networks.transformer.ray_frames import RayFrames


@dataclass(frozen=True, kw_only=True)
class Stream:
    """Tokens of one kind of some scenes, in one row."""

    places: Int[Tensor, "row"]
    """Where they stand among all tokens of all sequences, one sequence after the other."""
    sequences: Int[Tensor, "row"]
    """Which sequence each of them belongs to."""
    scenes: tuple[tuple[int, int], ...]
    """For each scene: its sequences, and the tokens that each of them has in this stream."""

    def taken(self, tokens: Float[Tensor, "b tokens d"]) -> Float[Tensor, "1 row d"]:
        """The stream's tokens out of all."""
        return tokens.flatten(0, 1)[self.places][None]

    def put_into(
        self, tokens: Float[Tensor, "b tokens d"], row: Float[Tensor, "1 row d"]
    ) -> Float[Tensor, "b tokens d"]:
        """All tokens with the stream's in their places."""
        return tokens.flatten(0, 1).index_copy(0, self.places, row[0]).view_as(tokens)

    def modulation(self, scale_shifts: Float[Tensor, "*any b d"]) -> Float[Tensor, "*any 1 row d"]:
        """What norms multiply by and add for every token, from what they do for every sequence (or the same for
        all).
        """
        if scale_shifts.shape[-2] == 1:
            return scale_shifts[..., None, :]
        return scale_shifts.index_select(-2, self.sequences)[..., None, :, :]

    def cut(self, row: Float[Tensor, "1 heads row k"]) -> list[Float[Tensor, "s heads t k"]]:
        """Scene by scene."""
        parts = row.split([sequences * tokens for sequences, tokens in self.scenes], dim=2)
        return [
            rearrange(part, "1 heads (s t) k -> s heads t k", s=sequences)
            for part, (sequences, _) in zip(parts, self.scenes, strict=True)
        ]


def streams(known: Bool[Tensor, "b tokens"], sequences_per_scene: int = 1) -> tuple[Stream, Stream]:
    """(known tokens, all others). Of a scene's sequences, which are consecutive and know the same, the first one's
    known ones count.
    """
    per_scene = known[::sequences_per_scene]
    counts = per_scene.sum(dim=1).tolist()
    total, tokens = known.shape
    places = torch.arange(total * tokens, device=known.device).view(total, tokens)
    owner = repeat(torch.arange(total, device=known.device), "b -> b tokens", tokens=tokens)
    firsts = slice(None, None, sequences_per_scene)
    known_stream = Stream(
        places=places[firsts][per_scene],
        sequences=owner[firsts][per_scene],
        scenes=tuple((1, count) for count in counts),
    )
    others = Stream(
        places=places[~known],
        sequences=owner[~known],
        scenes=tuple((sequences_per_scene, tokens - count) for count in counts),
    )
    return known_stream, others


@dataclass(kw_only=True)
class Relation:
    """How the tokens of a stream attend: to those of their own sequence, and to the known ones of their scene."""

    stream: Stream
    frames: RayFrames | None
    """Frames of the stream's tokens."""
    known: dict[Attention, list[KeysValues]] | None = None
    """Keys and values of every scene's known tokens in every block; None for the stream of known tokens itself."""
    kept: dict[Attention, list[KeysValues]] = field(default_factory=dict)
    """Keys and values of this stream, block by block, scene by scene; of known tokens alone."""
    last: Attention | None = None
    """The last attention of the network: known tokens stop there, since nothing reads them afterwards."""

    def keep(self, attention: Attention, x: Float[Tensor, "1 row d"]) -> None:
        """Keep a block's keys and values."""
        self._keep(attention, attention.own_keys_values(x, self.frames))

    def _keep(self, attention: Attention, own: KeysValues) -> list[KeysValues]:
        cut = [KeysValues(*pair) for pair in zip(self.stream.cut(own.keys), self.stream.cut(own.values), strict=True)]
        if self.known is None:
            self.kept[attention] = cut
        return cut

    def gathered(self, attention: Attention, x: Float[Tensor, "1 row d"]) -> Float[Tensor, "1 row d"]:
        """Self-attention."""
        queries, own = attention.queries_keys_values(x, self.frames)
        cut = self._keep(attention, own)
        if self.known is None:
            return attention.answered(self._attended(queries, cut), self.frames)
        both = []
        for mine, theirs in zip(cut, self.known[attention], strict=True):
            count = len(mine.keys)
            both.append(
                KeysValues(
                    *(torch.cat([b.expand(count, -1, -1, -1), a], dim=2) for a, b in zip(mine, theirs, strict=True))
                )
            )
        return attention.answered(self._attended(queries, both), self.frames)

    def read(self, attention: Attention, x: Float[Tensor, "1 row d"], text: KeysValues) -> Float[Tensor, "1 row d"]:
        """Attention to the text of every sequence."""
        queries = attention.queries(x, text.values.dtype)
        count = len(text.keys)
        if count == 1:
            return attention.answered(attended(queries, *text), None)
        starts = torch.tensor([0, *(sequences for sequences, _ in self.stream.scenes)]).cumsum(0).tolist()
        step = (
            count // starts[-1] if self.known is None else 1
        )  # the known tokens of a scene stand for all of its sequences
        texts = [
            KeysValues(*(values[start * step : end * step : step] for values in text))
            for start, end in pairwise(starts)
        ]
        return attention.answered(self._attended(queries, texts), None)

    def _attended(
        self, queries: Float[Tensor, "1 heads row k"], looked_up: list[KeysValues]
    ) -> Float[Tensor, "1 heads row k"]:
        answers = [
            attended(asking, *pair) if asking.shape[2] else asking
            for asking, pair in zip(self.stream.cut(queries), looked_up, strict=True)
        ]
        return torch.cat([rearrange(answer, "s heads t k -> 1 heads (s t) k") for answer in answers], dim=2)
