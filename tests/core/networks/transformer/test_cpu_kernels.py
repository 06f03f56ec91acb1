"""Attention and the root-mean-square norm of a training against torch's and the exact ones."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from fb_core.networks.transformer import cpu_kernels
from fb_core.networks.transformer.cpu_kernels import attended, rms_normed


def drawn(*shape: int, seed: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).to(dtype).requires_grad_()


def errors(attention, inputs: list[torch.Tensor], gradient: torch.Tensor) -> list[float]:
    """Relative, of the gradients of queries, keys and values against those in float64."""
    exact = [values.detach().double().requires_grad_() for values in inputs]
    wanted = torch.autograd.grad(F.scaled_dot_product_attention(*exact), exact, gradient.double())
    got = torch.autograd.grad(attention(*inputs), inputs, gradient)
    return [float((a - b).norm() / b.norm()) for a, b in zip(got, wanted, strict=True)]


@pytest.mark.parametrize(("tokens", "words"), [(1, 1), (7, 30), (112, 192), (40, 5)])
@pytest.mark.parametrize("sharpness", [1.0, 3.0])
def test_gradients_of_attention_in_bfloat16_are_right_within_its_rounding(tokens, words, sharpness):
    shapes = ((2, 4, tokens, 16), (2, 4, words, 16), (2, 4, words, 16))
    inputs = [drawn(*shape, seed=seed, dtype=torch.bfloat16) for seed, shape in enumerate(shapes)]
    inputs = [(sharpness * values).detach().requires_grad_() for values in inputs]
    gradient = drawn(2, 4, tokens, 16, seed=9, dtype=torch.bfloat16).detach()
    ours = errors(attended, inputs, gradient)
    torchs = errors(F.scaled_dot_product_attention, inputs, gradient)
    if words == 1:  # no choice, so none of queries and keys
        ours, torchs = ours[2:], torchs[2:]
    assert max(ours) < 1.3 * max(torchs) + 1e-4 and max(ours) < 0.01
    exact = F.scaled_dot_product_attention(*(values.detach().double() for values in inputs))
    wrong, torchs_wrong = (
        float((answer - exact).norm() / exact.norm())
        for answer in (attended(*inputs).detach(), F.scaled_dot_product_attention(*inputs).detach())
    )
    assert wrong < 1.3 * torchs_wrong + 1e-4 and wrong < 0.01


def test_autocast_changes_nothing_of_attention_in_bfloat16():
    inputs = [drawn(2, 4, size, 16, seed=size, dtype=torch.bfloat16) for size in (7, 9, 9)]
    gradient = drawn(2, 4, 7, 16, seed=1, dtype=torch.bfloat16).detach()
    answers = []
    for enabled in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            answer = attended(*inputs)
        answers.append((answer, *torch.autograd.grad(answer, inputs, gradient)))
    assert all(torch.equal(plain, cast) for plain, cast in zip(*answers, strict=True))


def test_keys_that_several_sequences_share_gather_the_gradients_of_all():
    keys = drawn(1, 2, 6, 8, seed=0, dtype=torch.bfloat16)
    queries, values = (drawn(3, 2, size, 8, seed=size, dtype=torch.bfloat16) for size in (5, 6))
    got = torch.autograd.grad(attended(queries, keys.expand(3, -1, -1, -1), values).float().sum(), keys)[0]
    exact = [one.detach().double().requires_grad_() for one in (queries, keys, values)]
    answer = F.scaled_dot_product_attention(exact[0], exact[1].expand(3, -1, -1, -1), exact[2])
    wanted = torch.autograd.grad(answer.sum(), exact[1])[0]
    assert float((got - wanted).norm() / wanted.norm()) < 0.02


@pytest.mark.parametrize("case", ["float32", "nobody asks for gradients", "long"])
def test_all_other_attention_is_torchs(case, monkeypatch):
    def never(*_):
        raise AssertionError("this attention is torch's own")

    monkeypatch.setattr(cpu_kernels._Attended, "apply", never)
    dtype = torch.float32 if case == "float32" else torch.bfloat16
    if case == "long":
        monkeypatch.setattr(cpu_kernels, "_MOST_SCORES", 2 * 4 * 3 * 5 - 1)
    inputs = [drawn(2, 4, size, 8, seed=size, dtype=dtype) for size in (3, 5, 5)]
    if case.startswith("nobody"):
        inputs = [values.detach() for values in inputs]
    assert torch.equal(attended(*inputs), F.scaled_dot_product_attention(*inputs))


def test_the_gradient_of_the_norm_is_exact():
    x, weight = drawn(2, 3, 5, seed=0, dtype=torch.float64), drawn(5, seed=1, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x, weight: rms_normed(x, weight, 1e-5), (x, weight))
    tiny = (1e-4 * x).detach().requires_grad_()  # where the addend under the root counts
    assert torch.autograd.gradcheck(lambda x, weight: rms_normed(x, weight, 1e-5), (tiny, weight), eps=1e-9)


@pytest.mark.parametrize("shape", [(1, 40, 16), (1, 4, 40, 16)])
def test_the_norm_is_torchs_and_so_is_its_gradient_up_to_rounding(shape):
    x, weight = drawn(*shape, seed=0, dtype=torch.float32), drawn(shape[-1], seed=1, dtype=torch.float32)
    gradient = drawn(*shape, seed=2, dtype=torch.float32).detach()
    ours, torchs = rms_normed(x, weight, 1e-5), F.rms_norm(x, weight.shape, weight, 1e-5)
    assert torch.equal(ours, torchs)
    both = [torch.autograd.grad(normed, (x, weight), gradient) for normed in (ours, torchs)]
    for got, wanted in zip(*both, strict=True):
        torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-5)
