"""Bundle adjustment: cameras, lenses and points that fit observations best, by Levenberg-Marquardt with the points
eliminated.

A lens has a focal length and two coefficients of radial distortion (Brown's model, as OpenCV writes it).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from fb_core.geometry.pose_solver.refine import rotation_of

_HUBER = 1.0  # tolerances beyond which a residual counts linearly
_CONVERGED = 1e-6  # relative gain of a step
_NEAREST = 1e-6  # depth of points that are not behind the camera
_FOLDED = 0.05  # derivative of the bent radius below which a place lies beyond what the distortion can describe
_NEWTON, _FARTHEST = 12, 1e3  # steps that straighten a place, and how far from the axis it may come
_BEND_DEVIATION = (0.5, 0.5)  # of k1 and k2 around 0: no more than a safeguard where few places lie far out


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """n cameras of l lenses that observe p points o times; float64. The camera's place is -rotation.T @ shift."""

    rotations: Float[np.ndarray, "n 3 3"]
    """World to camera."""
    shifts: Float[np.ndarray, "n 3"]
    """Of the same maps."""
    focal: Float[np.ndarray, " l"]
    """Pixels."""
    bend: Float[np.ndarray, "l 2"]
    """k1, k2: places at distance r from the axis in the plane at depth 1 are pictured at r (1 + k1 r^2 + k2 r^4)."""
    lens: Int[np.ndarray, " n"]
    """Of each camera."""
    points: Float[np.ndarray, "p 3"]
    """World."""
    camera_of: Int[np.ndarray, " o"]
    """Who observes."""
    point_of: Int[np.ndarray, " o"]
    """What is observed."""
    offsets: Float[np.ndarray, "o 2"]
    """Where, in pixels from the principal point."""
    tolerance: Float[np.ndarray, " o"]
    """Pixels by which an observation may well be off."""

    def in_camera(self) -> Float[np.ndarray, "o 3"]:
        """Observed points in their camera's axes."""
        turned = np.einsum("oij,oj->oi", self.rotations[self.camera_of], self.points[self.point_of])
        return turned + self.shifts[self.camera_of]

    def misses(self) -> Float[np.ndarray, "o 2"]:
        """Projected minus observed, pixels; far off for points behind the camera."""
        seen = self.in_camera()
        plane, front = self.plane(seen)
        bent = plane * radial((plane**2).sum(axis=1), self.bend[self.lens[self.camera_of]])[0][:, None]
        misses = self.focal[self.lens[self.camera_of], None] * bent - self.offsets
        return np.where(front[:, None], misses, 1e3 * self.tolerance[:, None])

    def plane(self, seen: Float[np.ndarray, "o 3"]) -> tuple[Float[np.ndarray, "o 2"], Bool[np.ndarray, " o"]]:
        """Observed points in the plane at depth 1, and whether they are before the camera and where its lens is
        defined.
        """
        front = seen[:, 2] >= _NEAREST
        plane = seen[:, :2] / np.where(front, seen[:, 2], 1.0)[:, None]
        inside = front & (radial((plane**2).sum(axis=1), self.bend[self.lens[self.camera_of]])[1] > _FOLDED)
        return np.where(inside[:, None], plane, 0.0), inside


