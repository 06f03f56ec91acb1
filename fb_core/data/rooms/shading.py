"""The look of procedural rooms: patterns of two colours under soft, view-independent light."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.rooms.furniture import PATTERNS
from fb_core.data.rooms.intersection import RoomTable, Surface, rows_of

_PLAIN, _STRIPES, _CHECKER, _NOISE = (PATTERNS.index(name) for name in ("plain", "stripes", "checker", "noise"))


def surface_colours(table: RoomTable, surface: Surface, footprint: Tensor) -> Float[Tensor, "3 b v r"]:
    """Pattern times light. ``footprint`` is the pixel's width on the surface in metres ([b, v, r]); it fades what would
    alias.
    """
    red, green, blue, red2, green2, blue2, pattern, *waves, phase1, phase2, sharpness, glow = rows_of(
        table.materials, surface.material
    )
    angle1 = torch.addcmul(phase1, waves[0], surface.u).addcmul_(waves[1], surface.v)
    angle2 = torch.addcmul(phase2, waves[2], surface.u).addcmul_(waves[3], surface.v)
    squared_frequency = torch.maximum(waves[0] ** 2 + waves[1] ** 2, waves[2] ** 2 + waves[3] ** 2)
    # A box filter damps a sine; this is the filter to second order (the wave vectors are in radians per metre).
    fade = torch.exp(squared_frequency * footprint.square() / -24)
    first, second = torch.sin(angle1) * fade, torch.sin(angle2) * fade
    third = torch.sin(0.618 * angle1 + 1.3 * angle2) * fade
    sharp = torch.tanh(
        sharpness * first * torch.where(pattern == _CHECKER, second, torch.ones_like(second))
    ) / torch.tanh(sharpness)
    value = torch.where(
        pattern == _NOISE, (first + second + third) / 2, torch.where(pattern >= _STRIPES, sharp, surface.v_share)
    )
    share = torch.where(pattern == _PLAIN, torch.zeros_like(value), 0.5 + 0.5 * value.clamp(-1, 1))
    light = _light(table, surface.points, surface.normals)
    light = torch.lerp(light, torch.ones_like(light), glow)
    colours = [torch.lerp(a, b, share) * light for a, b in ((red, red2), (green, green2), (blue, blue2))]
    return torch.stack(colours).clamp_(0, 1)


def _light(table: RoomTable, points: Sequence[Tensor], normals: Sequence[Tensor]) -> Float[Tensor, "b v r"]:
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
        own = (-offset.sign() * normals[axis]).clamp_(
            min=0
        )  # 1 on the nearer wall itself, which must not darken itself
        light = light * (1 - 0.28 * (1 - own) * torch.exp(gap / -0.3))
    return light
