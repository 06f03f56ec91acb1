"""Where a fly-through's cameras stand and look: an ellipse fitted to the captured cameras, an orbit, or a spiral.

All of them are closed curves or windings about one axis, walked at even speed, and look at what the capture looks at
(:class:`~fb_core.geometry.viewpoints.paths.CaptureShape` tells an object that is surrounded from a room that is seen
from within).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.similarity import rounding_of
from fb_core.geometry.viewpoints.paths import CaptureShape

PATHS = ("ellipse", "orbit", "spiral")
_FINE = 4096  # points of a curve from which even steps are taken
_FEWEST_FOR_ELLIPSE = 5  # an ellipse has five parameters
_FLATTEST = 0.25  # least ratio of an ellipse's axes: along a straight walk, the way back is beside the way there
_LARGEST = 1.5  # semi axes of a fitted ellipse beyond so many extents of the cameras are an extrapolation
_ONE_WAY = 0.75  # length of the mean look direction from which all cameras look one way (1: exactly)
_AHEAD = 4.0  # how many radii ahead cameras look that all look one way and meet nowhere
_ONE_PLACE = 1e-9  # scene units; places that differ by less are one
_SPIRAL_TURNS, _SPIRAL_RISE = 2, 0.2  # windings; least half height in radii


@dataclass(frozen=True, kw_only=True)
class Ellipse:
    """``center + cos(angle) * first + sin(angle) * second``: any ellipse in space, a circle and a point included."""

    center: Float[Tensor, "3"]
    """World, scene units."""
    first: Float[Tensor, "3"]
    """Semi axis from the centre; the longer one."""
    second: Float[Tensor, "3"]
    """Semi axis across the first, not longer than it."""

    def __call__(self, angles: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Points of the curve."""
        return self.center + angles.cos()[:, None] * self.first + angles.sin()[:, None] * self.second

    @staticmethod
    def fitted(centers: Float[Tensor, "n 3"], *, up: Float[Tensor, "3"]) -> Ellipse:
        """The least-squares ellipse of camera centres, in their least-squares plane, counter-clockwise seen from above.

        Five or more centres get the direct fit of Fitzgibbon et al. (1999). Where that fails, or goes far beyond the
        cameras (a short arc), or there are fewer, the ellipse has the centres' own mean and moments, which is exact for
        centres all around. Centres on a line get a narrow ellipse along it, level across; centres in one place get that
        place.

        Raises ValueError without centres and for centres that are not finite.
        """
        places = centers.double()
        if not len(places) or not bool(torch.isfinite(places).all()):
            raise ValueError(
                "ellipse: expected one or more finite camera centres, got none or one that holds NaN or infinity"
            )
        middle = places.mean(dim=0)
        _, spread, axes = torch.linalg.svd(places - middle, full_matrices=True)
        deviation = F.pad(spread, (0, 3 - len(spread))) / math.sqrt(len(places))
        if float(deviation[0]) <= 1e-6 + rounding_of(centers):
            nothing = torch.zeros_like(middle)
            return Ellipse(center=middle.to(centers), first=nothing.to(centers), second=nothing.to(centers))
        along = axes[0]
        across = axes[1] if float(deviation[1]) > 0.02 * float(deviation[0]) else _level_across(along, up.double())
        if float(torch.linalg.cross(along, across) @ up.double()) < 0:
            across = -across
        plane = torch.stack([along, across], dim=1)
        flat = (places - middle) @ plane
        shift, first, second = _direct_fit(flat) or _moments(deviation)
        if float(first.norm()) < float(second.norm()):  # a quarter turn on, so that the way round stays the same
            first, second = second, -first
        second = F.normalize(torch.stack([-first[1], first[0]]), dim=0) * max(
            float(second.norm()), _FLATTEST * float(first.norm())
        )
        lifted = (middle + plane @ shift, plane @ first, plane @ second)
        return Ellipse(**dict(zip(("center", "first", "second"), (one.to(centers) for one in lifted), strict=True)))


