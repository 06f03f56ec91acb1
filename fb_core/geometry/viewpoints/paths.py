"""Where to put the cameras of generated views: on a cylinder around the scene, looking where the capture did not.

Paper, section 3.2: anchors stand on a cylinder and look in random directions; densified views fill the space between.
Centre, radius and up come from the capture. "Random" is stratified here: each direction is drawn where much is still
unseen, so that a few views together see all directions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_core.geometry.shell import Shell

_CONVERGING = (
    0.06  # mean squared sine between axes (about 14 degrees): below, the axes are too parallel to meet anywhere
)
_FACING_COSINE, _FACING_SHARE = math.cos(math.radians(40)), 0.8
_CANDIDATES = 256
_SEEN_AGAIN = 0.35  # a surface point is worth this much less each time another generated view sees it


@dataclass(frozen=True, kw_only=True)
class CaptureShape:
    """The cylinder that a capture lies on, and whether its cameras look out from the middle or in at something."""

    center: Float[Tensor, "3"]
    """Point on the cylinder's axis at the mean height of the cameras."""
    up: Float[Tensor, "3"]
    """Unit axis of the cylinder: the capture's up, not assumed to be z."""
    radius: float
    """Horizontal distance from the axis that the captured cameras keep (scene units); 0 for a pure rotation."""
    half_height: float
    """How far the cameras' heights spread to both sides of ``center`` (scene units)."""
    outward: bool
    """True for rooms and panoramas; False when the cameras surround what they look at (then the axis goes through
    it).
    """
    focus: Float[Tensor, "3"]
    """What the cameras look at; for outward captures the centre again."""

    @staticmethod
    def of(cameras: list[Pinholes]) -> CaptureShape:
        """Measure a capture of one or more cameras (sizes may differ). Raises ValueError for none or for NaN poses."""
        poses = _poses(cameras)
        like, poses = poses, poses.double()
        centers, forward = poses[:, :, 3], poses[:, :, 2]
        up = _up(poses)
        focus = _focus(centers, forward)
        axis_point = centers.mean(dim=0) if focus is None else focus
        height = (centers - axis_point) @ up
        center = axis_point + height.mean() * up
        across = (centers - center) - ((centers - center) @ up)[:, None] * up
        distance = across.norm(dim=1)
        # Rooms: the outer cameras bound the space that was walked. Orbits: all cameras stand on about one radius.
        radius = float(torch.quantile(distance, 0.8) if focus is None else distance.median())
        half_height = float(torch.quantile((height - height.mean()).abs(), 0.8))
        outward, focus = focus is None, (center if focus is None else focus).to(like)
        return CaptureShape(
            center=center.to(like), up=up.to(like), radius=radius, half_height=half_height, outward=outward, focus=focus
        )


def up_of(cameras: list[Pinholes]) -> Float[Tensor, "3"]:
    """The capture's up: the direction that all the cameras' right axes avoid, else the cameras' mean up.

    People hold cameras level more surely than upright: looking down at something tilts every camera's up the same way,
    but leaves the right axes horizontal.
    """
    poses = _poses(cameras)
    return _up(poses.double()).to(poses)


def _up(poses: Float[Tensor, "n 3 4"]) -> Float[Tensor, "3"]:
    mean = -poses[:, :, 1].mean(dim=0)
    right = poses[:, :, 0]
    spread, axes = torch.linalg.eigh(right.T @ right / len(right))
    level = axes[:, 0] * (1.0 if float(axes[:, 0] @ mean) >= 0 else -1.0)
    mean_unit = F.normalize(mean, dim=0)
    is_level = float(spread[0]) < 0.02 and float(spread[1]) > 0.05
    if float(mean.norm()) < 1e-3 or (is_level and float(level @ mean_unit) > math.cos(math.radians(45))):
        return level
    return mean_unit


def cylinder_centers(
    shape: CaptureShape,
    count: int,
    *,
    generator: torch.Generator,
    radius: float,
    inner_radius: float,
    half_height: float,
    levels: int,
) -> Float[Tensor, "n 3"]:
    """Centres at equal angles around the axis from a random heading, their heights going round the levels.

    Args:
        shape: supplies centre and up; lengths below are in scene units.
        count: number of centres.
        generator: draws the heading and the radii (on the CPU).
        radius: outer radius.
        inner_radius: each centre's radius is uniform between this and ``radius``; equal for anchors, less for densified
            views.
        half_height: heights lie between minus and plus this about the centre.
        levels: number of equally spaced heights; one level is at the centre's height.

    Raises ValueError for a negative count.
    """
    if count < 0:
        raise ValueError(f"cylinder_centers: expected a count of 0 or more, got {count}")
    like = {"device": shape.center.device, "dtype": shape.center.dtype}
    heading, draws = (torch.rand(number, generator=generator, dtype=torch.float32) for number in (1, count))
    angle = ((torch.arange(count) / max(count, 1) + heading) * 2 * math.pi).to(**like)
    distance = (inner_radius + (radius - inner_radius) * draws).to(**like)
    level = torch.linspace(-half_height, half_height, levels) if levels > 1 else torch.zeros(1)
    height = level[torch.arange(count) % len(level)].to(**like)
    first, second = _perpendicular(shape.up)
    around = angle.cos()[:, None] * first + angle.sin()[:, None] * second
    return shape.center + distance[:, None] * around + height[:, None] * shape.up


