"""``fillerbuster bench sampler``: error against passes for all solvers and grids, on a solvable flow and on a trained
model.

A pass is one evaluation of the network under one branch of guidance. The original takes three a step, whatever the
guidance.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fb_core.conditioning import LATENT_CHANNELS, STATE_CHANNELS
from fb_core.evaluation.completion import unseen_room
from fb_core.evaluation.results import Bar, OnCell, Report
from fb_core.inpainter import Fillerbuster
from fb_core.sampling.guidance import GuidanceVariant
from fb_core.sampling.integration.solvers import SOLVERS, VelocityField, evaluations
from fb_core.sampling.integration.time_grids import time_grid
from fb_core.sampling.integration.trajectory import integrate
from fb_core.sampling.options import SamplingConfig
from fb_core.sampling.starts import imposed
from fb_core.views import Views
from method_configs.benchmarks.sampler.solvable_flows import Mixture, fine_endpoint, guided_flow
from method_configs.benchmarks.sampler.steps_by_task import degrees

REFERENCE_PASSES = 3
"""Passes that the original takes a step."""
PASSES_BAR = 32
"""Passes in which the default must reach the original's error."""


@dataclass(frozen=True, kw_only=True)
class SamplerBenchmark:
    """What is measured."""

    guidance: tuple[float, ...] = (1.0, 3.0, 7.0)
    """Guidance scales (of unknown content; known content has 1.1, or 1 beside 1)."""
    steps: tuple[int, ...] = (4, 6, 8, 10, 12, 16, 24)
    """Steps of every solver; Heun takes about half as many."""
    shifts: tuple[float, ...] = (0.5, 1.0, 1.5, 2.0)
    """Time shifts of the even grid."""
    intervals: tuple[tuple[float, float], ...] = ((0.9, 0.2), (0.8, 0.3))
    """Limited guidance intervals (begin, end)."""
    strength: float = 0.5
    """Time at which half of the latents join the others, which start from noise."""
    reference_steps: int = 50
    """Euler steps of the original."""
    fine_steps: int = 1000
    """Steps of the solution that errors are measured against."""
    problems: int = 2
    """Solvable flows, and rooms for the model, over which errors are averaged."""
    views: int = 4
    """Views per room; half of them are known."""
    size: int = 64
    """Their side in pixels."""
    pose_steps: tuple[int, ...] = (2, 4, 8, 16, 24)
    """Steps at which raymaps are recovered."""
    model: bool = True
    """Also measure a trained model."""
    seed: int = 0
    """Decides flows, rooms and noise."""

    def __post_init__(self) -> None:
        if (
            min(self.problems, self.views - 1, self.fine_steps, self.reference_steps, *self.steps) < 1
            or not self.guidance
            or not all(map(math.isfinite, self.guidance))
        ):
            raise ValueError(
                f"benchmark: expected at least one problem, step and finite guidance scale, and two views, got {self}"
            )
        if not 0 < self.strength < 1:
            raise ValueError(f"benchmark: expected a strength between 0 and 1, got {self.strength}")


QUICK = SamplerBenchmark(
    guidance=(3.0,), steps=(2, 4), shifts=(2.0,), intervals=((0.8, 0.3),), reference_steps=4, fine_steps=20, problems=1,
    views=2, size=16,
    pose_steps=(2,),
)  # fmt: skip
"""A miniature that runs in seconds; its figures mean nothing."""


@dataclass(frozen=True, kw_only=True)
class _Problem:
    """A flow under one guidance scale, with its exact endpoint."""

    field: VelocityField
    limited: Callable[[GuidanceVariant], VelocityField]
    start: Tensor
    exact: Tensor
    guidance: float
    joined: VelocityField
    """The velocity when half of the latents are told and join at the strength."""
    exact_joined: Tensor

    def error(self, end: Tensor, exact: Tensor | None = None) -> float:
        """Mean over views of the distance to the exact endpoint over its length."""
        exact = self.exact if exact is None else exact
        return float(((end - exact).flatten(1).norm(dim=1) / exact.flatten(1).norm(dim=1)).mean())

    def passes(self, solver: str, times: list[float], variant: GuidanceVariant = GuidanceVariant()) -> int:
        if self.guidance == 1:
            return evaluations(solver, len(times) - 1)
        assert solver != "heun" or not variant.is_limited
        return 2 * evaluations(solver, len(times) - 1) - sum(not variant.acts_at(time) for time in times[:-1])


