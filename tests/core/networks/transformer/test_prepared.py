"""Prepared sampling: equal to the plain forward pass, whatever is shared, windowed or split."""

import dataclasses
import math

import jaxtyping
import pytest
import torch
from helpers.tiny_models import network_of

from fb_core.networks.transformer.dit import DiT, DiTConfig, TokenFacts
from fb_core.networks.transformer.prepared import Prepared

WITHOUT_TEXT = DiTConfig(heads=2, head_dim=8, depth=2, in_channels=10, out_channels=4, text_width=0)
WITH_TEXT = dataclasses.replace(WITHOUT_TEXT, text_width=5)
TIMES = [1.0, 2 / 3, 1 / 3]


def plain(network: DiT, state, conditioning, time: float, text=None) -> torch.Tensor:
    """The twin: every branch by itself, nothing kept."""
    branches = []
    for b in range(len(conditioning)):
        branch_text = None if text is None else text[b % len(text)][None]
        sequence = torch.cat([state, conditioning[b]], dim=1)[None]
        branches.append(network(sequence, torch.tensor([time], dtype=torch.float32), branch_text)[0])
    return torch.stack(branches)


@pytest.fixture(scope="module")
def state() -> torch.Tensor:
    """Noisy latents of five views."""
    return torch.randn(5, 4, 4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(3))


@pytest.fixture(scope="module")
def conditioning() -> torch.Tensor:
    """Three branches."""
    return torch.randn(3, 5, 6, 4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(4))


@pytest.mark.parametrize("branches_at_once", [None, 1, 2])
@pytest.mark.parametrize("texts", [0, 1, 3])
@pytest.mark.parametrize("index", ["flexible", "none"])
@torch.no_grad()
def test_prepared_equals_plain(state, conditioning, texts, index, branches_at_once):
    network = network_of(dataclasses.replace(WITH_TEXT if texts else WITHOUT_TEXT, index=index))
    text = torch.randn(texts, 7, 5, dtype=torch.float64) if texts else None
    prepared = Prepared(network, conditioning, TIMES, text=text, branches_at_once=branches_at_once)
    for time in [*TIMES, 0.123]:
        expected = plain(network, state, conditioning, time, text)
        torch.testing.assert_close(prepared(state, time), expected, atol=1e-9 * expected.abs().max().item(), rtol=0)


@torch.no_grad()
def test_a_window_is_a_sequence_of_its_own(state, conditioning):
    network = network_of(WITHOUT_TEXT)
    prepared = Prepared(network, conditioning, TIMES)
    for views in (torch.tensor([4, 1, 2]), torch.tensor([3])):
        expected = plain(network, state[views], conditioning[:, views], 1.0)
        torch.testing.assert_close(
            prepared(state[views], 1.0, views), expected, atol=1e-9 * expected.abs().max().item(), rtol=0
        )


@torch.no_grad()
def test_a_null_branch_may_be_one_expanded_view(state, conditioning):
    network = network_of(WITHOUT_TEXT)
    null = conditioning[:1, :1].expand(1, 5, -1, -1, -1)
    both = torch.cat([null, conditioning[1:2]])
    expected = plain(network, state, both, TIMES[1])
    torch.testing.assert_close(
        Prepared(network, both, TIMES)(state, TIMES[1]), expected, atol=1e-9 * expected.abs().max().item(), rtol=0
    )


@torch.no_grad()
def test_half_precision_stays_near_the_plain_pass(state, conditioning):
    network = network_of(WITH_TEXT).float()
    for name, parameter in network.named_parameters():  # benign weights: half precision is compared, not chaos
        torch.nn.init.normal_(
            parameter, std=0.3 / math.sqrt(max(parameter[0].numel(), 1)) if parameter.ndim > 1 else 0.1
        )
        if name.endswith(("norm.weight", "norm_q.weight", "norm_k.weight")):
            torch.nn.init.ones_(parameter)
    text = torch.randn(1, 7, 5)
    exact = plain(network, state.float(), conditioning.float(), 1.0, text)
    rough = Prepared(network.to(torch.bfloat16), conditioning.float(), TIMES, text=text)(state.float(), 1.0)
    assert rough.dtype == torch.float32
    assert (rough - exact).abs().max() < 0.03 * exact.abs().max()


def test_what_does_not_fit_is_refused(monkeypatch, state, conditioning):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # users run without the tests' type checks
    network = network_of(WITH_TEXT)
    text = torch.zeros(2, 7, 5, dtype=torch.float64)
    for arguments, message in [
        ({"conditioning": conditioning[:, :, :5]}, "expected branches of 6 channels, got 3 of 5"),
        ({"conditioning": conditioning[:0]}, "expected branches of 6 channels, got 0 of 6"),
        ({"text": text}, "expected one embedding or one for each of 3 branches, got 2"),
        ({"text": None}, "text: expected an embedding of width 5"),
        ({"branches_at_once": 0}, "branches_at_once: expected at least 1, got 0"),
    ]:
        with pytest.raises(ValueError, match=message):
            Prepared(network, **({"conditioning": conditioning, "times": TIMES, "text": text[:1]} | arguments))
    prepared = Prepared(network, conditioning, TIMES, text=text[:1])
    with pytest.raises(ValueError, match="state: expected 5 views, got 4"):
        prepared(state[:4], 1.0)


@pytest.mark.parametrize("texts", [0, 3])
@pytest.mark.parametrize("ray_frames", [False, True])
@pytest.mark.parametrize("branches_at_once", [None, 1])
@torch.no_grad()
def test_tokens_that_nobody_asks_for_end_in_the_last_block(state, conditioning, texts, ray_frames, branches_at_once):
    config = dataclasses.replace(WITH_TEXT if texts else WITHOUT_TEXT, ray_frames=ray_frames)
    network, text = network_of(config), torch.randn(texts, 7, 5, dtype=torch.float64) if texts else None
    frames = torch.eye(4, dtype=torch.float64).repeat(3, 5, 2, 3, 1, 1)
    frames[..., :3, 3] = torch.randn(3, 5, 2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    asked = torch.rand(5, 2, 3, generator=torch.Generator().manual_seed(6)) > 0.5
    options = {"text": text, "branches_at_once": branches_at_once}
    whole = Prepared(network, conditioning, TIMES, facts=TokenFacts(frames=frames), **options)
    some = Prepared(network, conditioning, TIMES, facts=TokenFacts(frames=frames, asked=asked), **options)
    for views in (None, torch.tensor([4, 1, 2])):
        chosen = slice(None) if views is None else views
        expected, got = (one(state[chosen], 0.4, views) for one in (whole, some))
        latents = asked[chosen].repeat_interleave(2, dim=1).repeat_interleave(2, dim=2)[None, :, None].expand_as(got)
        torch.testing.assert_close(got[latents], expected[latents])
        assert not bool(got[~latents].any())


@torch.no_grad()
def test_nobody_asked_for_or_all_asked_for(state, conditioning):
    network = network_of(WITHOUT_TEXT)
    every, none = torch.ones(5, 2, 3, dtype=torch.bool), torch.zeros(5, 2, 3, dtype=torch.bool)
    plain_velocity = Prepared(network, conditioning, TIMES)(state, 1.0)
    assert torch.equal(
        Prepared(network, conditioning, TIMES, facts=TokenFacts(asked=every))(state, 1.0), plain_velocity
    )
    assert not bool(Prepared(network, conditioning, TIMES, facts=TokenFacts(asked=none))(state, 1.0).any())
