"""Muon (Jordan et al. 2024): steps of orthogonalised momentum for the matrices inside a network, at a speed that a CPU
can afford.

torch's own Muon iterates in bfloat16, one matrix after the other. Where bfloat16 is emulated that takes longer than the
training step itself; so here the iteration has the precision that the training has (bfloat16 on a GPU), and equal
shapes go through it together.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Optimizer

Polynomial = tuple[float, float, float]
"""a, b, c of a x + b x^3 + c x^5."""
FIVE: tuple[Polynomial, ...] = 5 * ((3.4445, -4.7750, 2.0315),)
"""The published iteration: singular values near 0 rise fastest, and all from 0.0016 of the norm on end between 0.68 and
1.20.
"""
FOUR: tuple[Polynomial, ...] = (
    (8.2193, -23.3375, 16.6266),
    (3.9690, -2.8424, 0.5167),
    (3.4626, -2.4982, 0.4802),
    (2.5404, -1.8885, 0.4481),
)
"""One step less for processors in bfloat16: singular values from 0.003 of the norm on end between 0.78 and 1.22. Each
polynomial is the one that comes nearest to 1 on what the one before it leaves (minimax, by linear programming, as in
Amsel et al. 2025), all but the last for values 2 % larger than these, lest rounding leave the range.
"""
_LONG = 6
"""Columns for each row from which on two steps at a time on the small side pay."""


class Muon(Optimizer):
    """Nesterov momentum, its matrix made nearly orthogonal, scaled so that AdamW's learning rates serve (root mean
    square 0.2).
    """

    def __init__(
        self,
        matrices: Iterable[nn.Parameter],
        *,
        learning_rate: float,
        weight_decay: float = 0.0,
        momentum: float = 0.95,
        iteration: torch.dtype = torch.float32,
    ):
        """``matrices`` [rows, columns] each, or kernels of convolutions, whose rows are their output channels.

        Weight decay is decoupled; ``iteration`` is the precision of the products. Raises ValueError for parameters that
        are neither.
        """
        matrices = list(matrices)
        if odd := [tuple(matrix.shape) for matrix in matrices if matrix.ndim not in (2, 4)]:
            raise ValueError(
                f"muon: expected matrices or kernels, got parameters of shape {odd[0]}; give those to AdamW"
            )
        super().__init__(matrices, {"lr": learning_rate, "weight_decay": weight_decay, "momentum": momentum})
        self._iteration = iteration

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Take a step along the gradients."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            alike: dict[torch.Size, list[Tensor]] = defaultdict(list)
            for matrix in group["params"]:
                if matrix.grad is not None:
                    alike[matrix.shape].append(matrix)
            for matrices in alike.values():
                momenta = torch.stack([self._direction(matrix, group["momentum"]).flatten(1) for matrix in matrices])
                directions = orthogonalised(momenta, self._iteration)
                length = 0.2 * max(momenta.shape[1:]) ** 0.5
                torch._foreach_mul_(matrices, 1 - group["lr"] * group["weight_decay"])
                steps = [
                    direction.view(matrix.shape)
                    for direction, matrix in zip(directions.unbind(), matrices, strict=True)
                ]
                torch._foreach_add_(matrices, steps, alpha=-group["lr"] * length)
        return loss

    def _direction(self, matrix: Tensor, momentum: float) -> Float[Tensor, "rows *columns"]:
        """The gradient, mixed with its running mean a step ahead."""
        assert matrix.grad is not None
        state = self.state[matrix]
        if "mean" not in state:
            state["mean"] = torch.zeros_like(matrix.grad)
        mean = state["mean"].lerp_(matrix.grad, 1 - momentum)
        return matrix.grad.lerp(mean, momentum)


def orthogonalised(
    matrices: Float[Tensor, "k rows columns"], iteration: torch.dtype = torch.float32
) -> Float[Tensor, "k rows columns"]:
    """Matrices with the same singular vectors, and singular values between about 0.7 and 1.2 (0 stays 0); any scale,
    zeros included.

    A Newton-Schulz iteration of degree five: three products of matrices each time, on the shorter side. In bfloat16 on
    a CPU it has four steps instead of five, which long matrices take two at a time.
    """
    short = not matrices.is_cuda and iteration == torch.bfloat16
    tall = matrices.shape[1] > matrices.shape[2]
    x = matrices.mT if tall else matrices
    x = (x / x.norm(dim=(1, 2), keepdim=True).clamp(min=1e-30)).to(torch.bfloat16 if x.is_cuda else iteration)
    if short and x.shape[2] >= _LONG * x.shape[1]:
        for first, second in (FOUR[:2], FOUR[2:]):
            x = _two_steps(x, first, second)
    else:
        for a, b, c in FOUR if short else FIVE:
            gram = x @ x.mT
            polynomial = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
            x = torch.baddbmm(x, polynomial, x, beta=a)
    return (x.mT if tall else x).to(matrices.dtype)


def _two_steps(x: Float[Tensor, "k rows columns"], first: Polynomial, second: Polynomial) -> Tensor:
    """Two steps as one polynomial of the small matrix x x^T: the long side is multiplied twice instead of four times,
    in bfloat16; the small products are in float32, so that the answer is the more exact one, too.

    Not more at once: what x x^T lost by rounding would grow with every step that does not look at x again, in matrices
    of low rank beyond all bounds.
    """
    gram = (x @ x.mT).float()
    one = _of(gram, first)
    two = _of(one @ gram @ one, second)
    return (two @ one).to(x.dtype) @ x


def _of(gram: Float[Tensor, "k rows rows"], polynomial: Polynomial) -> Float[Tensor, "k rows rows"]:
    """What a step multiplies its matrix by."""
    a, b, c = polynomial
    factor = torch.baddbmm(gram, gram, gram, beta=b, alpha=c)
    factor.diagonal(dim1=1, dim2=2).add_(a)
    return factor
