"""Attention of tokens to one another and to text, with keys and values that may be kept."""

from __future__ import annotations

from typing import NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor, nn

from fb_core.networks.transformer.cpu_kernels import attended, rms_normed
from fb_core.networks.transformer.embeddings import at_least_float32
from fb_core.networks.transformer.ray_frames import RayFrames, transformed

EPS = 1e-5


class RMSNorm(nn.Module):
    """Divide by the root mean square over the last axis, times a learned gain; in float32 at least."""

    def __init__(self, width: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def forward(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Same shape; float32 for half-precision inputs."""
        dtype = at_least_float32(x.dtype)
        return rms_normed(x.to(dtype), self.weight.to(dtype), EPS)


class KeysValues(NamedTuple):
    """What attention looks up."""

    keys: Float[Tensor, "b heads words k"]
    values: Float[Tensor, "b heads words k"]


class Attention(nn.Module):
    """Multi-head attention with normalised queries and keys; from tokens to themselves or to a text."""

    def __init__(self, width: int, heads: int, context_width: int):
        super().__init__()
        self.heads = heads
        self.norm_q = RMSNorm(width // heads)
        self.norm_k = RMSNorm(width // heads)
        self.to_q = nn.Linear(width, width, bias=False)
        self.to_k = nn.Linear(context_width, width, bias=False)
        self.to_v = nn.Linear(context_width, width, bias=False)
        self.to_out = nn.ModuleList([nn.Linear(width, width)])

    def _split(self, x: Float[Tensor, "b tokens d"]) -> Float[Tensor, "b heads tokens k"]:
        return rearrange(x, "b tokens (heads k) -> b heads tokens k", heads=self.heads)

    def keys_values(self, context: Float[Tensor, "b words c"]) -> KeysValues:
        """Keys and values of what is attended to."""
        values = self._split(self.to_v(context))
        keys = self.norm_k(self._split(self.to_k(context))).to(values.dtype)
        return KeysValues(keys, values)

    def queries(self, x: Float[Tensor, "b tokens d"], dtype: torch.dtype) -> Float[Tensor, "b heads tokens k"]:
        """What every token asks."""
        return self.norm_q(self._split(self.to_q(x))).to(dtype)

    def queries_keys_values(
        self, x: Float[Tensor, "b tokens d"], frames: RayFrames | None, asked: Int[Tensor, "some"] | None = None
    ) -> tuple[Float[Tensor, "b heads some k"], KeysValues]:
        """What every token asks (or those alone that are ``asked`` for) and answers, told in the frames of their rays
        (see `fb_core.networks.transformer.ray_frames`).
        """
        own = self.own_keys_values(x, frames)
        if asked is not None:
            x, frames = x[:, asked], None if frames is None else frames.of_some(asked)
        queries = self.queries(x, own.values.dtype)
        return (queries if frames is None else transformed(queries, frames.inverse.mT)), own

    def own_keys_values(self, x: Float[Tensor, "b tokens d"], frames: RayFrames | None) -> KeysValues:
        """What every token answers."""
        own = self.keys_values(x)
        return own if frames is None else KeysValues(*(transformed(values, frames.frame) for values in own))

    def answered(self, y: Float[Tensor, "b heads tokens k"], frames: RayFrames | None) -> Float[Tensor, "b tokens d"]:
        """What tokens have gathered, as it is added to them."""
        y = y if frames is None else transformed(y, frames.inverse)
        return self.to_out[0](rearrange(y, "b heads tokens k -> b tokens (heads k)"))

    def forward(
        self,
        x: Float[Tensor, "b tokens d"],
        context: KeysValues | None = None,
        frames: RayFrames | None = None,
        asked: Int[Tensor, "some"] | None = None,
    ) -> Float[Tensor, "b some d"]:
        """What every token, or of all tokens those that are ``asked`` for, gathers from `context`, or from all tokens,
        whose frames then count.
        """
        if context is None:
            queries, context = self.queries_keys_values(x, frames, asked)
            if asked is not None and frames is not None:
                frames = frames.of_some(asked)
        else:
            queries = self.queries(x, context.values.dtype)
        return self.answered(attended(queries, *context), frames)
