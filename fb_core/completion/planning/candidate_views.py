"""Where new views could stand and look, and what each would show: what a need-driven plan chooses from."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.coverage import Coverage, shown_by
from fb_core.geometry.viewpoints.paths import CaptureShape, sphere_directions

_DIRECTIONS = 256
SIDE_SEEN = math.cos(math.radians(30))
"""A side of an object is seen by cameras whose direction from its middle has at least this cosine with its own."""


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Views to choose from."""

    centers: Float[Tensor, "c 3"]
    """Where they stand."""
    looks: Float[Tensor, "c 3"]
    """Unit directions that they look in."""
    coverage: Coverage
    """What of the scene is seen: of a room its walls, of an object its sides."""
    sides: Bool[Tensor, "c k"] | None = None
    """Which sides of an object each of them shows; None in rooms, where the lens decides."""
    unseen_by_capture: float = 0.0
    """Share of the surroundings that the captured pictures alone do not show."""

    def also_seen(self, seen: Bool[Tensor, "k"]) -> Candidates:
        """The same views, where more of the scene is seen."""
        return dataclasses.replace(self, coverage=dataclasses.replace(self.coverage, seen=self.coverage.seen | seen))

    def shown(self, half_angle_radians: float) -> Bool[Tensor, "c k"]:
        """What each of them shows, with a lens of half that opening."""
        if self.sides is not None:
            return self.sides
        return shown_by(self.centers, self.looks, self.coverage.surface, half_angle_radians)


def looking_out(
    places: Float[Tensor, "p 3"], shape: CaptureShape, coverage: Coverage, *, max_pitch_degrees: float
) -> Candidates:
    """Views of a room: from every place in directions all round, none steeper than the greatest pitch.

    The directions are counted from the capture's up and its first camera's place, so that they turn with the world.
    """
    axes = _axes(shape, places[0])
    directions = sphere_directions(_DIRECTIONS, like=shape.up)
    steepest = math.sin(math.radians(max_pitch_degrees)) + 1.001 / _DIRECTIONS
    directions = directions[directions[:, 2].abs() <= steepest] @ axes
    return Candidates(
        centers=places.repeat_interleave(len(directions), dim=0),
        looks=directions.repeat(len(places), 1),
        coverage=coverage,
        unseen_by_capture=coverage.unseen_share,
    )


def looking_in(places: Float[Tensor, "p 3"], shape: CaptureShape, cameras: Sequence[Pinholes]) -> Candidates:
    """Views of what a capture surrounds: from every place to the middle. Its sides are where the places lie."""
    from_middle = F.normalize(places - shape.focus, dim=1)
    captured = F.normalize(torch.cat([camera.centers for camera in cameras]) - shape.focus, dim=1)
    seen = (from_middle @ captured.T > SIDE_SEEN).any(dim=1)
    weight = torch.ones(len(places), dtype=places.dtype)
    coverage = Coverage(surface=shape.focus + from_middle * shape.radius, weight=weight, seen=seen)
    return Candidates(
        centers=places,
        looks=-from_middle,
        coverage=coverage,
        sides=from_middle @ from_middle.T > SIDE_SEEN,
        unseen_by_capture=coverage.unseen_share,
    )


def _axes(shape: CaptureShape, place: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Rows: two level axes of the capture's own and its up."""
    across = place - shape.center
    across = across - (across @ shape.up) * shape.up
    if float(across.norm()) <= 1e-9 * (1 + float(shape.center.abs().max())):  # it stands in the middle
        helper = F.one_hot(shape.up.abs().argmin(), 3).to(shape.up)
        across = helper - (helper @ shape.up) * shape.up
    first = F.normalize(across, dim=0)
    return torch.stack([first, torch.linalg.cross(shape.up, first), shape.up])
