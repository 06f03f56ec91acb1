"""``fillerbuster compile``: the drawing of splats as a library of this machine, tried before it is used."""

from __future__ import annotations

import logging
import time

import torch

from fb_core.splatting.compiled.library import NoCompiler, compile_libraries
from fb_core.splatting.rasterizer import Engine, rasterization

_GAUSSIANS, _SIDE, _RUNS = 10_000, 256, 3
_MOST_ERROR = 1e-9  # in double precision, where nothing but the order of additions differs
_logger = logging.getLogger(__name__)


def compile_splats() -> None:
    """Compile, compare with torch on a small scene, and say what it brings.

    Raises ValueError in one sentence (`NoCompiler`) where there is no compiler, and for a library that draws something
    else than torch, which is removed.
    """
    _logger.info("compiling; about 10 s")
    paths = compile_libraries()
    exact = [_drawn(engine, torch.float64)[0] for engine in ("torch", "compiled")]
    error = max(float((one - other).norm() / one.norm()) for one, other in zip(*exact, strict=True))
    if not error <= _MOST_ERROR:
        for path in paths:
            path.unlink()
        raise NoCompiler(
            f"compile: expected a library that draws what torch draws, got a relative error of {error:.1e}: name "
            "another compiler by CC; the library was removed, and splats are drawn by torch alone."
        )
    before, after = (min(_drawn(engine, torch.float32)[1] for _ in range(_RUNS)) for engine in ("torch", "compiled"))
    _logger.info(
        "wrote %s; drawing %d Gaussians at %dx%d, and their gradient, takes %.0f ms instead of %.0f. All commands use "
        "it from now on; remove the file to go back.",
        paths[0], _GAUSSIANS, _SIDE, _SIDE, 1000 * after, 1000 * before,
    )  # fmt: skip


def _drawn(engine: Engine, dtype: torch.dtype) -> tuple[list[torch.Tensor], float]:
    """Picture and gradients of a seeded cloud, and the seconds that they took."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = (random(_GAUSSIANS, 3) * 2 - 1 + torch.tensor([0.0, 0.0, 2.0])).to(dtype).requires_grad_()
    colors = random(_GAUSSIANS, 3).to(dtype).requires_grad_()
    began = time.perf_counter()
    images, alphas, _ = rasterization(
        means, random(_GAUSSIANS, 4).to(dtype), (0.02 * random(_GAUSSIANS, 3)).to(dtype), random(_GAUSSIANS).to(dtype),
        colors, torch.eye(4, dtype=dtype)[None],
        torch.tensor([[[_SIDE, 0, _SIDE / 2], [0, _SIDE, _SIDE / 2], [0, 0, 1.0]]], dtype=dtype), _SIDE, _SIDE,
        engine=engine,
    )  # fmt: skip
    (images.square().sum() + alphas.sum()).backward()
    seconds = time.perf_counter() - began
    return [images.detach(), *(leaf.grad for leaf in (means, colors) if leaf.grad is not None)], seconds