def distances(first: Float[Tensor, "n 3"], second: Float[Tensor, "m 3"]) -> Float[Tensor, "n m"]:
    """From every point to every other, in float64. Of differences: torch's usual way, by squares, is off by units far
    from the origin.
    """
    return torch.cdist(first.double(), second.double(), compute_mode="donot_use_mm_for_euclid_dist")


def kept_clear(
    centers: Float[Tensor, "n 3"],
    *,
    shell: Shell,
    points: Float[Tensor, "m 3"],
    clearance: float,
    refuges: Float[Tensor, "k 3"],
    free: FreeSpace | None = None,
) -> Float[Tensor, "n 3"]:
    """Pull camera centres out of what the capture has seen: inside the shell, ``clearance`` away from every seen point,
    and in space that is known to be free, if that is known.

    A blocked centre moves straight towards the nearest captured camera (a ``refuge``: somebody stood there) in eighths
    of the way, and stops at the first clear place; the last resort is the captured place itself.

    Raises ValueError without a captured place.
    """
    if len(centers) == 0:
        return centers
    if len(refuges) == 0:
        raise ValueError(
            "kept_clear: expected at least one captured place to withdraw to, got none; pass the captured cameras' "
            "centres"
        )
    home = refuges[distances(centers, refuges).argmin(dim=1)]
    result, settled = home.clone(), torch.zeros(len(centers), dtype=torch.bool, device=centers.device)
    for eighth in range(8):
        place = centers + (home - centers) * (eighth / 8)
        clear = shell.contains(place, margin=0.9)
        if len(points):
            clear &= distances(place, points).min(dim=1).values >= clearance
        if free is not None:
            clear &= free.crossed(place)
        chosen = clear & ~settled
        result[chosen] = place[chosen]
        settled |= clear
    return result


def seen_by(
    cameras: Sequence[Pinholes],
    points: Float[Tensor, "n 3"],
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
) -> Bool[Tensor, "n"]:
    """Whether a world point falls into the known part of at least one camera's picture (occlusion is not considered).

    Args:
        cameras: one camera per entry where ``known`` is given.
        points: in world coordinates.
        known: of each camera a mask of any size that covers its picture, or None for all of it; without, all pictures
            are known.
    """
    seen = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    masks = [None] * len(cameras) if known is None else known
    for camera, mask in zip(cameras, masks, strict=True):
        pixels, depth = camera.project(points)
        size = pixels.new_tensor([camera.width, camera.height])
        inside = ((pixels > 0) & (pixels < size)).all(dim=-1) & (depth > 0)
        if mask is not None:
            cells = pixels[inside] / size * pixels.new_tensor([mask.shape[1], mask.shape[0]])
            column, row = cells.long().unbind(dim=-1)
            inside[inside.clone()] = mask[row.clamp(max=mask.shape[0] - 1), column.clamp(max=mask.shape[1] - 1)]
        seen |= inside.any(dim=0)
    return seen


def sphere_directions(count: int, *, like: Tensor) -> Float[Tensor, "n 3"]:
    """Unit directions that are nearly equally spaced (a Fibonacci lattice about z). Raises ValueError for a negative
    count.
    """
    if count < 0:
        raise ValueError(f"sphere_directions: expected a count of 0 or more, got {count}")
    index = torch.arange(count, device=like.device, dtype=like.dtype) + 0.5
    z = 1 - 2 * index / count
    angle = index * (math.pi * (3 - math.sqrt(5)))
    across = (1 - z * z).clamp(min=0).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), z], dim=1)


def outward_directions(
    centers: Float[Tensor, "n 3"],
    *,
    surface: Float[Tensor, "m 3"],
    need: Float[Tensor, "m"],
    up: Float[Tensor, "3"],
    half_angle_radians: float,
    max_pitch_degrees: float,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "m"]]:
    """One look direction per centre, greedily those that see most of what is still needed; and the need that remains.

    Candidates are a lattice of directions turned by a random heading, at most ``max_pitch_degrees`` from level. Each
    one's gain, the sum of ``need`` over the surface points in its cone, is jittered by up to 10 per cent, which breaks
    ties at random. What a chosen view sees is needed less by the next.

    Args:
        centers: camera centres.
        surface: points that stand for the surface of the scene, in all directions.
        need: how much each point deserves to be seen, such as 1 where the capture never looked and less elsewhere.
        up: the capture's up.
        half_angle_radians: half the opening of a view's cone.
        max_pitch_degrees: steepest look direction.
        generator: on the CPU.

    Raises ValueError for a pitch beyond 0 to 90 degrees.
    """
    if not 0 <= max_pitch_degrees <= 90:
        raise ValueError(f"outward_directions: expected max_pitch_degrees from 0 to 90, got {max_pitch_degrees}")
    heading = torch.rand(1, generator=generator, dtype=torch.float32).to(up) * 2 * math.pi
    first, second = _perpendicular(up)
    first, second = heading.cos() * first + heading.sin() * second, heading.cos() * second - heading.sin() * first
    candidates = sphere_directions(_CANDIDATES, like=up) @ torch.stack([first, second, up])
    steepest = (
        math.sin(math.radians(max_pitch_degrees)) + 1.001 / _CANDIDATES
    )  # keeps the middle rows, at 1, for a limit of 0
    candidates = candidates[(candidates @ up).abs() <= steepest]
    chosen, need = [], need.clone()
    for center in centers:
        inside = candidates @ F.normalize(surface - center, dim=1).T > math.cos(half_angle_radians)
        jitter = 0.9 + 0.1 * torch.rand(len(candidates), generator=generator, dtype=torch.float32).to(need)
        best = int(((inside.to(need) @ need) * jitter).argmax())
        chosen.append(candidates[best])
        need = torch.where(inside[best], need * _SEEN_AGAIN, need)
    return torch.stack(chosen) if chosen else centers.new_empty(0, 3), need


