"""A vectorised ray caster for procedural rooms: exact hits with boxes, cylinders and spheres, soft view-independent shading.

Rays are laid out as [room, view, solid, ray] planes, one plane per coordinate, and worked through in chunks that fit the cache (CPU) or
a bounded share of memory (GPU). Several rooms are cast at once; shorter tables are filled with solids that no ray reaches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.data.rooms import Room
from fb_core.geometry.cameras import Pinholes

_FAR_BELOW = -1.0e4  # where padding solids lie: behind the floor of every room
_NEAR = 1e-5  # metres; a hit nearer than this is the surface that the ray starts on
_CPU_CHUNK, _GPU_CHUNK = 2**17, 2**25  # ray-solid pairs worked on at once


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
    """Rooms as batched columns; fields as in ``Room`` with a leading room dimension, solids grouped and padded by kind."""

    counts: tuple[int, int, int]
    solids: Float[Tensor, "b p 9"]
    """center 3, half 3, cosine and sine of the heading, kind."""
    origin_rows: Int[Tensor, "b p"]
    """Row in the room's own table; 0 for padding."""
    materials: Float[Tensor, "b m 15"]
    """base 3, second 3, pattern, waves 4, phases 2, sharpness, glow."""
    lights: Float[Tensor, "b 4"]
    """position 3, ambient."""


def _table(rooms: list[Room]) -> _Table:
    """Rooms side by side. Row 0 is the shell, then the other boxes, cylinders and spheres, each padded to the longest."""
    counts = [torch.bincount(room.kinds.cpu(), minlength=3).tolist() for room in rooms]
    longest = tuple(max(count[kind] for count in counts) for kind in range(3))
    device, dtype = rooms[0].centers.device, rooms[0].centers.dtype
    below = torch.tensor([0.0, 0.0, _FAR_BELOW, 0.01, 0.01, 0.01, 1.0, 0.0, 0.0], device=device, dtype=dtype)
    solids = below.expand(len(rooms), sum(longest), 9).clone()
    rows = torch.zeros(len(rooms), sum(longest), dtype=torch.long, device=device)
    materials = torch.zeros(len(rooms), 5 + sum(longest), 15, device=device, dtype=dtype)
    for index, (room, count) in enumerate(zip(rooms, counts, strict=True)):
        heading = room.headings[:, None]
        own = torch.cat([room.centers, room.halves, torch.cos(heading), torch.sin(heading), room.kinds[:, None].to(dtype)], dim=1)
        paint = torch.cat(
            [room.base, room.second, room.patterns[:, None].to(dtype), room.waves.flatten(1), room.phases,
             room.sharpness[:, None], room.glow[:, None]], dim=1,
        )  # fmt: skip
        materials[index, :5] = paint[:5]
        start, first = 0, 0
        for length, padded in zip(count, longest, strict=True):
            solids[index, first : first + length] = own[start : start + length]
            rows[index, first : first + length] = torch.arange(start, start + length, device=device)
            materials[index, 5 + first : 5 + first + length] = paint[5 + start : 5 + start + length]
            start, first = start + length, first + padded
    lights = torch.stack([torch.cat([room.light, room.ambient[None]]) for room in rooms])
    return _Table(counts=longest, solids=solids, origin_rows=rows, materials=materials, lights=lights)


def _safe(values: Tensor) -> Tensor:
    """Values moved away from zero, so that they can be divided by."""
    return torch.where(values.abs() < 1e-9, torch.full_like(values, 1e-9), values)


def _first_hits(table: _Table, origins: Float[Tensor, "b v q 3"], directions: Float[Tensor, "b v r 3"]) -> tuple[Tensor, Tensor]:
    """Distance and table row of the first surface on each ray ([b, v, r] both). ``q`` is 1 (a shared origin) or ``r``."""
    column = table.solids.transpose(1, 2)[:, :, None, :, None]  # [b 9 1 p 1]
    ox, oy, oz = (origins[..., axis].unsqueeze(2) - column[:, axis] for axis in range(3))  # [b v p q]
    cosine, sine = column[:, 6], column[:, 7]
    ox, oy = cosine * ox + sine * oy, cosine * oy - sine * ox
    wx, wy, wz = (directions[..., axis].unsqueeze(2) for axis in range(3))  # [b v 1 r]
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
    """Local geometry of the first hits; every field is [b, v, r] or [b, v, r, 3]."""

    row: Tensor
    distance: Tensor
    points: Tensor
    local: Tensor
    """Point in the solid's own axes, metres."""
    half: Tensor
    axis: Tensor
    """Which local axis the pattern does not use."""
    normals: Tensor
    """World, towards the origin."""


