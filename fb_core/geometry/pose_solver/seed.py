"""A first guess of each camera that wrong rays cannot lead astray: homographies from pixels to directions, by consensus
and in closed form.

A pinhole camera sends a pixel (u, v, 1) to the direction of M (u, v, 1) with M = R K^-1, up to scale. Four rays fix M;
all rays together give it as the eigenvector of a 9x9 matrix (direct linear transform). M then falls apart into rotation
and intrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.pose_solver.centers import median_over
from fb_core.geometry.pose_solver.rays import Rays, length_of

MEDIAN_OF_NORM_2D = 1.1774  # median length of a two-dimensional standard normal vector
_SCORING_RAYS = 192
_FITTING_RAYS = 512
_SEEDING_RAYS = 1024
_FINALISTS = 6
_LINEAR_ROUNDS = 2
_TINY = torch.finfo(torch.float64).tiny ** 0.5


@dataclass(frozen=True, kw_only=True)
class Seeds:
    """What consensus and closed form say of each view."""

    homography: Float[Tensor, "n 3 3"]
    """M with M (u, v, 1) along (not against) the rays, pixel coordinates, Frobenius norm of the normalised matrix 1."""
    deviation: Float[Tensor, " n"]
    """Robust standard deviation of the directions about M, radians per axis."""
    spread: Float[Tensor, " n"]
    """Root mean square angle (as chord) of M's own rays about their mean, over the pixels that agree: how wide the view
    is.
    """
    mirrored: Bool[Tensor, " n"]
    """M turns right-handed image axes into left-handed world axes: no camera does so."""


def seeds_of(rays: Rays, *, hypotheses: int, seed: int) -> Seeds:
    """Least median of squares over random homographies of four rays, then reweighted direct linear transforms.

    A view's draws depend on the seed alone, not on the other views. The leading rays of each list are enough for a
    seed.
    """
    rays = rays.leading(_SEEDING_RAYS)
    plane, normalizer = _normalized(rays.pixels, rays.usable)
    candidates = torch.cat(
        [_linear(plane, rays.directions, rays.weights)[:, None], _minimal(plane, rays, hypotheses, seed)], dim=1
    )
    homography = _consensus(candidates, plane, rays)
    for _ in range(_LINEAR_ROUNDS):
        homography, robust_weights, lengths, _ = _softly(
            homography, plane, rays.directions, rays.weights, rays.precision
        )
        homography = _linear(plane, rays.directions, robust_weights / lengths.square().clamp_min(_TINY))
    homography, robust_weights, _, deviation = _softly(homography, plane, rays.directions, rays.weights, rays.precision)
    mapped = homography @ plane
    mapped = mapped / length_of(mapped).clamp_min(_TINY)[:, None]
    share = robust_weights / robust_weights.sum(dim=1, keepdim=True).clamp_min(_TINY)
    mean = torch.einsum("nr,nir->ni", share, mapped)
    spread = (share * (mapped - mean[..., None]).square().sum(dim=1)).sum(dim=1).sqrt()
    return Seeds(
        homography=homography @ normalizer,
        deviation=deviation,
        spread=spread,
        mirrored=torch.linalg.det(homography) < 0,
    )


def camera_of_homography(
    homography: Float[Tensor, "n 3 3"], principal: Float[Tensor, "n 2"] | None, *, longest_side: float
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Rotation, focal length and principal point (pixels) of M = R K^-1; a given principal point is kept.

    Mirrored homographies get their first axis flipped first, so that the rotation is always a proper one. Focal lengths
    stay between 1e-4 and 1e7 image sides whatever the rays say.
    """
    identity = torch.eye(3, dtype=homography.dtype, device=homography.device).expand_as(homography)
    if principal is None:
        unitary, upper = torch.linalg.qr(homography + _TINY * identity)
        signs = torch.where(upper.diagonal(dim1=1, dim2=2) < 0, -1.0, 1.0)
        upper = upper * signs[:, :, None]
        scale = upper[:, 2, 2].clamp_min(_TINY)
        focal = scale[:, None] / upper.diagonal(dim1=1, dim2=2)[:, :2].clamp_min(_TINY)
        focal = focal.clamp(1e-4 * longest_side, 1e7 * longest_side)
        principal_point = -upper[:, :2, 2] / scale[:, None] * focal
        principal_point = torch.where(
            (principal_point.abs() < 1e3 * longest_side).all(dim=1, keepdim=True), principal_point, 0.5 * longest_side
        )
        return _proper(unitary * signs[:, None, :]), focal, principal_point
    shift = identity.clone()
    shift[:, :2, 2] = principal
    columns = homography @ shift
    norms = columns.norm(dim=1)
    focal = norms[:, 2:] / norms[:, :2].clamp_min(_TINY)
    left, _, right = torch.linalg.svd(columns / norms[:, None].clamp_min(_TINY) + _TINY * identity)
    return _proper(left @ right), focal.clamp(1e-4 * longest_side, 1e7 * longest_side), principal


