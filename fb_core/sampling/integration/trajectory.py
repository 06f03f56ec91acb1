"""Following a flow along a time grid, with a look at every step, and a trajectory that an interruption leaves whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from fb_core.sampling.integration.jumps import piece_of, without_other_pieces
from fb_core.sampling.integration.solvers import SOLVERS, Point, VelocityField

OnStep = Callable[[int, int], None]
"""(steps done, steps in all), called after every step."""


def counted(on_step: OnStep | None, number: int, of: int) -> OnStep | None:
    """Steps of one trajectory, told as steps of all that follow one another."""
    return None if on_step is None else lambda step, steps: on_step(number * steps + step, of * steps)


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """A trajectory that is somewhere on its way."""

    point: Point
    """Where it stands."""
    step: int
    """Steps done."""
    times: tuple[float, ...]
    """The whole grid."""

    @property
    def steps(self) -> int:
        """Steps in all."""
        return len(self.times) - 1


OnTrajectory = Callable[[Trajectory], None]
"""Called after every step with where it led."""


class SamplingInterrupted(KeyboardInterrupt):
    """Ctrl-C while sampling. Nothing was changed; `trajectory` is the last whole step, from which sampling can go on
    with the same bits.
    """

    def __init__(self, trajectory: Trajectory, seed: int | None = None):
        super().__init__(f"sampling stopped after {trajectory.step} of {trajectory.steps} steps")
        self.trajectory = trajectory
        self.seed = seed
        """Seed of the draws, where `Fillerbuster.complete` was interrupted."""


def integrate(
    field: VelocityField,
    state: Float[Tensor, "n *rest"],
    times: Sequence[float],
    *,
    solver: str = "euler",
    on_step: OnStep | None = None,
    on_trajectory: OnTrajectory | None = None,
    resume: Trajectory | None = None,
) -> Float[Tensor, "n *rest"]:
    """Follow dz/dt = field(z, t) along ``times`` (descending), in float32 at least.

    Args:
        field: the velocity. Where it jumps (`Jumping`) the solver starts anew; times that hold all jumps keep the
            solver's order.
        state: where it starts, at the first of the times.
        times: see `time_grid`.
        solver: one of `SOLVERS`.
        on_step: called with (steps done, steps in all).
        on_trajectory: called with all that is known after every step.
        resume: goes on from here instead of from `state`.

    Raises ValueError for an unknown solver or a trajectory along other times, SamplingInterrupted (a KeyboardInterrupt)
    on Ctrl-C.
    """
    if solver not in SOLVERS:
        raise ValueError(f"solver: expected one of {', '.join(SOLVERS)}, got {solver!r}")
    times = tuple(times)
    if resume is not None and resume.times != times:
        raise ValueError(
            f"resume: expected a trajectory along the same {len(times)} times, got one along {len(resume.times)} others"
        )
    trajectory = resume or Trajectory(point=Point(state=state, time=times[0]), step=0, times=times)
    try:
        while trajectory.step < trajectory.steps:
            start = without_other_pieces(trajectory.point, field)
            point = SOLVERS[solver](piece_of(field, start.time), start, times[trajectory.step + 1])
            trajectory = Trajectory(point=point, step=trajectory.step + 1, times=times)
            if on_step is not None:
                on_step(trajectory.step, trajectory.steps)
            if on_trajectory is not None:
                on_trajectory(trajectory)
    except KeyboardInterrupt as error:
        raise SamplingInterrupted(trajectory) from error
    return trajectory.point.state