@dataclass(frozen=True, kw_only=True)
class Lenses:
    """What is known beforehand of l lenses, and what may change."""

    told: Float[np.ndarray, " l"]
    """Focal lengths, pixels; NaN where none is known."""
    deviation: Float[np.ndarray, " l"]
    """Standard deviations of their logarithms, with the heavy tails of Cauchy's distribution: tags that lie carry no
    weight.
    """
    focal_free: Bool[np.ndarray, " l"]
    """Whether the focal length may change."""
    bend_free: Bool[np.ndarray, "l 2"]
    """Whether k1 and k2 may change."""

    def off(self, bundle: Bundle) -> Float[np.ndarray, "l 3"]:
        """How far log focal and the bend are from what is known, in deviations; 0 where nothing is."""
        known = np.isfinite(self.told)
        focal = np.where(known, np.log(bundle.focal / np.where(known, self.told, 1.0)) / self.deviation, 0.0)
        return np.concatenate([focal[:, None], bundle.bend / np.array(_BEND_DEVIATION)], axis=1)

    @property
    def weights(self) -> Float[np.ndarray, "l 3"]:
        """Inverse deviations; 0 where nothing is known."""
        bend = np.broadcast_to(1 / np.array(_BEND_DEVIATION), (len(self.told), 2))
        return np.concatenate([(np.isfinite(self.told) / self.deviation)[:, None], bend], axis=1)

    def precisions(self, bundle: Bundle) -> Float[np.ndarray, "l 3"]:
        """Inverse variances of what is known, less where it is far off."""
        return self.weights**2 / np.where(np.arange(3) == 0, 1 + self.off(bundle) ** 2, 1.0)

    @property
    def free(self) -> Bool[np.ndarray, "l 3"]:
        """Which of log focal, k1 and k2 may change."""
        return np.concatenate([self.focal_free[:, None], self.bend_free], axis=1)


def adjust(bundle: Bundle, lenses: Lenses, *, steps: int = 20) -> Bundle:
    """The bundle at a minimum of Huber's loss of the misses over their tolerance, from a guess, in so many steps at
    most.
    """
    damping, cost = 1e-3, _cost(bundle, lenses)
    for _ in range(steps):
        equations = Equations.of(bundle, lenses)
        while damping < 1e8:
            trial = equations.stepped(bundle, damping)
            new = _cost(trial, lenses)
            if new < cost:
                break
            damping *= 10
        else:
            return bundle
        gain, bundle, cost, damping = 1 - new / cost, trial, new, max(damping / 10, 1e-9)
        if gain < _CONVERGED:
            break
    return bundle


def _relative(bundle: Bundle) -> Float[np.ndarray, " o"]:
    return np.linalg.norm(bundle.misses(), axis=1) / bundle.tolerance


def _cost(bundle: Bundle, lenses: Lenses) -> float:
    relative = _relative(bundle)
    loss = np.where(relative <= _HUBER, relative**2, 2 * _HUBER * relative - _HUBER**2)
    off = lenses.off(bundle)
    return float(loss.sum() + np.log1p(off[:, 0] ** 2).sum() + (off[:, 1:] ** 2).sum())