@torch.no_grad()
def run_sampler(
    config: SamplerBenchmark = SamplerBenchmark(),
    model: Fillerbuster | None = None,
    *,
    on_cell: OnCell = lambda _: None,
) -> Report:
    """One row per (flow, guidance, solver, grid, steps), the bars, starts at the strength, limited intervals and pose
    budgets.

    ``model`` None is the bundled one.
    """
    report = Report(seed=config.seed)
    flows: dict[str, Callable[[float, int], _Problem]] = {
        "solvable flow": lambda scale, number: _solvable(config, scale, number)
    }
    if config.model:
        network = model or Fillerbuster.from_pretrained()
        flows["trained model"] = lambda scale, number: _trained(config, network, scale, number)
    for flow, make in flows.items():
        for guidance in config.guidance:
            on_cell(f"{flow}, guidance {guidance:g}")
            problems = [make(guidance, number) for number in range(config.problems)]
            _measure(report, config, flow, problems)
    if config.model:
        on_cell("raymaps of photos without poses")
        _measure_poses(report, config, network)
    return report


# Problems ----------------------------------------------------------------------------------------------------------


def _solvable(config: SamplerBenchmark, guidance: float, number: int) -> _Problem:
    """The condition is three of the sixteen components, in 64 dimensions; half of these may be told, from a sample of
    the condition.
    """
    generator = torch.Generator().manual_seed(1000 * config.seed + number)
    everything = Mixture.drawn(16, 64, generator=generator)
    condition, start = everything.of(range(3)), torch.randn(16, 64, generator=generator, dtype=torch.float64)

    def field(variant: GuidanceVariant = GuidanceVariant()) -> VelocityField:
        return guided_flow(everything, condition, guidance, variant)

    component = torch.randint(3, (16,), generator=generator)
    spread = condition.variances[component].sqrt()
    sample = condition.means[component] + spread * torch.randn(16, 64, generator=generator, dtype=torch.float64)
    counts = (torch.arange(64) < 32).to(sample).expand(16, -1)
    joined = imposed(field(), sample, start, counts, until=config.strength)
    exact, exact_joined = (fine_endpoint(flow, start, steps=config.fine_steps) for flow in (field(), joined))
    return _Problem(
        field=field(),
        limited=field,
        start=start,
        exact=exact,
        guidance=guidance,
        joined=joined,
        exact_joined=exact_joined,
    )