def inward_targets(
    centers: Float[Tensor, "n 3"], *, shape: CaptureShape, spread: float, generator: torch.Generator
) -> Float[Tensor, "n 3"]:
    """A random point around the focus for each camera to look at, never one within 30 per cent of the radius of the
    camera.

    Targets fill a cylinder of radius ``spread`` times the capture's radius, half as high.
    """
    tries = 16
    draws = torch.rand(len(centers), tries, 3, generator=generator, dtype=torch.float32).to(centers)
    angle, height = draws[..., 0] * 2 * math.pi, (draws[..., 2] - 0.5) * spread * shape.radius
    distance = draws[..., 1].sqrt() * spread * shape.radius
    first, second = _perpendicular(shape.up)
    around = angle.cos()[..., None] * first + angle.sin()[..., None] * second
    targets = shape.focus + distance[..., None] * around + height[..., None] * shape.up
    fits = (targets - centers[:, None]).norm(dim=-1) >= 0.3 * shape.radius
    fits[:, -1] |= ~fits.any(dim=1)
    return targets[torch.arange(len(centers), device=centers.device), fits.int().argmax(dim=1)]


def spread_subset(cameras: list[Pinholes], count: int) -> list[int]:
    """``count`` camera indices that differ most in place and look direction (farthest-point order), all when there are
    fewer.

    Indices count through the cameras of all groups.

    The first is the camera that is held most level and upright, because the model's canonical frame stands upright in
    the first view. Distances are in units of the capture's extent; looking the opposite way counts like that extent.
    """
    poses = _poses(cameras).double()
    centers, forward = poses[:, :, 3], poses[:, :, 2]
    extent = float((centers - centers.mean(dim=0)).norm(dim=1).max())
    features = torch.cat([(centers - centers.mean(dim=0)) / max(extent, 1e-9), forward / 2], dim=1)
    chosen = [int((-poses[:, :, 1] @ _up(poses)).argmax())]
    distance = (features - features[chosen[0]]).norm(dim=1)
    distance[chosen[0]] = -1.0
    while len(chosen) < min(count, len(poses)):
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (features - features[chosen[-1]]).norm(dim=1))
        distance[chosen] = -1.0
    return chosen


def strided_subset(total: int, count: int) -> list[int]:
    """``count`` equally spaced indices from first to last without repetition, all when there are fewer (the paper's
    choice).

    Raises ValueError for a negative count.
    """
    if count < 0:
        raise ValueError(f"strided_subset: expected a count of 0 or more, got {count}")
    if count >= total:
        return list(range(total))
    return torch.linspace(0, total - 1, count).round().long().tolist()


def _poses(cameras: list[Pinholes]) -> Float[Tensor, "n 3 4"]:
    if sum(len(group) for group in cameras) == 0:
        raise ValueError("cameras: expected at least one captured camera, got none")
    poses = torch.cat([group.camera_to_world for group in cameras])
    if not bool(torch.isfinite(poses).all()):
        raise ValueError("cameras: a captured camera's pose holds NaN or infinity; remove that frame from the capture")
    return poses


def _focus(centers: Float[Tensor, "n 3"], forward: Float[Tensor, "n 3"]) -> Float[Tensor, "3"] | None:
    """The point nearest to all optical axes, or None when the cameras do not surround and face one."""
    across = torch.eye(3).to(forward) - forward[:, :, None] * forward[:, None, :]
    total = across.mean(dim=0)
    if float(torch.linalg.eigvalsh(total)[0]) < _CONVERGING:
        return None
    middle = centers.mean(dim=0)
    focus = middle + torch.linalg.solve(total, (across @ (centers - middle)[:, :, None]).mean(dim=0)[:, 0])
    facing = (F.normalize(focus - centers, dim=1) * forward).sum(dim=1) > _FACING_COSINE
    return focus if float(facing.double().mean()) >= _FACING_SHARE else None


def _perpendicular(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Two unit directions that span the plane across ``up``."""
    helper = F.one_hot(up.abs().argmin(), 3).to(up)
    first = F.normalize(torch.linalg.cross(helper, up), dim=0)
    return first, torch.linalg.cross(up, first)
