"""`composite` of ../tiles/compositing.py by the compiled library: same arguments, same pictures, same gradients.

Cells are independent of each other, so that ranges of them go to several threads (the library runs without Python's
lock). What Gaussians gain from their cells is added up afterwards in one order: any number of threads gives the same
bits.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_core.splatting.compiled.library import library_for, loaded
from fb_core.splatting.compiled.threads import in_parts, threads_for
from fb_core.splatting.single_thread import single_thread
from fb_core.splatting.tiles.blocks import Table, table_of
from fb_core.splatting.tiles.cells import CellGrid, Ellipses, Strips, measure_strips, slabs
from fb_core.splatting.tiles.compositing import PULLS, CompositingSettings, gradients_of, to_cells, to_image

_LANES = 16  # the most that the library works on at once
MOST_CHANNELS = 15
"""Values that the library composites at once; more go to torch."""


class _Scene(ctypes.Structure):
    """`Scene` of compositing.c."""

    _fields_ = [
        ("table", ctypes.c_void_p),
        *[(name, ctypes.c_int32) for name in ("stride", "channels")],
        *[(name, ctypes.c_void_p) for name in ("splats", "starts")],
        *[(name, ctypes.c_int32) for name in ("columns", "rows", "cell_width", "cell_height")],
        *[(name, ctypes.c_double) for name in ("below", "cap")],
    ]


class _Strips(ctypes.Structure):
    """`Strips` of compositing.c."""

    _fields_ = [
        *[(name, ctypes.c_void_p) for name in ("x", "y", "skew", "over_A", "over_yy", "reach", "turn", "first_row")],
        *[(name, ctypes.c_void_p) for name in ("rows", "camera", "left", "right")],
        *[(name, ctypes.c_int32) for name in ("columns", "grid_rows", "cell_width", "cell_height")],
    ]


@dataclass(frozen=True, kw_only=True)
class Lists:
    """Gaussians by cell, near ones first: those of cell k are splats[starts[k] : starts[k + 1]]."""

    splats: Int32[Tensor, " m"]
    starts: Int32[Tensor, " cells+1"]


def can_draw(channels: int, like: Tensor) -> bool:
    """Whether a library for so many channels of such numbers has been made."""
    return like.device.type == "cpu" and channels <= MOST_CHANNELS and loaded(like.dtype) is not None


def composite_compiled(
    means2d: Float[Tensor, "c n 2"],
    conics: Float[Tensor, "c n 3"],
    opacities: Float[Tensor, "c n"],
    values: Float[Tensor, "v d"],
    ellipses: Ellipses,
    settings: CompositingSettings,
) -> tuple[Float[Tensor, "c h w d"], Float[Tensor, "c h w 1"]]:
    """As `tiles.compositing.composite`; the library must have been made (`can_draw`)."""
    return _Compiled.apply(means2d, conics, opacities, values, ellipses, settings)


def _lists(ellipses: Ellipses, strips: Strips, run: tuple[int, int], light: Float[Tensor, "cells p"]) -> Lists:
    """The lists of one run of Gaussians, without the cells that the runs before have made opaque."""
    library, grid = library_for(light.dtype), ellipses.grid
    bounds = (None, None) if ellipses.bounds is None else (ellipses.bounds[0], ellipses.bounds[1])
    columns = [
        ellipses.x, ellipses.y, strips.skew, strips.over_A, strips.over_yy, strips.reach, strips.turn,
        strips.first_row, strips.rows, ellipses.camera, *bounds,
    ]  # fmt: skip
    held = [None if column is None else column.contiguous() for column in columns]
    struct = _Strips(
        *[None if column is None else column.data_ptr() for column in held],
        grid.columns, grid.rows, grid.cell_width, grid.cell_height,
    )  # fmt: skip
    begin, end = run
    alive = (light > 0).any(dim=1) if begin else None
    number = int(strips.rows[begin:end].sum())
    cell, wide = (torch.empty(number, dtype=torch.int32) for _ in range(2))
    starts = torch.zeros(grid.count + 1, dtype=torch.int32)
    where = ctypes.c_void_p(None if alive is None else alive.data_ptr())
    library.fb_strips(
        ctypes.byref(struct), ctypes.c_int64(begin), ctypes.c_int64(end), where, *map(_at, (cell, wide, starts))
    )
    starts = starts.cumsum(0, dtype=torch.int32)
    splats = torch.empty(int(starts[-1]), dtype=torch.int32)
    following = starts.clone()
    library.fb_fill(
        ctypes.byref(struct),
        ctypes.c_int64(begin),
        ctypes.c_int64(end),
        where,
        *map(_at, (cell, wide, following, splats)),
    )
    return Lists(splats=splats, starts=starts)


def _at(tensor: Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if tensor is None else tensor.data_ptr())


def _scene(table: Table, lists: Lists, grid: CellGrid) -> _Scene:
    return _Scene(
        table.rows.data_ptr(), table.rows.shape[1], table.channels, lists.splats.data_ptr(), lists.starts.data_ptr(),
        grid.columns, grid.rows, grid.cell_width, grid.cell_height, table.alpha_threshold, table.cap,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Run:
    """A run of Gaussians that has been composited."""

    lists: Lists
    stop: Tensor
    """For each pixel the rank in its cell's list from which on nothing was drawn."""
    light: Float[Tensor, "cells p"]
    """Transmittance behind the run; below 0 where a pixel has stopped."""


