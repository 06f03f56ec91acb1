"""The transformer's parts: norms that the time modulates, attention, feed-forward, and the block made of them.

Parameter names are those of the released checkpoint. In half precision the residual stream, the norms and the
modulations stay in float32, as in the released model; only matrix products and attention run in the parameters'
precision.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor, nn

from fb_core.networks.transformer.attention import EPS, Attention, KeysValues, RMSNorm
from fb_core.networks.transformer.embeddings import at_least_float32
from fb_core.networks.transformer.known_tokens import Relation
from fb_core.networks.transformer.ray_frames import RayFrames


class LayerNorm(nn.Module):
    """Layer norm with learned gain and bias; in float32 at least."""

    def __init__(self, width: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Same shape; float32 for half-precision inputs."""
        dtype = at_least_float32(x.dtype)
        return F.layer_norm(x.to(dtype), self.weight.shape, self.weight.to(dtype), self.bias.to(dtype), EPS)


class Modulation(NamedTuple):
    """All that the network takes from the time, for b times: what every norm multiplies by and adds."""

    blocks: Float[Tensor, "depth norms 2 b d"]
    """(scale, shift) of each block's norms, in the order of the norms."""
    final: Float[Tensor, "2 b d"]
    """(scale, shift) of the norm before the output."""


def modulated(
    x: Float[Tensor, "b tokens d"], scale_shift: Float[Tensor, "2 #b d"] | Float[Tensor, "2 #b #tokens d"]
) -> Float[Tensor, "b tokens d"]:
    """x * (1 + scale) + shift, the same for all tokens of a sample (or of all samples), or token by token."""
    scale, shift = scale_shift[:, :, None] if scale_shift.ndim == 3 else scale_shift
    return torch.addcmul(x + shift, x, scale)


class AdaptiveNorm(nn.Module):
    """A norm whose scale and shift are a linear function of the time embedding (scale first)."""

    def __init__(self, width: int, norm: type[nn.Module]):
        super().__init__()
        self.linear = nn.Linear(width, 2 * width, bias=False)
        self.norm = norm(width)

    def scale_shift(self, activated: Float[Tensor, "b d"]) -> Float[Tensor, "2 b d"]:
        """Scale and shift of an (already activated) time embedding; float32 at least."""
        raw = self.linear(activated.to(self.linear.weight.dtype))
        return rearrange(raw.to(at_least_float32(raw.dtype)), "b (two d) -> two b d", two=2)

    def forward(
        self, x: Float[Tensor, "b tokens d"], scale_shift: Float[Tensor, "2 #b d"] | Float[Tensor, "2 #b #tokens d"]
    ) -> Float[Tensor, "b tokens d"]:
        """Normalised and modulated tokens, in the precision of the parameters."""
        return modulated(self.norm(x), scale_shift).to(self.linear.weight.dtype)


class GatedProjection(nn.Module):
    """One linear layer whose first half is multiplied by the GELU of its second half."""

    def __init__(self, width: int, hidden: int):
        super().__init__()
        self.proj = nn.Linear(width, 2 * hidden)

    def forward(self, x: Float[Tensor, "b tokens d"]) -> Float[Tensor, "b tokens hidden"]:
        """`hidden` channels."""
        value, gate = self.proj(x).chunk(2, dim=-1)
        return value * F.gelu(gate)


class FeedForward(nn.Module):
    """Two layers on each token by itself."""

    def __init__(self, width: int, hidden: int):
        super().__init__()
        self.net = nn.ModuleList([GatedProjection(width, hidden), nn.Identity(), nn.Linear(hidden, width)])

    def forward(self, x: Float[Tensor, "b tokens d"]) -> Float[Tensor, "b tokens d"]:
        """Same shape as the input."""
        return self.net[2](self.net[0](x))


class Block(nn.Module):
    """Self-attention, attention to the text (unless `text_width` is 0), feed-forward; each added to the tokens."""

    def __init__(self, width: int, heads: int, hidden: int, text_width: int):
        super().__init__()
        self.norm1 = AdaptiveNorm(width, RMSNorm)
        self.attn1 = Attention(width, heads, width)
        if text_width:
            self.norm2 = AdaptiveNorm(width, RMSNorm)
            self.attn2 = Attention(width, heads, text_width)
        self.norm3 = AdaptiveNorm(width, LayerNorm)
        self.ff = FeedForward(width, hidden)
        self.reads_text = bool(text_width)

    @property
    def norms(self) -> list[AdaptiveNorm]:
        """The adaptive norms in the order of their use."""
        return [self.norm1, self.norm2, self.norm3] if self.reads_text else [self.norm1, self.norm3]

    def forward(
        self,
        x: Float[Tensor, "b tokens d"],
        scale_shifts: Float[Tensor, "norms 2 #b d"] | Float[Tensor, "norms 2 #b #tokens d"],
        text: KeysValues | None,
        frames: RayFrames | None = None,
        relation: Relation | None = None,
        asked: Int[Tensor, "some"] | None = None,
    ) -> Float[Tensor, "b some d"]:
        """The residual stream after this block, given its norms' modulation and the text's keys and values (None
        without text).

        `frames` are those of the tokens' rays. A `relation` says whom the tokens attend to instead of one another, and
        in which frames. Without one, only tokens that are ``asked`` for may be computed: the others then just answer.
        """
        each = scale_shifts.unbind()  # one gradient for all norms; picked one by one, each would make a whole one
        normed = self.norm1(x, each[0])
        if relation is not None and relation.last is self.attn1:
            relation.keep(self.attn1, normed)
            return x
        if relation is None:
            x = (x if asked is None else x[:, asked]) + self.attn1(normed, None, frames, asked)
        else:
            x = x + relation.gathered(self.attn1, normed)
        if text is not None:
            normed = self.norm2(x, each[1])
            x = x + (self.attn2(normed, text) if relation is None else relation.read(self.attn2, normed, text))
        return x + self.ff(self.norm3(x, each[-1]))
