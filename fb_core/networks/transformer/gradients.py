"""Attention and the root-mean-square norm as a training on a CPU is fast at them; without gradients they are torch's.

On a CPU torch's own backward of attention in bfloat16 works in small blocks, at a tenth of the speed of a matrix
product, and that of the norm is put together from a dozen passes over the activations: together a fifth of a training
step of a small transformer.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

_MOST_SCORES = 2**20
"""Scores that are kept for the backward pass, 6 bytes each; longer sequences are left to torch, whose memory does not
grow with them.
"""


def attended(
    queries: Float[Tensor, "b heads tokens k"], keys: Float[Tensor, "b heads words k"], values: Tensor
) -> Float[Tensor, "b heads tokens k"]:
    """What every query gathers: softmax(queries keys^T / sqrt(k)) values."""
    scores = queries.shape[:3].numel() * keys.shape[2]
    wanted = torch.is_grad_enabled() and (queries.requires_grad or keys.requires_grad or values.requires_grad)
    ours = wanted and queries.device.type == "cpu" and queries.dtype == keys.dtype == values.dtype == torch.bfloat16
    if ours and scores <= _MOST_SCORES:
        return _Attended.apply(queries, keys, values)
    return F.scaled_dot_product_attention(queries, keys, values)


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
