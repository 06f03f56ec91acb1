"""The diffusion transformer over a sequence of views (paper section 3.2): plain pre-norm blocks over all tokens of all
views.

The forward pass is made of named parts (`embed_patches`, `positions`, `modulate`, `text_context`, `run_blocks`,
`unpatchify`), so that whatever is constant during sampling can be computed once. Parameter names are those of the
released checkpoint.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, cast, get_args

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from fb_core.networks.transformer.attention import Attention, KeysValues
from fb_core.networks.transformer.blocks import Block, Modulation, modulated
from fb_core.networks.transformer.embeddings import (
    INDEX_MODES,
    IndexMode,
    TimeEmbedding,
    at_least_float32,
    index_positions,
    layout_embedding,
    sincos,
)
from fb_core.networks.transformer.known_tokens import Relation, Stream, streams
from fb_core.networks.transformer.ray_frames import VECTOR, RayFrames

FINAL_EPS = 1e-6
KnownTokens = Literal["joint", "apart"]
"""Whether tokens of which everything is known are denoised with all others, as released, or see one another alone, free
of noise.
"""


@dataclass(frozen=True, kw_only=True)
class DiTConfig:
    """Architecture of the transformer; the defaults are the released one (646M parameters)."""

    heads: int = 16
    """Attention heads."""
    head_dim: int = 64
    """Channels per head; heads * head_dim is the width of the network."""
    depth: int = 24
    """Blocks."""
    patch: int = 2
    """Side of a token's patch in latent pixels; divides the latents' height and width."""
    in_channels: int = 66
    """Noisy latents, conditioning latents and masks per latent pixel (`fb_core.conditioning` owns their order)."""
    out_channels: int = 32
    """Predicted velocity channels per latent pixel."""
    text_width: int | None = 768
    """Width of the text embedding; 0 or None builds blocks without cross-attention."""
    index: IndexMode = "flexible"
    """How views of a sequence are told apart: see `embeddings.index_positions`."""
    mlp_ratio: int = 4
    """Hidden width of the feed-forward layers over the network's width."""
    ray_frames: bool = False
    """Attention in the frames of known rays (`fb_core.networks.transformer.ray_frames`); no parameter more. The
    released model has none.
    """
    known_tokens: KnownTokens = "joint"
    """'joint' as released, or 'apart' (`fb_core.networks.transformer.known_tokens`)."""

    @property
    def width(self) -> int:
        """Channels of a token."""
        return self.heads * self.head_dim

    def __post_init__(self) -> None:
        object.__setattr__(self, "text_width", self.text_width or 0)
        for name in ("heads", "head_dim", "depth", "patch", "in_channels", "out_channels", "mlp_ratio"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a positive integer, got {getattr(self, name)!r}.")
        if not isinstance(self.text_width, int) or self.text_width < 0:
            raise ValueError(f"text_width: expected a width, or 0 for a network without text, got {self.text_width!r}.")
        if self.width < 8 or self.width % 4:
            raise ValueError(
                f"heads * head_dim: expected a multiple of 4 of at least 8 (position embeddings), got {self.width}."
            )
        if not isinstance(self.ray_frames, bool):
            raise ValueError(f"ray_frames: expected true or false, got {self.ray_frames!r}.")
        if self.ray_frames and self.head_dim % (2 * VECTOR):
            raise ValueError(
                f"head_dim: expected a multiple of {2 * VECTOR} for attention in ray frames, got {self.head_dim}."
            )
        if self.known_tokens not in get_args(KnownTokens):
            raise ValueError(
                f"known_tokens: expected one of {', '.join(get_args(KnownTokens))}, got {self.known_tokens!r}."
            )
        if self.index not in INDEX_MODES:
            raise ValueError(f"index: expected one of {', '.join(INDEX_MODES)}, got {self.index!r}.")


class TokenFacts(NamedTuple):
    """What is known of the tokens of b sequences of n views besides their channels
    (`fb_core.conditioning.Conditioning.facts`).
    """

    frames: Float[Tensor, "b n h w 4 4"] | None = None
    """Frames of their rays, the identity where these are unknown; None = no ray is known. Read by networks with
    `ray_frames`.
    """
    known: Bool[Tensor, "b n h w"] | None = None
    """Whether everything that the token shows is known; None = no token is. Read by networks with
    `known_tokens="apart"`.
    """
    sequences_per_scene: int = 1
    """Sequences in a row that know the same, such as draws of noise for one training sequence."""
    asked: Bool[Tensor, "n h w"] | None = None
    """Tokens whose velocity matters, of every sequence; None = all. Where known tokens are joint the last block is
    computed for these alone, and the velocity of the others is 0.
    """


NO_FACTS = TokenFacts()
"""Nothing is known."""


class PatchEmbedding(nn.Module):
    """Holds the patch projection as the convolution that it is in the checkpoint; `DiT.embed_patches` applies it."""

    def __init__(self, config: DiTConfig):
        super().__init__()
        self.proj = nn.Conv2d(config.in_channels, config.width, config.patch, stride=config.patch)


class DiT(nn.Module):
    """Predicts the velocity of the noisy latents of all views of a sequence together."""

    def __init__(self, config: DiTConfig):
        super().__init__()
        self.config = config
        self.pos_embed = PatchEmbedding(config)
        self.time_embed = TimeEmbedding(config.width)
        self.transformer_blocks = nn.ModuleList(
            Block(config.width, config.heads, config.mlp_ratio * config.width, config.text_width or 0)
            for _ in range(config.depth)
        )
        self.proj_out_1 = nn.Linear(config.width, 2 * config.width)
        self.proj_out_2 = nn.Linear(config.width, config.patch**2 * config.out_channels)

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the parameters."""
        return self.proj_out_2.weight.dtype

    @property
    def blocks(self) -> list[Block]:
        """The blocks in the order of their use."""
        return cast(list[Block], list(self.transformer_blocks))

    def forward(
        self,
        sequence: Float[Tensor, "b n c h w"],
        time: Float[Tensor, "b"],
        text: Float[Tensor, "b words t"] | None = None,
        index: Float[Tensor, "b n"] | None = None,
        facts: TokenFacts = NO_FACTS,
    ) -> Float[Tensor, "b n z h w"]:
        """Velocity (noise minus data) of the sequence at `time` in [0, 1], 1 being noise; in the sequence's precision.

        `text` is given exactly if the configuration has a text width. `index` holds one position in [0, 2 pi] per view
        (draw it with `index_positions` in training); None means evenly spaced. Where known tokens are apart their
        velocity is the one that leads straight to what is known. Raises ValueError for no views, for a size that the
        patch does not divide, for another channel count, and for a text that is missing or too much.
        """
        _, views, count, height, width = sequence.shape
        if count != self.config.in_channels:
            raise ValueError(f"sequence: expected {self.config.in_channels} channels, got {count}.")
        known, noisy = self.known_of(facts), self.config.out_channels
        modulation, texts, frames = self.modulate(time), self.text_context(text), self.frames_of(facts)
        state, known_latents, channels = sequence[:, :, :noisy], sequence[:, :, noisy : 2 * noisy], sequence
        if known is not None:
            channels = torch.cat([self.where_known(known, known_latents, state), sequence[:, :, noisy:]], dim=2)
        tokens = self.embed_patches(channels) + self.positions(views, height, width, index, device=sequence.device)
        if known is None:
            velocity = self.run_blocks(tokens, modulation, texts, frames)
            return self.unpatchify(velocity, views, height, width).to(sequence.dtype)
        apart, others = streams(rearrange(known, "b n h w -> b (n h w)"), facts.sequences_per_scene)
        looked_up = self.run_known(tokens, apart, texts, frames)
        velocity = self.run_unknown(tokens, others, looked_up, modulation, texts, frames)
        velocity = self.unpatchify(velocity, views, height, width).to(sequence.dtype)
        return self.where_known(known, self.leading_to(known_latents, state, time), velocity)

    def known_of(self, facts: TokenFacts) -> Bool[Tensor, "b n h w"] | None:
        """Which tokens stand apart; None where none does."""
        if self.config.known_tokens == "joint" or facts.known is None or not bool(facts.known.any()):
            return None
        return facts.known

    def frames_of(self, facts: TokenFacts) -> RayFrames | None:
        """The frames that attention is told in; None for the identity everywhere."""
        return RayFrames.of(facts.frames) if self.config.ray_frames and facts.frames is not None else None

    def where_known(
        self, known: Bool[Tensor, "#b n h w"], yes: Float[Tensor, "#b n z lh lw"], no: Float[Tensor, "#b n z lh lw"]
    ) -> Float[Tensor, "b n z lh lw"]:
        """`yes` at the latents of known tokens, `no` at all others."""
        patch = self.config.patch
        return torch.where(repeat(known, "b n h w -> b n 1 (h p) (w q)", p=patch, q=patch), yes.to(no.dtype), no)

    @staticmethod
    def leading_to(
        told: Float[Tensor, "#b n z h w"], state: Float[Tensor, "#b n z h w"], time: Float[Tensor, "#b"]
    ) -> Float[Tensor, "b n z h w"]:
        """The constant velocity that leads a state from `time` straight to the latents that are told at 0 (0 at time 0
        itself).
        """
        t = time.view(-1, 1, 1, 1, 1)
        return torch.where(t > 0, (state - told) / t.clamp(min=torch.finfo(t.dtype).tiny), torch.zeros_like(state))

    def embed_patches(
        self, sequence: Float[Tensor, "b n c h w"], first_channel: int = 0, bias: bool = True
    ) -> Float[Tensor, "b tokens d"]:
        """Project patches to tokens, in the order (view, row, column).

        The projection is linear in the channels: the tokens of a sequence are the sum over any split of its channels,
        each part projected from its `first_channel` on and one of them with the bias.

        Raises ValueError without views and for sides that are no multiples of the patch.
        """
        patch, proj = self.config.patch, self.pos_embed.proj
        _, views, channels, height, width = sequence.shape
        if not views:
            raise ValueError("sequence: expected at least one view, got none.")
        if not height or not width or height % patch or width % patch:
            raise ValueError(
                f"sequence: expected latent height and width to be positive multiples of {patch}, got {height} x "
                f"{width}."
            )
        weight = rearrange(proj.weight[:, first_channel : first_channel + channels], "d c p q -> d (c p q)")
        patches = rearrange(sequence.to(self.dtype), "b n c (h p) (w q) -> b (n h w) (c p q)", p=patch, q=patch)
        return F.linear(patches, weight, proj.bias if bias else None)

    def positions(
        self,
        views: int,
        height: int,
        width: int,
        index: Float[Tensor, "b n"] | None = None,
        *,
        device: torch.device | str | None = None,
    ) -> Float[Tensor, "b tokens d"]:
        """What is added to the tokens of `views` latents of a size: place in the view, and which view. float32; b is 1
        without `index`.

        Raises ValueError for another number of index positions than of views.
        """
        config = self.config
        layout = layout_embedding(height // config.patch, width // config.patch, config.width, device=device)
        layout = rearrange(layout, "h w d -> 1 1 (h w) d")
        if config.index == "none":
            return repeat(
                layout, "1 1 places d -> b (views places) d", b=1 if index is None else index.shape[0], views=views
            )
        if index is None:
            index = index_positions(config.index, 1, views, device=device)
        if index.shape[1] != views:
            raise ValueError(f"index: expected one position for each of {views} views, got {index.shape[1]}.")
        which = sincos(index.to(device=device, dtype=layout.dtype), config.width)
        return rearrange(layout + which[:, :, None], "b views places d -> b (views places) d")

    def modulate(self, time: Float[Tensor, "b"]) -> Modulation:
        """Scales and shifts of all norms at `time` in [0, 1]."""
        activated = self.time_embed.timestep_embedder(time)
        activated = F.silu(activated.to(at_least_float32(activated.dtype)))
        blocks = [torch.stack([norm.scale_shift(activated) for norm in block.norms]) for block in self.blocks]
        final = self.proj_out_1(activated.to(self.dtype))
        # The released layer holds the shift first here, unlike in the blocks.
        shift, scale = final.to(at_least_float32(final.dtype)).chunk(2, dim=-1)
        return Modulation(torch.stack(blocks), torch.stack([scale, shift]))

    def text_context(self, text: Float[Tensor, "b words t"] | None) -> list[KeysValues | None]:
        """Keys and values of every block's cross-attention; Nones for a network without text. Raises ValueError for
        text of another width, and for any in a network without text.
        """
        expected = self.config.text_width
        if not expected:
            if text is not None:
                raise ValueError("text: expected None because this network was built without text, got an embedding.")
            return [None] * self.config.depth
        if text is None or text.shape[-1] != expected:
            got = "None" if text is None else f"width {text.shape[-1]}"
            raise ValueError(
                f"text: expected an embedding of width {expected} (that of the empty prompt for no text), got {got}."
            )
        return [block.attn2.keys_values(text.to(self.dtype)) for block in self.blocks]

    def run_blocks(
        self,
        tokens: Float[Tensor, "b tokens d"],
        modulation: Modulation,
        contexts: Sequence[KeysValues | None],
        frames: RayFrames | None = None,
        asked: Int[Tensor, "some"] | None = None,
    ) -> Float[Tensor, "b tokens out"]:
        """Patches of velocity of tokens that carry their positions; zeros but for the tokens that are ``asked`` for."""
        last = self._through_blocks(tokens, modulation.blocks, contexts, frames, asked=asked)
        patches = self._patches(last, modulation.final)
        if asked is None:
            return patches
        return patches.new_zeros(*tokens.shape[:2], patches.shape[-1]).index_copy(1, asked, patches)

    def _through_blocks(
        self,
        tokens: Float[Tensor, "b tokens d"],
        modulations: Iterable[Tensor],
        contexts: Sequence[KeysValues | None],
        frames: RayFrames | None = None,
        relation: Relation | None = None,
        asked: Int[Tensor, "some"] | None = None,
    ) -> Float[Tensor, "b some d"]:
        """The tokens after all blocks, or those alone that are ``asked`` for."""
        *earlier, last = zip(self.blocks, modulations, contexts, strict=True)
        for block, modulation, context in earlier:
            tokens = block(tokens, modulation, context, frames, relation)
        block, modulation, context = last
        return block(tokens, modulation, context, frames, relation, asked)

    def run_known(
        self,
        tokens: Float[Tensor, "b tokens d"],
        stream: Stream,
        contexts: Sequence[KeysValues | None],
        frames: RayFrames | None,
    ) -> dict[Attention, list[KeysValues]]:
        """Keys and values of known tokens in every block, scene by scene: all that other tokens see of them."""
        frames = None if frames is None else frames.chosen(stream.places)
        relation = Relation(stream=stream, frames=frames, last=self.blocks[-1].attn1)
        self._through_blocks(
            stream.taken(tokens), self.modulate(tokens.new_zeros(1)).blocks, contexts, relation=relation
        )
        return relation.kept

    def run_unknown(
        self,
        tokens: Float[Tensor, "b tokens d"],
        stream: Stream,
        known: dict[Attention, list[KeysValues]],
        modulation: Modulation,
        contexts: Sequence[KeysValues | None],
        frames: RayFrames | None,
    ) -> Float[Tensor, "b tokens out"]:
        """Patches of velocity of the tokens that are not known, which see the known ones too; zeros at known tokens."""
        frames = None if frames is None else frames.chosen(stream.places)
        relation = Relation(stream=stream, frames=frames, known=known)
        modulations = map(stream.modulation, modulation.blocks)
        row = self._through_blocks(stream.taken(tokens), modulations, contexts, relation=relation)
        patches = self._patches(row, stream.modulation(modulation.final))
        return stream.put_into(patches.new_zeros(*tokens.shape[:2], patches.shape[-1]), patches)

    def _patches(
        self,
        tokens: Float[Tensor, "b tokens d"],
        scale_shift: Float[Tensor, "2 #b d"] | Float[Tensor, "2 #b #tokens d"],
    ) -> Float[Tensor, "b tokens out"]:
        tokens = F.layer_norm(tokens, tokens.shape[-1:], eps=FINAL_EPS)
        return self.proj_out_2(modulated(tokens, scale_shift).to(self.dtype))

    def unpatchify(
        self, patches: Float[Tensor, "b tokens out"], views: int, height: int, width: int
    ) -> Float[Tensor, "b n z h w"]:
        """Latents of (view, row, column) tokens whose channels are ordered (row in patch, column in patch, channel)."""
        p = self.config.patch
        return rearrange(
            patches, "b (n h w) (p q z) -> b n z (h p) (w q)", n=views, h=height // p, w=width // p, p=p, q=p
        )

    @torch.no_grad()
    def initialize(self, generator: torch.Generator) -> "DiT":
        """Draw weights for training from scratch: zero velocity, no influence of the time, small residual branches."""
        branches = 3 * self.config.depth
        for name, parameter in self.named_parameters():
            if parameter.ndim == 1:
                parameter.fill_(0.0 if name.endswith("bias") else 1.0)
                continue
            std = parameter[0].numel() ** -0.5
            if name.endswith((".linear.weight", "proj_out_1.weight", "proj_out_2.weight")):
                std = 0.0
            elif name.endswith(("to_out.0.weight", "ff.net.2.weight")):
                std /= math.sqrt(branches)
            parameter.copy_(torch.randn(parameter.shape, generator=generator, device=generator.device) * std)
        return self
