"""Front-to-back alpha compositing of screen ellipses, by cells of 8x8 pixels, with an analytic gradient.

Inside a cell, with (u, v) a pixel's offset from the cell centre, the exponent of a Gaussian is a quadratic polynomial:

    log(opacity) - d^T conic d / 2  =  k0 + k1 u + k2 v + k3 u^2 + k4 u v + k5 v^2

so a block of B ranks x S cells x 64 pixels is one thin matrix product with the 6x64 matrix of monomials, one exp, and
B in-place multiplications for the transmittance. Blocks hold a bounded number of pairs and stay in the cache; cells whose
pixels are all opaque drop out. The backward pass walks the same blocks front to back again (nothing is stored): what lies
behind a Gaussian is the known total less what has been passed. The gradient of a pair is its derivative g by the exponent;
the sums of g times monomials (again one product with the 6x64 matrix) give the moments from which every gradient follows.

Rules per pixel (gsplat): skip alpha < 1/255; cap alpha; stop before the Gaussian that would bring the transmittance to
1e-4 or below. A pair above the cap passes no gradient to its exponent. The exponent of a positive definite conic is never
positive, so gsplat's test for sigma < 0 only ever rejects rounding noise and is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_nerfstudio.single_thread import single_thread
from fb_nerfstudio.torch_cells import CellGrid, CellLists, Ellipses, Strips, list_cells, measure_strips, slabs
from fb_nerfstudio.torch_projection import ALPHA_MIN

TRANSMITTANCE_MIN = 1e-4
PAIRS_PER_BLOCK = 2**18
ROWS_PER_LIST = 2**20
_NEVER = -1e4
_TERMS, _COLUMNS = 6, 11
# Shape of a block, found by measuring: 16 ranks x 256 cells x 64 pixels, deeper where there are fewer cells.
_SHALLOWEST = 16
# A layer (one rank) with fewer values than this is scanned by torch; larger layers are walked one by one, which is faster.
_THIN = 512


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

    def cells_per_block(self, pixels: int) -> int:
        return max(1, self.pairs_per_block // (_SHALLOWEST * pixels))


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


@dataclass(frozen=True, kw_only=True)
class _Table:
    """What a block needs to know, one row for each chosen Gaussian (one gather fetches all of it)."""

    rows: Float[Tensor, "v r"]
    """log2(opacity), two blanks, -A/2, -B, -C/2, x, y, A, B, C, the values, 1; conic entries times log2(e); then padding."""
    channels: int
    """Values and the 1."""
    monomials: Float[Tensor, "6 p"]
    centers: Float[Tensor, "2 cells"]
    alpha_threshold: float
    """The largest number below 1/255."""
    cap: float | None
    """Largest alpha; None where no opacity reaches it."""


@dataclass(frozen=True, kw_only=True)
class _Block:
    """B ranks deep, S cells wide, P pixels each; where two of them are one index the order is (b, s)."""

    splats: Int32[Tensor, " bs"]
    """Rows of the table; padding points at some row and has alpha 0."""
    columns: Float[Tensor, "11 bs"]
    """Coefficients k0 .. k5, dx and dy (mean less cell centre), A, B, C: to the base 2 like the table."""
    values: Float[Tensor, "b s d1"]
    """Channels, and a last one of ones, which composites to alpha."""
    alpha: Float[Tensor, "b s p"]
    light: Float[Tensor, "b s p"]
    """Transmittance in front of each."""
    capped: Tensor | None
    """Pairs at the cap (bool), or None where there are none."""


class _Scratch:
    """Reused buffers: fresh allocations of this size would cost page faults at every block."""

    def __init__(self, like: Tensor):
        self._like = like
        self._buffers: dict[str, Tensor] = {}
        self._views: dict[tuple[str | int, ...], Tensor] = {}

    def take(self, name: str, *shape: int) -> Tensor:
        view = self._views.get((name, *shape))
        if view is None:
            size = math.prod(shape)
            if name not in self._buffers or self._buffers[name].numel() < size:
                self._buffers[name] = self._like.new_zeros(size)
                self._views = {key: value for key, value in self._views.items() if key[0] != name}
            view = self._views[(name, *shape)] = self._buffers[name][:size].view(shape)
        return view


def _padded(width: int) -> int:
    """Row length for gathers and sums of rows: torch handles whole vectors twice as fast."""
    return -(-width // 16) * 16


def _monomials(size: int, like: Tensor) -> Float[Tensor, "6 p"]:
    """1, u, v, u^2, u v, v^2 at the pixels of a cell, row by row."""
    offsets = torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2
    v, u = (grid.reshape(-1) for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
    return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v])


def _table(ellipses: Ellipses, values: Tensor, grid: CellGrid, cap: float) -> _Table:
    below = torch.nextafter(torch.tensor(ALPHA_MIN, dtype=values.dtype), torch.zeros((), dtype=values.dtype))
    used = _COLUMNS + values.shape[1] + 1
    rows = values.new_empty(values.shape[0], _padded(used))
    A, B, C = (column * math.log2(math.e) for column in (ellipses.A, ellipses.B, ellipses.C))
    blank = torch.zeros_like(A)
    torch.stack(
        [ellipses.opacity.log2(), blank, blank, -0.5 * A, -B, -0.5 * C, ellipses.x, ellipses.y, A, B, C], dim=1, out=rows[:, :_COLUMNS]
    )
    rows[:, _COLUMNS : used - 1] = values
    rows[:, used - 1 :] = 1.0
    # A little slack: the polynomial may round an exponent to slightly above log(opacity).
    may_cap = values.shape[0] > 0 and float(ellipses.opacity.max()) > cap * (1 - 1e-3)
    return _Table(
        rows=rows,
        channels=values.shape[1] + 1,
        monomials=_monomials(grid.size, values),
        centers=torch.stack(grid.centers(values)),
        alpha_threshold=float(below),
        cap=cap if may_cap else None,
    )


class _Stretch:
    """Cells of similar length that are walked together, front to back, until most are opaque or all are done."""

    def __init__(self, cells: Tensor, counts: Tensor, starts: Tensor, rank: int):
        self.cells, self.rest = cells, None
        """`rest`: after `blocks`, the stretch of the cells that still need work, or None."""
        self._counts, self._starts, self._rank = counts, starts, rank

    def blocks(self, table: _Table, listed: Tensor, transmittance: Tensor, scratch: _Scratch, budget: int) -> Iterator[_Block]:
        """The blocks in order, covering the first cells of the stretch; at the end their transmittance [cells, p] is up to date."""
        pixels, rank, lengths = table.monomials.shape[1], self._rank, self._counts.tolist()
        centers = table.centers.index_select(1, self.cells)[:, None]
        light, deepest, width = transmittance.index_select(0, self.cells), lengths[0], len(lengths)
        while rank < deepest:
            while lengths[width - 1] <= rank:  # long lists come first, so finished cells are at the end
                width -= 1
            depth = min(max(_SHALLOWEST, budget // (width * pixels)), deepest - rank)
            splats, padding = self._pick(listed, rank, depth, width, full=lengths[width - 1] >= rank + depth)
            block, after = _block(table, splats, padding, centers[..., :width], light[:width], depth, scratch)
            light[:width] = after[-1]
            rank += depth
            opaque = float(after[-1].min()) <= TRANSMITTANCE_MIN
            if opaque:
                _stop(block.alpha, after)
            yield block
            if opaque and rank < deepest:
                still = (light[:width].amax(dim=1) > TRANSMITTANCE_MIN) & (self._counts[:width] > rank)
                if int(still.sum()) <= 0.75 * width:
                    kept = still.nonzero()[:, 0]
                    if kept.numel():
                        self.rest = _Stretch(*(column.index_select(0, kept) for column in (self.cells, self._counts, self._starts)), rank)
                    break
        transmittance.index_copy_(0, self.cells, light)

    def _pick(self, listed: Tensor, rank: int, depth: int, width: int, full: bool) -> tuple[Tensor, Tensor | None]:
        """Table rows of the ranks rank .. rank + depth of the first `width` cells, and what of it is padding."""
        ranks = torch.arange(rank, rank + depth, dtype=torch.int32, device=listed.device)[:, None]
        positions = ranks + self._starts[:width]
        padding = None if full else ranks >= self._counts[:width]
        if padding is not None:
            positions.masked_fill_(padding, 0)
        return listed.index_select(0, positions.view(-1)), padding


def _block(
    table: _Table, splats: Tensor, padding: Tensor | None, centers: Tensor, light: Tensor, depth: int, scratch: _Scratch
) -> tuple[_Block, Tensor]:
    """Evaluate all pairs; also returns the transmittance behind each [b, s, p]."""
    width, pixels = light.shape
    rows = table.rows.index_select(0, splats)
    k = scratch.take("columns", _COLUMNS, depth * width).copy_(rows[:, :_COLUMNS].t())
    k[6:8].view(2, depth, width).sub_(centers)
    dx, dy = k[6], k[7]
    torch.mul(k[8:10], dx, out=k[1:3]).addcmul_(k[9:11], dy)
    k[0].addcmul_(dx, k[1], value=-0.5).addcmul_(dy, k[2], value=-0.5)
    if padding is not None:
        k[0].masked_fill_(padding.view(-1), _NEVER)
    alpha = torch.mm(k[:_TERMS].t(), table.monomials, out=scratch.take("alpha", depth * width, pixels))
    # To the base 2 because torch's exp2 is twice as fast as its exp.
    alpha = F.threshold_(alpha.exp2_(), table.alpha_threshold, 0.0).view(depth, width, pixels)
    capped = None
    if table.cap is not None and float(alpha.max()) > table.cap:
        capped = alpha > table.cap
        alpha.clamp_(max=table.cap)
    lights = scratch.take("light", depth + 1, width, pixels)
    lights[0] = light
    _darken(alpha, lights)
    values = rows[:, _COLUMNS : _COLUMNS + table.channels].view(depth, width, -1)
    return _Block(splats=splats, columns=k, values=values, alpha=alpha, light=lights[:depth], capped=capped), lights[1:]


def _darken(alpha: Tensor, lights: Tensor) -> None:
    """lights[b + 1] = lights[b] (1 - alpha[b]), in place."""
    torch.sub(1.0, alpha, out=lights[1:])
    if alpha[0].numel() < _THIN:
        torch.cumprod(lights, dim=0, out=lights)
        return
    for before, after in pairwise(lights.unbind(0)):
        after.mul_(before)


def _stop(alpha: Tensor, after: Tensor) -> None:
    """Take out the Gaussian that would end a pixel, and all behind it. In floats: comparisons cost five times as much."""
    alpha.mul_(torch.threshold(after, TRANSMITTANCE_MIN, 0.0).mul_(1e30).clamp_(max=1.0))


def _march(lists: CellLists, width: int) -> Iterator[_Stretch]:
    """All cells that have something to draw, in stretches of at most `width` cells, long lists first."""
    busy = torch.argsort(lists.counts, descending=True)[: int((lists.counts > 0).sum())]
    for cells in busy.split(width) if busy.numel() else ():
        stretch = _Stretch(cells, lists.counts.index_select(0, cells), lists.starts.index_select(0, cells), 0)
        while stretch is not None:
            yield stretch
            stretch = stretch.rest


def _forward_block(block: _Block, image: Tensor, scratch: _Scratch) -> None:
    """Add the block to the cells [s, d1, p] of its stretch."""
    weights = torch.mul(block.alpha, block.light, out=scratch.take("weights", *block.alpha.shape))
    image[: weights.shape[1]].baddbmm_(block.values.permute(1, 2, 0), weights.permute(1, 0, 2))


def _backward_block(block: _Block, monomials: Tensor, upstream: Tensor, behind: Tensor, sums: Tensor, absgrad: bool, scratch: _Scratch):
    """Add the block's gradients to `sums` [v, r]; `behind` [s, p], the part of the loss that lies behind, is advanced in place.

    The columns of `sums`: six moments of g (`_central_moments`), two absolute pulls (with absgrad), the values, padding.
    """
    depth, width, pixels = block.alpha.shape
    upstream, behind = upstream[:width], behind[:width]
    new = scratch.take("new", depth * width, sums.shape[1])
    weights = torch.mul(block.alpha, block.light, out=scratch.take("weights", depth, width, pixels))
    v_values = new[:, _TERMS + 2 : _TERMS + 2 + upstream.shape[1]].view(depth, width, -1)
    v_values.copy_(torch.bmm(upstream, weights.permute(1, 2, 0)).permute(2, 0, 1))
    seen = torch.bmm(block.values.permute(1, 0, 2), upstream, out=scratch.take("seen", width, depth, pixels))
    share = weights.mul_(seen.permute(1, 0, 2))
    rest = scratch.take("rest", depth, width, pixels)
    _pass_by(behind, share, rest)
    # d loss / d exponent = alpha T (value . upstream) - alpha / (1 - alpha) * what lies behind
    ratio = torch.sub(1.0, block.alpha, out=scratch.take("seen", depth, width, pixels))
    g = share.addcmul_(torch.div(block.alpha, ratio, out=ratio), rest, value=-1.0)
    if block.capped is not None:
        g.masked_fill_(block.capped, 0.0)
    g = g.view(depth * width, pixels)
    new[:, :_TERMS] = _central_moments(block.columns[6:8], torch.mm(monomials, g.t())).t()
    if absgrad:
        new[:, _TERMS : _TERMS + 2] = _absolute_pulls(block.columns, monomials, g, scratch).t()
    sums.index_add_(0, block.splats.long(), new)  # several times faster with 64-bit indices


def _pass_by(behind: Tensor, share: Tensor, rest: Tensor) -> None:
    """rest[b] = behind - share[0] - .. - share[b]; then `behind` takes the last of these."""
    if behind.numel() < _THIN:
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


def _absolute_pulls(columns: Tensor, monomials: Tensor, g: Tensor, scratch: _Scratch) -> Float[Tensor, "2 bs"]:
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


def _to_image(cells: Tensor, grid: CellGrid) -> Tensor:
    """[cells, d, p] -> [c, h, w, d]."""
    shape = dict(c=grid.cameras, r=grid.rows, k=grid.columns, y=grid.size)
    return rearrange(cells, "(c r k) d (y x) -> c (r y) (k x) d", **shape)[:, : grid.height, : grid.width]


def _to_cells(image: Tensor, grid: CellGrid) -> Tensor:
    """[c, h, w, d] -> [cells, d, p]; pixels beyond the border hold zeros."""
    right, below = grid.columns * grid.size - grid.width, grid.rows * grid.size - grid.height
    padded = F.pad(image, (0, 0, 0, right, 0, below)) if right or below else image
    return rearrange(padded, "c (r y) (k x) d -> (c r k) d (y x)", y=grid.size, x=grid.size).contiguous()


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means2d, conics, opacities, values, chosen, ellipses: Ellipses, grid: CellGrid, settings: CompositingSettings):
        with single_thread():
            table, strips, scratch = _table(ellipses, values, grid, settings.alpha_cap), measure_strips(ellipses, grid), _Scratch(values)
            pixels = grid.size * grid.size
            image = values.new_zeros(grid.count, values.shape[1] + 1, pixels)
            transmittance = values.new_ones(grid.count, pixels)
            for lists in _lists(ellipses, strips, grid, settings.rows_per_list, transmittance):
                for stretch in _march(lists, settings.cells_per_block(pixels)):
                    local = image.new_zeros(stretch.cells.shape[0], *image.shape[1:])
                    for block in stretch.blocks(table, lists.splats, transmittance, scratch, settings.pairs_per_block):
                        _forward_block(block, local, scratch)
                    image.index_add_(0, stretch.cells, local)
            out = _to_image(image, grid)
            colors, alphas = out[..., :-1].contiguous(), out[..., -1:].contiguous()
        ctx.save_for_backward(means2d, conics, opacities, values, chosen, image)
        ctx.ellipses, ctx.strips, ctx.grid, ctx.settings = ellipses, strips, grid, settings
        return colors, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx, v_colors, v_alphas):
        means2d, conics, opacities, values, chosen, image = ctx.saved_tensors
        ellipses, grid, settings = ctx.ellipses, ctx.grid, ctx.settings
        with single_thread():
            table, scratch = _table(ellipses, values, grid, settings.alpha_cap), _Scratch(values)
            upstream = _to_cells(torch.cat([v_colors, v_alphas], dim=-1), grid)
            behind = (image * upstream).sum(dim=1)
            transmittance = torch.ones_like(behind)
            channels = values.shape[1]
            sums = values.new_zeros(values.shape[0], _padded(_TERMS + 2 + channels + 1))
            for lists in _lists(ellipses, ctx.strips, grid, settings.rows_per_list, transmittance):
                for stretch in _march(lists, settings.cells_per_block(behind.shape[1])):
                    arriving, hidden = upstream.index_select(0, stretch.cells), behind.index_select(0, stretch.cells)
                    for block in stretch.blocks(table, lists.splats, transmittance, scratch, settings.pairs_per_block):
                        _backward_block(block, table.monomials, arriving, hidden, sums, settings.absgrad, scratch)
                    behind.index_copy_(0, stretch.cells, hidden)
            m, mx, my, mxx, mxy, myy, pull_x, pull_y = sums[:, : _TERMS + 2].t().contiguous().unbind(0)
            A, B, C = ellipses.A, ellipses.B, ellipses.C

            def dense(like: Tensor, columns: list[Tensor]) -> Tensor:
                flat = like.new_zeros(means2d.shape[0] * means2d.shape[1], len(columns))
                return flat.index_copy_(0, chosen.long(), torch.stack(columns, dim=1)).view(like.shape)

            if settings.absgrad:
                means2d.absgrad = dense(means2d, [pull_x, pull_y])
            v_means2d = dense(means2d, [-(A * mx + B * my), -(B * mx + C * my)])
            v_conics = dense(conics, [-0.5 * mxx, -mxy, -0.5 * myy])
            v_opacities = dense(opacities, [m / ellipses.opacity])
        return v_means2d, v_conics, v_opacities, sums[:, _TERMS + 2 : _TERMS + 2 + channels], None, None, None, None
