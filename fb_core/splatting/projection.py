"""All Gaussians into all cameras: screen ellipses, culling as gsplat does it, and the autograd function around them.

The geometry of one camera is in `footprint`, its gradient in `footprint_gradient`. Gradients flow to means, quats,
scales, covars and viewmats; radii and every culling decision are constants. Backward keeps nothing but its inputs and
works on the drawn rows only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_core.splatting.footprint import Footprint, Lens, compensation, footprint, shapes_of
from fb_core.splatting.footprint_gradient import ScreenGradient, footprint_gradient
from fb_core.splatting.single_thread import single_thread

ALPHA_MIN = 1.0 / 255.0
_LARGEST_RADIUS = 2.0**30


@dataclass(frozen=True, kw_only=True)
class Semantics:
    """In what the versions of gsplat differ (facts checked against 1.4.0, 1.5.3 and 1.6.0)."""

    alpha_cap: float
    """Largest alpha of one Gaussian in one pixel."""
    square_boxes: bool
    """True: a square of three sigma, one radius, and the square cuts; False: an opacity-aware rectangle that cuts
    nothing visible.
    """
    compensation_floor: float
    """Lower limit of the antialiasing factor."""


SEMANTICS = {
    "1.4": Semantics(alpha_cap=0.999, square_boxes=True, compensation_floor=0.0),
    "1.5": Semantics(alpha_cap=0.999, square_boxes=False, compensation_floor=0.0),
    "1.6": Semantics(alpha_cap=0.99, square_boxes=False, compensation_floor=0.005),
}


@dataclass(frozen=True, kw_only=True)
class ProjectionSettings:
    """What is the same for all Gaussians and cameras of a call."""

    width: int
    """Image width, pixels."""
    height: int
    """Image height, pixels."""
    near_plane: float = 0.01
    """Smallest depth z that is drawn."""
    far_plane: float = 1e10
    """Largest depth z that is drawn."""
    radius_clip: float = 0.0
    """Gaussians whose radius is at most this many pixels are not drawn."""
    eps2d: float = 0.3
    """Added to the diagonal of the screen covariance, square pixels."""
    antialiased: bool = False
    """Whether the opacity that decides about culling includes the compensation."""
    semantics: Semantics = SEMANTICS["1.4"]
    """The gsplat version to agree with."""


@dataclass(frozen=True, kw_only=True)
class Projection:
    """C cameras x N Gaussians on the image; rows that are not drawn hold zeros."""

    means2d: Float[Tensor, "c n 2"]
    """Centres in pixels."""
    conics: Float[Tensor, "c n 3"]
    """Upper triangle (xx, xy, yy) of the inverse screen covariance, 1/pixel^2."""
    depths: Float[Tensor, "c n"]
    """Camera z."""
    compensations: Float[Tensor, "c n"]
    """sqrt(det before the blur / det after it), the antialiasing factor."""
    radii: Int32[Tensor, "c n"] | Int32[Tensor, "c n 2"]
    """Half sizes of the screen box, pixels; 0 = not drawn. Constant for autograd."""
    determinants: Float[Tensor, "c n"]
    """Determinant of the blurred screen covariance, pixel^4. Constant for autograd."""


@dataclass(frozen=True, kw_only=True)
class Gaussians:
    """N Gaussians in the world, as `rasterizer.rasterization` is given them."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"] | None
    """Rotations (wxyz) of any length; a zero quaternion is the identity rotation and gets a zero gradient."""
    scales: Float[Tensor, "n 3"] | None
    covars: Float[Tensor, "n 3 3"] | None
    """Where given, in place of quats and scales."""
    opacities: Float[Tensor, " n"]


@dataclass(frozen=True, kw_only=True)
class ProjectionConstants:
    """What decides how Gaussians are projected, and gets no gradient."""

    Ks: Float[Tensor, "c 3 3"]
    opacities: Float[Tensor, " n"]
    usable: Bool[Tensor, " n"] | None
    """Rows where it is False are never drawn; None for all that are."""
    settings: ProjectionSettings

    @staticmethod
    def of(
        splats: Gaussians, Ks: Float[Tensor, "c 3 3"], usable: Bool[Tensor, " n"] | None, settings: ProjectionSettings
    ) -> ProjectionConstants:
        """Of Gaussians and cameras."""
        opacities = splats.opacities.detach().contiguous()
        return ProjectionConstants(Ks=Ks, opacities=opacities, usable=usable, settings=settings)


def project_splats(
    splats: Gaussians,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    usable: Bool[Tensor, " n"] | None,
    settings: ProjectionSettings,
) -> Projection:
    """Project all Gaussians into all cameras, differentiable in means, quats, scales, covars and viewmats.

    Rows where `usable` is False are never drawn. Gradients do not flow to Ks or opacities.
    """
    return projected_by(_Project, splats, viewmats, ProjectionConstants.of(splats, Ks, usable, settings))


def projected_by(
    function: type[torch.autograd.Function],
    splats: Gaussians,
    viewmats: Float[Tensor, "c 4 4"],
    constants: ProjectionConstants,
) -> Projection:
    """What an autograd function of means, quats, scales, covars, viewmats and constants gives, by its names."""
    means2d, conics, depths, compensations, radii, determinants = function.apply(
        splats.means, splats.quats, splats.scales, splats.covars, viewmats, constants
    )
    return Projection(
        means2d=means2d,
        conics=conics,
        depths=depths,
        compensations=compensations,
        radii=radii,
        determinants=determinants,
    )


