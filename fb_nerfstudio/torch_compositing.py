"""Front-to-back alpha compositing of screen ellipses with an analytic gradient (pure torch, bounded memory).

The backward pass evaluates the blocks of `torch_blocks` once more, back to front; forward keeps where they were (`Step`), and that only
for the last slab of a scene whose lists are made slab by slab. The gradient of a pair is its derivative g by the exponent; sums of
g times the monomials (one thin matrix product) are moments, from which every gradient follows. A pair above the cap passes no
gradient to its exponent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_nerfstudio.single_thread import single_thread
from fb_nerfstudio.torch_blocks import (
    PAIRS_PER_BLOCK,
    TERMS,
    TRANSMITTANCE_MIN,
    Block,
    Scratch,
    Stretch,
    Table,
    march,
    padded,
    stop,
    table_of,
)
from fb_nerfstudio.torch_cells import CellGrid, CellLists, Ellipses, Strips, list_cells, measure_strips, slabs

ROWS_PER_LIST = 2**20
PULLS = TERMS + 2
"""Columns of the gradient sums before the values: moments and absolute pulls."""


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


def _forward_block(block: Block, image: Tensor) -> None:
    """Add the block to the cells [s, d1, p] of its stretch."""
    image[: block.weights.shape[1]].baddbmm_(block.values.permute(1, 2, 0), block.weights.permute(1, 0, 2))


def _backward_block(
    block: Block, monomials: Tensor, upstream: Tensor, behind: Tensor, out: Float[Tensor, "bs r"], absgrad: bool, scratch: Scratch
) -> None:
    """Gradients of the block's rows; `behind` [s, p] is brought from what is seen behind the block to what is seen of it.

    The columns of `out`: six moments of g (`_central_moments`), two absolute pulls (with absgrad), the values, padding.
    """
    depth, width, pixels = block.alpha.shape
    upstream, behind = upstream[:width], behind[:width]
    if block.stops:
        stop(block.alpha, block.lights)
    v_values = out[:, PULLS : PULLS + upstream.shape[1] - 1].view(depth, width, -1)
    v_values.copy_(torch.bmm(upstream[:, :-1], block.weights.permute(1, 2, 0)).permute(2, 0, 1))
    torch.bmm(block.values.permute(1, 0, 2), upstream, out=scratch.take("seen", width, depth, pixels))
    g = _slopes(depth, behind, scratch)
    if block.capped is not None:
        g.masked_fill_(block.capped, 0.0)
    g = g.view(depth * width, pixels)
    columns, local = scratch.take("moments", PULLS, depth * width), scratch.take("local", TERMS, depth * width)
    _central_moments(block.columns[6:8], torch.mm(monomials, g.t(), out=local), columns[:TERMS])
    if absgrad:
        _absolute_pulls(block.columns, monomials, g, columns[TERMS:], scratch)
    out[:, :PULLS] = columns.t()


def _slopes(depth: int, behind: Float[Tensor, "s p"], scratch: Scratch) -> Float[Tensor, "b s p"]:
    """g = d loss / d exponent = alpha T (seen - behind): what one sees of the Gaussian, less what one would see without it.

    Whoever looks at a Gaussian sees alpha of it and 1 - alpha of what is `behind`, which is brought from the last rank to the first:
    no division, no difference of large numbers. Reads `seen` and the block from scratch, rank by rank like `_darken`.
    """
    shape = depth, *behind.shape
    slopes, seen = scratch.layers("slopes", *shape), scratch.layers("seen", shape[1], depth, shape[2], axis=1)
    shares, weights = scratch.layers("alpha", *shape), scratch.layers("weights", *shape)
    for rank in reversed(range(depth)):
        torch.sub(seen[rank], behind, out=slopes[rank])
        behind.addcmul_(shares[rank], slopes[rank])
        slopes[rank].mul_(weights[rank])
    return scratch.take("slopes", *shape)


def _central_moments(d: Float[Tensor, "2 bs"], local: Float[Tensor, "6 bs"], out: Float[Tensor, "6 bs"]) -> None:
    """Shift sums of g times monomials of (u, v) about the cell centre to (x, y) = d - (u, v) about the mean: 1, x, y, xx, xy, yy."""
    total, offsets, first = local[0], local[1:3], out[1:3]
    out[0] = total
    torch.mul(d, total, out=first).sub_(offsets)
    torch.sub(first, offsets, out=out[3::2]).mul_(d).add_(local[3::2])
    torch.addcmul(local[4], d[0], first[1], out=out[4]).addcmul_(d[1], offsets[0], value=-1.0)


def _absolute_pulls(columns: Tensor, monomials: Tensor, g: Tensor, out: Float[Tensor, "2 bs"], scratch: Scratch) -> None:
    """Sums over pixels of |g| |conic d|, the gradient of the mean before its signs cancel; conic d is linear in (u, v). Uses g up."""
    size = g.abs_()
    for total, (constant, along_u, along_v) in zip(out.unbind(0), ((1, 8, 9), (2, 9, 10)), strict=True):
        line = torch.stack([columns[constant], -columns[along_u], -columns[along_v]])
        pull = torch.mm(line.t(), monomials[:3], out=scratch.take("weights", *g.shape))
        torch.sum(pull.abs_().mul_(size), dim=1, out=total).mul_(math.log(2.0))


def _add_rows(sums: Float[Tensor, "v r"], splats: Int32[Tensor, " m"], rows: Float[Tensor, "m r"]) -> None:
    """sums[splats[i]] += rows[i]. Sorting and summing whole bags takes half as long as `index_add_`."""
    order = torch.sort(splats).indices
    counts = torch.bincount(splats, minlength=sums.shape[0])
    sums.add_(F.embedding_bag(order, rows, counts.cumsum(0) - counts, mode="sum"))


def _lists(ellipses: Ellipses, strips: Strips, run: tuple[int, int], grid: CellGrid, transmittance: Tensor | None) -> CellLists:
    """The lists of one slab, without the cells that the slabs before have made opaque."""
    alive = None if transmittance is None else transmittance.amax(dim=1) > TRANSMITTANCE_MIN
    return list_cells(ellipses, strips, run, grid, alive)


def _walk(
    table: Table, ellipses: Ellipses, strips: Strips, run: tuple[int, int], grid: CellGrid, start: Tensor | None,
    settings: CompositingSettings, scratch: Scratch,
) -> list[Stretch]:  # fmt: skip
    """The stretches of one slab, walked once more for where their blocks are."""
    lists, walked = _lists(ellipses, strips, run, grid, start), []
    transmittance = table.rows.new_ones(grid.count, grid.size * grid.size) if start is None else start.clone()
    for stretch in march(lists, transmittance.shape[1], settings.pairs_per_block):
        for _ in stretch.blocks(table, lists.splats, transmittance, scratch, settings.pairs_per_block):
            pass
        walked.append(stretch)
    return walked


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
            walked, starts = [], []
            for run in slabs(strips, settings.rows_per_list):
                starts.append((run, transmittance.clone() if run[0] else None))
                walked.clear()
                lists = _lists(ellipses, strips, run, grid, starts[-1][1])
                for stretch in march(lists, pixels, settings.pairs_per_block):
                    local = image.new_zeros(stretch.cells.shape[0], *image.shape[1:])
                    for block in stretch.blocks(table, lists.splats, transmittance, scratch, settings.pairs_per_block):
                        _forward_block(block, local)
                    image.index_add_(0, stretch.cells, local)
                    walked.append(stretch)
            colors, alphas = _to_image(image[:, :-1], grid), _to_image(image[:, -1:], grid)
        ctx.save_for_backward(means2d, conics, opacities, values, chosen)
        ctx.ellipses, ctx.strips, ctx.grid, ctx.settings = ellipses, strips, grid, settings
        ctx.table, ctx.scratch, ctx.walked, ctx.starts = table, scratch, walked, starts
        return colors, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx, v_colors, v_alphas):
        means2d, conics, opacities, values, chosen = ctx.saved_tensors
        ellipses, grid, settings = ctx.ellipses, ctx.grid, ctx.settings
        with single_thread():
            table, scratch = ctx.table, ctx.scratch
            upstream = _to_cells([v_colors, v_alphas], grid)
            behind = upstream.new_zeros(grid.count, upstream.shape[2])
            channels = values.shape[1]
            sums = values.new_zeros(values.shape[0], padded(PULLS + channels))
            for number, (run, start) in reversed(list(enumerate(ctx.starts))):
                last = number == len(ctx.starts) - 1
                walked = ctx.walked if last else _walk(table, ellipses, ctx.strips, run, grid, start, settings, scratch)
                steps = [step.splats for stretch in walked for step in stretch.steps]
                if not steps:
                    continue  # what was chosen reaches no pixel
                splats = torch.cat(steps)
                rows = values.new_empty(splats.shape[0], sums.shape[1])
                end = rows.shape[0]
                for stretch in reversed(walked):
                    arriving, hidden = upstream.index_select(0, stretch.cells), behind.index_select(0, stretch.cells)
                    for block in stretch.blocks_again(table, scratch):
                        begin = end - block.columns.shape[1]
                        _backward_block(block, table.monomials, arriving, hidden, rows[begin:end], settings.absgrad, scratch)
                        end = begin
                    behind.index_copy_(0, stretch.cells, hidden)
                _add_rows(sums, splats, rows)
            m, mx, my, mxx, mxy, myy, pull_x, pull_y = sums[:, :PULLS].t().contiguous().unbind(0)
            A, B, C = ellipses.A, ellipses.B, ellipses.C

            def dense(like: Tensor, columns: list[Tensor]) -> Tensor:
                flat = like.new_zeros(means2d.shape[0] * means2d.shape[1], len(columns))
                return flat.index_copy_(0, chosen.long(), torch.stack(columns, dim=1)).view(like.shape)

            if settings.absgrad:
                means2d.absgrad = dense(means2d, [pull_x, pull_y])
            v_means2d = dense(means2d, [-(A * mx + B * my), -(B * mx + C * my)])
            v_conics = dense(conics, [-0.5 * mxx, -mxy, -0.5 * myy])
            v_opacities = dense(opacities, [m / ellipses.opacity])
        return v_means2d, v_conics, v_opacities, sums[:, PULLS : PULLS + channels], None, None, None, None
