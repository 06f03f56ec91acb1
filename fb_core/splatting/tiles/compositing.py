"""Front-to-back alpha compositing of screen ellipses with an analytic gradient (pure torch, bounded memory).

Backward walks the blocks of `blocks` once more, back to front. Forward keeps where they were (`Step`), and the blocks
themselves up to `kept_pairs`; of a scene whose lists are made slab by slab, that only for the last slab. The gradient
of a pair is its derivative g by the exponent; sums of g times the monomials (one thin matrix product) are moments, from
which every gradient follows. A pair above the cap passes no gradient to its exponent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_core.splatting.single_thread import single_thread
from fb_core.splatting.tiles.blocks import (
    PAIRS_PER_BLOCK,
    TERMS,
    TRANSMITTANCE_MIN,
    Block,
    Scratch,
    Stretch,
    Table,
    march,
    padded_width,
    table_of,
)
from fb_core.splatting.tiles.cells import CellGrid, CellLists, Ellipses, Strips, list_cells, measure_strips, slabs

ROWS_PER_LIST = 3 * 2**19
KEPT_PAIRS = 2**24
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
    kept_pairs: int = KEPT_PAIRS
    """Pairs that forward keeps for backward, which evaluates the others again: bounds the memory between the two."""
    rows_per_list: int = ROWS_PER_LIST
    """Pairs (Gaussian, cell) listed at once: bounds the memory of the lists."""


def composite(
    means2d: Float[Tensor, "c n 2"],
    conics: Float[Tensor, "c n 3"],
    opacities: Float[Tensor, "c n"],
    values: Float[Tensor, "v d"],
    ellipses: Ellipses,
    settings: CompositingSettings,
) -> tuple[Float[Tensor, "c h w d"], Float[Tensor, "c h w 1"]]:
    """Images of the values, and alpha = 1 - transmittance.

    `values` and `ellipses` are given only for the Gaussians that may be seen, nearest first. Gradients flow to means2d,
    conics, opacities and values.
    """
    if not (torch.is_grad_enabled() and any(t.requires_grad for t in (means2d, conics, opacities, values))):
        settings = replace(settings, kept_pairs=0)
    return _Composite.apply(means2d, conics, opacities, values, ellipses, settings)


def _forward_block(block: Block, image: Tensor) -> None:
    """Add the block to the cells [s, d1, p] of its stretch."""
    image[: block.weights.shape[1]].baddbmm_(block.values.permute(1, 2, 0), block.weights.permute(1, 0, 2))


@dataclass(frozen=True, kw_only=True)
class _Pixels:
    """The pixels of some cells on the way from back to front."""

    upstream: Float[Tensor, "s d1 p"]
    """Gradient of the loss by the composited values and alpha."""
    behind: Float[Tensor, "s p"]
    """What is seen behind a block, times `upstream`; a block brings it to what is seen of it."""
    light: Float[Tensor, "s p"]
    """The transmittance behind a block; a block brings it to the one in front."""

    def of(self, cells: Int32[Tensor, " s"]) -> _Pixels:
        """Copies for a stretch of cells."""
        return _Pixels(
            upstream=self.upstream.index_select(0, cells),
            behind=self.behind.index_select(0, cells),
            light=self.light.index_select(0, cells),
        )

    def put(self, cells: Int32[Tensor, " s"], walked: _Pixels) -> None:
        """What walking a stretch has left."""
        self.behind.index_copy_(0, cells, walked.behind)
        self.light.index_copy_(0, cells, walked.light)


def _backward_block(
    block: Block, monomials: Tensor, pixels: _Pixels, out: Float[Tensor, "bs r"], absgrad: bool, scratch: Scratch
) -> None:
    """Gradients of the block's rows; brings `pixels` from behind the block to in front of it.

    The columns of `out`: six moments of g (`_central_moments`), two absolute pulls (with absgrad), the values, padding.
    """
    depth, width, each = block.weights.shape
    upstream, behind, light = pixels.upstream[:width], pixels.behind[:width], pixels.light[:width]
    v_values = out[:, PULLS : PULLS + upstream.shape[1] - 1].view(depth, width, -1)
    v_values.copy_(torch.bmm(upstream[:, :-1], block.weights.permute(1, 2, 0)).permute(2, 0, 1))
    torch.bmm(block.values.permute(1, 0, 2), upstream, out=scratch.take("seen", width, depth, each))
    g = _slopes(block.weights, behind, light, scratch)
    if block.capped is not None:
        g.masked_fill_(block.capped, 0.0)
    g = g.view(depth * width, each)
    columns, local = scratch.take("moments", PULLS, depth * width), scratch.take("local", TERMS, depth * width)
    _central_moments(block.columns[1:3], torch.mm(monomials, g.t(), out=local), columns[:TERMS])
    if absgrad:
        _absolute_pulls(block.columns, monomials, g, columns[TERMS:], scratch)
    out[:, :PULLS] = columns.t()


def _slopes(
    weights: Float[Tensor, "b s p"], behind: Float[Tensor, "s p"], light: Float[Tensor, "s p"], scratch: Scratch
) -> Float[Tensor, "b s p"]:
    """g = d loss / d exponent = alpha T (seen - behind): what one sees of the Gaussian, less what one would see without
    it.

    Whoever looks at a Gaussian sees alpha of it and 1 - alpha of what is `behind`, which is brought from the last rank
    to the first. Its weight alpha T is all that is known of it: the light in front, T, is that behind plus the weight.
    No difference of large numbers, and T > 1e-4, so that the division is harmless. Reads `seen` from scratch.
    """
    shape = weights.shape
    slopes, seen = scratch.layers("slopes", *shape), scratch.layers("seen", shape[1], shape[0], shape[2], axis=1)
    for slope, shown, weight in zip(reversed(slopes), reversed(seen), reversed(weights.unbind(0)), strict=True):
        torch.sub(shown, behind, out=slope).mul_(weight)
        behind.addcdiv_(slope, light.add_(weight))
    return scratch.take("slopes", *shape)


def _central_moments(d: Float[Tensor, "2 bs"], local: Float[Tensor, "6 bs"], out: Float[Tensor, "6 bs"]) -> None:
    """Shift sums of g times monomials of (u, v) about the cell centre to (x, y) = d - (u, v) about the mean: 1, x, y,
    xx, xy, yy.
    """
    total, offsets, first = local[0], local[1:3], out[1:3]
    out[0] = total
    torch.mul(d, total, out=first).sub_(offsets)
    torch.sub(first, offsets, out=out[3::2]).mul_(d).add_(local[3::2])
    torch.addcmul(local[4], d[0], first[1], out=out[4]).addcmul_(d[1], offsets[0], value=-1.0)


def _absolute_pulls(
    columns: Tensor, monomials: Tensor, g: Tensor, out: Float[Tensor, "2 bs"], scratch: Scratch
) -> None:
    """Sums over pixels of |g| |conic d|, the gradient of the mean before its signs cancel; conic d is linear in (u, v).
    Uses g up.
    """
    size = g.abs_()
    _, dx, dy, A, B, C = columns
    for total, (along_u, along_v) in zip(out.unbind(0), ((A, B), (B, C)), strict=True):
        line = torch.stack([along_u * dx + along_v * dy, -along_u, -along_v])
        pull = torch.mm(line.t(), monomials[:3], out=scratch.take("pulls", *g.shape))
        torch.sum(pull.abs_().mul_(size), dim=1, out=total).mul_(math.log(2.0))


def _add_rows(sums: Float[Tensor, "v r"], splats: Int32[Tensor, " m"], rows: Float[Tensor, "m r"]) -> None:
    """sums[splats[i]] += rows[i]. Sorting and summing whole bags takes half as long as `index_add_`."""
    order = torch.sort(splats).indices
    counts = torch.bincount(splats, minlength=sums.shape[0])
    sums.add_(F.embedding_bag(order, rows, counts.cumsum(0) - counts, mode="sum"))


def _lists(ellipses: Ellipses, strips: Strips, run: tuple[int, int], light: Tensor | None) -> CellLists:
    """The lists of one slab, without the cells that the slabs before have made opaque."""
    alive = None if light is None else light[0].amax(dim=1) > TRANSMITTANCE_MIN
    return list_cells(ellipses, strips, run, alive)


def _walk(
    table: Table,
    ellipses: Ellipses,
    strips: Strips,
    run: tuple[int, int],
    start: Tensor | None,
    settings: CompositingSettings,
    scratch: Scratch,
) -> list[Stretch]:
    """The stretches of one slab, walked once more for where their blocks are."""
    pixels = table.monomials.shape[1]
    light = table.rows.new_ones(2, ellipses.grid.count, pixels) if start is None else start.clone()
    lists, walked, keep = _lists(ellipses, strips, run, start), [], settings.kept_pairs
    for stretch in march(lists, pixels, settings.pairs_per_block):
        for _ in stretch.blocks(table, lists.splats, light, scratch, settings.pairs_per_block, keep):
            pass
        keep -= stretch.kept
        walked.append(stretch)
    return walked


def _plane(cells: Tensor, grid: CellGrid) -> Tensor:
    """One channel of cells [cells, p] as (camera, cell row, y, cell column, x), a view."""
    return rearrange(
        cells,
        "(c r k) (y x) -> c r y k x",
        c=grid.cameras,
        r=grid.rows,
        k=grid.columns,
        y=grid.cell_height,
        x=grid.cell_width,
    )


def to_image(cells: Tensor, grid: CellGrid) -> Tensor:
    """[cells, d, p] -> [c, h, w, d]; channel by channel, which is what keeps a CPU's copies in long runs."""
    height, width, down, across = grid.height, grid.width, grid.cell_height, grid.cell_width
    image = cells.new_empty(grid.cameras, grid.rows * down, grid.columns * across, cells.shape[1])
    for channel in range(cells.shape[1]):
        rearrange(image[..., channel], "c (r y) (k x) -> c r y k x", y=down, x=across).copy_(
            _plane(cells[:, channel], grid)
        )
    return image[:, :height, :width].contiguous()


