"""A vectorised ray caster for procedural rooms: exact hits with boxes, cylinders and spheres, soft view-independent shading.

Rays are laid out as [room, view, solid, ray] planes, one plane per coordinate, and worked through in chunks that fit the cache (CPU) or
a bounded share of memory (GPU). Several rooms are cast at once; shorter tables are filled with solids that no ray reaches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from einops import rearrange, reduce
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.data.rooms import Room
from fb_core.geometry.cameras import Pinholes

_FAR_BELOW = -1.0e4  # where padding solids lie: behind the floor of every room
_NEAR = 1e-5  # metres; a hit nearer than this is the surface that the ray starts on
_CPU_PAIRS, _GPU_PAIRS = 2**18, 2**25


@dataclass(frozen=True, kw_only=True)
class Hits:
    """First surfaces met by ``n`` rays."""

    distance: Float[Tensor, "n"]
    """Metres along the unit direction."""
    points: Float[Tensor, "n 3"]
    """World coordinates."""
    normals: Float[Tensor, "n 3"]
    """Unit, towards the ray's origin."""
    solids: Int[Tensor, "n"]
    """Row in the room's table; 0 is the shell."""


@dataclass(frozen=True, kw_only=True)
class RoomImages:
    """What ``n`` cameras see."""

    rgb: Float[Tensor, "n 3 h w"]
    """In [0, 1]."""
    depth: Float[Tensor, "n h w"]
    """z-depth in metres at the pixel centres."""
    normals: Float[Tensor, "n 3 h w"]
    """Unit, world frame, towards the camera, at the pixel centres."""


@dataclass(frozen=True, kw_only=True)
class _Table:
    """Rooms as batched columns. Row 0 is the shell; boxes, cylinders and spheres follow, each kind padded to the longest room."""

    counts: tuple[int, int, int]
    solids: Float[Tensor, "b p 9"]
    """center 3, half 3, cosine and sine of the heading, kind."""
    materials: Float[Tensor, "b m 15"]
    """base 3, second 3, pattern, waves 4 (radians per metre), phases 2, sharpness, glow; rows as in ``Room``, shifted by the padding."""
    lights: Float[Tensor, "b 4"]
    """position 3, ambient."""

    def to(self, device: torch.device) -> _Table:
        """The same table elsewhere; four small copies instead of one per field and room."""
        return replace(self, solids=self.solids.to(device), materials=self.materials.to(device), lights=self.lights.to(device))


def _table(rooms: list[Room]) -> _Table:
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
        paint = torch.cat([room.base, room.second, room.patterns[:, None].to(**like), waves, room.phases, scalars], dim=1)
        # Padding goes behind the members of each kind: where every solid of this room lands in the common table.
        starts = [sum(longest[:kind]) for kind in range(3)]
        places = [start + member for start, length in zip(starts, count, strict=True) for member in range(length)]
        solids[index, places] = own
        materials[index, list(range(5)) + [5 + place for place in places]] = paint
    lights = torch.stack([torch.cat([room.light, room.ambient[None]]) for room in rooms])
    return _Table(counts=longest, solids=solids, materials=materials, lights=lights)


def _safe(values: Tensor) -> Tensor:
    """Values moved away from zero, so that they can be divided by."""
    return torch.where(values.abs() < 1e-9, torch.full_like(values, 1e-9), values)