def _radii(view: Footprint, opacity: Tensor, semantics: Semantics) -> tuple[Tensor, Tensor]:
    """Half width and half height of the screen box, pixels (whole numbers held as floats)."""
    if semantics.square_boxes:
        half_gap = (view.a - view.c).mul_(0.5)
        gap = half_gap.square_().addcmul_(view.b, view.b).clamp_(min=0.01).sqrt_()
        radius = (view.a + view.c).mul_(0.5).add_(gap).sqrt_().mul_(3.0).ceil_()
        return radius, radius
    extent = (opacity * 255.0).clamp_(min=1.0).log_().mul_(2.0).sqrt_().clamp_(max=3.33)
    return (extent * view.a.sqrt()).ceil_(), (extent * view.c.sqrt()).ceil_()


def _hidden(view: Footprint, radii: tuple[Tensor, Tensor], opacity: Tensor, settings: ProjectionSettings) -> Tensor:
    """Which rows are culled: by depth, a degenerate covariance, the radius clip, or for lying beside the image."""
    (rx, ry), u, v = radii, view.u, view.v
    drawn = (view.z >= settings.near_plane) & (view.z <= settings.far_plane)
    drawn &= (view.determinant > 0) & (view.determinant < math.inf)
    drawn &= torch.maximum(rx, ry) > settings.radius_clip
    drawn &= (u + rx > 0) & (u - rx < settings.width) & (v + ry > 0) & (v - ry < settings.height)
    if not settings.semantics.square_boxes:
        drawn &= opacity >= ALPHA_MIN
    return drawn.logical_not_()


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, scales, covars, viewmats, constants: ProjectionConstants):
        cameras, n = viewmats.shape[0], means.shape[0]
        opacities, usable, settings = constants.opacities, constants.usable, constants.settings
        floor, square = settings.semantics.compensation_floor, settings.semantics.square_boxes
        with single_thread():
            lenses = [Lens.of(K, settings.width, settings.height) for K in constants.Ks]
            shapes = shapes_of(quats, scales, covars)
            means2d, conics = means.new_empty(cameras, n, 2), means.new_empty(cameras, n, 3)
            depths, compensations, determinants = (means.new_empty(cameras, n) for _ in range(3))
            radii = torch.zeros((cameras, n) if square else (cameras, n, 2), dtype=torch.int32, device=means.device)
            for camera, lens in enumerate(lenses):
                view = footprint(means, shapes, viewmats[camera], lens, settings.eps2d)
                factor = compensation(view, floor)
                opacity = opacities * factor if settings.antialiased else opacities
                boxes = _radii(view, opacity, settings.semantics)
                hidden = _hidden(view, boxes, opacity, settings)
                if usable is not None:
                    hidden |= ~usable
                over = view.determinant.reciprocal()
                rows = hidden[:, None]
                means2d[camera] = torch.stack([view.u, view.v], dim=1).masked_fill_(rows, 0.0)
                conics[camera] = torch.stack([view.c * over, -view.b * over, view.a * over], dim=1).masked_fill_(
                    rows, 0.0
                )
                depths[camera] = view.z.masked_fill(hidden, 0.0)
                compensations[camera] = factor.masked_fill_(hidden, 0.0)
                determinants[camera] = view.determinant.masked_fill(hidden, 0.0)
                whole = (
                    torch.stack(boxes[:1] if square else boxes, dim=1)
                    .clamp_(max=_LARGEST_RADIUS)
                    .masked_fill_(rows, 0.0)
                )
                radii[camera] = whole[:, 0] if square else whole
        ctx.save_for_backward(means, quats, scales, covars, viewmats, radii)
        ctx.lenses, ctx.settings = lenses, settings
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, determinants)
        return means2d, conics, depths, compensations, radii, determinants

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d, v_conics, v_depths, v_compensations, _radii, _determinants):
        means, quats, scales, covars, viewmats, radii = ctx.saved_tensors
        settings, inputs = ctx.settings, (means, quats, scales, covars, viewmats)
        totals = [
            torch.zeros_like(t) if wanted else None for t, wanted in zip(inputs, ctx.needs_input_grad, strict=False)
        ]
        with single_thread():
            for camera, lens in enumerate(ctx.lenses):
                box = radii[camera] if radii.ndim == 2 else radii[camera, :, 0]
                rows = (box > 0).nonzero()[:, 0]

                def of(tensor: Tensor | None, rows: Tensor = rows) -> Tensor | None:
                    return None if tensor is None else tensor.index_select(0, rows)

                arriving = dict(means2d=v_means2d, conics=v_conics, depths=v_depths, compensations=v_compensations)
                incoming = ScreenGradient(
                    **{name: None if v is None else of(v[camera]) for name, v in arriving.items()}
                )
                shapes, floor = shapes_of(of(quats), of(scales), of(covars)), settings.semantics.compensation_floor
                leaving = footprint_gradient(
                    means.index_select(0, rows), shapes, viewmats[camera], lens, settings.eps2d, floor, incoming
                )
                parts = (leaving.means, leaving.quats, leaving.scales, leaving.covars)
                for total, part in zip(totals, parts, strict=False):
                    if total is not None and part is not None:
                        total.index_add_(0, rows, part)
                if totals[4] is not None:
                    totals[4][camera] = leaving.viewmat
        return (*totals, None)
