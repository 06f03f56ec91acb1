"""Diffusion transformer: the released numbers, which symmetries hold, a readable twin, and refusals."""

import copy
import dataclasses
import math

import jaxtyping
import numpy as np
import pytest
import torch
from einops import rearrange
from torch.nn.functional import silu

from fb_core.networks.released import read_released
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.transformer.embeddings import index_positions, layout_embedding, sincos, timestep_embedding

SMALL = DiTConfig(heads=2, head_dim=8, depth=2, in_channels=6, out_channels=3, text_width=0)
WITH_TEXT = dataclasses.replace(SMALL, text_width=5)


def small(config: DiTConfig = SMALL, **changes) -> DiT:
    """A network in float64 whose every parameter matters."""
    torch.manual_seed(1)
    network = DiT(dataclasses.replace(config, **changes)).double().eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return network


def sequence_of(batch: int, views: int, height: int = 4, width: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    """A random sequence and times."""
    generator = torch.Generator().manual_seed(2)
    sequence = torch.randn(batch, views, 6, height, width, generator=generator, dtype=torch.float64)
    return sequence, torch.rand(batch, generator=generator, dtype=torch.float64)


def golden(shared_path, name: str) -> dict[str, torch.Tensor]:
    """Tensors of one golden file."""
    with np.load(shared_path(f"golden/reference/{name}.npz")) as file:
        return {key: torch.from_numpy(file[key]) for key in file.files}


@pytest.fixture(scope="module")
def released(shared_path) -> DiT:
    """The golden network, through the reader of the released layout."""
    return read_released(shared_path("golden/reference/transformer.ckpt").parent).dit


@pytest.fixture(scope="module")
def inputs(shared_path) -> dict[str, torch.Tensor]:
    """The golden networks' inputs and outputs by case."""
    return golden(shared_path, "transformer_tiny")


def with_index(network: DiT, mode: str) -> DiT:
    """The same weights under another index mode."""
    other = DiT(dataclasses.replace(network.config, index=mode))
    other.load_state_dict(network.state_dict())
    return other


# Released numbers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", ["n1_8x8", "n1_16x24", "n4_8x8", "n4_16x24", "n9_8x8", "n9_16x24"])
@torch.no_grad()
def test_released_numbers(released, inputs, case):
    velocity = released(inputs["x_" + case], inputs["t_" + case] / 1000, inputs["text_" + case].float())
    assert (velocity - inputs["y_" + case]).abs().max() <= 2e-5


@torch.no_grad()
def test_released_numbers_of_every_part(shared_path, released, inputs):
    """The goldens' tokens run over the views joined side by side, ours view by view."""
    expected = golden(shared_path, "transformer_tiny_internals")
    sequence, time, text = inputs["x_n4_8x8"], inputs["t_n4_8x8"] / 1000, inputs["text_n4_8x8"].float()
    found: dict[str, torch.Tensor] = {}
    parts = {"norm1", "attn1", "norm2", "attn2", "norm3", "ff"}
    first = released.transformer_blocks[0]
    watched = {f"{name}_0": getattr(first, name) for name in parts} | {
        f"block{i}": b for i, b in enumerate(released.transformer_blocks)
    }
    handles = [
        module.register_forward_hook(lambda _m, _i, output, name=name: found.__setitem__(name, output))
        for name, module in watched.items()
    ]
    released(sequence, time, text)
    for handle in handles:
        handle.remove()
    found["patch_proj"] = released.embed_patches(sequence)
    found["tokens"] = found["patch_proj"] + released.positions(4, 8, 8)
    found["temb"] = released.time_embed.timestep_embedder(time)
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        joined = found[name]
        if joined.ndim == 3:
            joined = rearrange(joined, "b (n h w) d -> b (h n w) d", n=4, h=4)
        if name == "patch_proj":
            value = rearrange(value, "b d h w -> b (h w) d")
        assert (joined - value).abs().max() <= 2e-5, name


@torch.no_grad()
def test_released_index_modes(shared_path, released, inputs):
    expected = golden(shared_path, "transformer_tiny_index_modes")
    arguments = inputs["x_n4_8x8"], inputs["t_n4_8x8"] / 1000, inputs["text_n4_8x8"].float()
    assert (released(*arguments, expected["loc_idx"]) - expected["y_train"]).abs().max() <= 2e-5
    for mode in ("fixed", "none"):
        assert (with_index(released, mode)(*arguments) - expected[f"y_{mode}"]).abs().max() <= 2e-5


def test_parameter_names_are_the_released_ones(shared_path):
    with torch.device("meta"):
        state = DiT(DiTConfig()).state_dict()
    expected = shared_path("facts/reference_keys_transformer.txt").read_text().splitlines()
    assert sorted(f"{key} {list(value.shape)}" for key, value in state.items()) == sorted(
        line for line in expected if line
    )


# Laws ------------------------------------------------------------------------------------------------------------


@torch.no_grad()
def test_without_index_permuting_the_views_permutes_the_velocity():
    network = small(index="none")
    sequence, time = sequence_of(2, 5)
    order = torch.tensor([3, 0, 4, 1, 2])
    torch.testing.assert_close(network(sequence[:, order], time), network(sequence, time)[:, order], atol=1e-10, rtol=0)


@torch.no_grad()
def test_views_that_keep_their_index_may_stand_in_any_order():
    network = small()
    sequence, time = sequence_of(1, 4)
    index = index_positions("flexible", 1, 4, generator=torch.Generator().manual_seed(0))
    order = torch.tensor([2, 3, 0, 1])
    permuted = network(sequence[:, order], time, None, index[:, order])
    torch.testing.assert_close(permuted, network(sequence, time, None, index)[:, order], atol=1e-10, rtol=0)
    assert (network(sequence[:, order], time) - permuted).abs().max() > 1e-3, "the index makes a difference"


@torch.no_grad()
def test_samples_of_a_batch_do_not_see_each_other():
    network = small(WITH_TEXT)
    sequence, time = sequence_of(3, 2)
    text = torch.randn(3, 7, 5, dtype=torch.float64)
    together = network(sequence, time, text)
    for i in range(3):
        alone = network(sequence[i : i + 1], time[i : i + 1], text[i : i + 1])
        torch.testing.assert_close(together[i : i + 1], alone, atol=1e-10, rtol=0)
    assert network(sequence[:0], time[:0], text[:0]).shape == (0, 2, 3, 4, 6)


@pytest.mark.parametrize("views", [1, 2, 7])
@pytest.mark.parametrize("size", [(2, 2), (4, 10), (6, 2)])
@torch.no_grad()
def test_any_number_of_views_of_any_even_size(views, size):
    sequence, time = sequence_of(1, views, *size)
    velocity = small()(sequence, time)
    assert velocity.shape == (1, views, 3, *size)
    assert velocity.isfinite().all()


@torch.no_grad()
def test_patch_projection_splits_over_channels():
    network = small()
    sequence, _ = sequence_of(2, 3)
    split = network.embed_patches(sequence[:, :, :4]) + network.embed_patches(
        sequence[:, :, 4:], first_channel=4, bias=False
    )
    torch.testing.assert_close(split, network.embed_patches(sequence), atol=1e-12, rtol=0)


@torch.no_grad()
def test_patch_projection_is_the_convolution_of_the_checkpoint():
    network = small()
    sequence, _ = sequence_of(2, 3)
    convolved = network.pos_embed.proj(sequence.flatten(0, 1))
    expected = rearrange(convolved, "(b n) d h w -> b (n h w) d", b=2)
    torch.testing.assert_close(network.embed_patches(sequence), expected, atol=1e-12, rtol=0)


# Readable twin ---------------------------------------------------------------------------------------------------


def rms(x: torch.Tensor, gain: torch.Tensor) -> torch.Tensor:
    """x over its root mean square, times a gain."""
    return x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt() * gain


def slow_attention(module, x: torch.Tensor, context: torch.Tensor, heads: int) -> torch.Tensor:
    """One head after the other, the softmax written out."""
    q, k, v = x @ module.to_q.weight.T, context @ module.to_k.weight.T, context @ module.to_v.weight.T
    outputs = []
    for qh, kh, vh in zip(q.chunk(heads, -1), k.chunk(heads, -1), v.chunk(heads, -1), strict=True):
        scores = rms(qh, module.norm_q.weight) @ rms(kh, module.norm_k.weight).transpose(1, 2) / math.sqrt(qh.shape[-1])
        outputs.append(scores.softmax(-1) @ vh)
    return torch.cat(outputs, -1) @ module.to_out[0].weight.T + module.to_out[0].bias


def slow_velocity(network: DiT, sequence: torch.Tensor, time: torch.Tensor, text: torch.Tensor) -> torch.Tensor:
    """The whole network as its description reads, patch by patch."""
    batch, views, _, height, width = sequence.shape
    config, proj = network.config, network.pos_embed.proj
    tokens = []
    for n, i, j in [(n, i, j) for n in range(views) for i in range(height // 2) for j in range(width // 2)]:
        patch = sequence[:, n, :, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        place = torch.cat(
            [
                sincos(torch.tensor(2 * math.pi * j / (width // 2)), 8),
                sincos(torch.tensor(2 * math.pi * i / (height // 2)), 8),
            ]
        )
        which = sincos(torch.tensor(2 * math.pi * n / max(views - 1, 1)), 16)
        tokens.append((patch[:, None] * proj.weight).sum((2, 3, 4)) + proj.bias + place + which)
    x = torch.stack(tokens, 1)
    layers = network.time_embed.timestep_embedder
    hidden = silu(layers.linear_1(timestep_embedding(1000 * time, 256)))
    active = silu(layers.linear_2(hidden))[:, None]
    for block in network.transformer_blocks:
        scale, shift = (active @ block.norm1.linear.weight.T).chunk(2, -1)
        y = rms(x, block.norm1.norm.weight) * (1 + scale) + shift
        x = x + slow_attention(block.attn1, y, y, config.heads)
        scale, shift = (active @ block.norm2.linear.weight.T).chunk(2, -1)
        y = rms(x, block.norm2.norm.weight) * (1 + scale) + shift
        x = x + slow_attention(block.attn2, y, text, config.heads)
        scale, shift = (active @ block.norm3.linear.weight.T).chunk(2, -1)
        centred = x - x.mean(-1, keepdim=True)
        y = (
            centred / (centred.square().mean(-1, keepdim=True) + 1e-5).sqrt() * block.norm3.norm.weight
            + block.norm3.norm.bias
        )
        value, gate = block.ff.net[0].proj(y * (1 + scale) + shift).chunk(2, -1)
        x = x + block.ff.net[2](value * gate * (1 + torch.erf(gate / math.sqrt(2))) / 2)
    shift, scale = network.proj_out_1(active).chunk(2, -1)
    centred = x - x.mean(-1, keepdim=True)
    out = network.proj_out_2(centred / (centred.square().mean(-1, keepdim=True) + 1e-6).sqrt() * (1 + scale) + shift)
    velocity = torch.empty(batch, views, 3, height, width, dtype=x.dtype)
    for token, (n, i, j) in enumerate(
        (n, i, j) for n in range(views) for i in range(height // 2) for j in range(width // 2)
    ):
        velocity[:, n, :, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = (
            out[:, token].reshape(batch, 2, 2, 3).permute(0, 3, 1, 2)
        )
    return velocity


def test_values_and_gradients_equal_the_readable_twin():
    network = small(WITH_TEXT)
    sequence, time = sequence_of(2, 2)
    text = torch.randn(2, 3, 5, dtype=torch.float64)
    sequence.requires_grad_(True)
    inputs = [sequence, *network.parameters()]
    fast, slow = network(sequence, time, text), slow_velocity(network, sequence, time, text)
    scale = slow.abs().max().item()
    torch.testing.assert_close(fast, slow, atol=1e-6 * scale, rtol=0)  # positions are float32 by design
    probe = torch.randn_like(slow)
    for a, b in zip(*(torch.autograd.grad((y * probe).sum(), inputs) for y in (fast, slow)), strict=True):
        torch.testing.assert_close(a, b, atol=1e-5 * max(b.abs().max().item(), 1e-3), rtol=0)


# Embeddings ------------------------------------------------------------------------------------------------------


def test_sincos_closed_form():
    half_pi = torch.tensor([0.0, math.pi / 20], dtype=torch.float64)  # times the angle scale of 10: 0 and 90 degrees
    embedded = sincos(half_pi, 4)
    expected = [[0, 0, 1, 1], [1, math.sin(math.pi / 2 * 1e-4), 0, math.cos(math.pi / 2 * 1e-4)]]
    torch.testing.assert_close(embedded, torch.tensor(expected, dtype=torch.float64), atol=1e-12, rtol=0)


def test_sincos_equals_the_golden(shared_path):
    expected = golden(shared_path, "transformer_tiny_index_modes")["sincos_1024"]
    assert (sincos(torch.linspace(0, 2 * math.pi, 5), 1024) - expected).abs().max() <= 2e-5


def test_layout_is_relative_to_the_size_of_the_view():
    coarse, fine = layout_embedding(2, 3, 32, dtype=torch.float64), layout_embedding(4, 6, 32, dtype=torch.float64)
    torch.testing.assert_close(fine[::2, ::2], coarse)
    torch.testing.assert_close(coarse[0, :, 16:], coarse[:1, 0, 16:].expand(3, 16))
    torch.testing.assert_close(coarse[:, 0, :16], coarse[0, :1, :16].expand(2, 16))


def test_index_positions():
    even = index_positions("flexible", 2, 5)
    torch.testing.assert_close(even[1], torch.tensor([0, 0.5, 1, 1.5, 2]) * math.pi)
    assert index_positions("flexible", 1, 1).tolist() == [[0.0]]
    draw = index_positions("flexible", 200, 30, generator=torch.Generator().manual_seed(0))
    assert 0 <= draw.min() < 0.01 and 2 * math.pi - 0.01 < draw.max() <= 2 * math.pi
    assert abs(draw.mean().item() - math.pi) < 0.1
    torch.testing.assert_close(index_positions("fixed", 1, 5, generator=torch.Generator()), even[:1])
    assert not index_positions("none", 2, 3).any()


def test_timestep_embedding_begins_with_cosines():
    embedded = timestep_embedding(torch.tensor([0.0, 2.0], dtype=torch.float64), 6)
    frequencies = torch.tensor([1, 10000 ** (-1 / 3), 10000 ** (-2 / 3)], dtype=torch.float64)
    torch.testing.assert_close(embedded[0], torch.tensor([1, 1, 1, 0, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(embedded[1], torch.cat([(2 * frequencies).cos(), (2 * frequencies).sin()]))


# Precision, initialisation, compilation --------------------------------------------------------------------------


@torch.no_grad()
def test_half_precision_answers_in_the_precision_of_its_input(released, inputs):
    case = "n4_8x8"
    rough = copy.deepcopy(released).to(torch.bfloat16)
    velocity = rough(inputs["x_" + case], inputs["t_" + case] / 1000, inputs["text_" + case].float())
    assert velocity.dtype == torch.float32
    assert (velocity - inputs["y_" + case]).abs().max() < 0.03 * inputs["y_" + case].abs().max()


def test_fresh_weights_predict_nothing_but_can_learn():
    one, two = (DiT(WITH_TEXT).initialize(torch.Generator().manual_seed(4)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), two.state_dict().values(), strict=True))
    sequence, time = (x.float() for x in sequence_of(2, 3))
    text = torch.randn(2, 4, 5)
    assert not one(sequence, time, text).any()
    optimiser = torch.optim.SGD(one.parameters(), lr=0.05)
    for _ in range(2):
        optimiser.zero_grad()
        (one(sequence, time, text) - sequence[:, :, :3]).square().mean().backward()
        optimiser.step()
    asleep = [name for name, parameter in one.named_parameters() if not parameter.grad.any()]
    assert not [name for name in asleep if "time_embed" not in name], (
        "only the time layers wait for the modulations to leave zero"
    )


@pytest.mark.slow
def test_compiles_without_graph_breaks(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    network = small(WITH_TEXT)
    sequence, time = sequence_of(2, 3)
    text = torch.randn(2, 4, 5, dtype=torch.float64)
    compiled = torch.compile(network, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(sequence, time, text), network(sequence, time, text))


# Refusals --------------------------------------------------------------------------------------------------------


def test_a_network_without_text_has_no_text_layers_and_refuses_text():
    network = small()
    assert not [name for name in network.state_dict() if "attn2" in name or "norm2" in name]
    assert DiTConfig(text_width=None) == DiTConfig(text_width=0)
    with pytest.raises(ValueError, match="text: expected None"):
        network(*sequence_of(1, 2), torch.zeros(1, 3, 5, dtype=torch.float64))


def test_a_network_with_text_refuses_none_and_other_widths():
    network = small(WITH_TEXT)
    with pytest.raises(ValueError, match=r"text: expected an embedding of width 5 .* got None"):
        network(*sequence_of(1, 2))
    with pytest.raises(ValueError, match="got width 7"):
        network(*sequence_of(1, 2), torch.zeros(1, 3, 7, dtype=torch.float64))


def test_sequences_that_do_not_fit_are_refused(monkeypatch):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    network = small()
    sequence, time = sequence_of(1, 2)
    for wrong, message in [
        (sequence[:, :0], "expected at least one view"),
        (sequence[..., :5], "positive multiples of 2, got 4 x 5"),
        (sequence[..., :0, :], "positive multiples of 2, got 0 x 6"),
        (sequence[:, :, :5], "expected 6 channels, got 5"),
    ]:
        with pytest.raises(ValueError, match=message):
            network(wrong, time)
    with pytest.raises(ValueError, match="index: expected one position for each of 2 views, got 3"):
        network(sequence, time, None, torch.zeros(1, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": 0}, "depth: expected a positive integer"),
        ({"heads": 1.5}, "heads: expected a positive integer, got 1.5"),
        ({"heads": 1, "head_dim": 6}, "expected a multiple of 4"),
        ({"index": "random"}, "index: expected one of flexible, fixed, none, got 'random'"),
        ({"text_width": -1}, "text_width: expected a width, or 0"),
    ],
)
def test_nonsense_configurations_are_refused(monkeypatch, change, message):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **change)
