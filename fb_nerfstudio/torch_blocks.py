"""All pairs (Gaussian, pixel) of an image, evaluated block by block, front to back; both passes of the compositor walk them.

Inside a cell, with (u, v) a pixel's offset from the cell centre, the exponent of a Gaussian is a quadratic polynomial:

    log(opacity) - d^T conic d / 2  =  k0 + k1 u + k2 v + k3 u^2 + k4 u v + k5 v^2

so a block of B ranks x S cells x 64 pixels is one thin matrix product with the 6x64 matrix of monomials, one power of two, and
B in-place multiplications for the transmittance. Blocks hold a bounded number of pairs and stay in the cache; cells whose
pixels are all opaque drop out.

Rules per pixel (gsplat): skip alpha < 1/255; cap alpha; stop before the Gaussian that would bring the transmittance to
1e-4 or below. The exponent of a positive definite conic is never positive, so gsplat's test for sigma < 0 only ever rejects
rounding noise and is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from fb_nerfstudio.torch_cells import CellGrid, CellLists, Ellipses
from fb_nerfstudio.torch_projection import ALPHA_MIN

TRANSMITTANCE_MIN = 1e-4
TERMS, GEOMETRY, COLUMNS = 6, 6, 11
# Shape of a block, found by measuring: 16 ranks x 256 cells x 64 pixels, deeper where there are fewer cells.
PAIRS_PER_BLOCK = 2**18
_SHALLOWEST = 16
# A layer (one rank) with fewer values than this is scanned by torch; larger layers are walked one by one, which is faster.
THIN = 512
_NEVER = -1e4


@dataclass(frozen=True, kw_only=True)
class Table:
    """What a block needs to know, one row for each chosen Gaussian (one gather fetches all of it)."""

    rows: Float[Tensor, "v r"]
    """log2(opacity), x, y, A, B, C (conic entries times log2(e)), the values, 1; then padding. A line of the cache where d is small."""
    channels: int
    """Values and the 1."""
    monomials: Float[Tensor, "6 p"]
    halves: Float[Tensor, "3 1"]
    """-1/2, -1, -1/2: what makes k3, k4, k5 of A, B, C."""
    centers: Float[Tensor, "2 cells"]
    alpha_threshold: float
    """The largest number below 1/255."""
    cap: float | None
    """Largest alpha; None where no opacity reaches it."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """B ranks deep, S cells wide, P pixels each; where two of them are one index the order is (b, s)."""

    splats: Int32[Tensor, " bs"]
    """Rows of the table; padding points at some row and has alpha 0."""
    columns: Float[Tensor, "11 bs"]
    """Coefficients k0 .. k5, dx and dy (mean less cell centre), A, B, C: to the base 2 like the table."""
    clear: Float[Tensor, "b s p"]
    """1 - alpha before the stop."""
    values: Float[Tensor, "b s d1"]
    """Channels, and a last one of ones, which composites to alpha."""
    alpha: Float[Tensor, "b s p"]
    light: Float[Tensor, "b s p"]
    """Transmittance in front of each."""
    capped: Tensor | None
    """Pairs at the cap (bool), or None where there are none."""


class Scratch:
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


def padded(width: int) -> int:
    """Row length for gathers and sums of rows: torch handles whole vectors twice as fast."""
    return -(-width // 16) * 16


def _monomials(size: int, like: Tensor) -> Float[Tensor, "6 p"]:
    """1, u, v, u^2, u v, v^2 at the pixels of a cell, row by row."""
    offsets = torch.arange(size, dtype=like.dtype, device=like.device) - (size - 1) / 2
    v, u = (grid.reshape(-1) for grid in torch.meshgrid(offsets, offsets, indexing="ij"))
    return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v])


def table_of(ellipses: Ellipses, values: Tensor, grid: CellGrid, cap: float) -> Table:
    below = torch.nextafter(torch.tensor(ALPHA_MIN, dtype=values.dtype), torch.zeros((), dtype=values.dtype))
    used = GEOMETRY + values.shape[1] + 1
    rows = values.new_empty(values.shape[0], padded(used))
    A, B, C = (column * math.log2(math.e) for column in (ellipses.A, ellipses.B, ellipses.C))
    torch.stack([ellipses.opacity.log2(), ellipses.x, ellipses.y, A, B, C], dim=1, out=rows[:, :GEOMETRY])
    rows[:, GEOMETRY : used - 1] = values
    rows[:, used - 1 :] = 1.0
    # A little slack: the polynomial may round an exponent to slightly above log(opacity).
    may_cap = values.shape[0] > 0 and float(ellipses.opacity.max()) > cap * (1 - 1e-3)
    return Table(
        rows=rows,
        channels=values.shape[1] + 1,
        monomials=_monomials(grid.size, values),
        halves=values.new_tensor([[-0.5], [-1.0], [-0.5]]),
        centers=torch.stack(grid.centers(values)),
        alpha_threshold=float(below),
        cap=cap if may_cap else None,
    )


class Stretch:
    """Cells of similar length that are walked together, front to back, until most are opaque or all are done."""

    def __init__(self, cells: Tensor, counts: Tensor, starts: Tensor, rank: int):
        self.cells = cells
        self.rest: Stretch | None = None
        """`rest`: after `blocks`, the stretch of the cells that still need work, or None."""
        self._counts, self._starts, self._rank = counts, starts, rank
        self._ranks = torch.arange(int(counts[0]), dtype=torch.int32, device=counts.device)[:, None]

    def blocks(self, table: Table, listed: Tensor, transmittance: Tensor, scratch: Scratch, budget: int) -> Iterator[Block]:
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
                _stop(block.alpha, after, scratch)
            yield block
            if opaque and rank < deepest:
                still = (light[:width].amax(dim=1) > TRANSMITTANCE_MIN) & (self._counts[:width] > rank)
                if int(still.sum()) <= 0.75 * width:
                    kept = still.nonzero()[:, 0]
                    if kept.numel():
                        cells, counts, starts = (column.index_select(0, kept) for column in (self.cells, self._counts, self._starts))
                        self.rest = Stretch(cells, counts, starts, rank)
                    break
        transmittance.index_copy_(0, self.cells, light)

    def _pick(self, listed: Tensor, rank: int, depth: int, width: int, full: bool) -> tuple[Tensor, Tensor | None]:
        """Table rows of the ranks rank .. rank + depth of the first `width` cells, and what of it is padding."""
        ranks = self._ranks[rank : rank + depth]
        positions = ranks + self._starts[:width]
        padding = None if full else ranks >= self._counts[:width]
        if padding is not None:
            positions.masked_fill_(padding, 0)
        return listed.index_select(0, positions.view(-1)), padding


def _block(
    table: Table, splats: Tensor, padding: Tensor | None, centers: Tensor, light: Tensor, depth: int, scratch: Scratch
) -> tuple[Block, Tensor]:
    """Evaluate all pairs; also returns the transmittance behind each [b, s, p]."""
    width, pixels = light.shape
    rows = torch.index_select(table.rows, 0, splats, out=scratch.take("rows", depth * width, table.rows.shape[1]))
    k = scratch.take("columns", COLUMNS, depth * width)
    k[COLUMNS - GEOMETRY :].copy_(rows[:, :GEOMETRY].t())
    k[6:8].view(2, depth, width).sub_(centers)
    dx, dy = k[6], k[7]
    torch.mul(k[8:10], dx, out=k[1:3]).addcmul_(k[9:11], dy)
    torch.addcmul(k[5], dx, k[1], value=-0.5, out=k[0]).addcmul_(dy, k[2], value=-0.5)
    torch.mul(k[8:11], table.halves, out=k[3:6])
    if padding is not None:
        k[0].masked_fill_(padding.view(-1), _NEVER)
    alpha = torch.mm(k[:TERMS].t(), table.monomials, out=scratch.take("alpha", depth * width, pixels))
    # To the base 2 because torch's exp2 is twice as fast as its exp.
    alpha = torch.threshold_(alpha.exp2_(), table.alpha_threshold, 0.0).view(depth, width, pixels)
    capped = None
    if table.cap is not None and float(alpha.max()) > table.cap:
        capped = alpha > table.cap
        alpha.clamp_(max=table.cap)
    lights = scratch.take("light", depth + 1, width, pixels)
    lights[0] = light
    clear = torch.sub(1.0, alpha, out=scratch.take("clear", depth, width, pixels))
    _darken(clear, lights)
    values = rows[:, GEOMETRY : GEOMETRY + table.channels].view(depth, width, -1)
    return Block(splats=splats, columns=k, values=values, alpha=alpha, clear=clear, light=lights[:depth], capped=capped), lights[1:]


def _darken(clear: Tensor, lights: Tensor) -> None:
    """lights[b + 1] = lights[b] clear[b]."""
    if clear[0].numel() < THIN:
        lights[1:] = clear
        torch.cumprod(lights, dim=0, out=lights)
        return
    for through, (before, after) in zip(clear.unbind(0), pairwise(lights.unbind(0)), strict=True):
        torch.mul(before, through, out=after)


def _stop(alpha: Tensor, after: Tensor, scratch: Scratch) -> None:
    """Take out the Gaussian that would end a pixel, and all behind it. In floats: comparisons cost five times as much."""
    drawn = torch.sub(after, TRANSMITTANCE_MIN, out=scratch.take("drawn", *after.shape))
    alpha.mul_(drawn.mul_(1e30).clamp_(0.0, 1.0))


def march(lists: CellLists, pixels: int, budget: int) -> Iterator[Stretch]:
    """All cells that have something to draw, in stretches that fit blocks of `budget` pairs, long lists first."""
    width = max(1, budget // (_SHALLOWEST * pixels))
    busy = torch.argsort(lists.counts, descending=True)[: int((lists.counts > 0).sum())]
    for cells in busy.split(width) if busy.numel() else ():
        stretch = Stretch(cells, lists.counts.index_select(0, cells), lists.starts.index_select(0, cells), 0)
        while stretch is not None:
            yield stretch
            stretch = stretch.rest