def path_cameras(
    kind: str, cameras: list[Pinholes], count: int, *, size: int, fov_degrees: float | None = None
) -> Pinholes:
    """Cameras of a fly-through around (or inside) a capture, in its world.

    Args:
        kind: ``ellipse`` (fitted to the captured centres, in their plane), ``orbit`` (a level circle at their median
            distance from the axis and mean height) or ``spiral`` (that circle wound twice, rising from their lowest to
            their highest).
        cameras: the captured cameras, one or more.
        count: how many, at even distances along the curve; the closed ones end one step before their start.
        size: side of the square pictures in pixels.
        fov_degrees: across the picture; None is the median of the captured cameras' largest squares.

    Raises ValueError for another kind, for no cameras and for fewer than one view.
    """
    if kind not in PATHS:
        raise ValueError(f"path: expected {', '.join(PATHS)} or a camera path's .json file, got {kind!r}")
    if count < 1:
        raise ValueError(f"views: expected at least one view along the path, got {count}")
    given = cameras[0].camera_to_world.dtype if cameras else torch.float32
    cameras, origin = _centred(cameras)
    shape = CaptureShape.of(cameras)
    centers = torch.cat([one.centers for one in cameras])
    level = _circle(shape)
    if kind == "ellipse":
        curve, turns = Ellipse.fitted(centers, up=shape.up), 1
    elif kind == "orbit":
        curve, turns = level, 1
    else:
        curve, turns = _spiral(shape, level), _SPIRAL_TURNS
    angles = even_angles(curve, count, turns=turns, closed=turns == 1)
    places = curve(angles)
    new = Pinholes.looking_at(
        places,
        _targets(
            shape,
            cameras,
            places,
            _outward(places, angles, curve.center if isinstance(curve, Ellipse) else shape.center, shape.up),
        ),
        up=shape.up,
        fov_degrees=square_fov_degrees(cameras) if fov_degrees is None else fov_degrees,
        width=size,
        height=size,
    )
    return new.moved(origin).to(given)


def _centred(cameras: list[Pinholes]) -> tuple[list[Pinholes], Float[Tensor, "3"]]:
    """The cameras in float64 about their middle, and where that was: near the origin the world's place costs no
    digits.
    """
    exact = [one.to(torch.float64) for one in cameras]
    middle = torch.cat([one.centers for one in exact]).mean(dim=0) if exact else torch.zeros(3, dtype=torch.float64)
    return [one.moved(-middle) for one in exact], middle


def even_angles(
    curve: Callable[[Float[Tensor, " m"]], Float[Tensor, "m 3"]], count: int, *, turns: int = 1, closed: bool = True
) -> Float[Tensor, " n"]:
    """Angles (radians from 0) that cut a curve into pieces of one length; of a closed one the last is left out, being
    the first.
    """
    fine = torch.linspace(0, turns * 2 * math.pi, _FINE + 1, dtype=torch.float64)
    points = curve(fine.float()).double().cpu()
    length = F.pad((points[1:] - points[:-1]).norm(dim=1).cumsum(dim=0), (1, 0))
    if float(length[-1]) <= 1e-9:  # a turn on the spot
        length = fine / fine[-1]
    wanted = torch.linspace(0, float(length[-1]), count + 1 if closed else count, dtype=torch.float64)[:count]
    return torch.from_numpy(np.interp(wanted.numpy(), length.numpy(), fine.numpy())).float()


def square_fov_degrees(cameras: list[Pinholes]) -> float:
    """Median field of view across the largest square that fits into each camera's picture."""
    angles = [2 * torch.atan(0.5 * min(one.width, one.height) / one.focal.mean(dim=1)) for one in cameras]
    return float(torch.rad2deg(torch.cat(angles)).median())


