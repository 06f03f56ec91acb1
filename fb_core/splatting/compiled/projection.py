"""`project_splats` of ../projection.py by the compiled library: same arguments, same culling, same gradients.

Ranges of Gaussians go to several threads. What a camera gains from its Gaussians is summed chunk by chunk and then over
the chunks: any number of threads gives the same bits.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_core.splatting.compiled.library import library_for
from fb_core.splatting.compiled.threads import in_ranges, threads_for
from fb_core.splatting.footprint import Lens
from fb_core.splatting.projection import (
    Gaussians,
    Projection,
    ProjectionConstants,
    ProjectionSettings,
    projected_by,
)

_CHUNK = 2048
"""`CHUNK` of projection.c."""


class _Splats(ctypes.Structure):
    """`Splats` of projection.c."""

    _fields_ = [
        ("number", ctypes.c_int64),
        *[(name, ctypes.c_void_p) for name in ("means", "quats", "scales", "covars", "opacities", "usable")],
    ]


class _Camera(ctypes.Structure):
    """`Camera` of projection.c."""

    _fields_ = [
        ("view", ctypes.c_double * 12),
        *[(name, ctypes.c_double) for name in ("fx", "fy", "cx", "cy", "left", "right", "top", "bottom")],
        *[(name, ctypes.c_double) for name in ("width", "height", "near", "far", "clip", "blur", "floor")],
        *[(name, ctypes.c_int32) for name in ("antialiased", "square")],
    ]


class _Pointers(ctypes.Structure):
    """`Screen` and `Gradients` of projection.c, which are addresses alone."""

    _fields_ = [("addresses", ctypes.c_void_p * 10)]


def project_compiled(
    splats: Gaussians,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    usable: Bool[Tensor, " n"] | None,
    settings: ProjectionSettings,
) -> Projection:
    """As `projection.project_splats`; the library must have been made (`library.loaded`)."""
    constants = ProjectionConstants.of(splats, Ks, usable, settings)
    return projected_by(_CompiledProjection, splats, viewmats, constants)


def _pointers(*tensors: Tensor | None) -> _Pointers:
    addresses = [None if tensor is None else tensor.data_ptr() for tensor in tensors]
    return _Pointers((ctypes.c_void_p * 10)(*addresses))


def _splats(held: list[Tensor | None], constants: ProjectionConstants) -> _Splats:
    """Of contiguous means, quats, scales, covars; covars take the place of the two before."""
    means, usable = held[0], constants.usable
    assert means is not None, "means are always given"
    columns = (*held, constants.opacities, usable)
    return _Splats(means.shape[0], *[None if tensor is None else tensor.data_ptr() for tensor in columns])


def _camera(viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], settings: ProjectionSettings) -> _Camera:
    lens, rules = Lens.of(K, settings.width, settings.height), settings.semantics
    return _Camera(
        (ctypes.c_double * 12)(*viewmat[:3].flatten().tolist()),
        lens.fx, lens.fy, lens.cx, lens.cy, lens.left, lens.right, lens.top, lens.bottom,
        settings.width, settings.height, settings.near_plane, settings.far_plane, settings.radius_clip,
        settings.eps2d, rules.compensation_floor, settings.antialiased, rules.square_boxes,
    )  # fmt: skip


def _contiguous(tensors: tuple[Tensor | None, ...]) -> list[Tensor | None]:
    return [None if tensor is None else tensor.contiguous() for tensor in tensors]


class _CompiledProjection(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means, quats, scales, covars, viewmats, constants: ProjectionConstants):
        settings, cameras, n = constants.settings, viewmats.shape[0], means.shape[0]
        library, held = library_for(means.dtype), _contiguous((means, quats, scales, covars))
        splats, views = _splats(held, constants), []
        means2d, conics = means.new_empty(cameras, n, 2), means.new_empty(cameras, n, 3)
        depths, compensations, determinants = (means.new_empty(cameras, n) for _ in range(3))
        square = settings.semantics.square_boxes
        radii = torch.empty((cameras, n) if square else (cameras, n, 2), dtype=torch.int32)
        for number in range(cameras):
            camera = _camera(viewmats[number], constants.Ks[number], settings)
            columns = (means2d, conics, depths, compensations, determinants, radii)
            screen = _pointers(*[column[number] for column in columns])

            def project(first: int, last: int, camera: _Camera = camera, screen: _Pointers = screen) -> None:
                library.fb_project(
                    ctypes.byref(splats), ctypes.byref(camera), ctypes.c_int64(first), ctypes.c_int64(last),
                    ctypes.byref(screen),
                )  # fmt: skip

            in_ranges(project, n, threads_for(n))
            views.append(camera)
        ctx.save_for_backward(means, quats, scales, covars, viewmats, radii)
        ctx.views, ctx.constants = views, constants
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, determinants)
        return means2d, conics, depths, compensations, radii, determinants

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *arriving: Tensor | None):  # type: ignore[override]
        inputs, radii = ctx.saved_tensors[:5], ctx.saved_tensors[5]
        totals = [
            None if tensor is None or not wanted else torch.zeros(tensor.shape, dtype=tensor.dtype)
            for tensor, wanted in zip(inputs, ctx.needs_input_grad, strict=False)
        ]
        held, upstream = _contiguous(inputs[:4]), _contiguous(arriving[:4])
        for number, camera in enumerate(ctx.views):
            incoming = [None if tensor is None else tensor[number] for tensor in upstream]
            view = _camera_gradient(held, (camera, ctx.constants), incoming, radii[number], totals)
            if view is not None and totals[4] is not None:
                totals[4][number, :3] = view
        return (*totals, None)


def _camera_gradient(
    held: list[Tensor | None],
    drawn_by: tuple[_Camera, ProjectionConstants],
    incoming: list[Tensor | None],
    radii: Int32[Tensor, " n"] | Int32[Tensor, "n 2"],
    totals: list[Tensor | None],
) -> Float[Tensor, "3 4"] | None:
    """Add what arrives at one camera's screen to the totals; returns the gradient of its matrix, if that is wanted."""
    camera, constants = drawn_by
    splats, chunks = _splats(held, constants), -(-radii.shape[0] // _CHUNK)
    view = None if totals[4] is None else torch.zeros(chunks, 12, dtype=torch.float64)
    axes = (None, None) if held[3] is not None else totals[1:3]  # covars take their place
    gradients = _pointers(*incoming, radii, totals[0], *axes, totals[3], view)
    library = library_for(constants.opacities.dtype)

    def backward(first: int, last: int) -> None:
        library.fb_project_backward(
            ctypes.byref(splats), ctypes.byref(camera), ctypes.c_int64(first), ctypes.c_int64(last),
            ctypes.byref(gradients),
        )  # fmt: skip

    in_ranges(backward, chunks, threads_for(radii.shape[0]))
    return None if view is None else view.sum(dim=0).view(3, 4)
