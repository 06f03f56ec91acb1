"""Where rays meet the solids of procedural rooms: exact, for several rooms at once.

Rays are laid out as planes [room, view, ray], one plane per coordinate; solids add a dimension while distances are
compared. Shorter tables are filled up with solids that no ray reaches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.data.rooms.room import Room

_FAR_BELOW = -1.0e4  # where padding solids lie: behind the floor of every room
_NEAR = 1e-5  # metres; a hit nearer than this is the surface that the ray starts on


@dataclass(frozen=True, kw_only=True)
class RoomTable:
    """Rooms as batched columns. Row 0 is the shell; boxes, cylinders and spheres follow, each kind padded to the
    longest room.
    """

    counts: tuple[int, int, int]
    solids: Float[Tensor, "b p 9"]
    """center 3, half 3, cosine and sine of the heading, kind."""
    materials: Float[Tensor, "b m 15"]
    """base 3, second 3, pattern, waves 4 (radians per metre), phases 2, sharpness, glow; rows as in ``Room``, shifted
    by the padding.
    """
    lights: Float[Tensor, "b 4"]
    """position 3, ambient."""

    def to(self, device: torch.device) -> RoomTable:
        """The same table elsewhere; four small copies instead of one per field and room."""
        return replace(
            self, solids=self.solids.to(device), materials=self.materials.to(device), lights=self.lights.to(device)
        )


def room_table(rooms: list[Room]) -> RoomTable:
    """Rooms side by side."""
    counts = [torch.bincount(room.kinds, minlength=3).tolist() for room in rooms]
    longest = tuple(max(count[kind] for count in counts) for kind in range(3))
    like = {"device": rooms[0].centers.device, "dtype": rooms[0].centers.dtype}
    below = torch.tensor([0.0, 0.0, _FAR_BELOW, 0.01, 0.01, 0.01, 1.0, 0.0, 0.0], **like)
    solids = below.expand(len(rooms), sum(longest), 9).clone()
    materials = torch.zeros(len(rooms), 5 + sum(longest), 15, **like)
    for index, (room, count) in enumerate(zip(rooms, counts, strict=True)):
        angle, kind = room.headings[:, None], room.kinds[:, None].to(**like)
        own = torch.cat([room.centers, room.halves, torch.cos(angle), torch.sin(angle), kind], dim=1)
        waves = 2 * math.pi * room.waves.flatten(1)
        scalars = torch.stack([room.sharpness, room.glow], dim=1)
        paint = torch.cat(
            [room.base, room.second, room.patterns[:, None].to(**like), waves, room.phases, scalars], dim=1
        )
        # Padding goes behind the members of each kind: where every solid of this room lands in the common table.
        starts = [sum(longest[:kind]) for kind in range(3)]
        places = [start + member for start, length in zip(starts, count, strict=True) for member in range(length)]
        solids[index, places] = own
        materials[index, list(range(5)) + [5 + place for place in places]] = paint
    lights = torch.stack([torch.cat([room.light, room.ambient[None]]) for room in rooms])
    return RoomTable(counts=longest, solids=solids, materials=materials, lights=lights)


def _first_hits(
    table: RoomTable, origins: Float[Tensor, "b v q 3"], directions: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Distance and table row ([b, v, r] both) of the first surfaces. ``q`` is 1 (a shared origin) or ``r``; directions
    come by axis.
    """
    distances, first = [], 0
    for count, entries in zip(table.counts, (_box_entries, _cylinder_entries, _sphere_entries), strict=True):
        if count:
            solids = table.solids[:, first : first + count]
            distances.append(entries(*_local_rays(solids, origins, directions)))
            first += count
    return torch.cat(distances, dim=2).min(dim=2)


def _local_rays(
    solids: Float[Tensor, "b p 9"], origins: Tensor, directions: Sequence[Tensor]
) -> tuple[list[Tensor], ...]:
    """Origins [b, v, p, q], directions [b, v, p or 1, r] and half sizes [b, 1, p, 1] by axis, in the axes of every
    solid.
    """
    cx, cy, cz, hx, hy, hz, cosine, sine, _ = rearrange(solids, "b p c -> c b 1 p 1").unbind(0)
    x, y, z = (origins[..., axis].unsqueeze(2) - center for axis, center in enumerate((cx, cy, cz)))
    wx, wy, wz = (way.unsqueeze(2) for way in directions)
    return (
        [cosine * x + sine * y, cosine * y - sine * x, z],
        [cosine * wx + sine * wy, cosine * wy - sine * wx, wz],
        [hx, hy, hz],
    )


