"""Front-to-back alpha compositing of screen ellipses with an analytic gradient (pure torch, bounded memory).

The backward pass walks the blocks of `torch_blocks` front to back once more, nothing is stored: what lies behind a Gaussian is the
known total less what has been passed. The gradient of a pair is its derivative g by the exponent; sums of g times the monomials
(one thin matrix product) are moments, from which every gradient follows. A pair above the cap passes no gradient to its exponent.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_nerfstudio.single_thread import single_thread
from fb_nerfstudio.torch_blocks import PAIRS_PER_BLOCK, TERMS, THIN, TRANSMITTANCE_MIN, Block, Scratch, march, padded, table_of
from fb_nerfstudio.torch_cells import CellGrid, CellLists, Ellipses, Strips, list_cells, measure_strips, slabs

ROWS_PER_LIST = 2**20


@dataclass(frozen=True, kw_only=True)
class CompositingSettings:
    """What the compositor needs besides tensors."""

    alpha_cap: float
    """Largest alpha of one pair."""
    absgrad: bool = False
    """Whether backward leaves the sum over pixels of |d loss / d mean2d| in `means2d.absgrad`."""
    pairs_per_block: int = PAIRS_PER_BLOCK
    """Pairs (Gaussian, pixel) worked on at once: bounds the scratch memory and should fit the cache."""
    rows_per_list: int = ROWS_PER_LIST
    """Pairs (Gaussian, cell) listed at once: bounds the memory of the lists."""


def composite(
    means2d: Float[Tensor, "c n 2"],
    conics: Float[Tensor, "c n 3"],
    opacities: Float[Tensor, "c n"],
    values: Float[Tensor, "v d"],
    chosen: Int32[Tensor, " v"],
    ellipses: Ellipses,
    grid: CellGrid,
    settings: CompositingSettings,
) -> tuple[Float[Tensor, "c h w d"], Float[Tensor, "c h w 1"]]:
    """Images of the values, and alpha = 1 - transmittance.

    `chosen` holds the flat indices (camera * n + Gaussian) of the Gaussians that may be seen, nearest first; `values` and
    `ellipses` are given for these rows only. Gradients flow to means2d, conics, opacities and values.
    """
    return _Composite.apply(means2d, conics, opacities, values, chosen, ellipses, grid, settings)


def _forward_block(block: Block, image: Tensor, scratch: Scratch) -> None:
    """Add the block to the cells [s, d1, p] of its stretch."""
    weights = torch.mul(block.alpha, block.light, out=scratch.take("weights", *block.alpha.shape))
    image[: weights.shape[1]].baddbmm_(block.values.permute(1, 2, 0), weights.permute(1, 0, 2))


def _backward_block(block: Block, monomials: Tensor, upstream: Tensor, behind: Tensor, sums: Tensor, absgrad: bool, scratch: Scratch):
    """Add the block's gradients to `sums` [v, r]; `behind` [s, p], the part of the loss that lies behind, is advanced in place.

    The columns of `sums`: six moments of g (`_central_moments`), two absolute pulls (with absgrad), the values, padding.
    """
    depth, width, pixels = block.alpha.shape
    upstream, behind = upstream[:width], behind[:width]
    new = scratch.take("new", depth * width, sums.shape[1])
    weights = torch.mul(block.alpha, block.light, out=scratch.take("weights", depth, width, pixels))
    v_values = new[:, TERMS + 2 : TERMS + 2 + upstream.shape[1]].view(depth, width, -1)
    v_values.copy_(torch.bmm(upstream, weights.permute(1, 2, 0)).permute(2, 0, 1))
    seen = torch.bmm(block.values.permute(1, 0, 2), upstream, out=scratch.take("seen", width, depth, pixels))
    share = weights.mul_(seen.permute(1, 0, 2))
    rest = scratch.take("rest", depth, width, pixels)
    _pass_by(behind, share, rest)
    # d loss / d exponent = alpha T (value . upstream) - alpha / (1 - alpha) * what lies behind
    g = share.addcmul_(torch.div(block.alpha, block.clear, out=block.clear), rest, value=-1.0)
    if block.capped is not None:
        g.masked_fill_(block.capped, 0.0)
    g = g.view(depth * width, pixels)
    new[:, :TERMS] = _central_moments(block.columns[6:8], torch.mm(monomials, g.t())).t()
    if absgrad:
        new[:, TERMS : TERMS + 2] = _absolute_pulls(block.columns, monomials, g, scratch).t()
    sums.index_add_(0, block.splats.long(), new)  # several times faster with 64-bit indices


def _pass_by(behind: Tensor, share: Tensor, rest: Tensor) -> None:
    """rest[b] = behind - share[0] - .. - share[b]; then `behind` takes the last of these."""
    if behind.numel() < THIN:
        torch.sub(behind, torch.cumsum(share, dim=0, out=rest), out=rest)
        behind.copy_(rest[-1])
        return
    front = behind
    for part, remaining in zip(share.unbind(0), rest.unbind(0), strict=True):
        front = torch.sub(front, part, out=remaining)
    behind.copy_(front)


def _central_moments(d: Float[Tensor, "2 bs"], local: Float[Tensor, "6 bs"]) -> Float[Tensor, "6 bs"]:
    """Shift sums of g times monomials of (u, v) about the cell centre to (x, y) = d - (u, v) about the mean: 1, x, y, xx, xy, yy."""
    total, offsets, cross = local[0], local[1:3], local[4]
    first = (d * total).sub_(offsets)
    squares = (first - offsets).mul_(d).add_(local[3::2])
    mixed = (d[0] * first[1]).addcmul_(d[1], offsets[0], value=-1.0).add_(cross)
    return torch.stack([total, first[0], first[1], squares[0], mixed, squares[1]])


def _absolute_pulls(columns: Tensor, monomials: Tensor, g: Tensor, scratch: Scratch) -> Float[Tensor, "2 bs"]:
    """Sums over pixels of |g| |conic d|, the gradient of the mean before its signs cancel; conic d is linear in (u, v). Uses g up."""
    size, sums = g.abs_(), []
    for constant, along_u, along_v in ((1, 8, 9), (2, 9, 10)):
        line = torch.stack([columns[constant], -columns[along_u], -columns[along_v]])
        pull = torch.mm(line.t(), monomials[:3], out=scratch.take("rest", *g.shape))
        sums.append(pull.abs_().mul_(size).sum(dim=1))
    return torch.stack(sums).mul_(math.log(2.0))


def _lists(ellipses: Ellipses, strips: Strips, grid: CellGrid, budget: int, transmittance: Tensor) -> Iterator[CellLists]:
    """The lists slab by slab, without the cells that the slabs before have made opaque."""
    for run in slabs(strips, budget):
        alive = (transmittance.amax(dim=1) > TRANSMITTANCE_MIN) if run[0] else None
        yield list_cells(ellipses, strips, run, grid, alive)


def _plane(cells: Tensor, grid: CellGrid) -> Tensor:
    """One channel of cells [cells, p] as (camera, cell row, y, cell column, x), a view."""
    return rearrange(cells, "(c r k) (y x) -> c r y k x", c=grid.cameras, r=grid.rows, k=grid.columns, y=grid.size, x=grid.size)


def _to_image(cells: Tensor, grid: CellGrid) -> Tensor:
    """[cells, d, p] -> [c, h, w, d]; channel by channel, which is what keeps a CPU's copies in long runs."""
    height, width, size = grid.height, grid.width, grid.size
    image = cells.new_empty(grid.cameras, grid.rows * size, grid.columns * size, cells.shape[1])
    for channel in range(cells.shape[1]):
        rearrange(image[..., channel], "c (r y) (k x) -> c r y k x", y=size, x=size).copy_(_plane(cells[:, channel], grid))
    return image[:, :height, :width].contiguous()


