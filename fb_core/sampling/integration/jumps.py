"""Velocities that jump at known times: in between they are smooth, and over a jump no solver may look, neither back nor
ahead.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from fb_core.sampling.integration.solvers import Point, VelocityField


@dataclass(frozen=True, kw_only=True)
class Jumping:
    """A velocity in smooth pieces, one after the other on the way from noise to data. Asked for at a time alone, the
    piece that begins there answers.
    """

    jumps: tuple[float, ...]
    """Times at which a piece ends and the next begins, in any order."""
    piece: Callable[[float], VelocityField]
    """The smooth velocity that a step follows which sets out at this time, up to its end; at a jump the one that begins
    there.
    """

    def __call__(self, state: Float[Tensor, "n *rest"], time: float) -> Float[Tensor, "n *rest"]:
        """dz/dt at a state and a time."""
        return self.piece(time)(state, time)


def jumps_of(field: VelocityField) -> tuple[float, ...]:
    """Where a velocity jumps; nowhere if it does not say so."""
    return field.jumps if isinstance(field, Jumping) else ()


def piece_of(field: VelocityField, time: float) -> VelocityField:
    """What a step from this time follows: Heun's second look, at the step's end, is not yet at the next piece."""
    return field.piece(time) if isinstance(field, Jumping) else field


def without_other_pieces(point: Point, field: VelocityField) -> Point:
    """The point without its memory where that is of another piece, which no extrapolation and no correction may use.

    It depends on times alone, so a trajectory that is resumed forgets at the same places.
    """
    last = point.last
    if last is None or not any(last.time > jump >= point.time for jump in jumps_of(field)):
        return point
    return dataclasses.replace(point, last=None)
