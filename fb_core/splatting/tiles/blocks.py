"""All pairs (Gaussian, pixel) of an image, evaluated block by block, front to back; backward walks the same blocks,
back to front.

Inside a cell, with (u, v) a pixel's offset from the cell centre, the exponent of a Gaussian is a quadratic polynomial:

    log(opacity) - d^T conic d / 2  =  k0 + k1 u + k2 v + k3 u^2 + k4 u v + k5 v^2

so a block of B ranks x S cells x 32 pixels is one thin matrix product with the 6x32 matrix of monomials, one power of
two, and B in-place multiplications for the transmittance. Blocks hold a bounded number of pairs and stay in the cache;
cells whose pixels are all opaque drop out. Blocks are kept for backward while there is room for them, and evaluated
again where there was none.

Rules per pixel (gsplat): skip alpha < 1/255; cap alpha; stop before the Gaussian that would bring the transmittance to
1e-4 or below. The exponent of a positive definite conic is never positive, so gsplat's test for sigma < 0 only ever
rejects rounding noise and is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from fb_core.splatting.projection import ALPHA_MIN
from fb_core.splatting.tiles.cells import CellGrid, CellLists, Ellipses

TRANSMITTANCE_MIN = 1e-4
TERMS, GEOMETRY = 6, 6
# Shape of a block, found by measuring: 24 ranks x 500 cells x 32 pixels, deeper where there are fewer cells. No power
# of two, or the ranks of a cell would lie a multiple of 4096 bytes apart, where a cache has room for eight of them.
PAIRS_PER_BLOCK = 375 * 1024
_SHALLOWEST = 24
# A layer (one rank) with fewer values than this is scanned by torch; larger layers are walked one by one, which is
# faster.
THIN = 512
_NEVER = -1e4


@dataclass(frozen=True, kw_only=True)
class Table:
    """What a block needs to know, one row for each chosen Gaussian (one gather fetches all of it)."""

    rows: Float[Tensor, "v r"]
    """log2(opacity), x, y, A, B, C (conic entries times log2(e)), the values, 1; then padding. A line of the cache
    where d is small.
    """
    channels: int
    """Values and the 1."""
    monomials: Float[Tensor, "6 p"]
    halves: Float[Tensor, "3 1"]
    """-1/2, -1, -1/2: what makes k3, k4, k5 of A, B, C."""
    centers: Float[Tensor, "2 cells"]
    alpha_threshold: float
    """The largest number below 1/255."""
    cap: float
    """Largest alpha."""


@dataclass(frozen=True, kw_only=True)
class Step:
    """Where a block lies: all that it takes to evaluate it again. 20 bytes a row, where the weights of a row have
    128.
    """

    depth: int
    splats: Int32[Tensor, " bs"]
    """Rows of the table; padding points at some row and has alpha 0."""
    padding: Bool[Tensor, "b s"] | None
    light: Float[Tensor, "s p"]
    """Transmittance in front of the block, as if nothing had stopped."""
    block: Block | None = None
    """The block itself; None where there was no room for it."""


@dataclass(frozen=True, kw_only=True)
class Block:
    """B ranks deep, S cells wide, P pixels each; where two of them are one index the order is (b, s)."""

    splats: Int32[Tensor, " bs"]
    columns: Float[Tensor, "6 bs"]
    """log2(opacity), dx and dy (mean less cell centre), A, B, C: to the base 2 like the table."""
    values: Float[Tensor, "b s d1"]
    """Channels, and a last one of ones, which composites to alpha."""
    weights: Float[Tensor, "b s p"]
    """alpha times the transmittance in front; 0 from where a pixel stops."""
    capped: Bool[Tensor, "b s p"] | None
    """Pairs at the cap, or None where there are none."""


class Scratch:
    """Reused buffers: fresh allocations of this size would cost page faults at every block."""

    def __init__(self, like: Tensor):
        self._like = like
        self._buffers: dict[str, Tensor] = {}
        self._views: dict[tuple[str | int, ...], Tensor] = {}
        self._layers: dict[tuple[str | int, ...], tuple[Tensor, ...]] = {}

    def take(self, name: str, *shape: int) -> Tensor:
        """A tensor of that name and shape, whose memory is used again and again; it holds whatever was left there."""
        view = self._views.get((name, *shape))
        if view is None:
            size = math.prod(shape)
            if name not in self._buffers or self._buffers[name].numel() < size:
                self._buffers[name] = self._like.new_empty(size)
                self._views = {key: value for key, value in self._views.items() if key[0] != name}
                self._layers = {key: value for key, value in self._layers.items() if key[0] != name}
            view = self._views[(name, *shape)] = self._buffers[name][:size].view(shape)
        return view

    def layers(self, name: str, *shape: int, axis: int = 0) -> tuple[Tensor, ...]:
        """`take(...)` cut along an axis, always the same for a name. Kept as well: making a view costs as much as a
        pass over a layer.
        """
        whole = self.take(name, *shape)
        layers = self._layers.get((name, *shape))
        if layers is None:
            layers = self._layers[(name, *shape)] = whole.unbind(axis)
        return layers


def padded_width(width: int) -> int:
    """Row length for gathers and sums of rows: torch handles whole vectors twice as fast."""
    return -(-width // 16) * 16


def _monomials(grid: CellGrid, like: Tensor) -> Float[Tensor, "6 p"]:
    """1, u, v, u^2, u v, v^2 at the pixels of a cell, row by row."""
    across, down = (
        torch.arange(n, dtype=like.dtype, device=like.device) - (n - 1) / 2 for n in (grid.cell_width, grid.cell_height)
    )
    v, u = (offsets.reshape(-1) for offsets in torch.meshgrid(down, across, indexing="ij"))
    return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v])


def table_of(ellipses: Ellipses, values: Tensor, cap: float) -> Table:
    """What blocks read of every Gaussian, a row each: logarithm of the opacity, place, shape, values, and 1."""
    below = torch.nextafter(torch.tensor(ALPHA_MIN, dtype=values.dtype), torch.zeros((), dtype=values.dtype))
    used = GEOMETRY + values.shape[1] + 1
    rows = values.new_empty(values.shape[0], padded_width(used))
    A, B, C = (column * math.log2(math.e) for column in (ellipses.A, ellipses.B, ellipses.C))
    torch.stack([ellipses.opacity.log2(), ellipses.x, ellipses.y, A, B, C], dim=1, out=rows[:, :GEOMETRY])
    rows[:, GEOMETRY : used - 1] = values
    rows[:, used - 1 :] = 1.0
    return Table(
        rows=rows,
        channels=values.shape[1] + 1,
        monomials=_monomials(ellipses.grid, values),
        halves=values.new_tensor([[-0.5], [-1.0], [-0.5]]),
        centers=torch.stack(ellipses.grid.centers(values)),
        alpha_threshold=float(below),
        cap=cap,
    )


class Stretch:
    """Cells of similar length that are walked together, front to back, until most are opaque or all are done."""

    def __init__(self, cells: Tensor, counts: Tensor, starts: Tensor, rank: int):
        self.cells = cells
        self.steps: list[Step] = []
        """`steps`: where the blocks were, once they have been walked."""
        self.kept = 0
        """`kept`: pairs of the blocks that the steps hold."""
        self.rest: Stretch | None = None
        """`rest`: after `blocks`, the stretch of the cells that still need work, or None."""
        self._counts, self._starts, self._rank = counts, starts, rank
        self._ranks = torch.arange(int(counts[0]), dtype=torch.int32, device=counts.device)[:, None]

    def blocks(
        self, table: Table, listed: Tensor, light: Float[Tensor, "2 cells p"], scratch: Scratch, budget: int, keep: int
    ) -> Iterator[Block]:
        """The blocks in order, covering the first cells of the stretch; at the end their `light` is up to date.

        `light[0]` is the transmittance as if nothing had stopped, `light[1]` behind all that is drawn. The steps hold
        blocks of up to `keep` pairs.
        """
        pixels, rank, lengths = table.monomials.shape[1], self._rank, self._counts.tolist()
        centers = self._centers(table)
        local, deepest, width = light.index_select(1, self.cells), lengths[0], len(lengths)
        while rank < deepest:
            while lengths[width - 1] <= rank:  # long lists come first, so finished cells are at the end
                width -= 1
            depth = min(max(_SHALLOWEST, budget // (width * pixels)), deepest - rank)
            splats, padding = self._pick(listed, rank, depth, width, full=lengths[width - 1] >= rank + depth)
            step = Step(depth=depth, splats=splats, padding=padding, light=local[0, :width].clone())
            fits = self.kept + depth * width * pixels <= keep
            block = _evaluate(table, step, centers, local[:, :width], scratch, keep=fits)
            self.kept += block.weights.numel() if fits else 0
            self.steps.append(replace(step, block=block) if fits else step)
            rank += depth
            yield block
            if rank < deepest and float(local[0, :width].min()) <= TRANSMITTANCE_MIN:
                still = (local[0, :width].amax(dim=1) > TRANSMITTANCE_MIN) & (self._counts[:width] > rank)
                if int(still.sum()) <= 0.75 * width:
                    remaining = still.nonzero()[:, 0]
                    if remaining.numel():
                        cells, counts, starts = (
                            column.index_select(0, remaining) for column in (self.cells, self._counts, self._starts)
                        )
                        self.rest = Stretch(cells, counts, starts, rank)
                    break
        light.index_copy_(1, self.cells, local)

    def blocks_again(self, table: Table, scratch: Scratch) -> Iterator[Block]:
        """The blocks that have been walked, last one first."""
        centers = self._centers(table)
        for step in reversed(self.steps):
            yield step.block or _evaluate(
                table, step, centers, torch.stack([step.light, step.light]), scratch, keep=False
            )

    def _centers(self, table: Table) -> Float[Tensor, "2 1 s"]:
        return table.centers.index_select(1, self.cells)[:, None]

    def _pick(self, listed: Tensor, rank: int, depth: int, width: int, full: bool) -> tuple[Tensor, Tensor | None]:
        """Table rows of the ranks rank .. rank + depth of the first `width` cells, and what of it is padding."""
        ranks = self._ranks[rank : rank + depth]
        positions = ranks + self._starts[:width]
        padding = None if full else ranks >= self._counts[:width]
        if padding is not None:
            positions.masked_fill_(padding, 0)
        return listed.index_select(0, positions.view(-1)), padding


def _evaluate(
    table: Table,
    step: Step,
    centers: Float[Tensor, "2 1 widest"],
    light: Float[Tensor, "2 s p"],
    scratch: Scratch,
    *,
    keep: bool,
) -> Block:
    """All pairs of a block. Unless it is to `keep`, it lives in `scratch`, until the next one is evaluated."""
    depth, (width, pixels) = step.depth, step.light.shape

    def place(name: str, *shape: int) -> Tensor:
        return table.rows.new_empty(shape) if keep else scratch.take(name, *shape)

    rows = torch.index_select(table.rows, 0, step.splats, out=scratch.take("rows", depth * width, table.rows.shape[1]))
    columns = place("columns", GEOMETRY, depth * width).copy_(rows[:, :GEOMETRY].t())
    # A little slack: the polynomial may round an exponent to slightly above log(opacity).
    may_cap = float(columns[0].max()) > math.log2(table.cap) - 1e-3
    columns[1:3].view(2, depth, width).sub_(centers[..., :width])
    opacity, dx, dy = columns[:3]
    k = scratch.take("coefficients", TERMS, depth * width)
    torch.mul(columns[3:5], dx, out=k[1:3]).addcmul_(columns[4:6], dy)
    torch.addcmul(opacity, dx, k[1], value=-0.5, out=k[0]).addcmul_(dy, k[2], value=-0.5)
    torch.mul(columns[3:6], table.halves, out=k[3:6])
    if step.padding is not None:
        k[0].masked_fill_(step.padding.view(-1), _NEVER)
    weights = place("weights", depth, width, pixels)
    torch.mm(k.t(), table.monomials, out=weights.view(depth * width, pixels))
    # To the base 2 because torch's exp2 is twice as fast as its exp.
    torch.threshold_(weights.exp2_(), table.alpha_threshold, 0.0)
    capped = None
    if may_cap and float(weights.max()) > table.cap:
        capped = weights > table.cap
        weights.clamp_(max=table.cap)
    _darken(weights, step.light, light)
    values = rows[:, GEOMETRY : GEOMETRY + table.channels].view(depth, width, -1)
    return Block(
        splats=step.splats,
        columns=columns,
        values=values.contiguous() if keep else values,
        weights=weights,
        capped=capped,
    )


def _darken(alpha: Float[Tensor, "b s p"], before: Float[Tensor, "s p"], light: Float[Tensor, "2 s p"]) -> None:
    """Turn alpha into weights, rank by rank, so that a layer stays in the cache; bring `light` from `before` the block
    to behind it.
    """
    passing, left = light
    if passing.numel() < THIN:
        lights = torch.cat([before[None], 1 - alpha]).cumprod_(dim=0)
        _stop(alpha.mul_(lights[:-1]), lights[1:])
        passing.copy_(lights[-1])
        torch.minimum(left, torch.threshold_(lights, TRANSMITTANCE_MIN, 1.0).amin(dim=0), out=left)
        return
    layers = alpha.unbind(0)
    for layer in layers:
        passing.sub_(layer.mul_(passing))
    if float(passing.min()) > TRANSMITTANCE_MIN:
        left.copy_(passing)
        return
    passing.copy_(before)  # some pixel stops: once more, with a look at every rank
    for layer in layers:
        passing.sub_(layer)
        _stop(layer, passing)
        left.sub_(layer)


def _stop(weights: Tensor, after: Tensor) -> None:
    """Take out the Gaussian that would end a pixel, and all behind it: 0 where after <= 1e-4, in one pass."""
    torch.ops.aten.threshold_backward.grad_input(weights, after, TRANSMITTANCE_MIN, grad_input=weights)


def march(lists: CellLists, pixels: int, budget: int) -> Iterator[Stretch]:
    """All cells that have something to draw, in stretches that fit blocks of `budget` pairs, long lists first."""
    width = max(1, budget // (_SHALLOWEST * pixels))
    busy = torch.argsort(lists.counts, descending=True)[: int((lists.counts > 0).sum())]
    for cells in busy.split(width) if busy.numel() else ():
        stretch = Stretch(cells, lists.counts.index_select(0, cells), lists.starts.index_select(0, cells), 0)
        while stretch is not None:
            yield stretch
            stretch = stretch.rest