def _surface(table: _Table, origins: Tensor, directions: Tensor) -> _Surface:
    """Cast and describe the surfaces that were hit."""
    distance, row = _first_hits(table, origins, directions)
    points = origins + distance[..., None] * directions
    batch = torch.arange(len(table.solids), device=row.device)[:, None, None]
    solid = table.solids[batch, row]
    center, half, cosine, sine, kind = solid[..., :3], solid[..., 3:6], solid[..., 6], solid[..., 7], solid[..., 8]
    x, y, z = (points - center).unbind(-1)
    x, y = cosine * x + sine * y, cosine * y - sine * x
    local = torch.stack([x, y, z], dim=-1)
    scaled = local / half
    box_axis = scaled.abs().argmax(dim=-1)
    on_cap = (kind == 1) & (scaled[..., 2].abs() > scaled[..., :2].norm(dim=-1))
    axis = torch.where(kind == 0, box_axis, torch.where(on_cap, 2, 1))
    flat = F.one_hot(torch.where(on_cap, 2, box_axis), 3).to(local) * local.sign()
    upright = torch.where(kind == 1, torch.zeros_like(z), z)
    curved = F.normalize(torch.stack([x, y, upright], dim=-1), dim=-1)
    normal = torch.where(((kind == 0) | on_cap)[..., None], flat, curved)
    normal = torch.stack(
        [cosine * normal[..., 0] - sine * normal[..., 1], sine * normal[..., 0] + cosine * normal[..., 1], normal[..., 2]], dim=-1
    )
    normal = torch.where((row == 0)[..., None], -normal, normal)
    return _Surface(row=row, distance=distance, points=points, local=local, half=half, axis=axis, normals=normal)


def _colours(table: _Table, surface: _Surface, footprint: Tensor) -> Float[Tensor, "b v r 3"]:
    """Pattern times light. ``footprint`` is the pixel's width on the surface in metres ([b, v, r]); it fades what would alias."""
    side = 2 * surface.axis + (surface.local.gather(-1, surface.axis[..., None])[..., 0] > 0)
    batch = torch.arange(len(table.solids), device=side.device)[:, None, None]
    paint = table.materials[batch, torch.where(surface.row == 0, side, surface.row + 5)]
    pattern = paint[..., 6]
    x, y, z = surface.local.unbind(-1)
    u = torch.where(surface.axis == 0, y, x)
    v = torch.where(surface.axis == 2, y, z)
    v_half = torch.where(surface.axis == 2, surface.half[..., 1], surface.half[..., 2])
    waves, phases, sharpness = paint[..., 7:11], paint[..., 11:13], paint[..., 13]
    angles = [2 * math.pi * (waves[..., 2 * i] * u + waves[..., 2 * i + 1] * v) + phases[..., i] for i in (0, 1)]
    frequency = waves[..., :2].norm(dim=-1).maximum(waves[..., 2:].norm(dim=-1))
    fade = torch.exp(-((math.pi * frequency * footprint) ** 2) / 6)  # box filter of a sine, to second order
    first, second = torch.sin(angles[0]) * fade, torch.sin(angles[1]) * fade
    third = torch.sin(0.618 * angles[0] + 1.3 * angles[1]) * fade
    sharpen = torch.tanh(sharpness).reciprocal()
    stripes = torch.tanh(sharpness * first) * sharpen
    checker = torch.tanh(sharpness * first * second) * sharpen
    noise = ((first + second + third) / 2).clamp(-1, 1)
    value = torch.where(pattern == 0, -torch.ones_like(u), v / v_half)
    value = torch.where(pattern == 2, stripes, torch.where(pattern == 3, checker, torch.where(pattern == 4, noise, value)))
    colour = paint[..., :3] + (paint[..., 3:6] - paint[..., :3]) * (0.5 + 0.5 * value.clamp(-1, 1))[..., None]
    light = _light(table, surface.points, surface.normals)
    glow = paint[..., 14]
    return (colour * (light + (1 - light) * glow)[..., None]).clamp(0, 1)


def _light(table: _Table, points: Tensor, normals: Tensor) -> Float[Tensor, "b v r"]:
    """Ambient light plus a soft lamp, darkened towards the room's edges and corners as inter-reflection does."""
    lamp, ambient = table.lights[:, None, None, :3], table.lights[:, None, None, 3]
    towards = lamp - points
    squared = towards.square().sum(-1)
    facing = (towards * normals).sum(-1) * squared.clamp(min=1e-6).rsqrt()
    lit = (0.5 + 0.5 * facing) * 1.6 / (1 + squared / 16)
    light = ambient + (1 - ambient) * lit.clamp(max=1.2)
    center, half = table.solids[:, None, None, 0, :3], table.solids[:, None, None, 0, 3:6]
    offset = points - center
    for sign in (-1.0, 1.0):  # the wall at sign * half has the inward normal -sign
        gap = half - sign * offset
        turned = 1 - (-sign * normals).clamp(min=0)
        light = light * (1 - 0.28 * turned * torch.exp(-gap.clamp(min=0) / 0.3)).prod(dim=-1)
    return light.clamp(0, 1.1)