class _Compiled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means2d, conics, opacities, values, ellipses: Ellipses, settings: CompositingSettings):
        library, runs, grid = library_for(values.dtype), list[_Run](), ellipses.grid
        needed = any(ctx.needs_input_grad[:4])
        pixels = grid.cell_width * grid.cell_height
        with single_thread():
            table, strips = table_of(ellipses, values, settings.alpha_cap), measure_strips(ellipses)
            image = values.new_zeros(grid.count, values.shape[1] + 1, pixels)
            light = values.new_ones(grid.count, pixels)
            for run in slabs(strips, settings.rows_per_list):
                lists = _lists(ellipses, strips, run, light)
                scene = _scene(table, lists, grid)
                stop = torch.empty(light.shape, dtype=_WHOLE[values.dtype])

                def forward(first: int, last: int, scene: _Scene = scene, stop: Tensor = stop) -> None:
                    library.fb_forward(
                        ctypes.byref(scene),
                        ctypes.c_int64(first),
                        ctypes.c_int64(last),
                        *map(_at, (image, light, stop)),
                    )

                in_parts(forward, lists.starts, threads_for(lists.splats.shape[0]))
                if needed:
                    runs.append(_Run(lists=lists, stop=stop, light=light.clone()))
            colors, alphas = to_image(image[:, :-1], grid), to_image(image[:, -1:], grid)
        ctx.save_for_backward(means2d, conics, opacities, values)
        ctx.ellipses, ctx.settings, ctx.table, ctx.runs = ellipses, settings, table, runs
        return colors, alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor, v_alphas: Tensor):  # type: ignore[override]
        means2d, conics, opacities, values = ctx.saved_tensors
        ellipses, grid, settings, table = ctx.ellipses, ctx.ellipses.grid, ctx.settings, ctx.table
        library, channels = library_for(values.dtype), values.shape[1]
        with single_thread():
            upstream = to_cells([v_colors, v_alphas], grid)
            behind = upstream.new_zeros(grid.count, upstream.shape[2])
            width = math.ceil((PULLS + channels) / _LANES) * _LANES
            sums = values.new_zeros(values.shape[0], width)
            for run in reversed(ctx.runs):
                scene, light, lists = _scene(table, run.lists, grid), run.light.clone(), run.lists
                threads = threads_for(lists.splats.shape[0])
                rows = values.new_empty(lists.splats.shape[0], width) if threads > 1 else None

                def backward(first: int, last: int, scene=scene, light=light, rows=rows, stop=run.stop) -> None:
                    library.fb_backward(
                        ctypes.byref(scene), ctypes.c_int64(first), ctypes.c_int64(last),
                        *map(_at, (upstream, behind, light, stop)), ctypes.c_int32(settings.absgrad), _at(rows),
                        _at(sums), ctypes.c_int32(width),
                    )  # fmt: skip

                in_parts(backward, lists.starts, threads)
                if rows is not None:
                    library.fb_add_rows(
                        ctypes.c_int64(rows.shape[0]), _at(lists.splats), _at(rows), ctypes.c_int32(width), _at(sums)
                    )
            v_means2d, v_conics, v_opacities = gradients_of(
                sums, means2d, conics, opacities, ellipses, settings.absgrad
            )
        return v_means2d, v_conics, v_opacities, sums[:, PULLS : PULLS + channels], None, None


_WHOLE = {torch.float32: torch.int32, torch.float64: torch.int64}
