"""The most likely cameras given their rays: Levenberg-Marquardt on rotations, focal lengths and, if wanted, principal
points.

Minimises the sum of w |k(p) - R^T d|^2 over the inlying rays, where k(p) is the unit vector through pixel p in the
camera's frame: the angle between the rays and the camera's own. Rotations move as R exp([omega]x). All views advance
together; a focal length that views share couples them through the Schur complement of its one or two parameters.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.pose_solver.centers import median_over
from fb_core.geometry.pose_solver.rays import Rays, length_of
from fb_core.geometry.pose_solver.seed import MEDIAN_OF_NORM_2D

_KEPT = 4.0  # beyond so many deviations a direction is an outlier (one in 3000 true ones is)
_HARD_ROUNDS = 3  # of choosing the inliers anew
_STEPS = 6  # at most, between two choices
_SOFT_STEPS = 2  # before the first choice
_SOFT_RAYS = 1024  # for these
_CONVERGED = 1e-11  # radians, and relative for focal lengths
_RIDGE = 1e-14  # of the mean diagonal: keeps undetermined parameters where they are


@dataclass(frozen=True, kw_only=True)
class FocalPrior:
    """Focal lengths that somebody tells, such as a photo's EXIF data, as normal laws of their logarithms."""

    focal: Float[Tensor, " n"]
    """Pixels; NaN where nobody tells."""
    deviation: float
    """Standard deviation of the logarithm."""

    @property
    def told(self) -> Bool[Tensor, " n"]:
        """Whose focal length is told."""
        return torch.isfinite(self.focal)

    def off(self, fit: Fit) -> Float[Tensor, "n 2"]:
        """Logarithms of fx, fy against what is told; 0 where nothing is."""
        return torch.where(
            self.told[:, None], fit.focal.log() - torch.where(self.told, self.focal, 1.0).log()[:, None], 0.0
        )


