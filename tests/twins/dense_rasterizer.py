"""The slow readable twin of `fb_core.splatting.rasterizer`: every pixel times every Gaussian, straight from the
equations.

Autograd does the derivatives; there are no cells, no blocks and no tricks. Meant for a few dozen Gaussians and small
images in float64. What gsplat treats as constant (radii, tiles, order, which pairs are drawn) is decided without
gradients here too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import factorial, lpmv
from torch import Tensor

CAP = {"1.4": 0.999, "1.5": 0.999, "1.6": 0.99}
FLOOR = {"1.4": 0.0, "1.5": 0.0, "1.6": 0.005}


@dataclass(frozen=True, kw_only=True)
class DenseView:
    """One camera's picture and what led to it."""

    image: Tensor
    alpha: Tensor
    radii: Tensor
    means2d: Tensor
    """[n, 2], retains its gradient."""
    means2d_by_pixel: Tensor
    """[pixels, drawn, 2]; the sum over pixels of |its gradient| is absgrad of the Gaussians `order`."""
    order: Tensor


def rotation(quats: Tensor) -> Tensor:
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def covariance(quats: Tensor, scales: Tensor) -> Tensor:
    axes = rotation(quats) * scales[:, None, :]
    return axes @ axes.transpose(1, 2)


def screen_covariance(points: Tensor, covars: Tensor, R: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """J R covars R^T J^T, with x/z and y/z limited to 0.3 half-views beyond the image in J."""
    x, y, z = points.unbind(-1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.3 * width / (2 * fx), 0.3 * height / (2 * fy)
    tx = z * torch.clamp(x / z, -(cx / fx + margin_x), (width - cx) / fx + margin_x)
    ty = z * torch.clamp(y / z, -(cy / fy + margin_y), (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    J = torch.stack(
        [torch.stack([fx / z, zero, -fx * tx / z**2], dim=-1), torch.stack([zero, fy / z, -fy * ty / z**2], dim=-1)],
        dim=-2,
    )
    return J @ R @ covars @ R.T @ J.transpose(1, 2)


def spherical_harmonics(degree: int, directions: np.ndarray) -> np.ndarray:
    """Real spherical harmonics from associated Legendre functions (with their sign (-1)^m), [n, (degree + 1)^2]."""
    azimuth, cosine = np.arctan2(directions[:, 1], directions[:, 0]), directions[:, 2]
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            m = abs(order)
            norm = np.sqrt((2 * band + 1) / (4 * np.pi) * factorial(band - m) / factorial(band + m))
            turn = 1.0 if order == 0 else np.sqrt(2) * (np.cos(m * azimuth) if order > 0 else np.sin(m * azimuth))
            columns.append(norm * lpmv(m, band, cosine) * turn)
    return np.stack(columns, axis=-1)


def radii_of(blurred: Tensor, opacity: Tensor, semantics: str) -> Tensor:
    a, b, c = blurred[:, 0, 0], blurred[:, 0, 1], blurred[:, 1, 1]
    if semantics == "1.4":
        middle, determinant = 0.5 * (a + c), a * c - b * b
        longest = middle + (middle**2 - determinant).clamp(min=0.01).sqrt()
        radius = torch.ceil(3 * longest.sqrt())
        return torch.stack([radius, radius], dim=-1)
    extent = (2 * torch.log((255 * opacity).clamp(min=1.0))).sqrt().clamp(max=3.33)
    return torch.stack([torch.ceil(extent * a.sqrt()), torch.ceil(extent * c.sqrt())], dim=-1)


def tiles_of(means2d: Tensor, radii: Tensor, width: int, height: int, tile: int) -> Tensor:
    """Which pixels lie in tiles that a Gaussian's box touches, [pixels, n]."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    tiles = torch.stack([x, y], dim=-1).reshape(-1, 1, 2) // tile
    first, last = torch.floor((means2d - radii) / tile), torch.ceil((means2d + radii) / tile)
    return ((tiles >= first) & (tiles < last)).all(dim=-1)


def dense_view(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor,
    values: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    tile_size: int = 16,
    antialiased: bool = False,
    with_depth: bool = False,
    semantics: str = "1.4",
) -> DenseView:
    """One camera; `with_depth` appends the depth to the values."""
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = points[:, 2]
    safe = torch.where((depth >= near_plane)[:, None], points, torch.ones_like(points))
    sharp = screen_covariance(safe, covars, viewmat[:3, :3], K, width, height)
    blurred = sharp + eps2d * torch.eye(2, dtype=means.dtype)
    if antialiased:
        ratio = torch.linalg.det(sharp) / torch.linalg.det(blurred)
        opacities = opacities * ratio.clamp(min=FLOOR[semantics] ** 2).sqrt()
    means2d = safe[:, :2] / safe[:, 2:] * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
    if means2d.requires_grad:
        means2d.retain_grad()
    with torch.no_grad():
        radii = radii_of(blurred, opacities, semantics)
        drawn = (depth >= near_plane) & (depth <= far_plane) & (radii.amax(dim=-1) > radius_clip)
        size = torch.tensor([width, height], dtype=means.dtype)
        drawn &= ((means2d + radii > 0) & (means2d - radii < size)).all(dim=-1)
        if semantics != "1.4":
            drawn &= opacities >= 1 / 255
        kept = drawn.nonzero()[:, 0]
        order = kept[torch.argsort(depth[kept].float(), stable=True)]
        member = tiles_of(means2d[order], radii[order], width, height, tile_size)
    if with_depth:
        values = torch.cat([values, depth[:, None]], dim=-1)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 1, 2) + 0.5
    by_pixel = means2d[order].expand(width * height, -1, -1).clone()
    if by_pixel.requires_grad:
        by_pixel.retain_grad()
    d = by_pixel - pixels
    sigma = 0.5 * torch.einsum("pni,nij,pnj->pn", d, torch.linalg.inv(blurred[order]), d)
    alpha = (opacities[order] * torch.exp(-sigma)).clamp(max=CAP[semantics])
    alpha = torch.where(member & (alpha >= 1 / 255), alpha, 0.0)
    alive = torch.cumprod(1 - alpha.detach(), dim=1) > 1e-4
    alpha = torch.where(alive, alpha, 0.0)
    after = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)
    image = (alpha * after[:, :-1]) @ values[order]
    return DenseView(
        image=image.reshape(height, width, -1),
        alpha=1 - after[:, -1].reshape(height, width, 1),
        radii=(radii * drawn[:, None]).int(),
        means2d=means2d,
        means2d_by_pixel=by_pixel,
        order=order,
    )
