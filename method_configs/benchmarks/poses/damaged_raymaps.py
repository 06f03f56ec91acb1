"""``fillerbuster bench poses``: cameras from raymaps, in closed form and refined, beside 700 steps of plain gradient
descent.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.evaluation.metrics.camera_errors import errors
from fb_core.evaluation.results import Bar, OnCell, Report
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.solver import PoseSolving, RecoveredCameras, recover_cameras
from fb_core.geometry.raymap import raymaps_of
from fb_core.geometry.rotations import rotations_of
from method_configs.benchmarks.poses.plain_pose_fit import fit_cameras_plainly


@dataclass(frozen=True, kw_only=True)
class PosesBenchmark:
    """What is measured."""

    views: int = 16
    """Raymaps of a case."""
    size: int = 256
    """Their side in pixels."""
    draws: int = 3
    """Scenes of each case; errors are over all of their views, times are medians over them."""
    plain_steps: int = 700
    """Steps of the plain fit; 0 leaves it out."""
    plain_stride: int = 8
    """It gets every so-manieth pixel in both directions, for it is slow. What all pixels would cost it is timed over a
    few steps.
    """
    chi_square_views: int = 480
    """Noisy views over which covariances are compared with errors."""
    seed: int = 0
    """Decides cameras, noise and outliers."""

    def __post_init__(self) -> None:
        if (
            min(self.views, self.draws, self.chi_square_views, self.plain_stride) < 1
            or self.size < 8
            or self.plain_steps < 0
        ):
            raise ValueError(
                "poses benchmark: expected at least one view, draw and stride, a size of 8 or more and no negative "
                f"steps, got {self}"
            )


QUICK = PosesBenchmark(views=3, size=32, draws=1, plain_steps=20, plain_stride=2, chi_square_views=40)
"""A miniature that runs in seconds."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One kind of damage."""

    name: str
    """What is done to the raymaps."""
    damage: Callable[[Tensor, torch.Generator], Tensor] = lambda raymaps, _: raymaps
    """Does it."""
    known: float = 1.0
    """Share of the pixels that are not masked."""
    window: tuple[float, float] | None = None
    """Corner of the window of half the side that is kept, in sides: principal points are far from its centre."""


def noisy(
    raymaps: Float[Tensor, "n 6 h w"], generator: torch.Generator, degrees: float, outliers: float = 0.0
) -> Float[Tensor, "n 6 h w"]:
    """Directions off by so many degrees per axis, origins by a hundredth per degree, and a square block that belongs to
    another camera.
    """

    def noise(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=generator, dtype=like.dtype)

    origins, directions = raymaps[:, :3], raymaps[:, 3:]
    origins = origins + 0.01 * degrees * noise(origins)
    directions = torch.nn.functional.normalize(directions + math.radians(degrees) * noise(directions), dim=1)
    height, width = (round(side * math.sqrt(outliers)) for side in raymaps.shape[-2:])
    turns = rotations_of(F.normalize(torch.randn(len(raymaps), 4, generator=generator, dtype=raymaps.dtype), dim=-1))
    directions[..., :height, :width] = torch.einsum("nij,njhw->nihw", turns, directions[..., :height, :width])
    origins[..., :height, :width] += 0.5
    return torch.cat([origins, directions], dim=1)


def rounded(raymaps: Float[Tensor, "n 6 h w"], _: torch.Generator) -> Float[Tensor, "n 6 h w"]:
    """As if decoded in bfloat16, in the range [0, 1] of the raymap autoencoder."""
    return (raymaps / 2 + 0.5).bfloat16().to(raymaps.dtype) * 2 - 1


