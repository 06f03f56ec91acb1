"""Solvers of dz/dt = v(z, t) along a descending time grid, as pure steps from one point of a trajectory to the next.

A point holds all that a solver needs to go on (state, time, earlier velocities), so a trajectory can be cut and
continued with the same bits. States stay in float32 at least, whatever the network computes in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

VelocityField = Callable[[Float[Tensor, "n *rest"], float], Float[Tensor, "n *rest"]]
"""dz/dt at a state and a time."""


@dataclass(frozen=True, kw_only=True)
class Slope:
    """A velocity that was evaluated on the way, and what the step from there was."""

    time: float
    """Where it was evaluated."""
    velocity: Float[Tensor, "n *rest"]
    """dz/dt there."""
    base: Float[Tensor, "n *rest"] | None = None
    """State from which that step set out, where a later correction needs it."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """One point of a trajectory."""

    state: Float[Tensor, "n *rest"]
    """z_t."""
    time: float
    """t."""
    last: Slope | None = None
    """The evaluation before this point; None at the start."""

    @property
    def data(self) -> Float[Tensor, "n *rest"]:
        """The data that the last velocity points to: z_0 if the way went straight on. The state itself at the start."""
        return self.state if self.last is None else self.state - self.time * self.last.velocity


Step = Callable[[VelocityField, Point, float], Point]
"""(velocity field, where it stands, time to go to) -> the next point."""


def euler(field: VelocityField, point: Point, following: float) -> Point:
    """First order, one evaluation: what the original does."""
    slope = _evaluated(field, point.state, point.time)
    state = point.state + (following - point.time) * slope
    return Point(state=state, time=following, last=Slope(time=point.time, velocity=slope))


def heun(field: VelocityField, point: Point, following: float) -> Point:
    """Second order, two evaluations: the mean of the slopes at both ends. Euler into t = 0, where no network was
    trained.
    """
    step = following - point.time
    slope = _evaluated(field, point.state, point.time)
    state = point.state + step * slope
    if following > 0:
        slope = (slope + _evaluated(field, state, following)) / 2
        state = point.state + step * slope
    return Point(state=state, time=following, last=Slope(time=point.time, velocity=slope))


def ab2(field: VelocityField, point: Point, following: float) -> Point:
    """Second-order Adams-Bashforth for uneven steps, one evaluation; its first step is Euler's."""
    step = following - point.time
    slope = _evaluated(field, point.state, point.time)
    if point.last is None:
        state = point.state + step * slope
    else:
        ratio = step / (point.time - point.last.time)
        state = point.state + step * ((1 + ratio / 2) * slope - ratio / 2 * point.last.velocity)
    return Point(state=state, time=following, last=Slope(time=point.time, velocity=slope))


_SHORTEST = 1e-20
EXTRAPOLATION_LIMIT, CORRECTION_LIMIT = 0.5, 0.25
"""Most that the second-order term and the correction may move a view, as shares of what Euler's step moves it."""


def corrected(field: VelocityField, point: Point, following: float) -> Point:
    """AB2 whose every step is corrected once its end has been evaluated, at no further evaluation; bounded at any
    number of steps.

    The velocity at the end of a step serves twice: it starts the next step, and with the velocity at its beginning it
    gives the trapezoidal rule of the step behind (predict, evaluate, correct; Hairer, Norsett, Wanner, section III.1).
    Both terms beyond Euler's are limited per view, so a step is never longer than 1.75 of Euler's: where steps are too
    large for the flow, higher order would otherwise multiply the error instead of reducing it.
    """
    slope, state, last = _evaluated(field, point.state, point.time), point.state, point.last
    if last is not None and last.base is not None:
        length = point.time - last.time
        trapezoid = last.base + length / 2 * (last.velocity + slope)
        state = state + _limited(trapezoid - state, CORRECTION_LIMIT * _length(length * last.velocity))
    step = following - point.time
    move = step * slope
    if last is not None:
        ratio = step / (point.time - last.time)
        move = move + _limited(step * ratio / 2 * (slope - last.velocity), EXTRAPOLATION_LIMIT * _length(move))
    return Point(state=state + move, time=following, last=Slope(time=point.time, velocity=slope, base=state))


SOLVERS: dict[str, Step] = {"euler": euler, "heun": heun, "ab2": ab2, "corrected": corrected}
"""Every solver by its name."""


def evaluations(solver: str, steps: int) -> int:
    """How often a solver evaluates the field on its way to t = 0."""
    return 2 * steps - 1 if solver == "heun" else steps


def _evaluated(field: VelocityField, state: Tensor, time: float) -> Tensor:
    velocity = field(state, time)
    return velocity.to(torch.promote_types(velocity.dtype, torch.float32))


def _length(values: Tensor) -> Tensor:
    """Euclidean length per view."""
    return torch.linalg.vector_norm(values, dim=tuple(range(1, values.ndim)), keepdim=True)


def _limited(values: Tensor, most: Tensor) -> Tensor:
    """The values, shortened per view where they are longer than `most`; the factor is at most 1, in its gradient
    too.
    """
    return values * (most / torch.maximum(_length(values), most).clamp(min=_SHORTEST))