def _targets(
    shape: CaptureShape, cameras: list[Pinholes], places: Float[Tensor, "n 3"], outward: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """What each camera looks at: the focus; or, of cameras that all look one way, a point ahead; or straight out into
    the room.
    """
    if not shape.outward:
        return _kept_apart(shape.focus.expand_as(places), places, shape)
    forward = torch.cat([one.camera_to_world[:, :, 2] for one in cameras]).mean(dim=0)
    if float(forward.norm()) >= _ONE_WAY:
        reach = max(shape.radius, float((places - shape.center).norm(dim=1).max()), 1e-3)
        return _kept_apart(
            (shape.center + _AHEAD * reach * F.normalize(forward, dim=0)).expand_as(places), places, shape
        )
    pitch = forward @ shape.up
    return places + outward + pitch * shape.up


def _outward(
    places: Float[Tensor, "n 3"], angles: Float[Tensor, " n"], center: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "n 3"]:
    """Level unit directions away from the curve's centre; around it by angle where the camera stands in the centre."""
    away = places - center
    level = away - (away @ up)[:, None] * up
    along = _level_across(up, up.roll(1))
    around = angles.cos()[:, None] * along + angles.sin()[:, None] * torch.linalg.cross(up, along)
    there = level.norm(dim=1, keepdim=True)
    least = max(_ONE_PLACE, 1e-4 * float(there.max()), rounding_of(places))
    return torch.where(there > least, level / there.clamp(min=1e-12), around)


def _kept_apart(
    targets: Float[Tensor, "n 3"], places: Float[Tensor, "n 3"], shape: CaptureShape
) -> Float[Tensor, "n 3"]:
    """No camera looks at its own place."""
    nearest = 1e-3 * max(shape.radius, 1e-3)
    aside = shape.center + _level_across(shape.up, shape.up.roll(1))
    return torch.where((targets - places).norm(dim=1, keepdim=True) < nearest, aside, targets)


def _circle(shape: CaptureShape) -> Ellipse:
    """The capture's level circle about its axis; a point for a capture in one place."""
    along = _level_across(shape.up, shape.up.roll(1))
    return Ellipse(
        center=shape.center, first=shape.radius * along, second=shape.radius * torch.linalg.cross(shape.up, along)
    )


def _spiral(shape: CaptureShape, level: Ellipse) -> Callable[[Float[Tensor, " m"]], Float[Tensor, "m 3"]]:
    """The circle wound about its axis, from below to above."""
    half = max(shape.half_height, _SPIRAL_RISE * shape.radius)

    def curve(angles: Float[Tensor, " m"]) -> Float[Tensor, "m 3"]:
        share = angles / (_SPIRAL_TURNS * 2 * math.pi)
        return level(angles) + ((2 * share - 1) * half)[:, None] * shape.up

    return curve


def _level_across(along: Tensor, up: Tensor) -> Float[Tensor, "3"]:
    """A unit direction across one direction and, if that is possible, level."""
    across = torch.linalg.cross(up, along)
    if float(across.norm()) < 1e-3 * float(up.norm()):
        across = torch.linalg.cross(F.one_hot(along.abs().argmin(), 3).to(along), along)
    return F.normalize(across, dim=0)


def _moments(deviation: Float[Tensor, "3"]) -> tuple[Tensor, Tensor, Tensor]:
    """The ellipse whose even points have these deviations along the plane's axes: shift of its centre, and semi
    axes.
    """
    axes = math.sqrt(2) * deviation[:2].diag()
    return torch.zeros(2, dtype=torch.float64), axes[0], axes[1]


def _direct_fit(flat: Float[Tensor, "n 2"]) -> tuple[Tensor, Tensor, Tensor] | None:
    """Centre and semi axes of the direct least-squares ellipse, None where there is no sensible one."""
    if len(flat) < _FEWEST_FOR_ELLIPSE:
        return None
    import cv2

    extent = float(flat.norm(dim=1).max())
    scaled: Any = np.ascontiguousarray((flat / extent).numpy().astype(np.float32))
    (x, y), diameters, degrees = cv2.fitEllipseDirect(scaled)
    values = torch.tensor([x, y, *diameters, degrees], dtype=torch.float64)
    semi = values[2:4] / 2
    sensible = bool(torch.isfinite(values).all()) and float(semi.min()) > 1e-3 and float(semi.max()) < _LARGEST
    if not sensible or float(values[:2].norm()) > 1:
        return None
    turn = torch.deg2rad(values[4])
    first = torch.stack([turn.cos(), turn.sin()]) * semi[0]
    second = torch.stack([-turn.sin(), turn.cos()]) * semi[1]
    return extent * values[:2], extent * first, extent * second
