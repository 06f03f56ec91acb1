"""Bundle adjustment: cameras, focal lengths and points that fit observations best, by Levenberg-Marquardt with the points eliminated."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from fb_core.geometry.pose_refine import rotation_of

_HUBER = 1.0  # tolerances beyond which a residual counts linearly
_CONVERGED = 1e-6  # relative gain of a step
_NEAREST = 1e-6  # depth of points that are not behind the camera


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """n cameras of l lenses that observe p points o times; float64. The camera's place is -rotation.T @ shift."""

    rotations: Float[np.ndarray, "n 3 3"]
    """World to camera."""
    shifts: Float[np.ndarray, "n 3"]
    """Of the same maps."""
    focal: Float[np.ndarray, " l"]
    """Pixels."""
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
        behind = seen[:, 2] < _NEAREST
        depth = np.where(behind, 1.0, seen[:, 2])
        misses = self.focal[self.lens[self.camera_of], None] * seen[:, :2] / depth[:, None] - self.offsets
        return np.where(behind[:, None], 1e3 * self.tolerance[:, None], misses)


def adjust(bundle: Bundle, *, told: Float[np.ndarray, " l"], deviation: Float[np.ndarray, " l"], steps: int = 20) -> Bundle:
    """The bundle at a minimum of Huber's loss of the misses over their tolerance.

    Args:
        bundle: a guess.
        told: focal lengths that are known beforehand; NaN where none is.
        deviation: standard deviations of their logarithms.
        steps: at most.
    """
    damping, cost = 1e-3, _cost(bundle, told, deviation)
    for _ in range(steps):
        equations = _Equations.of(bundle, told, deviation)
        while damping < 1e8:
            trial = equations.stepped(bundle, damping)
            new = _cost(trial, told, deviation)
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


def _cost(bundle: Bundle, told: np.ndarray, deviation: Float[np.ndarray, " l"]) -> float:
    relative = _relative(bundle)
    loss = np.where(relative <= _HUBER, relative**2, 2 * _HUBER * relative - _HUBER**2)
    return float(loss.sum() + _off(bundle, told, deviation)[1].sum())


def _off(bundle: Bundle, told: np.ndarray, deviation: Float[np.ndarray, " l"]) -> tuple[np.ndarray, np.ndarray]:
    """Logarithms of focal lengths against what is told, in deviations, and their squares; 0 where nothing is told."""
    off = np.where(np.isfinite(told), np.log(bundle.focal / np.where(np.isfinite(told), told, 1.0)), 0.0) / deviation
    return off, off**2


