"""What the splat benchmark compares with: a plain loop over tiles with autograd, and gsplat's own torch functions on a
CPU.

gsplat 1.4 keeps torch twins of its kernels. Three of their parts need CUDA or take minutes; `gsplat_on_cpu` replaces
these for the time of a call, and only here: the list of pairs to composite, nerfacc's transmittance, and the Python
loop that sorts Gaussians into tiles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.splatting.projection import ALPHA_MIN

TILE = 16
_CAP, _STOP = 0.999, 1e-4


def tile_loop(**inputs: Any) -> tuple[Float[Tensor, "1 h w 4"], Float[Tensor, "1 h w 1"]]:
    """Colours and depth, alpha (gsplat 1.4's rules): tile by tile, its Gaussians times 256 pixels, differentiated by
    autograd.

    ``inputs`` are those of a scene (``SplatScene.inputs``), here and below.
    """
    view, opacities, width, height = _projected(inputs), inputs["opacities"], inputs["width"], inputs["height"]
    values = torch.cat([inputs["colors"], view["depths"][:, None]], dim=1)
    background = values.new_zeros(5)
    strips = []
    for top in range(0, height, TILE):
        row = []
        for left in range(0, width, TILE):
            y, x = torch.meshgrid(torch.arange(top, top + TILE), torch.arange(left, left + TILE), indexing="ij")
            pixels = torch.stack([x, y], dim=-1).reshape(-1, 2).to(values) + 0.5
            inside = (view["first"] <= torch.tensor([left, top]) // TILE) & (
                view["last"] > torch.tensor([left, top]) // TILE
            )
            chosen = (inside.all(dim=-1) & (view["radii"] > 0)).nonzero()[:, 0]
            chosen = chosen[torch.argsort(view["depths"][chosen].detach(), stable=True)]
            drawn = _tile(view, opacities, values, chosen, pixels) if len(chosen) else background.expand(TILE * TILE, 5)
            row.append(drawn.view(TILE, TILE, 5))
        strips.append(torch.cat(row, dim=1))
    image = torch.cat(strips)[None, :height, :width]
    return image[..., :4], image[..., 4:]


def _projected(inputs: Mapping[str, Any]) -> dict[str, Tensor]:
    """The Gaussians on the picture of one camera, by gsplat's own torch functions."""
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    means, width, height = inputs["means"], inputs["width"], inputs["height"]
    covars, _ = _quat_scale_to_covar_preci(inputs["quats"], inputs["scales"], compute_preci=False)
    assert covars is not None
    radii, means2d, depths, conics, _ = _fully_fused_projection(
        means, covars, inputs["viewmats"], inputs["Ks"], width, height
    )
    with torch.no_grad():
        box = radii[0, :, None].to(means)
        first, last = torch.floor((means2d[0] - box) / TILE), torch.ceil((means2d[0] + box) / TILE)
    return {
        "radii": radii[0],
        "means2d": means2d[0],
        "depths": depths[0],
        "conics": conics[0],
        "first": first,
        "last": last,
    }


def _alphas(means2d: Tensor, conics: Tensor, opacities: Tensor, pixels: Tensor) -> Float[Tensor, "p g"]:
    dx, dy = (means2d[None] - pixels[:, None]).unbind(-1)
    sigma = 0.5 * (conics[:, 0] * dx * dx + conics[:, 2] * dy * dy) + conics[:, 1] * dx * dy
    alphas = (opacities * torch.exp(-sigma)).clamp(max=_CAP)
    return torch.where((sigma >= 0) & (alphas >= ALPHA_MIN), alphas, 0.0)


def _tile(
    view: dict[str, Tensor], opacities: Tensor, values: Tensor, chosen: Tensor, pixels: Tensor
) -> Float[Tensor, "p 5"]:
    """Values and alpha of the pixels."""
    alphas = _alphas(view["means2d"][chosen], view["conics"][chosen], opacities[chosen], pixels)
    alphas = torch.where(torch.cumprod(1 - alphas.detach(), dim=1) > _STOP, alphas, 0.0)
    light = torch.cumprod(1 - alphas, dim=1)
    weights = alphas * torch.cat([torch.ones_like(light[:, :1]), light[:, :-1]], dim=1)
    return torch.cat([weights @ values[chosen], weights.sum(dim=1, keepdim=True)], dim=1)


def gsplat_torch(**inputs: Any) -> tuple[Float[Tensor, "1 h w 4"], Float[Tensor, "1 h w 1"]]:
    """The same by gsplat's projection, compositing in one pass over all pairs, and our replacements; float32 only, as
    gsplat's is.
    """
    from gsplat.cuda._torch_impl import _rasterize_to_pixels

    view, opacities, width, height = _projected(inputs), inputs["opacities"], inputs["width"], inputs["height"]
    values = torch.cat([inputs["colors"], view["depths"][:, None]], dim=1)
    offsets, splats = _tile_lists(view, width, height)
    with gsplat_on_cpu():
        return _rasterize_to_pixels(
            view["means2d"][None], view["conics"][None], values[None], opacities[None], width, height, TILE, offsets,
            splats,
            batch_per_iter=10**9,
        )  # fmt: skip


def gsplat_kernels(**inputs: Any) -> tuple[Float[Tensor, "1 h w 4"], Float[Tensor, "1 h w 1"]]:
    """The same by gsplat's CUDA kernels; the tensors must be on a GPU."""
    from gsplat import rendering

    return rendering.rasterization(**inputs, packed=False, render_mode="RGB+D")[:2]


@torch.no_grad()
def _tile_lists(view: dict[str, Tensor], width: int, height: int) -> tuple[Tensor, Tensor]:
    """gsplat's tile lists without its Python loop: offsets [1, rows, columns] and Gaussians by tile, near ones
    first.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    limits = torch.tensor([columns, rows])
    first, last = (view[name].long().clamp(min=0).minimum(limits) for name in ("first", "last"))
    spans = (last - first).clamp(min=0) * (view["radii"] > 0)[:, None]
    order = torch.argsort(view["depths"], stable=True)
    counts = spans.prod(dim=-1)[order]
    splats = torch.repeat_interleave(order, counts)
    ranks = torch.arange(len(splats)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    across = spans[splats, 0]
    tiles = (first[splats, 1] + ranks // across) * columns + first[splats, 0] + ranks % across
    tiles, sorting = torch.sort(tiles, stable=True)
    occupied = torch.bincount(tiles, minlength=rows * columns)
    return (occupied.cumsum(0) - occupied).view(1, rows, columns).int(), splats[sorting].int()


@contextmanager
def gsplat_on_cpu() -> Iterator[None]:
    """gsplat's torch compositing on a CPU, inside the block: what its CUDA and nerfacc's give is made in torch."""
    import nerfacc
    from gsplat.cuda import _wrapper

    before = _wrapper.rasterize_to_indices_in_range, nerfacc.render_weight_from_alpha
    _wrapper.rasterize_to_indices_in_range, nerfacc.render_weight_from_alpha = _pairs, _weights
    try:
        yield
    finally:
        _wrapper.rasterize_to_indices_in_range, nerfacc.render_weight_from_alpha = before


@torch.no_grad()
def _pairs(*given: Any) -> tuple[Tensor, Tensor, Tensor]:
    """All pairs to composite (Gaussian, pixel, camera), pixel by pixel and near ones first: stands in for a CUDA kernel
    of gsplat, whose arguments it has.
    """
    means2d, conics, opacities, width, height, tile, offsets, splats = given[3:]  # those before say where to begin
    ends = torch.cat([offsets.flatten()[1:], offsets.new_tensor([len(splats)])]).tolist()
    pairs: list[tuple[Tensor, Tensor]] = []
    for number, (begin, end) in enumerate(zip(offsets.flatten().tolist(), ends, strict=True)):
        if begin == end:
            continue
        top, left = (tile * place for place in divmod(number, offsets.shape[2]))
        y, x = torch.meshgrid(
            torch.arange(top, min(top + tile, height)), torch.arange(left, min(left + tile, width)), indexing="ij"
        )
        chosen = splats[begin:end].long()
        alphas = _alphas(
            means2d[0, chosen], conics[0, chosen], opacities[0, chosen], torch.stack([x, y], -1).reshape(-1, 2) + 0.5
        )
        pixel, rank = ((alphas > 0) & (torch.cumprod(1 - alphas, dim=1) > _STOP)).nonzero(as_tuple=True)
        pairs.append((chosen[rank], (y * width + x).reshape(-1)[pixel]))
    nothing = splats.new_zeros(0).long()
    gaussians, pixels = (torch.cat([nothing, *parts]) for parts in (zip(*pairs, strict=True) if pairs else ((), ())))
    return gaussians, pixels, torch.zeros_like(pixels)


def _weights(alphas: Tensor, ray_indices: Tensor, n_rays: int, **_: Any) -> tuple[Tensor, Tensor]:
    """Weights and transmittance of samples, those of a ray in one run: stands in for nerfacc's CUDA scan."""
    logs = torch.log1p(-alphas.double())
    before = torch.cumsum(logs, dim=0) - logs
    _, counts = torch.unique_consecutive(ray_indices, return_counts=True)
    first = torch.repeat_interleave(torch.cumsum(counts, dim=0) - counts, counts)
    light = torch.exp(before - before[first]).to(alphas)
    return alphas * light, light