def _proper(orthogonal: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Reflections become rotations by a flip of the first column."""
    flip = torch.ones_like(orthogonal)
    flip[:, :, 0] = torch.where(torch.linalg.det(orthogonal) < 0, -1.0, 1.0)[:, None]
    return orthogonal * flip


def _normalized(
    pixels: Float[Tensor, "n 2 r"], usable: Bool[Tensor, "n r"]
) -> tuple[Float[Tensor, "n 3 r"], Float[Tensor, "n 3 3"]]:
    """Homogeneous pixels about their mean, with mean square radius 2, and the matrix that makes them so."""
    count = usable.sum(dim=1).clamp_min(1)
    mean = (pixels * usable[:, None]).sum(dim=2) / count[:, None]
    offsets = (pixels - mean[..., None]) * usable[:, None]
    scale = (offsets.square().sum(dim=(1, 2)) / (2 * count)).sqrt()
    scale = torch.where(scale > 0, scale, 1.0)
    normalizer = pixels.new_zeros(len(pixels), 3, 3)
    normalizer[:, 0, 0] = normalizer[:, 1, 1] = 1 / scale
    normalizer[:, :2, 2] = -mean / scale[:, None]
    normalizer[:, 2, 2] = 1.0
    plane = offsets / scale[:, None, None]
    return torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1), normalizer


def _linear(
    plane: Float[Tensor, "n 3 r"], directions: Float[Tensor, "n 3 r"], weights: Float[Tensor, "n r"]
) -> Float[Tensor, "n 3 3"]:
    """The matrix of norm 1 that minimises the weighted sum of |d x M m|^2."""
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    projector = torch.stack([float(i == j) - directions[:, i] * directions[:, j] for i, j in pairs], dim=1)
    products = torch.stack([plane[:, i] * plane[:, j] for i, j in pairs], dim=1)
    small = (projector * weights[:, None]) @ products.transpose(1, 2)
    place = torch.tensor([[0, 1, 2], [1, 3, 4], [2, 4, 5]], device=plane.device)
    system = small[:, place][:, :, :, place].permute(0, 1, 3, 2, 4).reshape(-1, 9, 9)  # rows and columns (i, k) of M_ik
    system = system / system.diagonal(dim1=1, dim2=2).sum(dim=1).clamp_min(_TINY)[:, None, None]
    return torch.linalg.eigh(system).eigenvectors[:, :, 0].reshape(-1, 3, 3)


def _minimal(plane: Float[Tensor, "n 3 r"], rays: Rays, hypotheses: int, seed: int) -> Float[Tensor, "n s 3 3"]:
    """Homographies that send four random pixels exactly to their directions (zero matrices for degenerate draws).

    With m4 = sum a_i m_i and d4 = sum b_i d_i, M = sum (b_i / a_i) d_i (m_j x m_k)^T; the division is multiplied out.
    """
    if plane.shape[2] == 0:
        return plane.new_zeros(len(plane), hypotheses, 3, 3)
    draws = torch.rand(hypotheses * 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(
        plane.device
    )
    chosen = (draws * rays.usable.sum(dim=1, keepdim=True)).long()  # usable rays stand first

    def four(values: Tensor) -> Tensor:
        return torch.gather(values, 2, chosen[:, None].expand(-1, 3, -1)).transpose(1, 2).unflatten(1, (hypotheses, 4))

    m, d = four(plane), four(rays.directions)
    adjugate_m, adjugate_d = _crosses(m[:, :, :3]), _crosses(d[:, :, :3])
    a = torch.einsum("nsij,nsj->nsi", adjugate_m, m[:, :, 3])
    b = torch.einsum("nsij,nsj->nsi", adjugate_d, d[:, :, 3])
    factors = b * torch.roll(a, 1, dims=-1) * torch.roll(a, 2, dims=-1)
    return torch.einsum("nsk,nski,nskj->nsij", factors, d[:, :, :3], adjugate_m)


def _crosses(three: Float[Tensor, "n s 3 3"]) -> Float[Tensor, "n s 3 3"]:
    """Row i is the cross product of the other two vectors: the inverse of the matrix with these columns, times its
    determinant.
    """
    return torch.linalg.cross(torch.roll(three, -1, dims=2), torch.roll(three, -2, dims=2))


def _consensus(
    candidates: Float[Tensor, "n s 3 3"], plane: Float[Tensor, "n 3 r"], rays: Rays
) -> Float[Tensor, "n 3 3"]:
    """The candidate with the least median angle; the best few, which stand on four noisy rays each, are fitted to what
    agrees with them.
    """
    few = slice(0, _SCORING_RAYS)
    score = _scores(candidates, plane[..., few], rays.directions[..., few], rays.usable[:, few])
    count = min(_FINALISTS, candidates.shape[1])
    best = score.topk(count, dim=1, largest=False).indices
    finalists = torch.gather(candidates, 1, best[..., None, None].expand(-1, -1, 3, 3)).flatten(0, 1)
    finalists = finalists / finalists.norm(dim=(1, 2), keepdim=True).clamp_min(_TINY)
    more = slice(0, _FITTING_RAYS)
    views = torch.arange(len(candidates), device=best.device).repeat_interleave(count)
    part = (plane[..., more][views], rays.directions[..., more][views], rays.weights[:, more][views])
    for _ in range(_LINEAR_ROUNDS):
        finalists, robust_weights, lengths, _ = _softly(finalists, *part, rays.precision)
        finalists = _linear(part[0], part[1], robust_weights / lengths.square().clamp_min(_TINY))
    finalists = torch.cat(
        [
            finalists.unflatten(0, (-1, count)),
            torch.gather(candidates, 1, best[:, :1, None, None].expand(-1, -1, 3, 3)),
        ],
        1,
    )
    score = _scores(finalists, plane[..., more], rays.directions[..., more], rays.usable[:, more])
    chosen = finalists[torch.arange(len(score), device=best.device), score.argmin(dim=1)]
    return chosen / chosen.norm(dim=(1, 2), keepdim=True).clamp_min(_TINY)


def _scores(
    candidates: Float[Tensor, "n s 3 3"],
    plane: Float[Tensor, "n 3 r"],
    directions: Float[Tensor, "n 3 r"],
    usable: Bool[Tensor, "n r"],
) -> Float[Tensor, "n s"]:
    """1 - cosine at the median ray (2 without rays), for the better sign of each candidate."""
    mapped = (candidates.flatten(1, 2) @ plane).unflatten(1, (-1, 3))
    cosine = (mapped * directions[:, None]).sum(dim=2) / mapped.square().sum(dim=2).sqrt().clamp_min(_TINY)
    sign = torch.where((cosine * usable[:, None]).sum(dim=2, keepdim=True) < 0, -1.0, 1.0)
    miss = 1 - sign * cosine
    if not bool(usable.all()):
        miss = torch.where(usable[:, None], miss, torch.nan)
    if miss.shape[2] == 0:
        return miss.new_full(miss.shape[:2], 2.0)
    return miss.nanmedian(dim=2).values.nan_to_num(2.0)


def _softly(
    homography: Float[Tensor, "n 3 3"],
    plane: Float[Tensor, "n 3 r"],
    directions: Float[Tensor, "n 3 r"],
    weights: Float[Tensor, "n r"],
    precision: float,
) -> tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n r"], Float[Tensor, "n r"], Float[Tensor, " n"]]:
    """The homography with the sign that looks along the rays, Geman-McClure weights of its misses, |M m|, and the
    robust deviation.
    """
    mapped = homography @ plane
    lengths = length_of(mapped).clamp_min(_TINY)
    along = (mapped * directions).sum(dim=1) / lengths
    sign = torch.where((along * weights).sum(dim=1) < 0, -1.0, 1.0)
    squared = (sign[:, None, None] * mapped / lengths[:, None] - directions).square().sum(dim=1) * weights
    deviation = (median_over(squared, weights > 0).sqrt() / MEDIAN_OF_NORM_2D).clamp_min(precision)
    robust_weights = weights / (1 + squared / (2.5 * deviation[:, None]).square()).square()
    return sign[:, None, None] * homography, robust_weights, lengths, deviation
