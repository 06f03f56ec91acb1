"""The gradient of `footprint.footprint` in closed form; nothing is kept from the forward pass.

In the notation of that file, the gradient of the conic X reaches everything through X H, in which the long axis of a
needle's covariance cancels against that of its conic. So X H is computed from the minors N = H_x x H_y, where nothing
cancels:

    X H_x = ((S^2 H_y) x N + blur H_x) / det M,      X H_y = (-(S^2 H_x) x N + blur H_y) / det M

On the golden scene `stress_5ch` in float32 the quaternions' gradient is then right to 1e-4, against 0.16 through -X V X
with V the conic's gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.splatting.footprint import Axes, Footprint, Lens, Shapes, compensation, cross, footprint


@dataclass(frozen=True, kw_only=True)
class ScreenGradient:
    """What arrives from the image, for n Gaussians; None = nothing."""

    means2d: Float[Tensor, "n 2"] | None
    conics: Float[Tensor, "n 3"] | None
    """xx, xy, yy, where xy is one parameter that stands in both corners."""
    depths: Float[Tensor, " n"] | None
    compensations: Float[Tensor, " n"] | None


@dataclass(frozen=True, kw_only=True)
class WorldGradient:
    """What leaves to the Gaussians and the camera."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"] | None
    scales: Float[Tensor, "n 3"] | None
    covars: Float[Tensor, "n 3 3"] | None
    viewmat: Float[Tensor, "4 4"]


def footprint_gradient(
    means: Float[Tensor, "n 3"],
    shapes: Shapes,
    viewmat: Float[Tensor, "4 4"],
    lens: Lens,
    blur: float,
    floor: float,
    incoming: ScreenGradient,
) -> WorldGradient:
    """Gradient of `footprint`; nothing has to be kept from the forward pass."""
    view = footprint(means, shapes, viewmat, lens, blur)
    slope = _compensation_slope(view, floor, incoming.compensations)
    quats = scales = covars = None
    if isinstance(shapes, Axes):
        v_ground, quats, scales = _axes_gradient(view, shapes, blur, slope, incoming.conics)
    else:
        v_ground, covars = _covariance_gradient(view, blur, slope, incoming.conics)
    v_points, v_rotation = _point_gradient(view, v_ground, viewmat[:3, :3], lens, incoming)
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3, :3] = v_rotation + v_points @ means
    v_viewmat[:3, 3] = v_points.sum(dim=1)
    return WorldGradient(
        means=v_points.t() @ viewmat[:3, :3], quats=quats, scales=scales, covars=covars, viewmat=v_viewmat
    )


def _compensation_slope(view: Footprint, floor: float, v: Tensor | None) -> tuple[Tensor, Tensor] | None:
    """(d loss / d compensation^2, 1 - compensation^2): the covariance's gradient is slope ((1 - comp^2) X - blur/det
    I).
    """
    if v is None:
        return None
    value = compensation(view, floor)
    # The root's slope is infinite at 0, where a Gaussian is thinner than float can tell; gsplat's kernels bound it like
    # this.
    slope = 0.5 * v / (value + 1e-6)
    if floor > 0:
        slope.masked_fill_(view.sharp_determinant <= floor * floor * view.determinant, 0.0)
    return slope, 1 - value * value


