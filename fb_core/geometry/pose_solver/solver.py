"""Cameras from raymaps (paper, section 3.1: a generated raymap "is" a camera): robust, in closed form first, refined to
the likeliest.

Centres are robust means of the ray origins. Rotations and focal lengths come from a consensus of random four-ray
homographies and a direct linear transform (`seed`), then Levenberg-Marquardt (`refine`). Views of which this cannot
work are told apart, with a reason (`verdict`). Everything is reckoned in float64, for all views at once, and the same
call gives the same cameras.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.centers import Centers, robust_centers
from fb_core.geometry.pose_solver.inliers import Limits, agreeing_rays, homography_of
from fb_core.geometry.pose_solver.rays import Rays, rays_of, rays_of_raymaps, sound_rays
from fb_core.geometry.pose_solver.refine import Fit, FocalPrior, Model, Refined, refine
from fb_core.geometry.pose_solver.seed import camera_of_homography, seeds_of
from fb_core.geometry.pose_solver.verdict import (
    Arrangement,
    Judgement,
    Verdict,
    arrangement_of,
    judge_seeds,
    judge_share,
)


@dataclass(frozen=True, kw_only=True)
class PoseSolving:
    """What is known of the cameras, and how much work is put into them."""

    focal: Literal["per_view", "shared"] = "per_view"
    """Whether all views have one focal length (pictures of one camera, one zoom)."""
    square_pixels: bool = False
    """Whether fx = fy."""
    focal_deviation: float = 0.01
    """Relative standard deviation of focal lengths that are told; small, because the errors of raymaps' rays are not
    independent.
    """
    principal: Literal["known", "free"] = "known"
    """Whether principal points are given (the image's centre by default) or looked for."""
    rays_per_view: int = 4096
    """Rays that are fitted, of each raymap; the rest is only compared with the result."""
    hypotheses: int = 96
    """Random four-ray cameras of each view among which consensus chooses."""
    least_consensus: float = 0.5
    """Share of the usable rays that must agree with a camera for it to be trusted."""
    seed: int = 0
    """Decides the random choices."""

    def __post_init__(self) -> None:
        if not self.focal_deviation > 0:
            raise ValueError(f"pose solving: expected focal_deviation above 0, got {self.focal_deviation}")
        if self.rays_per_view < 4 or self.hypotheses < 1 or not 0 <= self.least_consensus <= 1:
            raise ValueError(
                "pose solving: expected rays_per_view of at least 4, hypotheses of at least 1 and least_consensus in "
                "[0, 1], got "
                f"{self.rays_per_view}, {self.hypotheses}, {self.least_consensus}"
            )


@dataclass(frozen=True, kw_only=True)
class RecoveredCameras:
    """Cameras of n views with what is to be thought of them. All numbers are finite, also where there is no camera."""

    cameras: Pinholes
    """In the frame and unit of the rays. Untrusted views hold a placeholder: no rotation, the robust centre, 53 degrees
    of view.
    """
    verdicts: tuple[Verdict, ...]
    """Of each view; a camera is meant only where it is OK."""
    reasons: tuple[str, ...]
    """Why not OK, in words; otherwise empty, or how many rays were rejected."""
    arrangement: Arrangement
    """How the trusted cameras stand to each other."""
    residual_degrees: Float[Tensor, " n"]
    """Standard deviation of the inlying directions about the camera's, per axis. Large ones deserve little trust."""
    residual_origins: Float[Tensor, " n"]
    """Standard deviation of the inlying origins about the centre, per axis, scene units."""
    covariance: Float[Tensor, "n 10 10"]
    """Of rotation (radians about the camera's right, down, forward), centre (scene units), fx, fy, cx, cy (pixels), in
    float64.

    Zero for what was given. Assumes errors that are independent between pixels; where they are not (generated raymaps),
    it is too small. Placeholders have variances as wide as nobody's knowledge: half a turn, the extent of the scene,
    the image.
    """
    inliers: Bool[Tensor, "n *rays"]
    """Which rays agree with their view's camera; none where there is no camera. [n, h, w] of raymaps, [n, r] of
    lists.
    """
    inlier_share: Float[Tensor, " n"]
    """Share of the usable rays that agree."""
    rejected: Int[Tensor, " n"]
    """Rays with a weight that were rejected because they hold NaN, infinity or no direction."""

    @property
    def trusted(self) -> Bool[Tensor, " n"]:
        """Views whose verdict is OK."""
        return torch.tensor(
            [verdict is Verdict.OK for verdict in self.verdicts], dtype=torch.bool, device=self.inliers.device
        )


def recover_cameras(
    raymaps: Float[Tensor, "n 6 h w"],
    *,
    weights: Float[Tensor, "n 1 h w"] | None = None,
    principal: Float[Tensor, "n 2"] | None = None,
    focal: Float[Tensor, " n"] | None = None,
    solving: PoseSolving = PoseSolving(),
) -> RecoveredCameras:
    """Pinhole cameras of raymaps, the inverse of :func:`fb_core.geometry.raymap.raymaps_of`; differentiable in the
    inlying rays.

    Args:
        raymaps: origins (scene units) and directions (any length) in a common frame; up to almost half of a view's may
            be wrong.
        weights: known-masks or inverse variances up to a factor (0 = unknown); None trusts all. Rays without weight may
            hold anything.
        principal: principal points in pixels of these raymaps; None is the image's centre. For a window at (left, top)
            of an image whose principal point is (cx, cy), they are (cx - left, cy - top), inside the window or not.
        focal: focal lengths in pixels that somebody tells (EXIF data); NaN where nobody does. `solving.focal_deviation`
            says how sure.
        solving: what is known of the cameras, and the amount of work.

    Returns cameras in the raymaps' precision (float32 for half precision). Raises ValueError for arguments of
    disagreeing shapes and for weights or principal points that are negative or not finite. Degenerate views raise
    nothing: they get a verdict.
    """
    count, _, height, width = raymaps.shape
    if raymaps.shape[1] != 6:
        raise ValueError(f"raymaps: expected a shape (n, 6, h, w), got {tuple(raymaps.shape)}")
    if weights is None:
        weights = torch.ones_like(raymaps[:, :1])
    if tuple(weights.shape) != (count, 1, height, width):
        raise ValueError(
            f"weights: expected a shape {(count, 1, height, width)} like the raymaps, got {tuple(weights.shape)}"
        )
    _check_weights(weights)
    sound = sound_rays(raymaps.detach())
    rays = rays_of_raymaps(raymaps, weights[:, 0], sound, at_most=solving.rays_per_view)
    if focal is not None and (tuple(focal.shape) != (count,) or bool((focal <= 0).any())):
        raise ValueError(f"focal: expected {count} positive lengths or NaN, one for each raymap, got {focal.tolist()}")
    prior = None if focal is None else FocalPrior(focal=focal.to(rays.pixels), deviation=solving.focal_deviation)
    recovered = _recover(rays, principal, width, height, solving, prior=prior, dtype=_working(raymaps.dtype))
    like = raymaps.detach().to(recovered.cameras.focal.dtype)
    x = torch.arange(width, device=like.device, dtype=like.dtype)[None, None] + 0.5
    y = torch.arange(height, device=like.device, dtype=like.dtype)[None, :, None] + 0.5
    agreeing = agreeing_rays(like, x, y, weights[:, 0], _limits(recovered))
    return _concluded(recovered, agreeing, (weights[:, 0] > 0) & sound, solving)


def recover_cameras_from_rays(
    origins: Float[Tensor, "n r 3"],
    directions: Float[Tensor, "n r 3"],
    pixels: Float[Tensor, "n r 2"],
    *,
    width: int,
    height: int,
    weights: Float[Tensor, "n r"] | None = None,
    principal: Float[Tensor, "n 2"] | None = None,
    solving: PoseSolving = PoseSolving(),
) -> RecoveredCameras:
    """The same from lists of rays through any points (x, y) of images of one size, all of which are fitted. Raises
    ValueError for lists of different lengths and for pixels that are not finite.
    """
    if weights is None:
        weights = torch.ones_like(origins[..., 0])
    shapes = {tuple(tensor.shape[:2]) for tensor in (origins, directions, pixels, weights)}
    if len(shapes) != 1:
        raise ValueError(f"rays: expected as many origins, directions, pixels and weights, got {sorted(shapes)}")
    _check_weights(weights)
    if not bool((torch.isfinite(pixels).all(dim=-1) | (weights == 0)).all()):
        raise ValueError("pixels: expected finite coordinates, got NaN or infinity; give such rays weight 0")
    rays = torch.cat([origins, directions], dim=2).transpose(1, 2)
    points = pixels.transpose(1, 2)
    recovered = _recover(
        rays_of(rays, points, weights), principal, width, height, solving, dtype=_working(origins.dtype)
    )
    sound = sound_rays(rays.detach())
    like, points = rays.detach().to(recovered.cameras.focal.dtype), points.to(recovered.cameras.focal.dtype)
    agreeing = agreeing_rays(like, points[:, 0], points[:, 1], weights, _limits(recovered))
    return _concluded(recovered, agreeing, (weights > 0) & sound, solving)


@dataclass(frozen=True, kw_only=True)
class _Found:
    """Everything but the comparison with all rays."""

    cameras: Pinholes
    refined: Refined
    centers: Centers
    judgements: list[Judgement]
    rays: Rays


def _recover(
    rays: Rays,
    principal: Float[Tensor, "n 2"] | None,
    width: int,
    height: int,
    solving: PoseSolving,
    *,
    prior: FocalPrior | None = None,
    dtype: torch.dtype,
) -> _Found:
    count = len(rays.weights)
    free = solving.principal == "free"
    if free and principal is not None:
        raise ValueError(
            "principal: expected None where principal points are looked for, got a tensor; choose principal='known'"
        )
    if principal is None:
        principal = torch.tensor([width / 2, height / 2]).expand(count, 2)
    if tuple(principal.shape) != (count, 2) or not bool(torch.isfinite(principal).all()):
        raise ValueError(
            f"principal: expected finite numbers of shape {(count, 2)}, got a tensor of shape {tuple(principal.shape)}"
        )
    principal = principal.to(rays.pixels)
    model = Model(
        shared_focal=solving.focal == "shared", square_pixels=solving.square_pixels, free_principal=free, prior=prior
    )
    with torch.no_grad():
        fixed = dataclasses.replace(rays, directions=rays.directions.detach(), origins=rays.origins.detach())
        seeds = seeds_of(fixed, hypotheses=solving.hypotheses, seed=solving.seed)
        judgements = judge_seeds(fixed, seeds)
        sound = torch.tensor(
            [one.verdict is Verdict.OK for one in judgements], dtype=torch.bool, device=rays.weights.device
        )
        rotations, focal, center = camera_of_homography(
            seeds.homography, None if free else principal, longest_side=float(max(width, height))
        )
    centers = robust_centers(rays.origins, rays.weights, precision=rays.precision)
    weights = rays.weights * sound[:, None]  # views without a camera must not have a say in a shared focal length
    refined = refine(
        Fit(rotations=rotations, focal=focal, principal=center),
        dataclasses.replace(rays, weights=weights),
        model,
    )
    fit = refined.fit
    pose = torch.cat([fit.rotations, centers.position[..., None]], dim=2)
    cameras = Pinholes(camera_to_world=pose, focal=fit.focal, principal=fit.principal, width=width, height=height).to(
        dtype
    )
    return _Found(cameras=cameras, refined=refined, centers=centers, judgements=judgements, rays=rays)


@torch.no_grad()
def _limits(found: _Found) -> Limits:
    """What inliers are measured by, in the precision of the result, for whose rounding the limits allow."""
    fit, dtype = found.refined.fit, found.cameras.focal.dtype
    rounding = 8 * max(found.rays.precision, torch.finfo(dtype).eps)
    position = found.centers.position
    return Limits(
        homography=homography_of(fit.rotations, fit.focal, fit.principal).to(dtype),
        centers=position.to(dtype),
        turn=found.refined.limit.clamp(rounding, 1.0).to(dtype),
        shift=torch.maximum(found.centers.limit, rounding * position.norm(dim=1)).to(dtype),
    )


@torch.no_grad()
def _shares(agreeing: Bool[Tensor, "n *r"], usable: Bool[Tensor, "n *r"]) -> Float[Tensor, " n"]:
    return agreeing.flatten(1).sum(dim=1) / usable.flatten(1).sum(dim=1).clamp_min(1)


def _concluded(
    found: _Found, agreeing: Bool[Tensor, "n *r"], usable: Bool[Tensor, "n *r"], solving: PoseSolving
) -> RecoveredCameras:
    """The result, with placeholders where there is no camera."""
    agreeing = agreeing & usable
    share = _shares(agreeing, usable)
    pairs = zip(found.judgements, share.tolist(), strict=True)
    judgements = [judge_share(judgement, one, solving.least_consensus) for judgement, one in pairs]
    trusted = torch.tensor([one.verdict is Verdict.OK for one in judgements], dtype=torch.bool, device=share.device)
    dtype = found.cameras.focal.dtype
    covariance = found.refined.covariance.new_zeros(len(trusted), 10, 10)
    order = torch.tensor([0, 1, 2, 6, 7, 8, 9], device=share.device)
    covariance[:, order[:, None], order] = found.refined.covariance
    covariance[:, 3:6, 3:6] = torch.diag_embed(found.centers.variance[:, None].expand(-1, 3))
    known = trusted.reshape(-1, 1, 1)
    return RecoveredCameras(
        cameras=_placed(found.cameras, trusted),
        verdicts=tuple(one.verdict for one in judgements),
        reasons=tuple(one.reason for one in judgements),
        arrangement=arrangement_of(
            found.centers.position.detach()[trusted],
            found.centers.variance.sqrt()[trusted],
            precision=found.rays.precision,
        ),
        residual_degrees=torch.where(trusted, torch.rad2deg(found.refined.deviation), 180.0).to(dtype),
        residual_origins=found.centers.deviation.to(dtype),
        covariance=torch.where(known, covariance, _nobody_knows(found)),
        inliers=agreeing & trusted.reshape(-1, *[1] * (agreeing.dim() - 1)),
        inlier_share=share.to(dtype),
        rejected=found.rays.broken,
    )


def _placed(cameras: Pinholes, trusted: Bool[Tensor, " n"]) -> Pinholes:
    """Placeholders in the place of untrusted cameras."""
    keep = trusted[:, None]
    side = max(cameras.width, cameras.height)
    axes = torch.eye(3, dtype=cameras.focal.dtype, device=cameras.focal.device)
    rotations = torch.where(keep[..., None], cameras.rotations, axes)
    middle = cameras.focal.new_tensor([cameras.width / 2, cameras.height / 2])
    return dataclasses.replace(
        cameras,
        camera_to_world=torch.cat([rotations, cameras.centers[..., None]], dim=2),
        focal=torch.where(keep, cameras.focal, float(side)),
        principal=torch.where(keep, cameras.principal, middle),
    )


def _nobody_knows(found: _Found) -> Float[Tensor, "n 10 10"]:
    """Covariance of a camera that is not known at all."""
    positions = found.centers.position.detach()
    extent = (positions - positions.mean(dim=0)).norm(dim=1).max() if len(positions) else positions.new_zeros(())
    half_turn = positions.new_full((3,), torch.pi)
    image = positions.new_full((4,), float(max(found.cameras.width, found.cameras.height)))
    deviations = torch.cat([half_turn, extent.clamp_min(torch.finfo(torch.float64).tiny ** 0.5).expand(3), image])
    return torch.diag(deviations.square()).expand(len(positions), 10, 10)


def _working(dtype: torch.dtype) -> torch.dtype:
    return dtype if dtype in (torch.float32, torch.float64) else torch.float32


def _check_weights(weights: Tensor) -> None:
    if weights.numel() == 0:
        return
    least, largest = weights.detach().aminmax()
    if not float(least) >= 0 or not float(largest) < float("inf"):  # NaN fails both
        raise ValueError(
            "weights: expected finite numbers of at least 0 (0 = unknown ray), got negative, NaN or infinite ones"
        )


__all__ = [
    "Arrangement",
    "PoseSolving",
    "RecoveredCameras",
    "Verdict",
    "recover_cameras",
    "recover_cameras_from_rays",
]