def _trained(config: SamplerBenchmark, model: Fillerbuster, guidance: float, number: int) -> _Problem:
    """An unseen room of which the model knows half of the views, and of the others may be told the left halves.

    The exact endpoint is that of many steps.
    """
    whole, views = _room(config, number), _room(config, number)
    views.image_known[len(views) // 2 :] = 0
    sampling = SamplingConfig(guidance_unknown=guidance, guidance_known=min(guidance, 1.1))

    def field(variant: GuidanceVariant = GuidanceVariant()) -> VelocityField:
        return model.denoising(
            views, seed=config.seed, sampling=dataclasses.replace(sampling, guidance=variant)
        ).field()

    plain = model.denoising(views, seed=config.seed, sampling=sampling)
    start, later = plain.start(), dataclasses.replace(sampling, strength=config.strength)
    latents = model.denoising(whole, seed=config.seed, sampling=sampling).conditioning.channels[:, :STATE_CHANNELS]
    counts = torch.ones_like(latents)
    counts[len(views) // 2 :, :LATENT_CHANNELS, :, latents.shape[-1] // 2 :] = 0
    joined = dataclasses.replace(plain, sampling=later, current=latents, counts=counts).field()
    exact = integrate(field(), start, time_grid(config.fine_steps), solver="ab2")
    exact_joined = integrate(joined, start, time_grid(config.fine_steps, through=(config.strength,)), solver="ab2")
    return _Problem(
        field=field(),
        limited=field,
        start=start,
        exact=exact,
        guidance=guidance,
        joined=joined,
        exact_joined=exact_joined,
    )


def _room(config: SamplerBenchmark, number: int) -> Views:
    room = unseen_room(family="narrow", seed=config.seed, number=number, views=config.views, size=config.size)
    views = Views.known(room.images, room.cameras)
    return dataclasses.replace(views, image_known=views.image_known.clone(), rays_known=views.rays_known.clone())


# Measurements ------------------------------------------------------------------------------------------------------


def grid_name(shift: float) -> str:
    """What a shifted grid is called in the rows."""
    return "even" if shift == 1 else f"shift {shift:g}"


def _grids(config: SamplerBenchmark) -> Iterator[tuple[str, dict[str, Any]]]:
    for shift in config.shifts:
        yield grid_name(shift), {"shift": shift}
    yield "reference", {"grid": "reference"}


def _measure(report: Report, config: SamplerBenchmark, flow: str, problems: list[_Problem]) -> None:
    guidance = problems[0].guidance
    same = {"part": flow, "guidance": guidance}

    def error(solver: str, times: list[float]) -> float:
        return sum(
            problem.error(integrate(problem.field, problem.start, times, solver=solver)) for problem in problems
        ) / len(problems)

    wanted = error("euler", time_grid(config.reference_steps, grid="reference"))
    original = {"solver": "original (euler)", "grid": "reference", "steps": config.reference_steps}
    report.rows.append(
        {**same, **original, "passes": REFERENCE_PASSES * config.reference_steps, "error": wanted, "reached": True}
    )
    mine = []
    for solver in SOLVERS:
        for name, options in _grids(config):
            for steps in config.steps:
                if solver == "heun" and steps > max(config.steps) // 2:
                    continue
                times = time_grid(steps, **options)
                row = {
                    **same,
                    "solver": solver,
                    "grid": name,
                    "steps": steps,
                    "passes": problems[0].passes(solver, times),
                }
                mine.append({**row, "error": (deviation := error(solver, times)), "reached": deviation <= wanted})
    report.rows.extend(mine)
    ours = {"solver": SamplingConfig().solver, "grid": grid_name(SamplingConfig().shift)}
    default = [row["passes"] for row in mine if row["reached"] and ours.items() <= row.items()]
    label = f"{flow}, guidance {guidance:g}: passes of"
    best = min((row for row in mine if row["reached"]), key=lambda row: (row["passes"], row["error"]), default=None)
    claim = f"{label} the default to the error of the original's {REFERENCE_PASSES * config.reference_steps}"
    report.bars.append(Bar(name=claim, value=float(min(default, default=float("nan"))), limit=PASSES_BAR, sense="<="))
    if best is not None:
        name = f"{label} the best ({best['solver']}, {best['grid']})"
        report.bars.append(Bar(name=name, value=float(best["passes"]), limit=PASSES_BAR, sense="<="))
    report.rows.extend(_started_rows(config, flow, problems))
    if guidance != 1:
        report.rows.extend(_limited_rows(config, flow, problems))


def _started_rows(config: SamplerBenchmark, flow: str, problems: list[_Problem]) -> Iterator[dict[str, Any]]:
    """Half of the latents are told and join the others at the strength: how exactly every solver goes on over the
    join.
    """
    for solver in SOLVERS:
        for steps in config.steps:
            if solver == "heun" and steps > max(config.steps) // 2:
                continue
            times = SamplingConfig(steps=steps, strength=config.strength).times_from_noise_too
            errors = [p.error(integrate(p.joined, p.start, times, solver=solver), p.exact_joined) for p in problems]
            yield {
                "part": f"{flow}: started at strength {config.strength:g}",
                "guidance": problems[0].guidance,
                "solver": solver,
                "steps": steps,
                "passes": problems[0].passes(solver, times),
                "error": sum(errors) / len(errors),
            }


def _limited_rows(config: SamplerBenchmark, flow: str, problems: list[_Problem]) -> Iterator[dict[str, Any]]:
    """Guidance on an interval alone leads elsewhere: how far, beside how exactly it gets there."""
    for begin, end in config.intervals:
        variant = GuidanceVariant(begin=begin, end=end)
        usual = SamplingConfig(guidance=variant)
        own, moved = 0.0, 0.0
        for problem in problems:
            field = problem.limited(variant)
            fine = time_grid(min(config.fine_steps, 200), through=variant.jumps)
            there = integrate(field, problem.start, fine, solver="ab2")
            own += problem.error(integrate(field, problem.start, usual.times, solver=usual.solver), there) / len(
                problems
            )
            moved += problem.error(there) / len(problems)
        yield {
            "part": f"{flow}: guidance on an interval is another distribution",
            "guidance": problems[0].guidance,
            "interval": f"{begin:g} to {end:g}",
            "steps": usual.steps,
            "passes": problems[0].passes(usual.solver, usual.times, variant),
            "passes_of_all": problems[0].passes(usual.solver, SamplingConfig().times),
            "error_to_its_own_end": own,
            "distance_of_that_end": moved,
        }


def _measure_poses(report: Report, config: SamplerBenchmark, model: Fillerbuster) -> None:
    """Directions of recovered rays against those of many steps, and against the true cameras (turned to fit)."""
    for steps in config.pose_steps:
        own, true = 0.0, 0.0
        for number in range(config.problems):
            views = _room(config, number)
            views.rays_known[1:] = 0

            def rays(count: int, views: Views = views) -> Tensor:
                sampling = dataclasses.replace(model.recommended_sampling, steps=count)
                return model.complete(
                    views, generator=torch.Generator().manual_seed(config.seed), sampling=sampling
                ).raymaps[1:, 3:]

            directions, fine = rays(steps), rays(4 * max(config.pose_steps))
            own += degrees(directions, fine) / config.problems
            true += degrees(directions, views.raymaps[1:, 3:]) / config.problems
        report.rows.append(
            {
                "part": "raymaps of views beside one that is posed",
                "steps": steps,
                "degrees_to_many_steps": own,
                "degrees_to_truth": true,
            }
        )