def _to_cells(images: list[Tensor], grid: CellGrid) -> Tensor:
    """Images [c, h, w, d] side by side -> [cells, d, p]; pixels beyond the border hold zeros."""
    right, below = grid.columns * grid.size - grid.width, grid.rows * grid.size - grid.height
    planes = torch.cat([image.permute(3, 0, 1, 2) for image in images])
    planes = F.pad(planes, (0, right, 0, below)) if right or below else planes
    return rearrange(planes, "d c (r y) (k x) -> (c r k) d (y x)", y=grid.size, x=grid.size).contiguous()


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, values, chosen, ellipses: Ellipses, grid: CellGrid, settings: CompositingSettings):
        with single_thread():
            table, strips, scratch = table_of(ellipses, values, grid, settings.alpha_cap), measure_strips(ellipses, grid), Scratch(values)
            pixels = grid.size * grid.size
            image = values.new_zeros(grid.count, values.shape[1] + 1, pixels)
            transmittance = values.new_ones(grid.count, pixels)
            for lists in _lists(ellipses, strips, grid, settings.rows_per_list, transmittance):
                for stretch in march(lists, pixels, settings.pairs_per_block):
                    local = image.new_zeros(stretch.cells.shape[0], *image.shape[1:])
                    for block in stretch.blocks(table, lists.splats, transmittance, scratch, settings.pairs_per_block):
                        _forward_block(block, local, scratch)
                    image.index_add_(0, stretch.cells, local)
            colors, alphas = _to_image(image[:, :-1], grid), _to_image(image[:, -1:], grid)
        ctx.save_for_backward(means2d, conics, opacities, values, chosen, image)
        ctx.ellipses, ctx.strips, ctx.grid, ctx.settings = ellipses, strips, grid, settings
        return colors, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx, v_colors, v_alphas):
        means2d, conics, opacities, values, chosen, image = ctx.saved_tensors
        ellipses, grid, settings = ctx.ellipses, ctx.grid, ctx.settings
        with single_thread():
            table, scratch = table_of(ellipses, values, grid, settings.alpha_cap), Scratch(values)
            upstream = _to_cells([v_colors, v_alphas], grid)
            behind = (image * upstream).sum(dim=1)
            transmittance = torch.ones_like(behind)
            channels = values.shape[1]
            sums = values.new_zeros(values.shape[0], padded(TERMS + 2 + channels + 1))
            for lists in _lists(ellipses, ctx.strips, grid, settings.rows_per_list, transmittance):
                for stretch in march(lists, behind.shape[1], settings.pairs_per_block):
                    arriving, hidden = upstream.index_select(0, stretch.cells), behind.index_select(0, stretch.cells)
                    for block in stretch.blocks(table, lists.splats, transmittance, scratch, settings.pairs_per_block):
                        _backward_block(block, table.monomials, arriving, hidden, sums, settings.absgrad, scratch)
                    behind.index_copy_(0, stretch.cells, hidden)
            m, mx, my, mxx, mxy, myy, pull_x, pull_y = sums[:, : TERMS + 2].t().contiguous().unbind(0)
            A, B, C = ellipses.A, ellipses.B, ellipses.C

            def dense(like: Tensor, columns: list[Tensor]) -> Tensor:
                flat = like.new_zeros(means2d.shape[0] * means2d.shape[1], len(columns))
                return flat.index_copy_(0, chosen.long(), torch.stack(columns, dim=1)).view(like.shape)

            if settings.absgrad:
                means2d.absgrad = dense(means2d, [pull_x, pull_y])
            v_means2d = dense(means2d, [-(A * mx + B * my), -(B * mx + C * my)])
            v_conics = dense(conics, [-0.5 * mxx, -mxy, -0.5 * myy])
            v_opacities = dense(opacities, [m / ellipses.opacity])
        return v_means2d, v_conics, v_opacities, sums[:, TERMS + 2 : TERMS + 2 + channels], None, None, None, None
