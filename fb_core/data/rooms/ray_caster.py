"""The ray caster of procedural rooms: cameras or rays in, pictures, depth and normals or hits out.

Work goes in chunks that fit a core's cache (CPU) or a bounded share of memory (GPU).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from einops import rearrange, reduce
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.data.rooms.intersection import RoomTable, find_surface, room_table
from fb_core.data.rooms.room import Room
from fb_core.data.rooms.shading import surface_colours
from fb_core.geometry.cameras import Pinholes

CPU_PAIRS, GPU_PAIRS = 2**18, 2**25
"""Rays and solids that are tried at a time, which bounds memory."""


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


def _on_one_core(work: Callable) -> Callable:
    """``work`` without torch's own threads.

    The operations are small: spread over cores one by one they gain little, and on a busy machine their many barriers
    cost tens of times the work itself (wide rooms at 64x64 on two cores that others used as well: 80 views/s with one
    thread, 5 with two).
    """

    @functools.wraps(work)
    def alone(*args, **kwargs):
        threads = torch.get_num_threads()
        if threads == 1:
            return work(*args, **kwargs)
        torch.set_num_threads(1)
        try:
            return work(*args, **kwargs)
        finally:
            torch.set_num_threads(threads)

    return alone


@_on_one_core
def cast(room: Room, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Hits:
    """First surfaces on rays that start inside the room; directions are unit vectors (world frame, metres)."""
    table = room_table([room]).to(origins.device)
    limit = max(1, _pairs_at_once(origins.device) // table.solids.shape[1])
    surfaces = [
        find_surface(table, some_origins[None, None], some_directions[None, None])
        for some_origins, some_directions in zip(origins.split(limit), directions.split(limit), strict=True)
    ]
    return Hits(
        distance=torch.cat([part.distance.flatten() for part in surfaces]),
        points=torch.cat([torch.stack(part.points, dim=-1)[0, 0] for part in surfaces]),
        normals=torch.cat([torch.stack(part.normals, dim=-1)[0, 0] for part in surfaces]),
        solids=torch.cat([part.row.flatten() for part in surfaces]),
    )


def render(room: Room, cameras: Pinholes, *, supersample: int = 1) -> RoomImages:
    """Colour, z-depth and normals of one room, on the cameras' device (the room may lie elsewhere); see
    :func:`render_batch`.
    """
    return render_batch([room], [cameras], supersample=supersample)[0]


def render_batch(rooms: list[Room], cameras: list[Pinholes], *, supersample: int = 1) -> list[RoomImages]:
    """Images of several rooms, at once where that pays (on a GPU); every room has the same number of cameras of one
    size.

    ``supersample`` = s averages s x s rays per pixel for the colour; depth and normals always belong to the pixel
    centres. The images lie on the cameras' device. Raises ValueError when counts or sizes differ or ``supersample`` is
    below 1.
    """
    kinds = {(len(group), group.width, group.height) for group in cameras}
    if len(rooms) != len(cameras) or len(kinds) != 1:
        raise ValueError(
            f"render_batch needs one set of cameras per room, all of one (count, width, height), got {len(rooms)} "
            "rooms and "
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
    table = room_table(rooms).to(together.focal.device)
    planes = _render_planes(table, together)
    shape = {"h": together.height, "w": together.width, "b": len(rooms)}
    rgb, depth, normals = (
        rearrange(planes[part], "c b v (h w) -> b v c h w", **shape) for part in (slice(3), slice(3, 4), slice(4, 7))
    )
    if supersample > 1:
        height, width = together.height * supersample, together.width * supersample
        fine = _render_planes(table, together.scaled(width, height))[:3]
        rgb = reduce(fine, "c b v (h s1 w s2) -> b v c h w", "mean", s1=supersample, s2=supersample, **shape)
    return [
        RoomImages(rgb=rgb[room].contiguous(), depth=depth[room, :, 0].contiguous(), normals=normals[room].contiguous())
        for room in range(len(rooms))
    ]


@_on_one_core
def _render_planes(table: RoomTable, cameras: Pinholes) -> Float[Tensor, "7 b v r"]:
    """rgb, z-depth and normal planes of all rooms' cameras, chunk by chunk over views and then over rays."""
    rooms, solids = table.solids.shape[:2]
    views, pixels = len(cameras) // rooms, cameras.height * cameras.width
    device = cameras.focal.device
    planes = torch.empty(7, rooms, views, pixels, device=device, dtype=cameras.focal.dtype)
    budget = max(1, _pairs_at_once(device) // (solids * rooms))  # rays of each room
    view_step = max(1, budget // pixels)
    numbers = torch.arange(len(cameras), device=device).view(rooms, views)
    for view in range(0, views, view_step):
        chosen = cameras[numbers[:, view : view + view_step].flatten()]
        _fill(planes[:, :, view : view + view_step], table, chosen, min(pixels, budget))
    return planes


def _fill(planes: Float[Tensor, "7 b v r"], table: RoomTable, cameras: Pinholes, ray_step: int) -> None:
    """Writes the planes of some views."""
    rooms = planes.shape[1]
    rays = rearrange(cameras.directions(), "(b v) h w c -> b v (h w) c", b=rooms)
    origins = rearrange(cameras.centers, "(b v) c -> b v 1 c", b=rooms)
    forward = rearrange(cameras.rotations[..., 2], "(b v) c -> b v c 1", b=rooms)
    pixel_angle = rearrange(1 / cameras.focal.amax(dim=-1), "(b v) -> b v 1", b=rooms)
    for ray in range(0, rays.shape[2], ray_step):
        directions = rays[:, :, ray : ray + ray_step]
        surface = find_surface(table, origins, directions)
        facing = -(rearrange(torch.stack(surface.normals), "c b v r -> b v r c") * directions).sum(dim=-1)
        part = planes[..., ray : ray + ray_step]
        part[:3] = surface_colours(table, surface, surface.distance * pixel_angle / facing.clamp(min=0.15))
        part[3] = surface.distance * (directions @ forward)[..., 0]
        part[4:7] = torch.stack(surface.normals)


def _pairs_at_once(device: torch.device) -> int:
    """Ray-solid pairs to work on together: what fits a core's cache, or keeps a GPU busy within about 2 GB."""
    return CPU_PAIRS if device.type == "cpu" else GPU_PAIRS
