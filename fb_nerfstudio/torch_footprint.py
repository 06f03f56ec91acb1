"""The footprint of a Gaussian on the image (EWA splatting) and its gradient, for one camera and in closed form.

With the camera point (x, y, z), the camera's rotation R, and the rotation Q and scales S of a Gaussian:

    J = [[fx/z, 0, -fx sx/z], [0, fy/z, -fy sy/z]],  sx = clamp(x/z),  sy = clamp(y/z)
    G = J R,  H = G Q (2x3),  M = H S^2 H^T + blur I (screen covariance),  X = M^-1 (conic)

Needles decide how this is computed. With N = H_x x H_y (the minors of H), the determinant before the blur is
sum over (k, l, o) of (s_k s_l N_o)^2, a sum of squares, where a c - b^2 would cancel. Likewise in the gradient: X H, in which the
long axis of X cancels that of H, is computed from the same minors,

    X H_x = ((S^2 H_y) x N + blur H_x) / det M,      X H_y = (-(S^2 H_x) x N + blur H_y) / det M,

and every derivative is written with it. In float32 this is a hundred times more accurate for needles than M = J C J^T.
Everything works on columns (n contiguous values each): products of small matrices cost several times more on a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Lens:
    """One pinhole as plain numbers; `left .. bottom` limit x/z and y/z in J, 0.3 half-views beyond the image's border."""

    fx: float
    fy: float
    cx: float
    cy: float
    left: float
    right: float
    top: float
    bottom: float

    @classmethod
    def of(cls, K: Float[Tensor, "3 3"], width: int, height: int) -> Lens:
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
        return cls(
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            left=-(cx / fx + margin_x),
            right=(width - cx) / fx + margin_x,
            top=-(cy / fy + margin_y),
            bottom=(height - cy) / fy + margin_y,
        )


@dataclass(frozen=True, kw_only=True)
class Shapes:
    """The extent of n Gaussians in columns: unit quaternions and scales, or else covariances."""

    unit: Float[Tensor, "4 n"] | None = None
    inverse_length: Float[Tensor, " n"] | None = None
    """1/|q| of the quaternions as given; 0 for a zero quaternion, which stands for the identity and gets no gradient."""
    rotation: Float[Tensor, "3 3 n"] | None = None
    """Q."""
    scales: Float[Tensor, "3 n"] | None = None
    covariance: Float[Tensor, "3 3 n"] | None = None

    @classmethod
    def of(cls, quats: Tensor | None, scales: Tensor | None, covars: Tensor | None) -> Shapes:
        """From quaternions (wxyz) of any length [n, 4] and scales [n, 3], or from covariances [n, 3, 3]."""
        if covars is not None:
            return cls(covariance=covars.permute(1, 2, 0).contiguous())
        unit, inverse_length = _unit_quaternions(quats)
        return cls(unit=unit, inverse_length=inverse_length, rotation=_rotations(unit), scales=scales.t().contiguous())


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """One camera's view of n Gaussians, in columns; the names are those of the formulas above."""

    u: Tensor
    """Centre, pixels."""
    v: Tensor
    x: Tensor
    y: Tensor
    z: Tensor
    jacobian: tuple[Tensor, Tensor, Tensor, Tensor]
    """fx/z, -fx sx/z, fy/z, -fy sy/z."""
    ground: Float[Tensor, "2 3 n"]
    """G."""
    spread: Float[Tensor, "2 3 n"]
    """H; or G C where covariances C are given."""
    a: Tensor
    b: Tensor
    c: Tensor
    sharp_determinant: Tensor
    """Before the blur."""
    determinant: Tensor


def _unit_quaternions(quats: Tensor) -> tuple[Tensor, Tensor]:
    columns = quats.t().contiguous()
    length = columns.square().sum(dim=0).sqrt_()
    if bool((length > 0).all()):
        inverse = length.reciprocal_()
        return columns.mul_(inverse) if columns.data_ptr() != quats.data_ptr() else columns * inverse, inverse
    zero = length <= 0
    inverse = length.masked_fill(zero, 1.0).reciprocal_()
    columns = columns * inverse
    columns[0].masked_fill_(zero, 1.0)
    return columns, inverse.masked_fill_(zero, 0.0)