@dataclass(frozen=True, kw_only=True)
class _Equations:
    """Normal equations: of cameras and lenses, of points, and between them. Camera parameters: turn and shift (6 n), log focal (l)."""

    own: Any
    mixed: Any
    points: Float[np.ndarray, "p 3 3"]
    gradient: Float[np.ndarray, " d"]
    point_gradient: Float[np.ndarray, "p 3"]

    @staticmethod
    def of(bundle: Bundle, told: np.ndarray, deviation: Float[np.ndarray, " l"]) -> _Equations:
        from scipy import sparse

        count, lenses, observations = len(bundle.rotations), len(bundle.focal), len(bundle.camera_of)
        of_camera, of_point, misses = _jacobians(bundle)
        lens = bundle.lens[bundle.camera_of]
        columns = np.concatenate([6 * bundle.camera_of[:, None] + np.arange(6), 6 * count + lens[:, None]], axis=1)
        rows = 2 * np.arange(observations)[:, None] + np.arange(2)

        def matrix(blocks: np.ndarray, columns: np.ndarray, width: int) -> Any:
            at = np.broadcast_to(rows[:, :, None], blocks.shape), np.broadcast_to(columns[:, None, :], blocks.shape)
            return sparse.csr_matrix((blocks.ravel(), (at[0].ravel(), at[1].ravel())), shape=(2 * observations, width))

        cameras = matrix(of_camera, columns, 6 * count + lenses)
        points = matrix(of_point, 3 * bundle.point_of[:, None] + np.arange(3), 3 * len(bundle.points))
        squares = np.zeros((len(bundle.points), 3, 3))
        np.add.at(squares, bundle.point_of, np.einsum("oki,okj->oij", of_point, of_point))
        own = (cameras.T @ cameras).toarray()
        gradient = cameras.T @ misses.ravel()
        off, _ = _off(bundle, told, deviation)
        own[6 * count :, 6 * count :] += np.diag(np.isfinite(told) / deviation**2)
        gradient[6 * count :] += off / deviation
        return _Equations(
            own=own,
            mixed=(cameras.T @ points).tocsr(),
            points=squares,
            gradient=gradient,
            point_gradient=(points.T @ misses.ravel()).reshape(-1, 3),
        )

    def stepped(self, bundle: Bundle, damping: float) -> Bundle:
        """After one damped step: the Schur complement gives the cameras, then each point follows."""
        from scipy import sparse

        count = len(bundle.rotations)
        diagonal = np.einsum("pii->pi", self.points)
        points = self.points + (damping * diagonal + 1e-12)[:, :, None] * np.eye(3)
        inverse = np.linalg.inv(points)
        blocks = sparse.bsr_matrix((inverse, np.arange(len(inverse)), np.arange(len(inverse) + 1)), shape=(3 * len(inverse),) * 2)
        eliminated = self.mixed @ blocks
        own = self.own + np.diag(damping * np.diag(self.own) + 1e-12)
        reduced = own - (eliminated @ self.mixed.T).toarray()
        right = self.gradient - eliminated @ self.point_gradient.ravel()
        try:
            step = -np.linalg.solve(reduced, right)
        except np.linalg.LinAlgError:  # more damping will make it solvable
            return bundle
        moved = -np.einsum("pij,pj->pi", inverse, self.point_gradient + (self.mixed.T @ step).reshape(-1, 3))
        turns, shifts = np.split(step[: 6 * count].reshape(-1, 6), 2, axis=1)
        turned = rotation_of(torch.from_numpy(turns.copy())).numpy()
        return dataclasses.replace(
            bundle,
            rotations=turned @ bundle.rotations,
            shifts=np.einsum("nij,nj->ni", turned, bundle.shifts) + shifts,
            focal=bundle.focal * np.exp(np.clip(step[6 * count :], -0.5, 0.5)),
            points=bundle.points + moved,
        )


def _jacobians(bundle: Bundle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted derivatives by camera (turn, shift, log focal), by point, and weighted misses. A turn moves R x + t as [w]x (R x + t)."""
    seen, focal = bundle.in_camera(), bundle.focal[bundle.lens[bundle.camera_of]]
    misses = bundle.misses()
    front = seen[:, 2] >= _NEAREST
    relative = _relative(bundle)
    weight = front * np.sqrt(np.minimum(1.0, _HUBER / np.maximum(relative, 1e-12))) / bundle.tolerance
    depth = np.where(front, seen[:, 2], 1.0)
    x, y = seen[:, 0] / depth, seen[:, 1] / depth
    zero = np.zeros_like(x)
    by_seen = (focal / depth)[:, None, None] * np.stack([np.stack([zero + 1, zero, -x], 1), np.stack([zero, zero + 1, -y], 1)], 1)
    skew = np.stack(
        [
            np.stack([zero, seen[:, 2], -seen[:, 1]], 1),
            np.stack([-seen[:, 2], zero, seen[:, 0]], 1),
            np.stack([seen[:, 1], -seen[:, 0], zero], 1),
        ],
        1,
    )  # of d([w]x s) / dw = -[s]x
    by_focal = (focal[:, None] * np.stack([x, y], 1))[:, :, None]
    of_camera = np.concatenate([by_seen @ skew, by_seen, by_focal], axis=2)
    of_point = by_seen @ bundle.rotations[bundle.camera_of]
    return of_camera * weight[:, None, None], of_point * weight[:, None, None], misses * weight[:, None]
