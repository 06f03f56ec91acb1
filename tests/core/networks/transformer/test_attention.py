"""Attention in bfloat16 by plain products: exact to the rounding of its scores, in bounded memory."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from fb_core.networks.transformer import cpu_kernels
from fb_core.networks.transformer.attention import KeysValues
from fb_core.networks.transformer.cpu_kernels import attended


def drawn(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed)).to(torch.bfloat16)


def error(got: Tensor, exact: Tensor) -> float:
    return float((got.double() - exact).norm() / exact.norm())


@pytest.fixture
def fused(monkeypatch) -> list[int]:
    """Calls of torch's kernel."""
    calls, plain = [], F.scaled_dot_product_attention

    def counted(*arguments, **options):
        calls.append(1)
        return plain(*arguments, **options)

    monkeypatch.setattr(F, "scaled_dot_product_attention", counted)
    return calls


@pytest.mark.parametrize(
    ("batch", "asking", "looked", "limit"),
    [(1, 64, 640, None), (2, 100, 37, None), (1, 1, 1, None), (2, 200, 50, 2 * 4 * 50 * 70), (1, 3, 500, 4 * 500)],
)
@torch.no_grad()
def test_plain_products_are_exact_to_the_rounding_of_scores(monkeypatch, fused, batch, asking, looked, limit) -> None:
    if limit is not None:  # 70 queries at a time, the last ones fewer
        monkeypatch.setattr(cpu_kernels, "_MOST_WEIGHTS", limit)
        monkeypatch.setattr(cpu_kernels, "_FEWEST_QUERIES", 1)
    queries = 2 * drawn(batch, asking, 4, 64, seed=1).transpose(1, 2)
    context = KeysValues(*(drawn(batch, looked, 4, 64, seed=seed).transpose(1, 2) for seed in (2, 3)))
    got = attended(queries, *context)
    assert got.dtype == torch.bfloat16 and got.shape == queries.shape and not fused
    exact = F.scaled_dot_product_attention(queries.double(), context.keys.double(), context.values.double())
    scores = queries.double() @ context.keys.double().mT * 64**-0.5
    assert error(got, exact) < 2**-9 * max(1.0, float(scores.std())) * 3  # half a unit of the last place, and its sums


@torch.no_grad()
def test_scores_that_are_far_apart_stay_finite() -> None:
    queries, keys = torch.full((1, 1, 2, 8), 1e4).bfloat16(), torch.tensor([1e4, -1e4]).bfloat16().view(1, 1, 2, 1)
    context = KeysValues(
        keys.expand(1, 1, 2, 8), torch.tensor([3.0, 5.0]).bfloat16().view(1, 1, 2, 1).expand(1, 1, 2, 8)
    )
    assert bool((attended(queries, *context) == 3).all())


@pytest.mark.parametrize("why", ["float32", "gradients", "too many keys", "no queries"])
def test_the_fused_kernel_answers_all_else(fused, why) -> None:
    shape = {"too many keys": (1, 4, 64, 8), "no queries": (1, 4, 0, 8)}.get(why, (1, 4, 3, 8))
    queries = drawn(*shape, seed=1)
    context = KeysValues(*(drawn(1, 4, 10_000 if why == "too many keys" else 5, 8, seed=seed) for seed in (2, 3)))
    if why == "float32":
        queries, context = queries.float(), KeysValues(*(x.float() for x in context))
    with torch.set_grad_enabled(why == "gradients"):
        assert attended(queries, *context).shape == queries.shape
    assert fused == [1]