def _rotations(unit: Float[Tensor, "4 n"]) -> Float[Tensor, "3 3 n"]:
    """Rotation matrices of unit quaternions (wxyz)."""
    w, x, y, z = unit.unbind(0)
    twice = unit[1:] * 2.0
    xx, xy, xz = x * twice[0], x * twice[1], x * twice[2]
    yy, yz, zz = y * twice[1], y * twice[2], z * twice[2]
    wx, wy, wz = (twice * w).unbind(0)
    rotation = unit.new_empty(3, 3, unit.shape[1])
    torch.add(yy, zz, out=rotation[0, 0]).neg_().add_(1.0)
    torch.add(xx, zz, out=rotation[1, 1]).neg_().add_(1.0)
    torch.add(xx, yy, out=rotation[2, 2]).neg_().add_(1.0)
    torch.sub(xy, wz, out=rotation[0, 1])
    torch.add(xy, wz, out=rotation[1, 0])
    torch.add(xz, wy, out=rotation[0, 2])
    torch.sub(xz, wy, out=rotation[2, 0])
    torch.sub(yz, wx, out=rotation[1, 2])
    torch.add(yz, wx, out=rotation[2, 1])
    return rotation


def _through(rows: Float[Tensor, "2 3 n"], matrix: Float[Tensor, "3 3 n"]) -> Float[Tensor, "2 3 n"]:
    """rows times matrix, Gaussian by Gaussian."""
    out = torch.empty_like(rows)
    for row, target in zip(rows.unbind(0), out.unbind(0), strict=True):
        torch.mul(row[0], matrix[0], out=target).addcmul_(row[1], matrix[1]).addcmul_(row[2], matrix[2])
    return out


def _cross(p: Float[Tensor, "3 n"], q: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    out = torch.empty_like(p)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        torch.mul(p[i], q[j], out=out[k]).addcmul_(p[j], q[i], value=-1.0)
    return out


def footprint(means: Float[Tensor, "n 3"], shapes: Shapes, viewmat: Float[Tensor, "4 4"], lens: Lens, blur: float) -> Footprint:
    """Project; what lies in or behind the image plane comes out as garbage, which the caller culls."""
    rotation = viewmat[:3, :3]
    # Centres in double: their rounding is what float32 pictures lose first (1e-5 pixel, times the slope of a footprint).
    exact = torch.addmm(viewmat[:3, 3:].double(), rotation.double(), means.t().double())
    u = exact[0].div(exact[2]).mul_(lens.fx).add_(lens.cx).to(means.dtype)
    v = exact[1].div(exact[2]).mul_(lens.fy).add_(lens.cy).to(means.dtype)
    x, y, z = exact.to(means.dtype).unbind(0)
    over_z = z.reciprocal()
    jx, jy = over_z * lens.fx, over_z * lens.fy
    jxz = (x * over_z).clamp_(lens.left, lens.right).mul_(jx).neg_()
    jyz = (y * over_z).clamp_(lens.top, lens.bottom).mul_(jy).neg_()
    ground = means.new_empty(2, 3, means.shape[0])
    torch.mul(rotation[0][:, None], jx, out=ground[0]).addcmul_(rotation[2][:, None], jxz)
    torch.mul(rotation[1][:, None], jy, out=ground[1]).addcmul_(rotation[2][:, None], jyz)
    if shapes.covariance is None:
        spread = _through(ground, shapes.rotation)
        p, q = spread * shapes.scales
        a, b, c, sharp = (p * p).sum(dim=0), (p * q).sum(dim=0), (q * q).sum(dim=0), _cross(p, q).square_().sum(dim=0)
    else:
        spread = _through(ground, shapes.covariance)
        p, q = spread
        a, b, c = (p * ground[0]).sum(dim=0), (p * ground[1]).sum(dim=0), (q * ground[1]).sum(dim=0)
        sharp = a * c - b * b
    determinant = (a + c).mul_(blur).add_(blur * blur).add_(sharp)
    a.add_(blur)
    c.add_(blur)
    jacobian = (jx, jxz, jy, jyz)
    return Footprint(
        u=u,
        v=v,
        x=x,
        y=y,
        z=z,
        jacobian=jacobian,
        ground=ground,
        spread=spread,
        a=a,
        b=b,
        c=c,
        sharp_determinant=sharp,
        determinant=determinant,
    )


def compensation(view: Footprint, floor: float) -> Tensor:
    """sqrt(det before the blur / det after it), at least `floor`: the factor on the opacity that keeps the energy."""
    return (view.sharp_determinant / view.determinant).clamp_(min=floor * floor).sqrt_()


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
    if shapes.covariance is None:
        v_ground, quats, scales = _axes_gradient(view, shapes, blur, slope, incoming.conics)
    else:
        v_ground, covars = _covariance_gradient(view, blur, slope, incoming.conics)
    v_points, v_rotation = _point_gradient(view, v_ground, viewmat[:3, :3], lens, incoming)
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3, :3] = v_rotation + v_points @ means
    v_viewmat[:3, 3] = v_points.sum(dim=1)
    return WorldGradient(means=v_points.t() @ viewmat[:3, :3], quats=quats, scales=scales, covars=covars, viewmat=v_viewmat)


