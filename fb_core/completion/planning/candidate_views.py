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
_WITHOUT_PARALLAX = 3.0  # worth of what a captured camera with a wider lens adds, beside that of other new views
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
    wider: Float[Tensor, "c"] | None = None
    """By how much each of them shows more to all sides than usual new views, as a ratio of focal lengths; None is 1
    everywhere.
    """

    @property
    def worth(self) -> Float[Tensor, "c"] | None:
        """How much more than others each is worth for what it adds: those without parallax, whose lens is wider."""
        return None if self.wider is None else torch.where(self.wider > 1, _WITHOUT_PARALLAX, 1.0)

    def also_seen(self, seen: Bool[Tensor, "k"]) -> Candidates:
        """The same views, where more of the scene is seen."""
        return dataclasses.replace(self, coverage=dataclasses.replace(self.coverage, seen=self.coverage.seen | seen))

    def shown(self, half_angle_radians: float) -> Bool[Tensor, "c k"]:
        """What each of them shows, with a lens of half that opening."""
        if self.sides is not None:
            return self.sides
        if self.wider is None:
            return shown_by(self.centers, self.looks, self.coverage.surface, half_angle_radians)
        shown = torch.zeros(len(self.centers), len(self.coverage.surface), dtype=torch.bool)
        for ratio in self.wider.unique():
            same = self.wider == ratio
            half = math.atan(float(ratio) * math.tan(half_angle_radians))
            shown[same] = shown_by(self.centers[same], self.looks[same], self.coverage.surface, half)
        return shown

    def and_before(self, first: Candidates) -> Candidates:
        """Others of the same scene before these: of views that add as much, theirs are taken."""
        wider = None
        if first.wider is not None or self.wider is not None:
            wider = torch.cat(
                [one.centers.new_ones(len(one.centers)) if one.wider is None else one.wider for one in (first, self)]
            )
        return dataclasses.replace(
            self,
            centers=torch.cat([first.centers, self.centers]),
            looks=torch.cat([first.looks, self.looks]),
            sides=None if self.sides is None or first.sides is None else torch.cat([first.sides, self.sides]),
            wider=wider,
        )


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


def with_wider_lens(candidates: Candidates, captured: Pinholes, ratio: float) -> Candidates:
    """The candidates of a room and, before them, the captured views with a wider lens: no parallax, so nothing in them
    hides behind what the capture saw, and all around the picture continues.
    """
    looks = F.normalize(captured.camera_to_world[:, :, 2], dim=1)
    wider = captured.centers.new_full((len(looks),), ratio)
    return candidates.and_before(
        dataclasses.replace(candidates, centers=captured.centers, looks=looks, sides=None, wider=wider)
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
