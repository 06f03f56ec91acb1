"""Cameras in procedural rooms for training: free positions, random headings, mostly level."""

from __future__ import annotations

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.rooms.room import Room
from fb_core.geometry.cameras import Pinholes

CAMERA_CLEARANCE_METRES = 0.25
"""Cameras keep this distance from every surface."""


def cameras_by_angles(
    centers: Float[Tensor, "n 3"],
    heading: Float[Tensor, "n"],
    pitch: Float[Tensor, "n"],
    fov_degrees: Float[Tensor, "n"],
    *,
    size: int,
) -> Pinholes:
    """Square, upright cameras. ``heading`` turns about z from +x, ``pitch`` is positive upwards (radians, below 90
    degrees).
    """
    forward = torch.stack([pitch.cos() * heading.cos(), pitch.cos() * heading.sin(), pitch.sin()], dim=-1)
    cameras = Pinholes.looking_at(
        centers, centers + forward, up=centers.new_tensor([0.0, 0.0, 1.0]), fov_degrees=60.0, width=size, height=size
    )
    focal = 0.5 * size / torch.tan(torch.deg2rad(fov_degrees) / 2)
    return dataclasses.replace(cameras, focal=focal[:, None].expand(-1, 2).clone())


def free_positions(
    room: Room, count: int, *, generator: torch.Generator, reach: float | None = None
) -> Float[Tensor, "n 3"]:
    """Random positions of the family's camera zone that keep their distance from every surface (on the generator's
    device: CPU).

    ``reach`` replaces the family's: share of the half sides around the room's centre. Raises ValueError for a room
    without free places.
    """
    family, size = room.family, room.size.cpu()
    reach = family.camera_reach if reach is None else reach
    low, high = family.camera_height_metres
    house = room.to("cpu")
    positions, tries = torch.empty(0, 3), 0
    while len(positions) < count:
        draws = torch.rand(4 * count, 3, generator=generator)
        across = (draws[:, :2] - 0.5) * size[:2] * reach
        height = (low + (high - low) * draws[:, 2:]).clamp(max=float(size[2]) - CAMERA_CLEARANCE_METRES)
        points = torch.cat([across, height], dim=1)
        positions = torch.cat([positions, points[house.clearance(points) >= CAMERA_CLEARANCE_METRES]])
        tries, reach = tries + 1, min(0.95, reach * 1.3)  # a centre crowded by furniture: look further out
        if tries > 40:
            raise ValueError(
                f"room {room.seed} of family {family.name} has no free place for a camera; take another seed"
            )
    return positions[:count]


def training_cameras(room: Room, count: int, *, size: int, generator: torch.Generator) -> Pinholes:
    """``count`` square training cameras of ``size`` pixels, on the room's device.

    Positions are free places of the family's zone, headings uniform, pitch mostly near level and sometimes steep, one
    field of view for all (the paper inpaints captures of one camera looking in random directions). The result depends
    on the generator alone.
    """
    family = room.family
    centers = free_positions(room, count, generator=generator)
    heading = torch.rand(count, generator=generator) * 2 * math.pi
    level = torch.randn(count, generator=generator) * math.radians(family.pitch_degrees)
    steep = (torch.rand(count, generator=generator) * 2 - 1) * math.radians(60)
    is_steep = torch.rand(count, generator=generator) < family.steep_odds
    pitch = torch.where(is_steep, steep, level.clamp(-1.0, 1.0))
    low, high = family.fov_degrees
    fov = (low + (high - low) * torch.rand(1, generator=generator)).expand(count)
    return cameras_by_angles(centers, heading, pitch, fov, size=size).to(room.centers.device)
