"""Known tokens apart: the streams against a twin with one dense attention mask, and the laws of what is known."""

from __future__ import annotations

import dataclasses

import jaxtyping
import pytest
import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from helpers.tiny_models import network_of
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from fb_core.networks.transformer.attention import Attention
from fb_core.networks.transformer.blocks import Block
from fb_core.networks.transformer.dit import FINAL_EPS, DiT, DiTConfig, TokenFacts
from fb_core.networks.transformer.prepared import Prepared
from fb_core.networks.transformer.ray_frames import RayFrames

JOINT = DiTConfig(heads=2, head_dim=16, depth=3, in_channels=10, out_channels=4, text_width=0, ray_frames=True)
APART = dataclasses.replace(JOINT, known_tokens="apart")
VIEWS = 5


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def some_facts(batch: int, sequences_per_scene: int = 1) -> TokenFacts:
    """Ragged: other tokens are known in every scene, in the last one none; frames are random rigid motions."""
    scenes = batch // sequences_per_scene
    known = torch.rand(scenes, VIEWS, 2, 2, generator=torch.Generator().manual_seed(7)) < 0.5
    known[-1] = False
    rotation, _ = torch.linalg.qr(drawn(scenes, VIEWS, 2, 2, 3, 3, seed=8))
    frames = torch.zeros(scenes, VIEWS, 2, 2, 4, 4, dtype=torch.float64)
    frames[..., :3, :3], frames[..., :3, 3], frames[..., 3, 3] = rotation, drawn(scenes, VIEWS, 2, 2, 3, seed=9), 1.0
    return TokenFacts(
        frames=frames.repeat_interleave(sequences_per_scene, dim=0),
        known=known.repeat_interleave(sequences_per_scene, dim=0),
        sequences_per_scene=sequences_per_scene,
    )