@dataclass(frozen=True, kw_only=True)
class Model:
    """Which parameters there are."""

    shared_focal: bool
    """One focal length for all views."""
    square_pixels: bool
    """fx = fy."""
    free_principal: bool
    """Principal points are looked for, each view's own."""
    prior: FocalPrior | None = None
    """What is known of focal lengths beforehand."""

    @property
    def local(self) -> int:
        """Parameters of each view before its focal length: three of rotation, two of the principal point."""
        return 5 if self.free_principal else 3

    @property
    def total(self) -> int:
        """Parameters that a view's rays depend on."""
        return self.local + (1 if self.square_pixels else 2)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Cameras without their centres."""

    rotations: Float[Tensor, "n 3 3"]
    """Camera-to-world."""
    focal: Float[Tensor, "n 2"]
    """Pixels."""
    principal: Float[Tensor, "n 2"]
    """Pixels."""


@dataclass(frozen=True, kw_only=True)
class Refined:
    """The optimum and its neighbourhood."""

    fit: Fit
    """The cameras."""
    deviation: Float[Tensor, " n"]
    """Standard deviation of an inlying direction with weight 1, radians per axis."""
    limit: Float[Tensor, " n"]
    """Directions of weight 1 that miss by more (chord) are outliers."""
    covariance: Float[Tensor, "n 7 7"]
    """Of rotation (radians, camera frame), fx, fy, cx, cy (pixels), if directions err independently; zero for what is
    given.
    """


def refine(fit: Fit, rays: Rays, model: Model) -> Refined:
    """Inliers and cameras in turn from a guess.

    Differentiable in the inlying rays: one last Gauss-Newton step, at the optimum, has the optimum's own derivative (up
    to the curvature of the residuals, which vanishes with them).
    """
    fixed = dataclasses.replace(rays, origins=rays.origins.detach(), directions=rays.directions.detach())
    if model.prior is not None:
        fit = dataclasses.replace(
            fit, focal=torch.where(model.prior.told[:, None], model.prior.focal[:, None], fit.focal)
        )
    if model.shared_focal or model.square_pixels:
        fit = dataclasses.replace(fit, focal=_tied(fit.focal, rays.weights.sum(dim=1), model))
    fit, hessian = _softly(fit, fixed.leading(_SOFT_RAYS), model)
    inlier_weights, used = fixed.weights, fixed.weights.new_ones(len(fixed.weights))
    for round_ in range(_HARD_ROUNDS):
        misses = _misses(fit, fixed)
        deviation = (
            _deviation(misses, inlier_weights, model)
            if round_
            else median_over(misses, fixed.usable) / MEDIAN_OF_NORM_2D
        )
        deviation = deviation.clamp_min(rays.precision)
        before, inlier_weights = inlier_weights, torch.where(misses <= _KEPT * deviation[:, None], fixed.weights, 0.0)
        if round_ and not model.shared_focal and torch.equal(inlier_weights, before):
            break  # the same inliers have the same optimum
        fit, hessian = _descend(fit, fixed, inlier_weights / deviation.square()[:, None], model, steps=_STEPS)
        used = deviation
    deviation = _deviation(_misses(fit, fixed), inlier_weights, model).clamp_min(rays.precision)
    hessian = hessian * (used / deviation).square()[:, None, None]
    covariance = _covariance(fit, hessian, model)
    if rays.directions.requires_grad:
        _, gradient, _ = _normal_equations(fit, rays, inlier_weights / deviation.square()[:, None], model)
        fit = _moved(fit, _step(hessian, gradient, torch.zeros_like(deviation), model), model)
    return Refined(fit=fit, deviation=deviation, limit=_KEPT * deviation, covariance=covariance)


def _softly(fit: Fit, rays: Rays, model: Model) -> tuple[Fit, Float[Tensor, "n p p"]]:
    """A few steps with Geman-McClure weights, which takes the algebraic bias out of the closed form."""
    misses = _misses(fit, rays)
    deviation = (median_over(misses, rays.usable) / MEDIAN_OF_NORM_2D).clamp_min(rays.precision)[:, None]
    soft = rays.weights / (1 + (misses / (2.5 * deviation)).square()).square()
    return _descend(fit, rays, soft / deviation.square(), model, steps=_SOFT_STEPS)


def rotation_of(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """exp([v]x): the rotations by |v| radians about v."""
    x, y, z = vectors.unbind(dim=-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(skew)


def _tied(focal: Float[Tensor, "n 2"], weights: Float[Tensor, " n"], model: Model) -> Float[Tensor, "n 2"]:
    """Guesses made equal where the model says so: medians over views, which stray guesses do not move."""
    if model.square_pixels:
        focal = focal.log().mean(dim=1, keepdim=True).exp().expand(-1, 2)
    if model.shared_focal and bool((weights > 0).any()):
        focal = focal[weights > 0].median(dim=0).values.expand(len(focal), 2)
    return focal.clone()


def _in_camera(fit: Fit, pixels: Float[Tensor, "n 2 r"]) -> Float[Tensor, "n 3 r"]:
    in_plane = (pixels - fit.principal[..., None]) / fit.focal[..., None]
    return torch.cat([in_plane, torch.ones_like(in_plane[:, :1])], dim=1)


def _misses(fit: Fit, rays: Rays) -> Float[Tensor, "n r"]:
    """|k(p) - R^T d|, times the root of the weight."""
    k = _in_camera(fit, rays.pixels)
    miss = k / length_of(k)[:, None] - fit.rotations.transpose(1, 2) @ rays.directions
    return length_of(miss) * rays.weights.sqrt()


def _deviation(misses: Float[Tensor, "n r"], kept: Float[Tensor, "n r"], model: Model) -> Float[Tensor, " n"]:
    squares = torch.where(kept > 0, misses.square(), 0.0).sum(dim=1)
    return (squares / (2 * (kept > 0).sum(dim=1) - model.total).clamp_min(1)).sqrt()


def _normal_equations(
    fit: Fit, rays: Rays, kept: Float[Tensor, "n r"], model: Model
) -> tuple[Float[Tensor, "n p p"], Float[Tensor, "n p"], Float[Tensor, " n"]]:
    """J^T W J, J^T W e and the cost of every view. Parameters: rotation, principal point (in focal lengths), log focal
    length.
    """
    k = _in_camera(fit, rays.pixels)
    shrink = 1 / length_of(k)
    unit = k * shrink[:, None]
    seen = fit.rotations.transpose(1, 2) @ rays.directions
    miss = unit - seen
    zero = torch.zeros_like(shrink)
    (x, y, z), u = seen.unbind(dim=1), unit.unbind(dim=1)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]  # what a small turn does to -R^T d, one row per axis of the turn
    # d unit = (I - unit unit^T) dk / |k|, and dk has one entry: -1 for the principal point, -k_x (-k_y) for the
    # logarithm of fx (fy).
    moved = [(u[i] * u[j] - float(i == j)) * shrink for j in range(2) for i in range(3)]
    zoomed = [column * k[:, j // 3] for j, column in enumerate(moved)]
    if model.free_principal:
        rows += moved
    rows += [zoomed[i] + zoomed[i + 3] for i in range(3)] if model.square_pixels else zoomed
    rows += [miss[:, i] for i in range(3)]
    jacobian = torch.stack(rows, dim=1).unflatten(1, (-1, 3))
    products = (jacobian * kept[:, None, None]).flatten(2) @ jacobian.flatten(2).transpose(1, 2)
    hessian, gradient, cost = products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]
    return (
        (hessian, gradient, cost)
        if model.prior is None
        else _with_prior(fit, hessian, gradient, cost, model, model.prior)
    )


def _with_prior(
    fit: Fit,
    hessian: Float[Tensor, "n p p"],
    gradient: Float[Tensor, "n p"],
    cost: Float[Tensor, " n"],
    model: Model,
    prior: FocalPrior,
) -> tuple[Float[Tensor, "n p p"], Float[Tensor, "n p"], Float[Tensor, " n"]]:
    """The same with what is told of focal lengths. Views that share one tell one thing, not each its own."""
    information = (
        prior.told.to(cost) / prior.deviation**2 / (prior.told.sum().clamp_min(1) if model.shared_focal else 1)
    )
    off = prior.off(fit)
    off = off[:, :1] if model.square_pixels else off
    zeros = torch.zeros_like(gradient[:, : model.local])
    diagonal = information[:, None] * torch.cat([zeros, torch.ones_like(off)], dim=1)
    return (
        hessian + torch.diag_embed(diagonal),
        gradient + torch.cat([zeros, information[:, None] * off], dim=1),
        cost + information * off.square().sum(dim=1),
    )


def _step(
    hessian: Float[Tensor, "n p p"], gradient: Float[Tensor, "n p"], damping: Float[Tensor, " n"], model: Model
) -> Float[Tensor, "n p"]:
    """The damped Gauss-Newton step; shared parameters get one value."""
    damped = _regular(hessian) + torch.diag_embed(damping[:, None] * hessian.diagonal(dim1=1, dim2=2))
    if not model.shared_focal:
        return -torch.linalg.solve(damped, gradient)
    local = slice(0, model.local)
    shared = slice(model.local, model.total)
    eliminated = torch.linalg.solve(
        damped[:, local, local], torch.cat([damped[:, local, shared], gradient[:, local, None]], dim=2)
    )
    reduced = damped[:, shared, shared] - damped[:, shared, local] @ eliminated[:, :, :-1]
    right = gradient[:, shared] - (damped[:, shared, local] @ eliminated[:, :, -1:])[..., 0]
    common = -torch.linalg.solve(_regular(reduced.sum(dim=0, keepdim=True))[0], right.sum(dim=0))
    return torch.cat([-eliminated[:, :, -1] - eliminated[:, :, :-1] @ common, common.expand(len(gradient), -1)], dim=1)


def _regular(hessian: Float[Tensor, "n p p"]) -> Float[Tensor, "n p p"]:
    """With a ridge far below everything that rays can say, so that it can always be inverted."""
    ridge = _RIDGE * hessian.diagonal(dim1=1, dim2=2).mean(dim=1) + torch.finfo(hessian.dtype).tiny ** 0.5
    return hessian + ridge[:, None, None] * torch.eye(hessian.shape[1], dtype=hessian.dtype, device=hessian.device)


def _moved(fit: Fit, step: Float[Tensor, "n p"], model: Model) -> Fit:
    """The cameras after a step, which is shortened where it leaves what linearisation may say."""
    turn = step[:, :3] * (0.5 / step[:, :3].norm(dim=1, keepdim=True).clamp_min(0.5))
    zoom = step[:, model.local :].clamp(-0.7, 0.7).exp()
    principal = fit.principal
    if model.free_principal:
        principal = principal + fit.focal * step[:, 3:5].clamp(-0.5, 0.5)
    return Fit(rotations=fit.rotations @ rotation_of(turn), focal=fit.focal * zoom, principal=principal)


def _descend(
    fit: Fit, rays: Rays, likely: Float[Tensor, "n r"], model: Model, *, steps: int
) -> tuple[Fit, Float[Tensor, "n p p"]]:
    """Levenberg-Marquardt with fixed weights: the optimum and its Hessian.

    Every view accepts or refuses its own steps; all do so together if they share a focal length.
    """
    hessian, gradient, cost = _normal_equations(fit, rays, likely, model)
    damping = torch.zeros_like(cost)
    for _ in range(steps):
        step = _step(hessian, gradient, damping, model)
        if step.numel() == 0 or float(step.abs().max()) < _CONVERGED:
            break
        trial = _moved(fit, step, model)
        new_hessian, new_gradient, new_cost = _normal_equations(trial, rays, likely, model)
        better = (new_cost.sum() <= cost.sum()).expand_as(cost) if model.shared_focal else new_cost <= cost

        def chosen(new: Tensor, old: Tensor, better: Tensor = better) -> Tensor:
            return torch.where(better.reshape(-1, *[1] * (new.dim() - 1)), new, old)

        fit = Fit(
            rotations=chosen(trial.rotations, fit.rotations),
            focal=chosen(trial.focal, fit.focal),
            principal=chosen(trial.principal, fit.principal),
        )
        hessian, gradient, cost = chosen(new_hessian, hessian), chosen(new_gradient, gradient), chosen(new_cost, cost)
        damping = torch.where(better, damping / 10, (damping * 100).clamp(1e-4, 1e6))
    left, _, right = torch.linalg.svd(fit.rotations)  # products of rotations drift by roundings
    return dataclasses.replace(fit, rotations=left @ right), hessian


def _covariance(fit: Fit, hessian: Float[Tensor, "n p p"], model: Model) -> Float[Tensor, "n 7 7"]:
    """Inverse of the information matrix (a joint one if views share a focal length), in the parameters that people
    read.
    """
    information = _regular(hessian)
    if model.shared_focal:
        local, shared = slice(0, model.local), slice(model.local, model.total)
        own = torch.linalg.inv(information[:, local, local])
        coupling = own @ information[:, local, shared]
        reduced = information[:, shared, shared] - information[:, shared, local] @ coupling
        common = torch.linalg.inv(_regular(reduced.sum(dim=0, keepdim=True))).expand(len(own), -1, -1)
        cross = -coupling @ common
        upper = torch.cat([own + coupling @ common @ coupling.transpose(1, 2), cross], dim=2)
        inverse = torch.cat([upper, torch.cat([cross.transpose(1, 2), common], dim=2)], dim=1)
    else:
        inverse = torch.linalg.inv(information)
    readable = fit.focal.new_zeros(len(fit.focal), 7, model.total)
    readable[:, :3, :3] = torch.eye(3, dtype=readable.dtype, device=readable.device)
    if model.free_principal:
        readable[:, 5:, 3:5] = torch.diag_embed(fit.focal)
    readable[:, 3:5, model.local :] = fit.focal[:, :, None] if model.square_pixels else torch.diag_embed(fit.focal)
    return readable @ inverse @ readable.transpose(1, 2)