CASES = (
    Case(name="clean"),
    Case(name="bfloat16", damage=rounded),
    Case(name="1 degree", damage=lambda raymaps, generator: noisy(raymaps, generator, 1.0)),
    Case(name="3 degrees", damage=lambda raymaps, generator: noisy(raymaps, generator, 3.0)),
    Case(name="1 degree, 15 % outliers", damage=lambda raymaps, generator: noisy(raymaps, generator, 1.0, 0.15)),
    Case(name="1 degree, 30 % outliers", damage=lambda raymaps, generator: noisy(raymaps, generator, 1.0, 0.30)),
    Case(name="3 degrees, 30 % outliers", damage=lambda raymaps, generator: noisy(raymaps, generator, 3.0, 0.30)),
    Case(name="1 degree, half masked", damage=lambda raymaps, generator: noisy(raymaps, generator, 1.0), known=0.5),
    Case(name="clean crop", window=(0.0, 0.5)),
    Case(name="1 degree, crop", damage=lambda raymaps, generator: noisy(raymaps, generator, 1.0), window=(0.5, 0.5)),
)
"""What raymaps may have gone through."""


def run_poses(config: PosesBenchmark = PosesBenchmark(), *, on_cell: OnCell = lambda _: None) -> Report:
    """A row per case with time and errors of both ways, two with the chi-square of covariances, and what all pixels
    cost the plain fit.
    """
    report = Report(seed=config.seed)
    recover_cameras(raymaps_of(_scene(config, 0)[0]).float())  # the first call of anything is slow
    for case in CASES:
        on_cell(case.name)
        report.rows.append(_row(case, config))
    on_cell("covariances")
    report.rows.extend(_chi_square(config, focal) for focal in ("per_view", "shared"))
    if config.plain_steps:
        on_cell("the plain fit on all pixels")
        report.rows.append(_all_pixels(config))
    report.bars.extend(_bars(report.rows))
    return report


def _scene(config: PosesBenchmark, draw: int, *, views: int | None = None) -> tuple[Pinholes, torch.Generator]:
    """Cameras anywhere in the cube, turned anyhow, with 40 to 70 degrees of view."""
    generator = torch.Generator().manual_seed(1000 * config.seed + draw)
    count = views or config.views
    rotations = rotations_of(F.normalize(torch.randn(count, 4, generator=generator, dtype=torch.float64), dim=-1))
    centers = torch.rand(count, 3, 1, generator=generator, dtype=torch.float64) * 1.6 - 0.8
    half_angle = torch.deg2rad(20 + 15 * torch.rand(count, 1, generator=generator, dtype=torch.float64))
    cameras = Pinholes(
        camera_to_world=torch.cat([rotations, centers], dim=2),
        focal=(config.size / 2 / half_angle.tan()).expand(-1, 2),
        principal=torch.full((count, 2), config.size / 2, dtype=torch.float64),
        width=config.size,
        height=config.size,
    )
    return cameras, generator


def _row(case: Case, config: PosesBenchmark) -> dict[str, Any]:
    solved: list[dict[str, Tensor]] = []
    plain: list[dict[str, Tensor]] = []
    times: dict[str, list[float]] = {"cpu": [], "wall": [], "plain_cpu": []}
    trusted = 0
    for draw in range(config.draws):
        cameras, generator = _scene(config, draw)
        if case.window is not None:
            half = config.size // 2
            cameras = cameras.cropped(
                round(case.window[0] * config.size), round(case.window[1] * config.size), half, half
            )
        raymaps = case.damage(raymaps_of(cameras), generator).float()
        weights = (
            (torch.rand(raymaps[:, :1].shape, generator=generator) < case.known).float() if case.known < 1 else None
        )
        principal = None if case.window is None else cameras.principal
        begin = time.process_time(), time.perf_counter()
        estimate = recover_cameras(raymaps, weights=weights, principal=principal)
        times["cpu"].append(time.process_time() - begin[0])
        times["wall"].append(time.perf_counter() - begin[1])
        trusted += int(estimate.trusted.sum())
        solved.append(errors(estimate.cameras, cameras))
        if config.plain_steps and draw == 0:
            start = time.process_time()
            fitted = fit_cameras_plainly(
                raymaps, steps=config.plain_steps, stride=config.plain_stride, weights=weights, principal=principal
            )
            times["plain_cpu"].append(time.process_time() - start)
            plain.append(errors(fitted, cameras))
    row: dict[str, Any] = {
        "part": "poses",
        "case": case.name,
        "views": config.views,
        "size": raymaps.shape[-1],
        "draws": config.draws,
    }
    row |= {"cpu_seconds": statistics.median(times["cpu"]), "wall_seconds": statistics.median(times["wall"])}
    row |= _summary(solved, "") | {"trusted_share": trusted / (config.views * config.draws)}
    if plain:
        row |= {
            "plain_cpu_seconds": times["plain_cpu"][0],
            "cpu_ratio": times["plain_cpu"][0] / row["cpu_seconds"],
        } | _summary(plain, "plain_")
    return row