def some_sequences(batch: int, sequences_per_scene: int = 1) -> Tensor:
    """Noise of its own for every sequence, conditioning for every scene."""
    told = drawn(batch // sequences_per_scene, VIEWS, 6, 4, 4, seed=2).repeat_interleave(sequences_per_scene, dim=0)
    return torch.cat([drawn(batch, VIEWS, 4, 4, 4, seed=1), told], dim=2)


def dense(network: DiT, sequence: Tensor, time: Tensor, facts: TokenFacts, text: Tensor | None = None) -> Tensor:
    """The twin: all tokens together under one mask, the time of every token by itself."""
    batch, views, _, height, width = sequence.shape
    patch, noisy = network.config.patch, network.config.out_channels
    known = rearrange(facts.known, "b n h w -> b (n h w)")
    pixels = repeat(facts.known, "b n h w -> b n 1 (h p) (w q)", p=patch, q=patch)
    told, state = sequence[:, :, noisy : 2 * noisy], sequence[:, :, :noisy]
    tokens = network.embed_patches(torch.cat([torch.where(pixels, told, state), sequence[:, :, noisy:]], dim=2))
    tokens = tokens + network.positions(views, height, width)
    clean, noised = network.modulate(torch.zeros(batch)), network.modulate(time)
    frames = RayFrames.of(facts.frames) if network.config.ray_frames else None
    mask = (known[:, None, None, :] | ~known[:, None, :, None]).expand(-1, 1, -1, -1)
    texts = network.text_context(text)

    def by_token(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(known[..., None], a[..., :, None, :], b[..., :, None, :])

    def attend(attention: Attention, x: Tensor) -> Tensor:
        queries, (keys, values) = attention.queries_keys_values(x, frames)
        return attention.answered(F.scaled_dot_product_attention(queries, keys, values, attn_mask=mask), frames)

    for number, block in enumerate(network.blocks):
        assert isinstance(block, Block)
        scale_shifts = by_token(clean.blocks[number], noised.blocks[number])
        tokens = tokens + attend(block.attn1, block.norm1(tokens, scale_shifts[0]))
        if texts[number] is not None:
            tokens = tokens + block.attn2(block.norm2(tokens, scale_shifts[1]), texts[number])
        tokens = tokens + block.ff(block.norm3(tokens, scale_shifts[-1]))
    scale, shift = by_token(clean.final, noised.final)
    tokens = F.layer_norm(tokens, tokens.shape[-1:], eps=FINAL_EPS) * (1 + scale) + shift
    velocity = network.unpatchify(network.proj_out_2(tokens), views, height, width)
    return torch.where(pixels, (state - told) / time[:, None, None, None, None], velocity)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("frames", [False, True])
@pytest.mark.parametrize("batch, sequences_per_scene", [(1, 1), (3, 1), (6, 3)])
@torch.no_grad()
def test_streams_equal_their_dense_twin(batch, sequences_per_scene, frames, text):
    network = network_of(dataclasses.replace(APART, ray_frames=frames, text_width=6 if text else 0))
    facts, sequence = some_facts(batch, sequences_per_scene), some_sequences(batch, sequences_per_scene)
    if batch == 1:
        facts = facts._replace(known=~facts.known & (torch.arange(VIEWS) < 2)[None, :, None, None])
    time = torch.linspace(0.2, 0.9, batch, dtype=torch.float64)
    prompt = (
        drawn(batch // sequences_per_scene, 3, 6, seed=4).repeat_interleave(sequences_per_scene, dim=0)
        if text
        else None
    )
    expected = dense(network, sequence, time, facts, prompt)
    torch.testing.assert_close(network(sequence, time, prompt, facts=facts), expected)


def test_gradients_equal_those_of_the_twin():
    network, facts, sequence, time = (
        network_of(APART),
        some_facts(4, 2),
        some_sequences(4, 2),
        torch.tensor([0.3, 0.9, 0.5, 0.7]),
    )
    gradients = []
    for forward in (network.__call__, lambda *a, facts: dense(network, *a, facts)):
        network.zero_grad()
        forward(sequence, time.double(), facts=facts).square().sum().backward()
        gradients.append([parameter.grad.clone() for parameter in network.parameters()])
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_recomputed_blocks_have_the_same_gradients():
    network, facts, sequence, time = (
        network_of(APART),
        some_facts(4, 2),
        some_sequences(4, 2),
        torch.rand(4, dtype=torch.float64),
    )
    network(sequence, time, facts=facts).square().sum().backward()
    expected = [parameter.grad.clone() for parameter in network.parameters()]
    network.zero_grad()
    for block in network.blocks:
        forward = block.forward
        block.forward = lambda *inputs, _forward=forward: checkpoint(_forward, *inputs, use_reentrant=False)
    network(sequence, time, facts=facts).square().sum().backward()
    for ours, theirs in zip((parameter.grad for parameter in network.parameters()), expected, strict=True):
        torch.testing.assert_close(ours, theirs)


@torch.no_grad()
def test_without_known_tokens_it_is_the_joint_network():
    apart, joint, sequence, time = network_of(APART), network_of(JOINT), some_sequences(2), torch.tensor([0.4, 0.8])
    nothing = torch.zeros(2, VIEWS, 2, 2, dtype=torch.bool)
    for facts in (TokenFacts(), TokenFacts(known=nothing)):
        assert torch.equal(apart(sequence, time, facts=facts), joint(sequence, time))


@torch.no_grad()
def test_known_tokens_lead_straight_to_what_is_known_and_see_no_noise():
    network, facts, sequence = network_of(APART), some_facts(2), some_sequences(2)
    other = sequence.clone()
    pixels = repeat(facts.known, "b n h w -> b n 1 (h p) (w q)", p=2, q=2).expand(-1, -1, 4, -1, -1)
    other[:, :, :4][pixels] = 1e6  # whatever the state is there, the others are told what is known
    time = torch.tensor([0.4, 0.8], dtype=torch.float64)
    first, second = (network(x, time, facts=facts) for x in (sequence, other))
    torch.testing.assert_close(first[~pixels], second[~pixels])
    arrived = sequence[:, :, :4] - time[:, None, None, None, None] * first
    torch.testing.assert_close(arrived[pixels], sequence[:, :, 4:8][pixels])
    assert torch.isfinite(network(sequence, torch.zeros(2, dtype=torch.float64), facts=facts)).all()


@torch.no_grad()
def test_everything_known():
    network, sequence = network_of(APART), some_sequences(2)
    facts = some_facts(2)._replace(known=torch.ones(2, VIEWS, 2, 2, dtype=torch.bool))
    answer = network(sequence, torch.tensor([0.5, 0.5]).double(), facts=facts)
    torch.testing.assert_close(answer, (sequence[:, :, :4] - sequence[:, :, 4:8]) / 0.5)


@pytest.mark.parametrize("branches_at_once", [None, 1])
@pytest.mark.parametrize("windowed", [False, True])
@torch.no_grad()
def test_prepared_equals_plain(branches_at_once, windowed):
    network, facts = network_of(APART), some_facts(3)
    told, state = some_sequences(3)[:, :, 4:], drawn(VIEWS, 4, 4, 4, seed=1)
    times = [1.0, 0.6, 0.3]
    prepared = Prepared(network, told, times, branches_at_once=branches_at_once, facts=facts)
    views = torch.tensor([3, 0, 2]) if windowed else torch.arange(VIEWS)
    for time in (*times, 0.123):
        part = TokenFacts(frames=facts.frames[:, views], known=facts.known[:, views])
        sequence = torch.cat([state[views].expand(3, -1, -1, -1, -1), told[:, views]], dim=2)
        expected = network(sequence, torch.full((3,), time), facts=part)
        torch.testing.assert_close(prepared(state[views], time, views if windowed else None), expected)
        only = prepared.only(slice(1, None))(state[views], time, views if windowed else None)
        torch.testing.assert_close(only, expected[1:])


def test_refusal():
    with pytest.raises((ValueError, jaxtyping.TypeCheckError), match="known_tokens"):
        dataclasses.replace(APART, known_tokens="away")