@dataclass(frozen=True, kw_only=True)
class Equations:
    """Normal equations: of cameras and lenses, of points, and between them. Parameters: turn and shift (6 n), log
    focal, k1, k2 (3 l).
    """

    own: Any
    mixed: Any
    points: Float[np.ndarray, "p 3 3"]
    gradient: Float[np.ndarray, " d"]
    point_gradient: Float[np.ndarray, "p 3"]

    @staticmethod
    def of(bundle: Bundle, lenses: Lenses) -> Equations:
        """Linearised at the bundle."""
        from scipy import sparse

        count, observations = len(bundle.rotations), len(bundle.camera_of)
        width = 6 * count + 3 * len(bundle.focal)
        of_camera, of_point, misses = _jacobians(bundle)
        lens = bundle.lens[bundle.camera_of]
        of_camera[:, :, 6:] *= lenses.free[lens][:, None]
        of_lens = 6 * count + 3 * lens[:, None] + np.arange(3)
        columns = np.concatenate([6 * bundle.camera_of[:, None] + np.arange(6), of_lens], axis=1)
        rows = 2 * np.arange(observations)[:, None] + np.arange(2)

        def matrix(blocks: np.ndarray, columns: np.ndarray, width: int) -> Any:
            at = np.broadcast_to(rows[:, :, None], blocks.shape), np.broadcast_to(columns[:, None, :], blocks.shape)
            return sparse.csr_matrix((blocks.ravel(), (at[0].ravel(), at[1].ravel())), shape=(2 * observations, width))

        cameras = matrix(of_camera, columns, width)
        points = matrix(of_point, 3 * bundle.point_of[:, None] + np.arange(3), 3 * len(bundle.points))
        squares = _squares(bundle, of_point)
        own = (cameras.T @ cameras).toarray()
        gradient = cameras.T @ misses.ravel()
        off, prior = lenses.off(bundle), lenses.precisions(bundle)
        own[6 * count :, 6 * count :] += np.diag(np.where(lenses.free, prior, 1.0).ravel())
        tamed = off / np.where(np.arange(3) == 0, 1 + off**2, 1.0)
        gradient[6 * count :] += np.where(lenses.free, tamed * lenses.weights, 0.0).ravel()
        return Equations(
            own=own,
            mixed=(cameras.T @ points).tocsr(),
            points=squares,
            gradient=gradient,
            point_gradient=(points.T @ misses.ravel()).reshape(-1, 3),
        )

    def stepped(self, bundle: Bundle, damping: float) -> Bundle:
        """After one damped step: the Schur complement gives the cameras, then each point follows."""
        count = len(bundle.rotations)
        reduced, right, inverse = self.reduced(damping)
        try:
            step = -np.linalg.solve(reduced, right)
        except np.linalg.LinAlgError:  # more damping will make it solvable
            return bundle
        moved = -np.einsum("pij,pj->pi", inverse, self.point_gradient + (self.mixed.T @ step).reshape(-1, 3))
        turns, shifts = np.split(step[: 6 * count].reshape(-1, 6), 2, axis=1)
        turned = rotation_of(torch.from_numpy(turns.copy())).numpy()
        lens = step[6 * count :].reshape(-1, 3)
        return dataclasses.replace(
            bundle,
            rotations=turned @ bundle.rotations,
            shifts=np.einsum("nij,nj->ni", turned, bundle.shifts) + shifts,
            focal=bundle.focal * np.exp(np.clip(lens[:, 0], -0.5, 0.5)),
            bend=bundle.bend + np.clip(lens[:, 1:], -0.2, 0.2),
            points=bundle.points + moved,
        )

    def reduced(
        self, damping: float = 0.0
    ) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, " d"], Float[np.ndarray, "p 3 3"]]:
        """Equations of cameras and lenses alone, their right side, and the inverses of the points' blocks."""
        from scipy import sparse

        diagonal = np.einsum("pii->pi", self.points)
        inverse = np.linalg.inv(self.points + (damping * diagonal + 1e-12)[:, :, None] * np.eye(3))
        blocks = sparse.bsr_matrix(
            (inverse, np.arange(len(inverse)), np.arange(len(inverse) + 1)), shape=(3 * len(inverse),) * 2
        )
        eliminated = self.mixed @ blocks
        own = self.own + np.diag(damping * np.diag(self.own) + 1e-12)
        return (
            own - (eliminated @ self.mixed.T).toarray(),
            self.gradient - eliminated @ self.point_gradient.ravel(),
            inverse,
        )


def adjusted_points(bundle: Bundle, *, steps: int) -> tuple[Bundle, Float[np.ndarray, "p 3 3"]]:
    """Only the points moved to where their observations agree best, in Newton steps, and their covariance where an
    observation's deviation is its tolerance.
    """
    for step in range(steps + 1):
        _, of_point, misses = _jacobians(bundle)
        squares = _squares(bundle, of_point)
        ridge = 1e-9 * np.maximum(np.einsum("pii->p", squares), 1e-12)
        covariance = np.linalg.inv(squares + ridge[:, None, None] * np.eye(3))
        if step < steps:
            gradient = np.zeros((len(bundle.points), 3))
            np.add.at(gradient, bundle.point_of, np.einsum("oki,ok->oi", of_point, misses))
            moved = bundle.points - np.einsum("pij,pj->pi", covariance, gradient)
            bundle = dataclasses.replace(bundle, points=moved)
    return bundle, covariance


