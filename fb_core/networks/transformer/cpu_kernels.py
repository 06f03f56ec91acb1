"""Attention and the root-mean-square norm as a CPU is fast at them; elsewhere they are torch's.

On a CPU torch's fused attention computes products of bfloat16 at the speed of float32, and its backward pass works in
small blocks, at a tenth of the speed of a matrix product. The backward pass of torch's norm is put together from a
dozen passes over the activations. Together that was a fifth of a training step of a small transformer.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_MOST_WEIGHTS, _FEWEST_QUERIES = 2**21, 64
"""Without gradients: weights of attention that are held at once (8 MiB with their scores), and queries that are worth a
product.
"""
_MOST_SCORES = 2**20
"""Scores that are kept for the backward pass, 6 bytes each; longer sequences are left to torch, whose memory does not
grow with them.
"""


def attended(
    queries: Float[Tensor, "b heads tokens k"], keys: Float[Tensor, "b heads words k"], values: Tensor
) -> Float[Tensor, "b heads tokens k"]:
    """What every query gathers: softmax(queries keys^T / sqrt(k)) values.

    On a CPU in bfloat16 by plain products, almost twice as fast as torch's fused kernel: with scores and softmax in
    float32 where gradients are wanted, else in bfloat16, which rounds them.
    """
    scores = queries.shape[:3].numel() * keys.shape[2]
    wanted = torch.is_grad_enabled() and (queries.requires_grad or keys.requires_grad or values.requires_grad)
    ours = queries.device.type == "cpu" and queries.dtype == keys.dtype == values.dtype == torch.bfloat16
    if ours and wanted and scores <= _MOST_SCORES:
        return _Attended.apply(queries, keys, values)
    if ours and not torch.is_grad_enabled():
        return _by_products(queries, keys, values)
    return F.scaled_dot_product_attention(queries, keys, values)


def _by_products(queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
    """A bounded number of scores and weights at a time; by the fused kernel where too few queries would be left."""
    rows, asking, looked = queries.shape[:-2].numel(), queries.shape[-2], keys.shape[-2]
    at_once = _MOST_WEIGHTS // max(1, rows * looked)
    if not rows * asking * looked or at_once < min(asking, _FEWEST_QUERIES):
        return F.scaled_dot_product_attention(queries, keys, values)
    flat, keys, values = (x.reshape(rows, *x.shape[-2:]) for x in (queries, keys, values))
    scale, nothing = queries.shape[-1] ** -0.5, queries.new_empty(())
    answers = [
        torch.bmm(torch.baddbmm(nothing, part, keys.mT, beta=0, alpha=scale).softmax(dim=-1), values)
        for part in flat.split(at_once, dim=1)
    ]
    return torch.cat(answers, dim=1).view(queries.shape)


def rms_normed(x: Float[Tensor, "*batch d"], weight: Float[Tensor, "d"], eps: float) -> Float[Tensor, "*batch d"]:
    """x over the root of its mean square (plus ``eps``) along the last axis, times ``weight``."""
    if torch.is_grad_enabled() and x.device.type == "cpu" and (x.requires_grad or weight.requires_grad):
        return _Normed.apply(x, weight, eps)
    return F.rms_norm(x, weight.shape, weight, eps)


class _Attended(torch.autograd.Function):
    """Attention that keeps its weights, with scores and softmax in float32."""

    @staticmethod
    def forward(ctx: Any, queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        scale = queries.shape[-1] ** -0.5
        with torch.autocast(queries.device.type, enabled=False):
            weights = torch.softmax((queries.float() * scale) @ keys.float().mT, dim=-1)
            rounded = weights.to(queries.dtype)
            ctx.save_for_backward(queries, keys, values, weights, rounded)
            return rounded @ values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        queries, keys, values, weights, rounded = ctx.saved_tensors
        of_values = rounded.mT @ gradient
        of_weights = (gradient @ values.mT).float()
        of_scores = torch.ops.aten._softmax_backward_data(of_weights, weights, -1, torch.float32)
        of_scores = of_scores.mul_(queries.shape[-1] ** -0.5).to(queries.dtype)
        return of_scores @ keys, of_scores.mT @ queries, of_values


class _Normed(torch.autograd.Function):
    """A root-mean-square norm whose backward pass goes over the activations five times."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, eps: float) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.eps = eps
        return F.rms_norm(x, weight.shape, weight, eps)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        x, weight = ctx.saved_tensors
        mean_square = torch.linalg.vector_norm(x, dim=-1, keepdim=True).square() / x.shape[-1]
        inverse = (mean_square + ctx.eps).rsqrt()
        unit = x * inverse
        product = gradient * unit
        along = (product @ weight)[..., None] / x.shape[-1]
        of_x = torch.addcmul(gradient * weight, unit, along, value=-1).mul_(inverse)
        return of_x, product.flatten(0, -2).sum(dim=0), None