def _summary(measured: list[dict[str, Tensor]], prefix: str) -> dict[str, float]:
    every = {name: torch.cat([one[name] for one in measured]) for name in measured[0]}
    kinds = {"median": torch.median, "max": torch.max}
    return {
        f"{prefix}{name}_{kind}": float(reduce(values))
        for name, values in every.items()
        for kind, reduce in kinds.items()
    }


def _chi_square(config: PosesBenchmark, focal: str) -> dict[str, Any]:
    """Mean of error^T covariance^-1 error per degree of freedom over views with 1 degree of noise: 1 if the covariances
    are honest.

    A shared focal length errs in all views at once and is left out, so that views count as independent.
    """
    small = dataclasses.replace(config, size=min(config.size, 48))
    cameras, generator = _scene(small, 500, views=config.chi_square_views)
    if focal == "shared":
        cameras = dataclasses.replace(cameras, focal=cameras.focal[:1].expand_as(cameras.focal))
    solving = PoseSolving(focal="shared" if focal == "shared" else "per_view", square_pixels=focal == "shared")
    estimate = recover_cameras(noisy(raymaps_of(cameras), generator, 1.0), solving=solving)
    freedom = 6 if focal == "shared" else 8
    error = _error_vector(estimate, cameras)[:, :freedom]
    squares = (error * torch.linalg.solve(estimate.covariance[:, :freedom, :freedom], error)).sum(dim=1) / freedom
    return {
        "part": "covariance",
        "focal": focal,
        "views": len(cameras),
        "size": small.size,
        "freedom": freedom,
        "chi_square": float(squares.mean()),
        "expected_deviation": math.sqrt(2 / (freedom * len(cameras))),
    }


def _error_vector(found: RecoveredCameras, truth: Pinholes) -> Float[Tensor, "n 8"]:
    turn = truth.rotations.transpose(1, 2) @ found.cameras.rotations
    axis = (
        torch.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], dim=1
        )
        / 2
    )
    return torch.cat([axis, found.cameras.centers - truth.centers, found.cameras.focal - truth.focal], dim=1)


def _all_pixels(config: PosesBenchmark) -> dict[str, Any]:
    """What a step of the plain fit costs with every pixel; 700 of them are reckoned, not run."""
    cameras, _ = _scene(config, 0)
    raymaps = raymaps_of(cameras).float()
    steps = 4
    fit_cameras_plainly(raymaps, steps=1)
    begin = time.process_time()
    fit_cameras_plainly(raymaps, steps=steps)
    each = (time.process_time() - begin) / steps
    return {
        "part": "plain fit, all pixels",
        "views": config.views,
        "size": config.size,
        "cpu_seconds_of_a_step": each,
        "of_700_reckoned": 700 * each,
    }


def _bars(rows: list[dict[str, Any]]) -> list[Bar]:
    poses = {row["case"]: row for row in rows if row["part"] == "poses"}
    chi_squares = [abs(row["chi_square"] - 1) for row in rows if row["part"] == "covariance"]
    measured: list[tuple[str, float, float]] = [
        ("clean: rotation, worst view, degrees", poses["clean"]["rotation_degrees_max"], 1e-5),
        ("clean: CPU seconds", poses["clean"]["cpu_seconds"], 0.25),
        ("1 degree of noise: rotation, median, degrees", poses["1 degree"]["rotation_degrees_median"], 0.15),
        ("30 % outliers: rotation, worst view, degrees", poses["1 degree, 30 % outliers"]["rotation_degrees_max"], 0.5),
        ("covariances: chi-square off 1", max(chi_squares), 0.1),
    ]
    return [Bar(name=name, value=value, limit=limit, sense="<=") for name, value, limit in measured]
