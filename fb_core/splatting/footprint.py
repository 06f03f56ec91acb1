"""The footprint of a Gaussian on the image (EWA splatting), for one camera.

With the camera point (x, y, z), the camera's rotation R, and the rotation Q and scales S of a Gaussian:

    J = [[fx/z, 0, -fx sx/z], [0, fy/z, -fy sy/z]],  sx = clamp(x/z),  sy = clamp(y/z)
    G = J R,  H = G Q (2x3),  M = H S^2 H^T + blur I (screen covariance),  X = M^-1 (conic)

Needles decide how this is computed. With N = H_x x H_y (the minors of H), the determinant before the blur is the sum of
the squares of s_k s_l N_m, where a c - b^2 would cancel in float32. `footprint_gradient` uses the same minors.
Everything works on columns (n contiguous values each): products of small matrices cost several times more on a CPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Lens:
    """One pinhole as plain numbers; `left .. bottom` limit x/z and y/z in J, 0.3 half-views beyond the image's
    border.
    """

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
        """The numbers of an intrinsic matrix (pixels) and of a picture of that size."""
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
class Axes:
    """The extent of n Gaussians in columns, by their axes."""

    unit: Float[Tensor, "4 n"]
    """Unit quaternions (wxyz)."""
    inverse_length: Float[Tensor, " n"]
    """1/|q| of the quaternions as given; 0 for a zero quaternion, which stands for the identity and gets no
    gradient.
    """
    rotation: Float[Tensor, "3 3 n"]
    """Q."""
    scales: Float[Tensor, "3 n"]


@dataclass(frozen=True, kw_only=True)
class Covariances:
    """The extent of n Gaussians in columns, by covariances C that were given."""

    covariance: Float[Tensor, "3 3 n"]


Shapes = Axes | Covariances


def shapes_of(quats: Tensor | None, scales: Tensor | None, covars: Tensor | None) -> Shapes:
    """From quaternions (wxyz) of any length [n, 4] and scales [n, 3], or, where given, from covariances [n, 3, 3]."""
    if covars is not None:
        return Covariances(covariance=covars.permute(1, 2, 0).contiguous())
    assert quats is not None and scales is not None, "the rasterizer has checked that it got either"
    unit, inverse_length = unit_quaternions(quats)
    return Axes(unit=unit, inverse_length=inverse_length, rotation=rotations(unit), scales=scales.t().contiguous())


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


def unit_quaternions(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions [n, 4] (wxyz) as unit columns [4, n], and one over their lengths [n]; the identity where all is 0."""
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


def rotations(unit: Float[Tensor, "4 n"]) -> Float[Tensor, "3 3 n"]:
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


def through(rows: Float[Tensor, "2 3 n"], matrix: Float[Tensor, "3 3 n"]) -> Float[Tensor, "2 3 n"]:
    """rows times matrix, Gaussian by Gaussian."""
    out = torch.empty_like(rows)
    for row, target in zip(rows.unbind(0), out.unbind(0), strict=True):
        torch.mul(row[0], matrix[0], out=target).addcmul_(row[1], matrix[1]).addcmul_(row[2], matrix[2])
    return out


def cross(p: Float[Tensor, "3 n"], q: Float[Tensor, "3 n"]) -> Float[Tensor, "3 n"]:
    """The cross products of columns."""
    out = torch.empty_like(p)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        torch.mul(p[i], q[j], out=out[k]).addcmul_(p[j], q[i], value=-1.0)
    return out


def footprint(
    means: Float[Tensor, "n 3"], shapes: Shapes, viewmat: Float[Tensor, "4 4"], lens: Lens, blur: float
) -> Footprint:
    """Project; what lies in or behind the image plane comes out as garbage, which the caller culls."""
    rotation = viewmat[:3, :3]
    # Centres in double: their rounding is what float32 pictures lose first (1e-5 pixel, times the slope of a
    # footprint).
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
    if isinstance(shapes, Axes):
        spread = through(ground, shapes.rotation)
        p, q = spread * shapes.scales
        a, b, c, sharp = (p * p).sum(dim=0), (p * q).sum(dim=0), (q * q).sum(dim=0), cross(p, q).square_().sum(dim=0)
    else:
        spread = through(ground, shapes.covariance)
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
