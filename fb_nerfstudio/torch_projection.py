"""Gaussians in the world -> ellipses on the image: the EWA projection, its culling and its analytic gradient.

The notation is that of `docs/conventions.md`: world_to_camera matrices with OpenCV axes, pixel centres at +0.5. With the
camera point (x, y, z), the rotation R of the camera, the rotation Q and the scales S of a Gaussian:

    G = J R (2x3),  J = [[fx/z, 0, -fx tx/z^2], [0, fy/z, -fy ty/z^2]],  tx = z clamp(x/z),  ty = z clamp(y/z)
    axes = G Q S (2x3),  covariance = axes axes^T + eps2d I,  conic = its inverse

The 2x3 matrix `axes` is kept instead of the 3x3 covariance: the determinant before the blur is then |axes_x x axes_y|^2,
which stays exact in float32 for needles, where a c - b^2 cancels. Everything works on columns (one contiguous tensor of n
values each), because small matrix products cost several times more on a CPU.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor
from torch.autograd.function import once_differentiable

from fb_nerfstudio.single_thread import single_thread

ALPHA_MIN = 1.0 / 255.0
_LARGEST_RADIUS = 2.0**30


@dataclass(frozen=True, kw_only=True)
class Semantics:
    """In what the versions of gsplat differ (facts checked against 1.4.0, 1.5.3 and 1.6.0)."""

    alpha_cap: float
    """Largest alpha of one Gaussian in one pixel."""
    square_boxes: bool
    """True: a square of three sigma, one radius, and the square cuts; False: an opacity-aware rectangle that cuts nothing visible."""
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


def project_splats(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, " n"],
    covars: Float[Tensor, "n 3 3"] | None,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    usable: Bool[Tensor, " n"] | None,
    settings: ProjectionSettings,
) -> Projection:
    """Project all Gaussians into all cameras, differentiable in means, quats, scales, covars and viewmats.

    `quats` (wxyz) may have any length; a zero quaternion is the identity rotation and gets a zero gradient. `covars`, where
    given, replaces quats and scales. Rows where `usable` is False are never drawn. Gradients do not flow to Ks or opacities.
    """
    return Projection(
        **dict(
            zip(
                ("means2d", "conics", "depths", "compensations", "radii", "determinants"),
                _Project.apply(means, quats, scales, covars, viewmats, opacities.detach(), Ks, usable, settings),
                strict=True,
            )
        )
    )


@dataclass(frozen=True, kw_only=True)
class _Lens:
    """One pinhole as plain numbers; `left .. bottom` limit x/z and y/z inside the Jacobian (0.3 half-views beyond the border)."""

    fx: float
    fy: float
    cx: float
    cy: float
    left: float
    right: float
    top: float
    bottom: float

    @classmethod
    def of(cls, K: Float[Tensor, "3 3"], settings: ProjectionSettings) -> _Lens:
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        margin_x, margin_y = 0.3 * 0.5 * settings.width / fx, 0.3 * 0.5 * settings.height / fy
        return cls(
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            left=-(cx / fx + margin_x),
            right=(settings.width - cx) / fx + margin_x,
            top=-(cy / fy + margin_y),
            bottom=(settings.height - cy) / fy + margin_y,
        )


@dataclass(frozen=True, kw_only=True)
class _Screen:
    """One camera's projection in columns; forward and backward both start from it."""

    x: Tensor
    y: Tensor
    z: Tensor
    slope_x: Tensor
    """Clamped x/z."""
    slope_y: Tensor
    """Clamped y/z."""
    jacobian: tuple[Tensor, Tensor, Tensor, Tensor]
    """fx/z, -fx tx/z^2, fy/z, -fy ty/z^2."""
    world_to_screen: Tensor
    """G [2, 3, n]."""
    a: Tensor
    b: Tensor
    c: Tensor
    sharp_determinant: Tensor
    """Determinant before the blur."""
    determinant: Tensor


@dataclass(frozen=True, kw_only=True)
class _Shape:
    """The Gaussians' extent, in columns: either unit quaternions and scales, or covariances."""

    rotation: Tensor | None = None
    """Q [3, 3, n]."""
    scales: Tensor | None = None
    """S [3, n]."""
    covariance: Tensor | None = None
    """[3, 3, n]."""


