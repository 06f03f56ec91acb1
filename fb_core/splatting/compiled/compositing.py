"""`composite` of ../tiles/compositing.py by the compiled library: same pictures, same gradients.

Bands of cells share nothing, so that they go to several threads (the library runs without Python's lock). What
Gaussians gain in their bands is added up afterwards in one order: any number of threads gives the same bits.
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
from fb_core.splatting.compiled.threads import in_parts, in_ranges, threads_for
from fb_core.splatting.projection import ALPHA_MIN
from fb_core.splatting.tiles.blocks import GEOMETRY
from fb_core.splatting.tiles.cells import CellGrid, slabs
from fb_core.splatting.tiles.compositing import PULLS, CompositingSettings

_LANES = 16  # the most that the library works on at once
MOST_CHANNELS = 15
"""Values that the library composites at once; more go to torch."""
_BANDS, _LEAST_BAND, _CELLS_OF_ONE_BAND = 12, 8, 1024
"""Bands of a picture, rows of cells in one, and the cells up to which a picture has a single band: more bands balance
threads, fewer split fewer Gaussians.
"""
_WHOLE = {torch.float32: torch.int32, torch.float64: torch.int64}
_NUMBERS = ("width", "height", "columns", "rows", "cell_width", "cell_height", "band_rows", "bands")
_TENSORS = (
    "chosen", "radii", "means2d", "conics", "determinants", "opacities", "values", "first_row", "high", "first_column",
    "wide", "logs", "band_items", "band_strips", "band_cells", "ranks", "starts", "places", "table", "strip_cells",
    "strip_wide", "lists", "list_starts", "list_counts", "colors", "alphas", "light_before", "light", "stop",
)  # fmt: skip
_FOR_BACKWARD = (
    "chosen", "conics", "opacities", "band_items", "band_cells", "starts", "places", "table", "lists", "list_starts",
    "list_counts", "light", "stop",
)  # fmt: skip
"""What backward reads. The pictures are not among them: a result that its own graph holds is never freed."""


class _Run(ctypes.Structure):
    """`Run` of run.h."""

    _fields_ = [
        *[(name, ctypes.c_int32) for name in (*_NUMBERS, "cameras", "tile_size", "channels", "stride")],
        *[(name, ctypes.c_int64) for name in ("each", "begin", "end")],
        *[(name, ctypes.c_double) for name in ("below", "cap")],
        *[(name, ctypes.c_void_p) for name in _TENSORS],
    ]

    def hold(self, **tensors: Tensor | None) -> None:
        """Point to the tensors, which live as long as this does."""
        self.held = {**getattr(self, "held", {}), **tensors}
        for name, tensor in tensors.items():
            setattr(self, name, None if tensor is None else tensor.data_ptr())


class _Way(ctypes.Structure):
    """`Way` of compositing.c."""

    _fields_ = [
        *[(name, ctypes.c_void_p) for name in ("colors", "alphas", "behind", "sums")],
        ("absgrad", ctypes.c_int32),
    ]


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """The V Gaussians that can be seen, and the pictures that they are seen in; constants for autograd."""

    ranks: Int32[Tensor, " v"]
    """Their flat indices, camera * n + Gaussian, near ones first."""
    determinants: Float[Tensor, "c n"]
    """Of the screen covariances of all Gaussians, pixel^4."""
    radii: Int32[Tensor, "c n"] | None
    """Half sizes of the square boxes that cut, pixels; None where none do."""
    tile_size: int
    """Pixels of the tiles that the boxes are rounded up to."""
    grid: CellGrid


def can_draw(channels: int, like: Tensor) -> bool:
    """Whether a library for so many channels of such numbers has been made."""
    return like.device.type == "cpu" and channels <= MOST_CHANNELS and loaded(like.dtype) is not None


def composite_compiled(
    means2d: Float[Tensor, "c n 2"],
    conics: Float[Tensor, "c n 3"],
    opacities: Float[Tensor, "c n"],
    values: Float[Tensor, "v d"],
    chosen: Chosen,
    settings: CompositingSettings,
) -> tuple[Float[Tensor, "c h w d"], Float[Tensor, "c h w 1"]]:
    """As `tiles.compositing.composite`; the library must have been made (`can_draw`)."""
    return _Compiled.apply(means2d, conics, opacities, values, chosen, settings)


def _start(gaussians: tuple[Tensor, Tensor, Tensor, Tensor], chosen: Chosen, settings: CompositingSettings) -> _Run:
    """What all runs have in common; rows and columns of cells are measured."""
    means2d, conics, opacities, values = (tensor.detach().contiguous() for tensor in gaussians)
    grid, visible, channels = chosen.grid, values.shape[0], values.shape[1] + 1
    few = grid.rows * grid.columns <= _CELLS_OF_ONE_BAND
    band_rows = grid.rows if few else max(_LEAST_BAND, math.ceil(grid.rows / _BANDS))
    below = torch.nextafter(values.new_tensor(ALPHA_MIN), values.new_zeros(()))
    run = _Run(
        width=grid.width, height=grid.height, columns=grid.columns, rows=grid.rows, cell_width=grid.cell_width,
        cell_height=grid.cell_height, band_rows=band_rows, bands=math.ceil(grid.rows / band_rows),
        cameras=grid.cameras, tile_size=0 if chosen.radii is None else chosen.tile_size, channels=channels,
        stride=math.ceil((max(PULLS, GEOMETRY + 1) + channels - 1) / _LANES) * _LANES, each=means2d.shape[1],
        below=float(below), cap=settings.alpha_cap,
    )  # fmt: skip
    spans = torch.empty(4, visible, dtype=torch.int32)
    run.hold(
        chosen=chosen.ranks, radii=chosen.radii, means2d=means2d, conics=conics, opacities=opacities, values=values,
        determinants=chosen.determinants, first_row=spans[0], high=spans[1], first_column=spans[2],
        wide=spans[3], logs=values.new_empty(visible),
        colors=values.new_empty(grid.cameras, grid.height, grid.width, channels - 1),
        alphas=values.new_empty(grid.cameras, grid.height, grid.width, 1),
    )  # fmt: skip
    return run


def _part(common: _Run, ranks: tuple[int, int], before: _Run | None, library: ctypes.CDLL) -> _Run:
    """One run of Gaussians, with room for all that is made of it."""
    run, grid_cells = _Run.from_buffer_copy(common), common.cameras * common.rows * common.columns
    values, pixels = common.held["values"], common.cell_width * common.cell_height

    def room(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return torch.empty(shape, dtype=dtype)

    run.begin, run.end = ranks
    bands = torch.zeros(3, run.cameras * run.bands + 1, dtype=torch.int32)
    starts = room(run.end - run.begin + 1)
    run.hold(**common.held)
    run.hold(band_items=bands[0], band_strips=bands[1], band_cells=bands[2], starts=starts)
    library.fb_count_items(ctypes.byref(run))
    items, strips, cells = bands[:, -1].tolist()
    run.hold(
        ranks=room(items), places=room(items), table=room(items, run.stride, dtype=values.dtype),
        strip_cells=room(strips), strip_wide=room(strips), lists=room(cells), list_starts=room(grid_cells),
        list_counts=room(grid_cells), light_before=None if before is None else before.held["light"],
        light=room(grid_cells, pixels, dtype=values.dtype),
        stop=room(grid_cells, pixels, dtype=_WHOLE[values.dtype]),
    )  # fmt: skip
    following = bands[0].clone()
    library.fb_place_items(ctypes.byref(run), ctypes.c_void_p(following.data_ptr()))
    return run


class _Compiled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means2d, conics, opacities, values, chosen: Chosen, settings: CompositingSettings):
        library, runs = library_for(values.dtype), list[_Run]()
        common, visible = _start((means2d, conics, opacities, values), chosen, settings), values.shape[0]

        def measure(first: int, last: int) -> None:
            library.fb_spans(ctypes.byref(common), ctypes.c_int64(first), ctypes.c_int64(last))

        in_ranges(measure, visible, threads_for(visible))
        for ranks in slabs(common.held["high"] * common.held["wide"], settings.rows_per_list) or [(0, 0)]:
            run = _part(common, ranks, runs[-1] if runs else None, library)

            def forward(first: int, last: int, run: _Run = run) -> None:
                library.fb_forward(ctypes.byref(run), ctypes.c_int64(first), ctypes.c_int64(last))

            in_parts(forward, run.held["band_cells"], threads_for(int(run.held["band_cells"][-1])))
            runs.append(run)
        images = common.held["colors"], common.held["alphas"]
        for run in runs:
            run.held = {name: run.held[name] for name in _FOR_BACKWARD}
        ctx.save_for_backward(means2d, conics, opacities, values)
        ctx.settings, ctx.runs = settings, runs if any(ctx.needs_input_grad[:4]) else []
        return images

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor, v_alphas: Tensor):  # type: ignore[override]
        means2d, values, runs = ctx.saved_tensors[0], ctx.saved_tensors[3], ctx.runs
        library, absgrad = library_for(values.dtype), ctx.settings.absgrad
        gradients = [
            torch.zeros(means2d.shape, dtype=values.dtype),
            torch.zeros(means2d.shape, dtype=values.dtype) if absgrad else None,
            torch.zeros(*means2d.shape[:2], 3, dtype=values.dtype),
            torch.zeros(means2d.shape[:2], dtype=values.dtype),
            torch.empty(values.shape, dtype=values.dtype),
        ]
        arriving = v_colors.contiguous(), v_alphas.contiguous()
        behind = torch.zeros_like(runs[-1].held["light"]) if len(runs) > 1 else None
        for run in reversed(runs):
            sums = torch.empty_like(run.held["table"])
            way = _Way(*[None if t is None else t.data_ptr() for t in (*arriving, behind, sums)], absgrad)

            def backward(first: int, last: int, run: _Run = run, way: _Way = way) -> None:
                library.fb_backward(ctypes.byref(run), ctypes.c_int64(first), ctypes.c_int64(last), ctypes.byref(way))

            def gather(first: int, last: int, run: _Run = run, sums: Tensor = sums) -> None:
                addresses = [ctypes.c_void_p(None if t is None else t.data_ptr()) for t in (sums, *gradients)]
                library.fb_gather(
                    ctypes.byref(run), ctypes.c_int64(run.begin + first), ctypes.c_int64(run.begin + last), *addresses
                )

            in_parts(backward, run.held["band_cells"], threads_for(int(run.held["band_cells"][-1])))
            in_ranges(gather, run.end - run.begin, threads_for(run.end - run.begin))
        v_means2d, pulls, v_conics, v_opacities, v_values = gradients
        if absgrad:
            # Tensors declare no such attribute; gsplat's strategies read it.
            setattr(means2d, "absgrad", pulls)  # noqa: B010
        return v_means2d, v_conics, v_opacities, v_values, None, None