def _slab(origin: Tensor, direction: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave the space between two parallel planes at -half and half."""
    inverse = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction).reciprocal_()
    middle, reach = origin * inverse, half * inverse.abs()
    return -(middle + reach), reach - middle


def _box_entries(origin: list[Tensor], direction: list[Tensor], half: list[Tensor]) -> Tensor:
    """Distances [b, v, p, r] to the outsides of boxes, infinite without a hit; for the first one, the shell, to its
    inside.
    """
    enters, leaves = zip(*(_slab(*axis) for axis in zip(origin, direction, half, strict=True)), strict=True)
    near = torch.maximum(torch.maximum(enters[0], enters[1]), enters[2])
    far = torch.minimum(torch.minimum(leaves[0], leaves[1]), leaves[2])
    entries = near.masked_fill((near >= far) | (near <= _NEAR), math.inf)
    entries[:, :, 0] = far[:, :, 0]
    return entries


def _cylinder_entries(origin: list[Tensor], direction: list[Tensor], half: list[Tensor]) -> Tensor:
    """Distances to upright cylinders with flat ends, infinite without a hit."""
    (x, y, z), (dx, dy, dz), (radius, _, height) = origin, direction, half
    near, far, valid = _quadratic(dx * dx + dy * dy, x * dx + y * dy, x * x + y * y - radius**2)
    enter, leave = _slab(z, dz, height)
    near, far = torch.maximum(near, enter), torch.minimum(far, leave)
    return near.masked_fill(~valid | (near >= far) | (near <= _NEAR), math.inf)


def _sphere_entries(origin: list[Tensor], direction: list[Tensor], half: list[Tensor]) -> Tensor:
    """Distances to spheres, infinite without a hit."""
    (x, y, z), (dx, dy, dz) = origin, direction
    along = x * dx + y * dy + z * dz
    near, _, valid = _quadratic(torch.ones_like(along), along, x * x + y * y + z * z - half[0] ** 2)
    return near.masked_fill(~valid | (near <= _NEAR), math.inf)


def _quadratic(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Roots of a t^2 + 2 b t + c and whether they are real. With a = 0 (a ray along the axis) they lie far out on both
    sides, or not.
    """
    a = a.clamp(min=1e-12)
    discriminant = b * b - a * c
    root = discriminant.clamp(min=0).sqrt()
    inverse = a.reciprocal()
    return (-b - root) * inverse, (root - b) * inverse, discriminant > 0


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Where rays end. Every field is a plane [b, v, r] or three of them (x, y, z)."""

    row: Tensor
    distance: Tensor
    points: tuple[Tensor, ...]
    normals: tuple[Tensor, ...]
    """World, towards the origin."""
    material: Tensor
    """Row in the material table."""
    u: Tensor
    """First face coordinate in metres."""
    v: Tensor
    """Second face coordinate in metres."""
    v_share: Tensor
    """Second face coordinate from -1 to 1 across the face."""


def rows_of(table: Float[Tensor, "b m f"], index: Int[Tensor, "b v r"]) -> tuple[Tensor, ...]:
    """The chosen rows as one plane [b, v, r] per column."""
    rooms, length, columns = table.shape
    offset = torch.arange(rooms, device=index.device)[:, None, None] * length
    flat = rearrange(table, "b m f -> f (b m)").contiguous()
    return flat.index_select(1, (index + offset).flatten()).view(columns, *index.shape).unbind(0)


def find_surface(table: RoomTable, origins: Float[Tensor, "b v q 3"], directions: Float[Tensor, "b v r 3"]) -> Surface:
    """Cast and describe the surfaces that were hit."""
    ways = rearrange(directions, "b v r c -> c b v r").contiguous().unbind(0)
    distance, row = _first_hits(table, origins, ways)
    points = tuple(torch.addcmul(origins[..., axis], distance, ways[axis]) for axis in range(3))
    cx, cy, cz, hx, hy, hz, cosine, sine, kind = rows_of(table.solids, row)
    wx, wy, z = points[0] - cx, points[1] - cy, points[2] - cz
    x, y = cosine * wx + sine * wy, cosine * wy - sine * wx
    sx, sy, sz = x / hx, y / hy, z / hz
    ax, ay, az = sx.abs(), sy.abs(), sz.abs()
    is_box, is_round = kind == 0, kind > 0
    flat_z = torch.where(is_box, torch.maximum(ax, ay) < az, (kind == 1) & (az * az > ax * ax + ay * ay))
    flat_x = is_box & ~flat_z & (ax > ay)
    side = torch.where(flat_z, 4 + (z > 0).long(), torch.where(flat_x, (x > 0).long(), 2 + (y > 0).long()))
    # In the solid's own axes: a flat face has one coordinate, round sides have two (cylinder) or three (sphere).
    curved = is_round & ~flat_z
    nx = torch.where(flat_x | curved, sx, torch.zeros_like(x))
    ny = torch.where(curved | (is_box & ~flat_z & ~flat_x), sy, torch.zeros_like(x))
    nz = torch.where(flat_z | (kind == 2), sz, torch.zeros_like(x))
    # On the surface these have unit length up to rounding; the shell looks inwards.
    length = (nx * nx + ny * ny + nz * nz).rsqrt()
    length = torch.where(row == 0, -length, length)
    nx, ny, nz = nx * length, ny * length, nz * length
    return Surface(
        row=row,
        distance=distance,
        points=points,
        normals=(cosine * nx - sine * ny, sine * nx + cosine * ny, nz),
        material=torch.where(row == 0, side, row + 5),
        u=torch.where(flat_x, y, x),
        v=torch.where(flat_z, y, z),
        v_share=torch.where(flat_z, sy, sz),
    )