def _squares(bundle: Bundle, of_point: Float[np.ndarray, "o 2 3"]) -> Float[np.ndarray, "p 3 3"]:
    squares = np.zeros((len(bundle.points), 3, 3))
    np.add.at(squares, bundle.point_of, np.einsum("oki,okj->oij", of_point, of_point))
    return squares


def _jacobians(bundle: Bundle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted derivatives by camera (turn, shift) and lens (log focal, k1, k2), by point, and weighted misses.

    A turn moves R x + t as [w]x (R x + t).
    """
    seen, focal = bundle.in_camera(), bundle.focal[bundle.lens[bundle.camera_of]]
    misses = bundle.misses()
    plane, front = bundle.plane(seen)
    relative = _relative(bundle)
    weight = front * np.sqrt(np.minimum(1.0, _HUBER / np.maximum(relative, 1e-12))) / bundle.tolerance
    depth = np.where(front, seen[:, 2], 1.0)
    x, y = plane.T
    squares, zero = x**2 + y**2, np.zeros_like(x)
    factor, outwards = radial(squares, bundle.bend[bundle.lens[bundle.camera_of]])
    slope = (outwards - factor) / np.maximum(squares, 1e-12)
    by_plane = factor[:, None, None] * np.eye(2) + slope[:, None, None] * plane[:, :, None] * plane[:, None, :]
    to_plane = np.stack([np.stack([zero + 1, zero, -x], 1), np.stack([zero, zero + 1, -y], 1)], 1)
    by_seen = (focal / depth)[:, None, None] * (by_plane @ to_plane)
    skew = np.stack(
        [
            np.stack([zero, seen[:, 2], -seen[:, 1]], 1),
            np.stack([-seen[:, 2], zero, seen[:, 0]], 1),
            np.stack([seen[:, 1], -seen[:, 0], zero], 1),
        ],
        1,
    )  # of d([w]x s) / dw = -[s]x
    by_lens = (focal[:, None] * plane)[:, :, None] * np.stack([factor, squares, squares**2], axis=1)[:, None, :]
    of_camera = np.concatenate([by_seen @ skew, by_seen, by_lens], axis=2)
    of_point = by_seen @ bundle.rotations[bundle.camera_of]
    return of_camera * weight[:, None, None], of_point * weight[:, None, None], misses * weight[:, None]


def radial(
    squares: Float[np.ndarray, " k"], bend: Float[np.ndarray, "k 2"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """The bent radius over the straight one, and its derivative by the straight one, at squared radii in the plane at
    depth 1.
    """
    k1, k2 = bend.T
    return 1 + squares * (k1 + k2 * squares), 1 + squares * (3 * k1 + 5 * k2 * squares)


def straight_places(places: Float[np.ndarray, "k 2"], bend: Float[np.ndarray, "*k 2"]) -> Float[np.ndarray, "k 2"]:
    """The places in the plane at depth 1 that a lens with k1 and k2 pictures at the given ones, by Newton's method; NaN
    where none is.
    """
    if not bend.any():
        return places
    bend = np.broadcast_to(bend, (len(places), 2))
    target = np.linalg.norm(places, axis=1)
    radius = target.copy()
    for _ in range(_NEWTON):
        factor, slope = radial(radius**2, bend)
        radius = np.clip(radius - (radius * factor - target) / np.maximum(slope, 0.1), 0.0, _FARTHEST)
    factor, slope = radial(radius**2, bend)
    found = (np.abs(radius * factor - target) < 1e-6 * (1 + target)) & (slope > _FOLDED)
    scale = np.where(found, radius / np.maximum(target, 1e-12), np.nan)
    return places * np.where(target > 1e-9, scale, 1.0)[:, None]