def _conic_matrix(v_conics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Columns of the symmetric gradient matrix."""
    columns = v_conics.t().contiguous()
    return columns[0], columns[1].mul_(0.5), columns[2]


def _times(xx: Tensor, xy: Tensor, yy: Tensor, rows: Float[Tensor, "2 3 n"]) -> Float[Tensor, "2 3 n"]:
    """Symmetric 2x2 matrix times rows."""
    out = torch.empty_like(rows)
    torch.mul(rows[0], xx, out=out[0]).addcmul_(rows[1], xy)
    torch.mul(rows[0], xy, out=out[1]).addcmul_(rows[1], yy)
    return out


def _axes_gradient(
    view: Footprint, axes: Axes, blur: float, slope: tuple[Tensor, Tensor] | None, v_conics: Tensor | None
):
    """Gradients of G [2, 3, n], quaternions [n, 4] and scales [n, 3].

    With V the gradient of M, the gradient of Q's body axes is N = H^T V H (3x3): scales get 2 s_k N_kk, a rotation
    about axis 3 gets 2 N_12 (s_1^2 - s_2^2), and so on; G gets 2 V H S^2 Q^T.
    """
    H, squares, over = view.spread, axes.scales.square(), view.determinant.reciprocal()
    minors = cross(H[0], H[1])
    Y = (
        torch.stack([cross(squares * H[1], minors), cross(minors, squares * H[0])]).add_(H, alpha=blur).mul_(over)
    )  # X H
    VH = torch.zeros_like(H)  # V H, and N = H^T V H
    N_diagonal, N_corner = torch.zeros_like(squares), torch.zeros_like(squares)
    pairs = ((1, 2), (2, 0), (0, 1))
    if v_conics is not None:
        W = _times(*_conic_matrix(v_conics), Y)
        VH.sub_(_times(view.c * over, -view.b * over, view.a * over, W))
        N_diagonal.sub_((Y * W).sum(dim=0))
        for o, (k, m) in enumerate(pairs):
            N_corner[o].addcmul_(Y[0, k], W[0, m], value=-1.0).addcmul_(Y[1, k], W[1, m], value=-1.0)
    if slope is not None:
        U = (Y * slope[1]).sub_(H * (blur * over)).mul_(slope[0])
        VH.add_(U)
        N_diagonal.add_((H * U).sum(dim=0))
        for o, (k, m) in enumerate(pairs):
            N_corner[o].addcmul_(H[0, k], U[0, m]).addcmul_(H[1, k], U[1, m])
    v_scales = N_diagonal.mul_(axes.scales).mul_(2.0).t()
    torque = torch.stack([2 * N_corner[o] * (squares[k] - squares[m]) for o, (k, m) in enumerate(pairs)])
    VH.mul_(squares).mul_(2.0)
    v_ground = torch.stack([(row * axes.rotation).sum(dim=1) for row in VH.unbind(0)])
    return v_ground, _quaternion_gradient(axes, torque), v_scales


def _quaternion_gradient(axes: Axes, torque: Float[Tensor, "3 n"]) -> Float[Tensor, "n 4"]:
    """2 q (0, torque) / |q|: a turn w about the body's axes moves the unit quaternion by q (0, w) / 2."""
    w, x, y, z = axes.unit.unbind(0)
    tx, ty, tz = (torque * (2.0 * axes.inverse_length)).unbind(0)
    return torch.stack(
        [
            -(x * tx) - y * ty - z * tz,
            w * tx + y * tz - z * ty,
            w * ty + z * tx - x * tz,
            w * tz + x * ty - y * tx,
        ],
        dim=1,
    )


def _covariance_gradient(view: Footprint, blur: float, slope: tuple[Tensor, Tensor] | None, v_conics: Tensor | None):
    """Gradients of G [2, 3, n] and of the given covariances [n, 3, 3]: 2 V G C and G^T V G."""
    over = view.determinant.reciprocal()
    A, B, C = view.c * over, -view.b * over, view.a * over
    Vxx = Vxy = Vyy = torch.zeros_like(A)
    if v_conics is not None:
        vA, vB, vC = _conic_matrix(v_conics)
        p00, p01, p10, p11 = A * vA + B * vB, A * vB + B * vC, B * vA + C * vB, B * vB + C * vC
        Vxx, Vxy, Vyy = -(p00 * A + p01 * B), -(p00 * B + p01 * C), -(p10 * B + p11 * C)
    if slope is not None:
        Vxx = Vxx + slope[0] * (slope[1] * A - blur * over)
        Vxy = Vxy + slope[0] * slope[1] * B
        Vyy = Vyy + slope[0] * (slope[1] * C - blur * over)
    G = view.ground
    VG = _times(Vxx, Vxy, Vyy, G)
    v_covars = (G[:, :, None] * VG[:, None]).sum(dim=0).permute(2, 0, 1)
    return _times(Vxx, Vxy, Vyy, view.spread).mul_(2.0), v_covars


def _point_gradient(
    view: Footprint, v_ground: Tensor, rotation: Tensor, lens: Lens, incoming: ScreenGradient
) -> tuple[Tensor, Tensor]:
    """Gradients of the camera points [3, n], and of the rotation inside G [3, 3]."""
    jx, jxz, jy, jyz = view.jacobian
    v_rotation = torch.stack([v_ground[0] @ jx, v_ground[1] @ jy, v_ground[0] @ jxz + v_ground[1] @ jyz])
    v_jx, v_jy = rotation[0] @ v_ground[0], rotation[1] @ v_ground[1]
    v_jxz, v_jyz = rotation[2] @ v_ground[0], rotation[2] @ v_ground[1]
    over_z = view.z.reciprocal()
    sx, sy = view.x * over_z, view.y * over_z
    # J = f/z and -f s/z. Where the clamp does not act, s moves as well, by dx/z - (x/z) dz/z; where it acts, only z
    # moves J.
    v_sx = (v_jxz * jx).neg_().masked_fill_((sx < lens.left) | (sx > lens.right), 0.0)
    v_sy = (v_jyz * jy).neg_().masked_fill_((sy < lens.top) | (sy > lens.bottom), 0.0)
    if incoming.means2d is not None:
        v_sx.add_(incoming.means2d[:, 0], alpha=lens.fx)
        v_sy.add_(incoming.means2d[:, 1], alpha=lens.fy)
    v_z = (v_jx * jx).addcmul_(v_jxz, jxz).addcmul_(v_jy, jy).addcmul_(v_jyz, jyz).addcmul_(v_sx, sx).addcmul_(v_sy, sy)
    v_z = v_z.mul_(over_z).neg_()
    if incoming.depths is not None:
        v_z.add_(incoming.depths)
    return torch.stack([v_sx * over_z, v_sy * over_z, v_z]), v_rotation