def cast(room: Room, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Hits:
    """First surfaces on rays that start inside the room; directions are unit vectors (world frame, metres)."""
    table = _table([room])
    limit = max(1, _chunk(origins.device) // table.solids.shape[1])
    parts = [
        _surface(table, o[None, None], d[None, None]) for o, d in zip(origins.split(limit), directions.split(limit), strict=True)
    ]  # fmt: skip

    def joined(name: str) -> Tensor:
        return torch.cat([getattr(part, name)[0, 0] for part in parts])

    return Hits(distance=joined("distance"), points=joined("points"), normals=joined("normals"), solids=table.origin_rows[0, joined("row")])


def _chunk(device: torch.device) -> int:
    return _CPU_CHUNK if device.type == "cpu" else _GPU_CHUNK


def render(room: Room, cameras: Pinholes, *, supersample: int = 1) -> RoomImages:
    """Colour, z-depth and normals of one room; see :func:`render_batch`."""
    return render_batch([room], [cameras], supersample=supersample)[0]


def render_batch(rooms: list[Room], cameras: list[Pinholes], *, supersample: int = 1) -> list[RoomImages]:
    """Images of several rooms at once (what training wants on a GPU); every room has the same number of cameras of one size.

    ``supersample`` = s averages s x s rays per pixel for the colour; depth and normals always belong to the pixel centres. Cameras and
    rooms share device and dtype. Raises ValueError when counts or sizes differ.
    """
    if len(rooms) != len(cameras) or len({(len(c), c.width, c.height) for c in cameras}) != 1:
        raise ValueError(
            f"render_batch needs one set of cameras per room, all of one count and size, got {len(rooms)} rooms and "
            f"{[(len(c), c.width, c.height) for c in cameras]}; group equal sizes and render them together"
        )
    if supersample < 1:
        raise ValueError(f"supersample must be at least 1, got {supersample}")
    table = _table(rooms)
    count, width, height = len(cameras[0]), cameras[0].width, cameras[0].height
    exact = _render_rays(table, Pinholes.cat(cameras), geometry=True)
    rgb = exact[0]
    if supersample > 1:
        fine = Pinholes.cat(cameras).scaled(width * supersample, height * supersample)
        rgb = F.avg_pool2d(_render_rays(table, fine, geometry=False)[0], supersample)
    return [
        RoomImages(rgb=rgb[start : start + count], depth=exact[1][start : start + count], normals=exact[2][start : start + count])
        for start in range(0, len(rooms) * count, count)
    ]


def _render_rays(table: _Table, cameras: Pinholes, *, geometry: bool) -> tuple[Tensor, Tensor, Tensor]:
    """rgb [n 3 h w], z-depth [n h w] and normals [n 3 h w] of all rooms' cameras (n = rooms x views), chunk by chunk."""
    rooms, solids = table.solids.shape[:2]
    views, pixels = len(cameras) // rooms, cameras.height * cameras.width
    like = {"device": cameras.focal.device, "dtype": cameras.focal.dtype}
    rgb = torch.empty(len(cameras), pixels, 3, **like)
    depth = torch.empty(len(cameras), pixels, **like) if geometry else rgb
    normals = torch.empty(len(cameras), pixels, 3, **like) if geometry else rgb
    budget = max(1, _chunk(cameras.focal.device) // solids)  # rays at once
    ray_step = min(pixels, budget)
    view_step = max(1, min(views, budget // pixels))
    room_step = max(1, min(rooms, budget // (pixels * views))) if view_step == views else 1
    for room in range(0, rooms, room_step):
        last_room = min(room + room_step, rooms)
        part = _Table(
            counts=table.counts, solids=table.solids[room:last_room], origin_rows=table.origin_rows[room:last_room],
            materials=table.materials[room:last_room], lights=table.lights[room:last_room],
        )  # fmt: skip
        for view in range(0, views, view_step):
            seen = range(view, min(view + view_step, views))
            index = torch.tensor([r * views + v for r in range(room, last_room) for v in seen], device=like["device"])
            chosen = cameras[index]
            rays = rearrange(chosen.directions(), "(b v) h w c -> b v (h w) c", b=last_room - room)
            origins = rearrange(chosen.centers, "(b v) c -> b v 1 c", b=last_room - room)
            forward = rearrange(chosen.rotations[..., 2], "(b v) c -> b v 1 c", b=last_room - room)
            pixel_angle = rearrange(1 / chosen.focal.amax(dim=-1), "(b v) -> b v 1", b=last_room - room)
            for start in range(0, pixels, ray_step):
                directions = rays[:, :, start : start + ray_step]
                surface = _surface(part, origins, directions)
                facing = -(surface.normals * directions).sum(-1)
                colours = _colours(part, surface, surface.distance * pixel_angle / facing.clamp(min=0.15))
                rgb[index, start : start + ray_step] = colours.flatten(0, 1)
                if geometry:
                    along = (directions * forward).sum(-1)
                    depth[index, start : start + ray_step] = (surface.distance * along).flatten(0, 1)
                    normals[index, start : start + ray_step] = surface.normals.flatten(0, 1)
    shape = {"h": cameras.height, "w": cameras.width}
    rgb = rearrange(rgb, "n (h w) c -> n c h w", **shape)
    if not geometry:
        return rgb, rgb, rgb
    return rgb, rearrange(depth, "n (h w) -> n h w", **shape), rearrange(normals, "n (h w) c -> n c h w", **shape)