def _compensation_slope(view: Footprint, floor: float, v: Tensor | None) -> tuple[Tensor, Tensor] | None:
    """(d loss / d compensation^2, 1 - compensation^2): the covariance's gradient is slope ((1 - comp^2) X - blur/det I)."""
    if v is None:
        return None
    value = compensation(view, floor)
    # The root's slope is infinite at 0, where a Gaussian is thinner than float can tell; gsplat's kernels bound it like this.
    slope = 0.5 * v / (value + 1e-6)
    if floor > 0:
        slope.masked_fill_(view.sharp_determinant <= floor * floor * view.determinant, 0.0)
    return slope, 1 - value * value


def _conic_matrix(v_conics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Columns of the symmetric gradient matrix."""
    columns = v_conics.t().contiguous()
    columns[1].mul_(0.5)
    return columns.unbind(0)


def _times(xx: Tensor, xy: Tensor, yy: Tensor, rows: Float[Tensor, "2 3 n"]) -> Float[Tensor, "2 3 n"]:
    """Symmetric 2x2 matrix times rows."""
    out = torch.empty_like(rows)
    torch.mul(rows[0], xx, out=out[0]).addcmul_(rows[1], xy)
    torch.mul(rows[0], xy, out=out[1]).addcmul_(rows[1], yy)
    return out


def _axes_gradient(view: Footprint, shapes: Shapes, blur: float, slope: tuple[Tensor, Tensor] | None, v_conics: Tensor | None):
    """Gradients of G [2, 3, n], quaternions [n, 4] and scales [n, 3].

    With V the gradient of M, the gradient of Q's body axes is N = H^T V H (3x3): scales get 2 s_k N_kk, a rotation about
    axis 3 gets 2 N_12 (s_1^2 - s_2^2), and so on; G gets 2 V H S^2 Q^T.
    """
    H, squares, over = view.spread, shapes.scales.square(), view.determinant.reciprocal()
    minors = _cross(H[0], H[1])
    Y = torch.stack([_cross(squares * H[1], minors), _cross(minors, squares * H[0])]).add_(H, alpha=blur).mul_(over)  # X H
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
    v_scales = N_diagonal.mul_(shapes.scales).mul_(2.0).t()
    torque = torch.stack([2 * N_corner[o] * (squares[k] - squares[m]) for o, (k, m) in enumerate(pairs)])
    VH.mul_(squares).mul_(2.0)
    v_ground = torch.stack([(row * shapes.rotation).sum(dim=1) for row in VH.unbind(0)])
    return v_ground, _quaternion_gradient(shapes, torque), v_scales


def _quaternion_gradient(shapes: Shapes, torque: Float[Tensor, "3 n"]) -> Float[Tensor, "n 4"]:
    """2 q (0, torque) / |q|: a turn w about the body's axes moves the unit quaternion by q (0, w) / 2."""
    w, x, y, z = shapes.unit.unbind(0)
    tx, ty, tz = (torque * (2.0 * shapes.inverse_length)).unbind(0)
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


def _point_gradient(view: Footprint, v_ground: Tensor, rotation: Tensor, lens: Lens, incoming: ScreenGradient) -> tuple[Tensor, Tensor]:
    """Gradients of the camera points [3, n], and of the rotation inside G [3, 3]."""
    jx, jxz, jy, jyz = view.jacobian
    v_rotation = torch.stack([v_ground[0] @ jx, v_ground[1] @ jy, v_ground[0] @ jxz + v_ground[1] @ jyz])
    v_jx, v_jy = rotation[0] @ v_ground[0], rotation[1] @ v_ground[1]
    v_jxz, v_jyz = rotation[2] @ v_ground[0], rotation[2] @ v_ground[1]
    over_z = view.z.reciprocal()
    sx, sy = view.x * over_z, view.y * over_z
    # J = f/z and -f s/z. Where the clamp does not act, s moves as well, by dx/z - (x/z) dz/z; where it acts, only z moves J.
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