def _unit_quaternions(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Columns [4, n] of q/|q| and 1/|q| (0 for a zero quaternion, which becomes the identity)."""
    columns = quats.t().contiguous()
    length = columns.square().sum(dim=0).sqrt_()
    if bool((length > 0).all()):
        inverse = length.reciprocal_()
        return columns * inverse, inverse
    zero = length <= 0
    inverse = length.masked_fill(zero, 1.0).reciprocal_()
    columns = columns * inverse
    columns[0].masked_fill_(zero, 1.0)
    return columns, inverse.masked_fill_(zero, 0.0)


def _rotation_columns(unit: Tensor) -> Tensor:
    """Rotation matrices [3, 3, n] of unit quaternions (wxyz) [4, n]."""
    w, x, y, z = unit.unbind(0)
    twice = unit[1:] * 2.0
    xx, xy, xz = x * twice[0], x * twice[1], x * twice[2]
    yy, yz, zz = y * twice[1], y * twice[2], z * twice[2]
    wx, wy, wz = (twice * w).unbind(0)
    rotation = unit.new_empty(3, 3, unit.shape[1])
    torch.add(yy, zz, out=rotation[0, 0])
    torch.add(xx, zz, out=rotation[1, 1])
    torch.add(xx, yy, out=rotation[2, 2])
    for diagonal in (rotation[0, 0], rotation[1, 1], rotation[2, 2]):
        diagonal.neg_().add_(1.0)
    torch.sub(xy, wz, out=rotation[0, 1])
    torch.add(xy, wz, out=rotation[1, 0])
    torch.add(xz, wy, out=rotation[0, 2])
    torch.sub(xz, wy, out=rotation[2, 0])
    torch.sub(yz, wx, out=rotation[1, 2])
    torch.add(yz, wx, out=rotation[2, 1])
    return rotation


def _quaternion_gradient(unit: Tensor, inverse_length: Tensor, v: Tensor) -> Tensor:
    """Gradient [4, n] of the quaternions as given, from the gradient v [3, 3, n] of their rotation matrices."""
    w, x, y, z = unit.unbind(0)
    xy, xz, yz = v[0, 1] + v[1, 0], v[0, 2] + v[2, 0], v[1, 2] + v[2, 1]
    wx, wy, wz = v[2, 1] - v[1, 2], v[0, 2] - v[2, 0], v[1, 0] - v[0, 1]
    gradient = torch.stack(
        [
            x * wx + y * wy + z * wz,
            y * xy + z * xz + w * wx - 2 * x * (v[1, 1] + v[2, 2]),
            x * xy + z * yz + w * wy - 2 * y * (v[0, 0] + v[2, 2]),
            x * xz + y * yz + w * wz - 2 * z * (v[0, 0] + v[1, 1]),
        ]
    ).mul_(2.0)
    along = (gradient * unit).sum(dim=0)
    return gradient.addcmul_(unit, along, value=-1.0).mul_(inverse_length)


def _screen(means: Tensor, shape: _Shape, viewmat: Tensor, lens: _Lens, eps2d: float) -> _Screen:
    """Project the columns of one camera; rows in or behind the image plane come out as garbage and are culled by the caller."""
    rotation = viewmat[:3, :3]
    x, y, z = torch.addmm(viewmat[:3, 3:], rotation, means.t()).unbind(0)
    over_z = z.reciprocal()
    slope_x = (x * over_z).clamp_(lens.left, lens.right)
    slope_y = (y * over_z).clamp_(lens.top, lens.bottom)
    jx, jy = over_z * lens.fx, over_z * lens.fy
    jxz, jyz = (jx * slope_x).neg_(), (jy * slope_y).neg_()
    ground = means.new_empty(2, 3, means.shape[0])
    torch.mul(rotation[0][:, None], jx, out=ground[0]).addcmul_(rotation[2][:, None], jxz)
    torch.mul(rotation[1][:, None], jy, out=ground[1]).addcmul_(rotation[2][:, None], jyz)
    if shape.covariance is None:
        axes = _through(ground, shape.rotation).mul_(shape.scales)
        u, v = axes.unbind(0)
        a, b, c = (u * u).sum(dim=0), (u * v).sum(dim=0), (v * v).sum(dim=0)
        cross_x, cross_y, cross_z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        sharp = (cross_x * cross_x).addcmul_(cross_y, cross_y).addcmul_(cross_z, cross_z)
    else:
        spread = _through(ground, shape.covariance)
        a, b, c = (spread[0] * ground[0]).sum(dim=0), (spread[0] * ground[1]).sum(dim=0), (spread[1] * ground[1]).sum(dim=0)
        sharp = a * c - b * b
    determinant = (a + c).mul_(eps2d).add_(eps2d * eps2d).add_(sharp)
    return _Screen(
        x=x,
        y=y,
        z=z,
        slope_x=slope_x,
        slope_y=slope_y,
        jacobian=(jx, jxz, jy, jyz),
        world_to_screen=ground,
        a=a.add_(eps2d),
        b=b,
        c=c.add_(eps2d),
        sharp_determinant=sharp,
        determinant=determinant,
    )


def _through(rows: Tensor, matrix: Tensor) -> Tensor:
    """rows [2, 3, n] times matrix [3, 3, n] -> [2, 3, n], Gaussian by Gaussian."""
    return torch.stack([(row[0] * matrix[0]).addcmul_(row[1], matrix[1]).addcmul_(row[2], matrix[2]) for row in rows.unbind(0)])


def _compensation(screen: _Screen, floor: float) -> Tensor:
    return (screen.sharp_determinant / screen.determinant).clamp_(min=floor * floor).sqrt_()


def _radii(screen: _Screen, opacity: Tensor, semantics: Semantics) -> tuple[Tensor, Tensor]:
    """Half width and half height of the screen box, pixels (whole numbers held as floats)."""
    if semantics.square_boxes:
        middle = (screen.a + screen.c).mul_(0.5)
        half_gap = (screen.a - screen.c).mul_(0.5)
        gap = half_gap.square_().addcmul_(screen.b, screen.b).clamp_(min=0.01).sqrt_()
        radius = middle.add_(gap).sqrt_().mul_(3.0).ceil_()
        return radius, radius
    extent = (opacity * 255.0).clamp_(min=1.0).log_().mul_(2.0).sqrt_().clamp_(max=3.33)
    return (extent * screen.a.sqrt()).ceil_(), (extent * screen.c.sqrt()).ceil_()


def _drawn(screen: _Screen, u: Tensor, v: Tensor, radii: tuple[Tensor, Tensor], opacity: Tensor, settings: ProjectionSettings) -> Tensor:
    """Which rows survive culling: depth range, a proper covariance, the radius clip, the image border."""
    rx, ry = radii
    drawn = (screen.z >= settings.near_plane) & (screen.z <= settings.far_plane)
    drawn &= (screen.determinant > 0) & (screen.determinant < math.inf)
    drawn &= torch.maximum(rx, ry) > settings.radius_clip
    drawn &= (u + rx > 0) & (u - rx < settings.width) & (v + ry > 0) & (v - ry < settings.height)
    if not settings.semantics.square_boxes:
        drawn &= opacity >= ALPHA_MIN
    return drawn


class _Project(torch.autograd.Function):
    """Forward keeps no intermediate: backward recomputes the columns of the drawn rows, which costs less than storing them."""

    @staticmethod
    def forward(ctx, means, quats, scales, covars, viewmats, opacities, Ks, usable, settings: ProjectionSettings):
        cameras, n = viewmats.shape[0], means.shape[0]
        with single_thread():
            if covars is None:
                shape = _Shape(rotation=_rotation_columns(_unit_quaternions(quats)[0]), scales=scales.t().contiguous())
            else:
                shape = _Shape(covariance=covars.permute(1, 2, 0).contiguous())
            lenses = [_Lens.of(K, settings) for K in Ks]
            means2d, conics = means.new_empty(cameras, n, 2), means.new_empty(cameras, n, 3)
            depths, compensations, determinants = (means.new_empty(cameras, n) for _ in range(3))
            square = settings.semantics.square_boxes
            radii = torch.zeros((cameras, n) if square else (cameras, n, 2), dtype=torch.int32, device=means.device)
            for camera, lens in enumerate(lenses):
                screen = _screen(means, shape, viewmats[camera], lens, settings.eps2d)
                u, v = (screen.x * lens.fx / screen.z).add_(lens.cx), (screen.y * lens.fy / screen.z).add_(lens.cy)
                compensation = _compensation(screen, settings.semantics.compensation_floor)
                opacity = opacities * compensation if settings.antialiased else opacities
                boxes = _radii(screen, opacity, settings.semantics)
                hidden = ~_drawn(screen, u, v, boxes, opacity, settings)
                if usable is not None:
                    hidden |= ~usable
                over = screen.determinant.reciprocal()
                torch.stack([u, v], dim=-1, out=means2d[camera]).masked_fill_(hidden[:, None], 0.0)
                torch.stack([screen.c * over, (screen.b * over).neg_(), screen.a * over], dim=-1, out=conics[camera])
                conics[camera].masked_fill_(hidden[:, None], 0.0)
                torch.mul(screen.z, 1.0, out=depths[camera]).masked_fill_(hidden, 0.0)
                torch.mul(compensation, 1.0, out=compensations[camera]).masked_fill_(hidden, 0.0)
                torch.mul(screen.determinant, 1.0, out=determinants[camera]).masked_fill_(hidden, 0.0)
                whole = [radius.masked_fill(hidden, 0.0).clamp_(max=_LARGEST_RADIUS) for radius in (boxes[:1] if square else boxes)]
                radii[camera].copy_(whole[0] if square else torch.stack(whole, dim=-1))
        ctx.save_for_backward(means, quats, scales, covars, viewmats, radii)
        ctx.lenses, ctx.settings = lenses, settings
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, determinants)
        return means2d, conics, depths, compensations, radii, determinants

    @staticmethod
    @once_differentiable
    def backward(ctx, v_means2d, v_conics, v_depths, v_compensations, _radii, _determinants):
        means, quats, scales, covars, viewmats, radii = ctx.saved_tensors
        totals = [
            torch.zeros_like(t) if t is not None and wanted else None
            for t, wanted in zip((means, quats, scales, covars, viewmats), ctx.needs_input_grad[:5], strict=True)
        ]
        incoming = (v_means2d, v_conics, v_depths, v_compensations)
        if all(gradient is None for gradient in incoming):
            return (*totals, None, None, None, None)
        with single_thread():
            for camera, lens in enumerate(ctx.lenses):
                box = radii[camera] if radii.ndim == 2 else radii[camera, :, 0]
                rows = (box > 0).nonzero()[:, 0]
                chosen = [None if t is None else t.index_select(0, rows) for t in (means, quats, scales, covars)]
                columns = [None if g is None else g[camera].index_select(0, rows) for g in incoming]
                parts = _camera_backward(chosen, viewmats[camera], lens, ctx.settings, columns)
                for total, part in zip(totals[:4], parts[:4], strict=True):
                    if total is not None and part is not None:
                        total.index_add_(0, rows, part)
                if totals[4] is not None:
                    totals[4][camera] = parts[4]
        return (*totals, None, None, None, None)


def _covariance_gradient(screen: _Screen, v_conic: Tensor | None, v_compensation: Tensor | None, settings: ProjectionSettings):
    """Gradient of the blurred screen covariance as columns (xx, xy counted once for both corners, yy)."""
    over = screen.determinant.reciprocal()
    A, B, C = screen.c * over, -screen.b * over, screen.a * over
    va = vb = vc = torch.zeros_like(A)
    if v_conic is not None:
        vA, vB, vC = v_conic.unbind(-1)
        half = 0.5 * vB
        p00, p01, p10, p11 = A * vA + B * half, A * half + B * vC, B * vA + C * half, B * half + C * vC
        va, vb, vc = -(p00 * A + p01 * B), -2 * (p00 * B + p01 * C), -(p10 * B + p11 * C)
    if v_compensation is not None:
        floor = settings.semantics.compensation_floor
        compensation = _compensation(screen, floor)
        # The square root has an infinite slope at 0; gsplat's kernels bound it in this way.
        slope = 0.5 * v_compensation / (compensation + 1e-6)
        if floor > 0:
            slope = slope.masked_fill(screen.sharp_determinant <= floor * floor * screen.determinant, 0.0)
        rest, blur = 1 - compensation * compensation, settings.eps2d * over
        va, vb, vc = va + slope * (rest * A - blur), vb + 2 * slope * rest * B, vc + slope * (rest * C - blur)
    return va, vb, vc


def _camera_backward(chosen, viewmat: Tensor, lens: _Lens, settings: ProjectionSettings, incoming):
    """Gradients of (means, quats, scales, covars) for the chosen rows, and of the camera matrix."""
    means, quats, scales, covars = chosen
    v_means2d, v_conics, v_depths, v_compensations = incoming
    unit, inverse_length = (None, None) if covars is not None else _unit_quaternions(quats)
    if covars is None:
        shape = _Shape(rotation=_rotation_columns(unit), scales=scales.t().contiguous())
    else:
        shape = _Shape(covariance=covars.permute(1, 2, 0).contiguous())
    screen = _screen(means, shape, viewmat, lens, settings.eps2d)
    va, vb, vc = _covariance_gradient(screen, v_conics, v_compensations, settings)
    ground = screen.world_to_screen
    v_quats = v_scales = v_covars = None
    if covars is None:
        sharp_axes = _through(ground, shape.rotation)
        u, v = (sharp_axes * shape.scales).unbind(0)
        v_axes = torch.stack([2 * va * u + vb * v, vb * u + 2 * vc * v])
        v_scales = (v_axes * sharp_axes).sum(dim=0).t()
        v_axes *= shape.scales
        v_rotation = ground[0][:, None] * v_axes[0] + ground[1][:, None] * v_axes[1]
        v_quats = _quaternion_gradient(unit, inverse_length, v_rotation).t()
        v_ground = torch.stack([(row * shape.rotation).sum(dim=1) for row in v_axes.unbind(0)])
    else:
        spread = _through(ground, shape.covariance)
        v_ground = torch.stack([2 * va * spread[0] + vb * spread[1], vb * spread[0] + 2 * vc * spread[1]])
        g0, g1 = ground.unbind(0)
        cross = g0[:, None] * g1[None] + g1[:, None] * g0[None]
        v_covars = (va * g0[:, None] * g0[None] + 0.5 * vb * cross + vc * g1[:, None] * g1[None]).permute(2, 0, 1)
    v_points, v_rotation_camera = _point_gradient(screen, v_ground, viewmat[:3, :3], lens, v_means2d, v_depths)
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3, :3] = v_rotation_camera + v_points @ means
    v_viewmat[:3, 3] = v_points.sum(dim=1)
    return v_points.t() @ viewmat[:3, :3], v_quats, v_scales, v_covars, v_viewmat


def _point_gradient(screen: _Screen, v_ground: Tensor, rotation: Tensor, lens: _Lens, v_means2d: Tensor | None, v_depths: Tensor | None):
    """Gradients of the camera points [3, n] and of the rotation inside G [3, 3]."""
    jx, jxz, jy, jyz = screen.jacobian
    v_rotation = torch.stack([v_ground[0] @ jx, v_ground[1] @ jy, v_ground[0] @ jxz + v_ground[1] @ jyz])
    v_jx, v_jy = rotation[0] @ v_ground[0], rotation[1] @ v_ground[1]
    v_jxz, v_jyz = rotation[2] @ v_ground[0], rotation[2] @ v_ground[1]
    over_z = screen.z.reciprocal()
    # J = f/z and -f s/z with s = clamp(x/z): where the clamp does not act, s moves too, by dx/z - (x/z) dz/z.
    v_z = -(v_jx * jx + v_jxz * jxz + v_jy * jy + v_jyz * jyz) * over_z
    v_slope_x, v_slope_y = -v_jxz * jx, -v_jyz * jy
    true_x, true_y = screen.x * over_z, screen.y * over_z
    v_slope_x = v_slope_x.masked_fill((true_x < lens.left) | (true_x > lens.right), 0.0)
    v_slope_y = v_slope_y.masked_fill((true_y < lens.top) | (true_y > lens.bottom), 0.0)
    if v_means2d is not None:
        v_slope_x = v_slope_x + lens.fx * v_means2d[:, 0]
        v_slope_y = v_slope_y + lens.fy * v_means2d[:, 1]
    v_z = v_z - (v_slope_x * true_x + v_slope_y * true_y) * over_z
    if v_depths is not None:
        v_z = v_z + v_depths
    return torch.stack([v_slope_x * over_z, v_slope_y * over_z, v_z]), v_rotation