def to_cells(images: list[Tensor], grid: CellGrid) -> Tensor:
    """Images [c, h, w, d] side by side -> [cells, d, p]; pixels beyond the border hold zeros."""
    right, below = grid.columns * grid.cell_width - grid.width, grid.rows * grid.cell_height - grid.height
    planes = torch.cat([image.permute(3, 0, 1, 2) for image in images])
    planes = F.pad(planes, (0, right, 0, below)) if right or below else planes
    return rearrange(planes, "d c (r y) (k x) -> (c r k) d (y x)", y=grid.cell_height, x=grid.cell_width).contiguous()


def gradients_of(
    sums: Float[Tensor, "v r"],
    means2d: Float[Tensor, "c n 2"],
    conics: Float[Tensor, "c n 3"],
    opacities: Float[Tensor, "c n"],
    ellipses: Ellipses,
    absgrad: bool,
) -> tuple[Float[Tensor, "c n 2"], Float[Tensor, "c n 3"], Float[Tensor, "c n"]]:
    """Gradients of means2d, conics and opacities from the chosen Gaussians' moments and pulls, the first columns of
    their sums; with `absgrad` also sets `means2d.absgrad`.
    """
    m, mx, my, mxx, mxy, myy, pull_x, pull_y = sums[:, :PULLS].t().contiguous().unbind(0)
    A, B, C = ellipses.A, ellipses.B, ellipses.C

    def dense(like: Tensor, columns: list[Tensor]) -> Tensor:
        flat = like.new_zeros(means2d.shape[0] * means2d.shape[1], len(columns))
        return flat.index_copy_(0, ellipses.chosen.long(), torch.stack(columns, dim=1)).view(like.shape)

    if absgrad:
        # Tensors declare no such attribute; gsplat's strategies read it.
        setattr(means2d, "absgrad", dense(means2d, [pull_x, pull_y]))  # noqa: B010
    return (
        dense(means2d, [-(A * mx + B * my), -(B * mx + C * my)]),
        dense(conics, [-0.5 * mxx, -mxy, -0.5 * myy]),
        dense(opacities, [m / ellipses.opacity]),
    )


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, values, ellipses: Ellipses, settings: CompositingSettings):
        grid = ellipses.grid
        with single_thread():
            table, strips, scratch = (
                table_of(ellipses, values, settings.alpha_cap),
                measure_strips(ellipses),
                Scratch(values),
            )
            pixels = table.monomials.shape[1]
            image, light = (
                values.new_zeros(grid.count, values.shape[1] + 1, pixels),
                values.new_ones(2, grid.count, pixels),
            )
            walked, starts = [], []
            for run in slabs(strips.cells, settings.rows_per_list):
                starts.append((run, light.clone() if run[0] else None))
                walked.clear()
                keep = settings.kept_pairs
                lists = _lists(ellipses, strips, run, starts[-1][1])
                for stretch in march(lists, pixels, settings.pairs_per_block):
                    local = image.new_zeros(stretch.cells.shape[0], *image.shape[1:])
                    for block in stretch.blocks(table, lists.splats, light, scratch, settings.pairs_per_block, keep):
                        _forward_block(block, local)
                    image.index_add_(0, stretch.cells, local)
                    keep -= stretch.kept
                    walked.append(stretch)
            colors, alphas = to_image(image[:, :-1], grid), to_image(image[:, -1:], grid)
        ctx.save_for_backward(means2d, conics, opacities, values)
        ctx.ellipses, ctx.strips, ctx.settings = ellipses, strips, settings
        ctx.table, ctx.scratch, ctx.walked, ctx.starts, ctx.light = table, scratch, walked, starts, light[1]
        return colors, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx, v_colors, v_alphas):
        means2d, conics, opacities, values = ctx.saved_tensors
        ellipses, grid, settings = ctx.ellipses, ctx.ellipses.grid, ctx.settings
        with single_thread():
            table, scratch = ctx.table, ctx.scratch
            upstream = to_cells([v_colors, v_alphas], grid)
            behind = upstream.new_zeros(grid.count, upstream.shape[2])
            pixels = _Pixels(upstream=upstream, behind=behind, light=ctx.light.clone())
            channels = values.shape[1]
            sums = values.new_zeros(values.shape[0], padded_width(PULLS + channels))
            for number, (run, start) in reversed(list(enumerate(ctx.starts))):
                last = number == len(ctx.starts) - 1
                walked = ctx.walked if last else _walk(table, ellipses, ctx.strips, run, start, settings, scratch)
                steps = [step.splats for stretch in walked for step in stretch.steps]
                if not steps:
                    continue  # what was chosen reaches no pixel
                splats = torch.cat(steps)
                rows = values.new_empty(splats.shape[0], sums.shape[1])
                end = rows.shape[0]
                for stretch in reversed(walked):
                    local = pixels.of(stretch.cells)
                    for block in stretch.blocks_again(table, scratch):
                        begin = end - block.splats.shape[0]
                        _backward_block(block, table.monomials, local, rows[begin:end], settings.absgrad, scratch)
                        end = begin
                    pixels.put(stretch.cells, local)
                _add_rows(sums, splats, rows)
            v_means2d, v_conics, v_opacities = gradients_of(
                sums, means2d, conics, opacities, ellipses, settings.absgrad
            )
        return v_means2d, v_conics, v_opacities, sums[:, PULLS : PULLS + channels], None, None
