"""The one function that the splat model calls to draw Gaussians: gsplat on CUDA, the torch rasterizer anywhere else.

The choice follows the tensors' device and nothing else. Trying gsplat and catching its failure would not do: its first
call without a GPU may start a build that takes minutes.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.splatting.rasterizer import RenderMode, rasterization

BLUR = 0.3
"""Variance in square pixels that every Gaussian is widened by on the screen; gsplat's."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RenderedSplats:
    """Pictures of Gaussians."""

    colors: Float[Tensor, "c h w x"]
    """The channels asked for, accumulated; a depth channel comes last."""
    alphas: Float[Tensor, "c h w 1"]
    """1 - transmittance."""
    meta: dict[str, Any]
    """What gsplat's strategies read: `means2d` (the tensor that the gradient flows through), `radii`, `width`,
    `height`, ...
    """


def render_splats(
    *,
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "n d"] | Float[Tensor, "n k 3"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = BLUR,
    sh_degree: int | None = None,
    backgrounds: Float[Tensor, "c d"] | None = None,
    render_mode: RenderMode = "RGB",
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
) -> RenderedSplats:
    """Draw Gaussians with the backend of their device, unpacked; see `rasterizer.rasterization` for every argument.

    Both backends take any number of channels (normals are drawn as three more), antialiasing and absgrad. On Apple's
    mps the picture is computed on the CPU, said once, and comes back to mps together with what the strategies read.
    """
    splats: dict[str, Any] = dict(
        means=means, quats=quats, scales=scales, opacities=opacities, colors=colors, viewmats=viewmats, Ks=Ks
    )
    options: dict[str, Any] = dict(
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        sh_degree=sh_degree,
        packed=False,
        render_mode=render_mode,
        absgrad=absgrad,
        rasterize_mode=rasterize_mode,
    )
    if means.device.type == "cuda":
        # Every keyword used here means the same in gsplat 1.4, 1.5 and 1.6.
        from gsplat.rendering import rasterization as gsplat_rasterization

        images, alphas, meta = gsplat_rasterization(**splats, **options, backgrounds=backgrounds)
        return RenderedSplats(colors=images, alphas=alphas, meta=meta)
    if means.device.type != "cpu":
        return _through_cpu(splats, options, backgrounds)
    images, alphas, meta = rasterization(**splats, **options, backgrounds=backgrounds, semantics=installed_semantics())
    return RenderedSplats(colors=images, alphas=alphas, meta=meta)


@cache
def installed_semantics() -> Literal["1.4", "1.5", "1.6"]:
    """The semantics of the installed gsplat, whose strategies read our meta: 1.5 changed the shape of `radii`, for
    one.
    """
    major, minor = (int(part) for part in version("gsplat").split(".")[:2])
    if (major, minor) < (1, 5):
        return "1.4"
    return "1.5" if (major, minor) == (1, 5) else "1.6"


def _through_cpu(splats: dict[str, Tensor], options: dict[str, Any], backgrounds: Tensor | None) -> RenderedSplats:
    """Draw on the CPU for another device; gradients come back through the copies."""
    device = splats["means"].device
    _say_once(device.type)
    on_cpu = {name: tensor.cpu() for name, tensor in splats.items()}
    background = None if backgrounds is None else backgrounds.cpu()
    images, alphas, meta = rasterization(**on_cpu, **options, backgrounds=background, semantics=installed_semantics())
    moved = {name: value.detach().to(device) if isinstance(value, Tensor) else value for name, value in meta.items()}
    if meta["means2d"].requires_grad:
        moved["means2d"] = _gradient_mirror(meta["means2d"], device)
    return RenderedSplats(colors=images.to(device), alphas=alphas.to(device), meta=moved)


def _gradient_mirror(source: Tensor, device: torch.device) -> Tensor:
    """A leaf on `device` whose `.grad` and `.absgrad` follow those of `source` after backward (strategies index with
    them).
    """
    mirror = source.detach().to(device, copy=True).requires_grad_()

    def follow(gradient: Tensor) -> None:
        mirror.grad = gradient.to(device)
        absolute = getattr(source, "absgrad", None)
        if absolute is not None:
            # Tensors declare no such attribute; gsplat's strategies read it.
            setattr(mirror, "absgrad", absolute.to(device))  # noqa: B010

    source.register_hook(follow)
    return mirror


@cache
def _say_once(device: str) -> None:
    _logger.warning(
        "gsplat's kernels need CUDA and the model is on %s: Gaussians are drawn on the CPU and copied back.", device
    )