def _first_hits(table: _Table, origins: Float[Tensor, "b v q 3"], directions: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Distance and table row ([b, v, r] both) of the first surfaces. ``q`` is 1 (a shared origin) or ``r``; directions come by axis."""
    column = table.solids.transpose(1, 2)[:, :, None, :, None]  # [b 9 1 p 1]
    ox, oy, oz = (origins[..., axis].unsqueeze(2) - column[:, axis] for axis in range(3))  # [b v p q]
    cosine, sine = column[:, 6], column[:, 7]
    ox, oy = cosine * ox + sine * oy, cosine * oy - sine * ox
    wx, wy, wz = (way.unsqueeze(2) for way in directions)  # [b v 1 r]
    inverse_z = _safe(wz).reciprocal()
    boxes, cylinders, _ = table.counts
    distances = []

    group = slice(0, boxes)
    inverse_x = _safe(cosine[:, :, group] * wx + sine[:, :, group] * wy).reciprocal_()
    inverse_y = _safe(cosine[:, :, group] * wy - sine[:, :, group] * wx).reciprocal_()
    near, far = None, None
    for origin, inverse, axis in ((ox, inverse_x, 3), (oy, inverse_y, 4), (oz, inverse_z, 5)):
        middle, reach = origin[:, :, group] * inverse, column[:, axis, :, group] * inverse.abs()
        enter, leave = -middle - reach, reach - middle
        near = enter if near is None else torch.maximum(near, enter)
        far = leave if far is None else torch.minimum(far, leave)
    hit = (near < far) & (near > _NEAR)
    hit[:, :, 0] = False
    distances.append(near.masked_fill_(~hit, math.inf))
    distances[0][:, :, 0] = far[:, :, 0]  # the shell is seen from inside

    if cylinders:
        group = slice(boxes, boxes + cylinders)
        dx, dy = cosine[:, :, group] * wx + sine[:, :, group] * wy, cosine[:, :, group] * wy - sine[:, :, group] * wx
        x, y, z = ox[:, :, group], oy[:, :, group], oz[:, :, group]
        near, far, valid = _quadratic(dx * dx + dy * dy, x * dx + y * dy, x * x + y * y - column[:, 3, :, group] ** 2)
        middle, reach = z * inverse_z, column[:, 5, :, group] * inverse_z.abs()
        near, far = torch.maximum(near, -middle - reach), torch.minimum(far, reach - middle)
        distances.append(near.masked_fill(~(valid & (near < far) & (near > _NEAR)), math.inf))
    if table.counts[2]:
        group = slice(boxes + cylinders, None)
        x, y, z = (o[:, :, group] for o in (ox, oy, oz))
        along = x * (cosine[:, :, group] * wx + sine[:, :, group] * wy) + y * (cosine[:, :, group] * wy - sine[:, :, group] * wx) + z * wz
        near, _, valid = _quadratic(torch.ones_like(along), along, x * x + y * y + z * z - column[:, 3, :, group] ** 2)
        distances.append(near.masked_fill(~(valid & (near > _NEAR)), math.inf))
    return torch.cat(distances, dim=2).min(dim=2)


def _quadratic(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Roots of a t^2 + 2 b t + c and whether they are real."""
    discriminant = b * b - a * c
    root = discriminant.clamp(min=0).sqrt()
    inverse = a.clamp(min=1e-12).reciprocal()
    return (-b - root) * inverse, (root - b) * inverse, discriminant > 0


@dataclass(frozen=True, kw_only=True)
class _Surface:
    """Where rays end. Every field is a plane [b, v, r] or three of them (x, y, z)."""

    row: Tensor
    distance: Tensor
    points: tuple[Tensor, Tensor, Tensor]
    normals: tuple[Tensor, Tensor, Tensor]
    """World, towards the origin."""
    material: Tensor
    """Row in the material table."""
    u: Tensor
    """First face coordinate in metres."""
    v: Tensor
    """Second face coordinate in metres."""
    v_share: Tensor
    """Second face coordinate from -1 to 1 across the face."""


def _rows(table: Float[Tensor, "b m f"], index: Int[Tensor, "b v r"]) -> tuple[Tensor, ...]:
    """The chosen rows as one plane [b, v, r] per column."""
    rooms, length, columns = table.shape
    offset = torch.arange(rooms, device=index.device)[:, None, None] * length
    flat = rearrange(table, "b m f -> f (b m)").contiguous()
    return flat.index_select(1, (index + offset).flatten()).view(columns, *index.shape).unbind(0)


def _surface(table: _Table, origins: Float[Tensor, "b v q 3"], directions: Float[Tensor, "b v r 3"]) -> _Surface:
    """Cast and describe the surfaces that were hit."""
    ways = rearrange(directions, "b v r c -> c b v r").contiguous().unbind(0)
    distance, row = _first_hits(table, origins, ways)
    points = tuple(torch.addcmul(origins[..., axis], distance, ways[axis]) for axis in range(3))
    cx, cy, cz, hx, hy, hz, cosine, sine, kind = _rows(table.solids, row)
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
    return _Surface(
        row=row,
        distance=distance,
        points=points,
        normals=(cosine * nx - sine * ny, sine * nx + cosine * ny, nz),
        material=torch.where(row == 0, side, row + 5),
        u=torch.where(flat_x, y, x),
        v=torch.where(flat_z, y, z),
        v_share=torch.where(flat_z, sy, sz),
    )


def _colours(table: _Table, surface: _Surface, footprint: Tensor) -> Float[Tensor, "3 b v r"]:
    """Pattern times light. ``footprint`` is the pixel's width on the surface in metres ([b, v, r]); it fades what would alias."""
    red, green, blue, red2, green2, blue2, pattern, *waves, phase1, phase2, sharpness, glow = _rows(table.materials, surface.material)
    angle1 = torch.addcmul(phase1, waves[0], surface.u).addcmul_(waves[1], surface.v)
    angle2 = torch.addcmul(phase2, waves[2], surface.u).addcmul_(waves[3], surface.v)
    squared_frequency = torch.maximum(waves[0] ** 2 + waves[1] ** 2, waves[2] ** 2 + waves[3] ** 2)
    # A box filter damps a sine; this is the filter to second order (the wave vectors are in radians per metre).
    fade = torch.exp(squared_frequency * footprint.square() / -24)
    first, second = torch.sin(angle1) * fade, torch.sin(angle2) * fade
    third = torch.sin(0.618 * angle1 + 1.3 * angle2) * fade
    sharp = torch.tanh(sharpness * first * torch.where(pattern == 3, second, torch.ones_like(second))) / torch.tanh(sharpness)
    value = torch.where(pattern == 4, (first + second + third) / 2, torch.where(pattern >= 2, sharp, surface.v_share))
    share = torch.where(pattern == 0, torch.zeros_like(value), 0.5 + 0.5 * value.clamp(-1, 1))
    light = _light(table, surface.points, surface.normals)
    light = torch.lerp(light, torch.ones_like(light), glow)
    colours = [torch.lerp(a, b, share) * light for a, b in ((red, red2), (green, green2), (blue, blue2))]
    return torch.stack(colours).clamp_(0, 1)


def _light(table: _Table, points: tuple, normals: tuple) -> Float[Tensor, "b v r"]:
    """Ambient light plus a soft lamp, darkened towards the room's edges and corners as inter-reflection does."""
    lamp = table.lights[:, None, None]
    tx, ty, tz = (lamp[..., axis] - points[axis] for axis in range(3))
    squared = tx * tx + ty * ty + tz * tz
    facing = (tx * normals[0] + ty * normals[1] + tz * normals[2]) * squared.clamp(min=1e-6).rsqrt()
    lit = ((0.8 + 0.8 * facing) / (1 + squared / 16)).clamp_(max=1.2)
    light = torch.lerp(lit, torch.ones_like(lit), lamp[..., 3])
    shell = table.solids[:, None, None, 0]
    for axis in range(3):
        offset = points[axis] - shell[..., axis]
        gap = (shell[..., 3 + axis] - offset.abs()).clamp_(min=0)
        own = (-offset.sign() * normals[axis]).clamp_(min=0)  # 1 on the nearer wall itself, which must not darken itself
        light = light * (1 - 0.28 * (1 - own) * torch.exp(gap / -0.3))
    return light


def cast(room: Room, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Hits:
    """First surfaces on rays that start inside the room; directions are unit vectors (world frame, metres)."""
    table = _table([room]).to(origins.device)
    limit = max(1, _pairs_at_once(origins.device) // table.solids.shape[1])
    surfaces = [
        _surface(table, some_origins[None, None], some_directions[None, None])
        for some_origins, some_directions in zip(origins.split(limit), directions.split(limit), strict=True)
    ]
    return Hits(
        distance=torch.cat([part.distance.flatten() for part in surfaces]),
        points=torch.cat([torch.stack(part.points, dim=-1)[0, 0] for part in surfaces]),
        normals=torch.cat([torch.stack(part.normals, dim=-1)[0, 0] for part in surfaces]),
        solids=torch.cat([part.row.flatten() for part in surfaces]),
    )


def render(room: Room, cameras: Pinholes, *, supersample: int = 1) -> RoomImages:
    """Colour, z-depth and normals of one room, on the cameras' device (the room may lie elsewhere); see :func:`render_batch`."""
    return render_batch([room], [cameras], supersample=supersample)[0]


def render_batch(rooms: list[Room], cameras: list[Pinholes], *, supersample: int = 1) -> list[RoomImages]:
    """Images of several rooms, at once where that pays (on a GPU); every room has the same number of cameras of one size.

    ``supersample`` = s averages s x s rays per pixel for the colour; depth and normals always belong to the pixel centres. The images lie
    on the cameras' device. Raises ValueError when counts or sizes differ or ``supersample`` is below 1.
    """
    kinds = {(len(group), group.width, group.height) for group in cameras}
    if len(rooms) != len(cameras) or len(kinds) != 1:
        raise ValueError(
            f"render_batch needs one set of cameras per room, all of one (count, width, height), got {len(rooms)} rooms and "
            f"{len(cameras)} sets of {sorted(kinds)}; group equal sizes and render each group"
        )
    if supersample < 1:
        raise ValueError(f"supersample must be at least 1, got {supersample}")
    if cameras[0].focal.device.type == "cpu":
        return [_render([room], [group], supersample)[0] for room, group in zip(rooms, cameras, strict=True)]
    return _render(rooms, cameras, supersample)


def _render(rooms: list[Room], cameras: list[Pinholes], supersample: int) -> list[RoomImages]:
    """Several rooms in one table."""
    together = Pinholes.cat(cameras)
    table = _table(rooms).to(together.focal.device)
    planes = _render_planes(table, together)
    shape = {"h": together.height, "w": together.width, "b": len(rooms)}
    rgb, depth, normals = (rearrange(planes[part], "c b v (h w) -> b v c h w", **shape) for part in (slice(3), slice(3, 4), slice(4, 7)))
    if supersample > 1:
        height, width = together.height * supersample, together.width * supersample
        fine = _render_planes(table, together.scaled(width, height))[:3]
        rgb = reduce(fine, "c b v (h s1 w s2) -> b v c h w", "mean", s1=supersample, s2=supersample, **shape)
    return [
        RoomImages(rgb=rgb[room].contiguous(), depth=depth[room, :, 0].contiguous(), normals=normals[room].contiguous())
        for room in range(len(rooms))
    ]


def _render_planes(table: _Table, cameras: Pinholes) -> Float[Tensor, "7 b v r"]:
    """rgb, z-depth and normal planes of all rooms' cameras, chunk by chunk over views and then over rays."""
    rooms, solids = table.solids.shape[:2]
    views, pixels = len(cameras) // rooms, cameras.height * cameras.width
    device = cameras.focal.device
    planes = torch.empty(7, rooms, views, pixels, device=device, dtype=cameras.focal.dtype)
    budget = max(1, _pairs_at_once(device) // (solids * rooms))  # rays of each room
    ray_step, view_step = min(pixels, budget), max(1, budget // pixels)
    numbers = torch.arange(len(cameras), device=device).view(rooms, views)
    for view in range(0, views, view_step):
        chosen = cameras[numbers[:, view : view + view_step].flatten()]
        rays = rearrange(chosen.directions(), "(b v) h w c -> b v (h w) c", b=rooms)
        origins = rearrange(chosen.centers, "(b v) c -> b v 1 c", b=rooms)
        forward = rearrange(chosen.rotations[..., 2], "(b v) c -> b v c 1", b=rooms)
        pixel_angle = rearrange(1 / chosen.focal.amax(dim=-1), "(b v) -> b v 1", b=rooms)
        for ray in range(0, pixels, ray_step):
            directions = rays[:, :, ray : ray + ray_step]
            surface = _surface(table, origins, directions)
            facing = -sum(n * way for n, way in zip(surface.normals, directions.unbind(-1), strict=True))
            part = planes[:, :, view : view + view_step, ray : ray + ray_step]
            part[:3] = _colours(table, surface, surface.distance * pixel_angle / facing.clamp(min=0.15))
            part[3] = surface.distance * (directions @ forward)[..., 0]
            part[4:7] = torch.stack(surface.normals)
    return planes


def _pairs_at_once(device: torch.device) -> int:
    """Ray-solid pairs to work on together: what fits a core's cache, or keeps a GPU busy within about 2 GB."""
    return _CPU_PAIRS if device.type == "cpu" else _GPU_PAIRS
