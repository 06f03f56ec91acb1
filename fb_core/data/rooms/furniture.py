"""Furniture and wall pieces of procedural rooms, as plain Python records of yaw-rotated boxes, cylinders and spheres.

A piece is designed in its own frame (x along the wall, y from the wall into the room, z up, metres) and then put into
the room.
"""

from __future__ import annotations

import colorsys
import math
from dataclasses import dataclass, replace

import numpy as np

PATTERNS = ("plain", "gradient", "stripes", "checker", "noise")
"""Pattern kinds; a material holds the position in this tuple."""
KINDS = ("box", "cylinder", "sphere")
"""Solid kinds; a room holds the position in this tuple."""

Colour = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Material:
    """Two colours mixed by a pattern over the face coordinates (metres)."""

    base: Colour
    second: Colour
    pattern: str = "plain"
    waves: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    """Two wave vectors in cycles per metre."""
    phases: tuple[float, float] = (0.0, 0.0)
    """Radians."""
    sharpness: float = 1.0
    """0.1: sine; 4: nearly hard edges."""
    glow: float = 0.0
    """0: lit by the room's light; 1: shows its own colour (window, lamp)."""


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A primitive in the frame of its piece or of the room. Round kinds take their radius from ``half[0]``."""

    kind: str
    center: tuple[float, float, float]
    half: tuple[float, float, float]
    heading: float = 0.0
    """Rotation about z in radians."""
    material: Material


def colour(
    rng: np.random.Generator, hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]
) -> Colour:
    """A random colour within ranges of hue, saturation and value."""
    return colorsys.hsv_to_rgb(rng.uniform(*hue) % 1.0, rng.uniform(*saturation), rng.uniform(*value))


def shifted(rng: np.random.Generator, base: Colour, contrast: float) -> Colour:
    """A colour near ``base``: brightness and hue move by about ``contrast`` (0 to 1)."""
    hue, saturation, value = colorsys.rgb_to_hsv(*base)
    away = -1.0 if value > 0.55 else 1.0
    sign = away if rng.random() < 0.8 else -away
    value = float(np.clip(value + sign * contrast * rng.uniform(0.5, 1.0), 0.05, 1.0))
    saturation = float(np.clip(saturation + contrast * rng.uniform(-0.5, 0.5), 0.0, 0.9))
    return colorsys.hsv_to_rgb((hue + contrast * rng.uniform(-0.3, 0.3)) % 1.0, saturation, value)


def material(
    rng: np.random.Generator, base: Colour, *, contrast: float, busyness: float, glow: float = 0.0
) -> Material:
    """A random pattern over ``base``. ``busyness`` (0 to 1) raises the frequency, the edges and the odds of a
    pattern.
    """
    odds = np.array([1.0, 1.0, 0.4 + busyness, 0.6 * busyness, 0.4 + busyness])
    pattern = str(rng.choice(PATTERNS, p=odds / odds.sum()))
    frequency = rng.uniform(0.4, 0.9 + 2.6 * busyness)
    angle = rng.choice([0.0, math.pi / 2]) if pattern != "noise" else rng.uniform(0, math.pi)
    across = angle + (math.pi / 2 if pattern == "checker" else rng.uniform(0.8, 2.0))
    return Material(
        base=base,
        second=shifted(rng, base, contrast),
        pattern=pattern,
        waves=(
            (frequency * math.cos(angle), frequency * math.sin(angle)),
            (frequency * math.cos(across), frequency * math.sin(across)),
        ),
        phases=(rng.uniform(0, 2 * math.pi), rng.uniform(0, 2 * math.pi)),
        sharpness=0.3 + 3.5 * busyness * rng.random(),
        glow=glow,
    )


class Joiner:
    """Draws pieces of furniture with one random stream and one taste (contrast and busyness of the room's family)."""

    def __init__(self, rng: np.random.Generator, *, contrast: float, busyness: float):
        self.rng, self.contrast, self.busyness = rng, contrast, busyness

    def finish(self, *, wood: bool = False) -> Material:
        """A furniture surface: wood or a fabric or paint of any hue."""
        rng = self.rng
        if wood:
            base = colour(rng, (0.05, 0.1), (0.3, 0.6), (0.3, 0.75))
        else:
            base = colour(rng, (0.0, 1.0), (0.15, 0.65), (0.25, 0.85))
        return material(rng, base, contrast=self.contrast, busyness=0.6 * self.busyness)

    def box(self, center: tuple, size: tuple, finish: Material) -> Solid:
        """An upright box of full ``size`` whose ``center`` gives x, y and the height of its underside."""
        half = tuple(extent / 2 for extent in size)
        return Solid(
            kind="box", center=(float(center[0]), float(center[1]), center[2] + half[2]), half=half, material=finish
        )

    def drum(self, center: tuple, radius: float, height: float, finish: Material) -> Solid:
        """A vertical cylinder; ``center`` gives x, y and the height of its underside."""
        return Solid(
            kind="cylinder",
            center=(float(center[0]), float(center[1]), center[2] + height / 2),
            half=(radius, radius, height / 2),
            material=finish,
        )

    def ball(self, center: tuple, radius: float, finish: Material) -> Solid:
        """A sphere about ``center``."""
        return Solid(
            kind="sphere",
            center=(float(center[0]), float(center[1]), float(center[2])),
            half=(radius, radius, radius),
            material=finish,
        )

    def cabinet(self) -> list[Solid]:
        """A sideboard or wardrobe."""
        width, depth, height = (
            self.rng.uniform(0.7, 1.6),
            self.rng.uniform(0.4, 0.6),
            self.rng.choice([0.8, 1.0, 1.9]) * self.rng.uniform(0.9, 1.1),
        )
        return [self.box((0, depth / 2, 0), (width, depth, height), self.finish(wood=self.rng.random() < 0.6))]

    def bookcase(self) -> list[Solid]:
        """A tall case whose front shows rows of books as stripes."""
        width, height = self.rng.uniform(0.8, 1.5), self.rng.uniform(1.5, 2.1)
        wood = self.finish(wood=True)
        frequency = self.rng.uniform(1.5, 2.5 + 3.0 * self.busyness)
        books = replace(
            wood, second=shifted(self.rng, wood.base, 0.15 + self.contrast), pattern="checker", sharpness=1.5
        )
        books = replace(books, waves=((frequency, 0.0), (0.0, 1.2)), phases=(0.0, 1.0))
        return [self.box((0, 0.16, 0), (width, 0.32, height), books)]

    def stool(self) -> list[Solid]:
        """A round seat, bin or pedestal."""
        radius, height = self.rng.uniform(0.2, 0.35), self.rng.uniform(0.4, 0.9)
        return [self.drum((0, radius + 0.05, 0), radius, height, self.finish())]

    def cushion(self) -> list[Solid]:
        """A ball on the floor."""
        radius = self.rng.uniform(0.2, 0.35)
        return [self.ball((0, radius + 0.05, radius), radius, self.finish())]

    def sofa(self) -> list[Solid]:
        """Seat and back, with arms in half of the cases."""
        width, depth = self.rng.uniform(1.3, 2.0), self.rng.uniform(0.75, 0.9)
        fabric = self.finish()
        solids = [
            self.box((0, depth / 2, 0), (width, depth, 0.42), fabric),
            self.box((0, 0.1, 0.42), (width, 0.2, 0.42), fabric),
        ]
        if self.rng.random() < 0.5:
            solids += [
                self.box((side * (width / 2 + 0.08), depth / 2, 0), (0.16, depth, 0.6), fabric) for side in (-1, 1)
            ]
        return solids

    def bed(self) -> list[Solid]:
        """A mattress with a headboard."""
        width = self.rng.uniform(1.0, 1.6)
        return [
            self.box((0, 1.05, 0), (width, 1.9, 0.5), self.finish()),
            self.box((0, 0.05, 0), (width + 0.1, 0.1, 1.0), self.finish(wood=True)),
        ]

    def table(self) -> list[Solid]:
        """A top on two side panels or on one column."""
        width, depth, height = self.rng.uniform(0.9, 1.6), self.rng.uniform(0.6, 0.8), self.rng.uniform(0.68, 0.78)
        wood = self.finish(wood=True)
        top = self.box((0, depth / 2, height - 0.05), (width, depth, 0.05), wood)
        if self.rng.random() < 0.3:
            return [top, self.drum((0, depth / 2, 0), 0.12, height - 0.05, wood)]
        panels = [
            self.box((side * (width / 2 - 0.06), depth / 2, 0), (0.06, depth - 0.1, height - 0.05), wood)
            for side in (-1, 1)
        ]
        return [top, *panels]

    def lamp(self) -> list[Solid]:
        """A standing lamp."""
        height = self.rng.uniform(1.2, 1.7)
        shade = Material(base=(0.98, 0.93, 0.8), second=(0.9, 0.8, 0.6), pattern="gradient", glow=0.8)
        head = (
            self.drum((0, 0.25, height), 0.18, 0.28, shade)
            if self.rng.random() < 0.6
            else self.ball((0, 0.25, height + 0.1), 0.18, shade)
        )
        return [self.drum((0, 0.25, 0), 0.03, height, self.finish()), head]

    def plant(self) -> list[Solid]:
        """A pot with a round crown."""
        leaves = material(
            self.rng,
            colour(self.rng, (0.25, 0.4), (0.4, 0.7), (0.25, 0.6)),
            contrast=self.contrast,
            busyness=self.busyness,
        )
        crown = self.rng.uniform(0.22, 0.4)
        return [self.drum((0, 0.4, 0), 0.16, 0.35, self.finish()), self.ball((0, 0.4, 0.3 + crown), crown, leaves)]

    def picture(self) -> list[Solid]:
        """A framed picture at eye height."""
        width, height = self.rng.uniform(0.5, 1.2), self.rng.uniform(0.4, 0.8)
        art = material(
            self.rng,
            colour(self.rng, (0.0, 1.0), (0.2, 0.7), (0.3, 0.9)),
            contrast=0.2 + self.contrast,
            busyness=0.3 + 0.7 * self.busyness,
        )
        frame = Material(base=colour(self.rng, (0.05, 0.1), (0.0, 0.5), (0.1, 0.9)), second=(0.0, 0.0, 0.0))
        level = self.rng.uniform(1.3, 1.55) - height / 2
        return [
            self.box((0, 0.01, level - 0.04), (width + 0.08, 0.02, height + 0.08), frame),
            self.box((0, 0.015, level), (width, 0.03, height), art),
        ]

    def window(self) -> list[Solid]:
        """A bright pane in a pale frame."""
        width, height = self.rng.uniform(0.8, 1.6), self.rng.uniform(0.9, 1.2)
        sky = Material(base=(0.95, 0.97, 1.0), second=(0.62, 0.8, 0.97), pattern="gradient", glow=1.0)
        frame = Material(base=(0.9, 0.9, 0.88), second=(0.9, 0.9, 0.88))
        return [
            self.box((0, 0.015, 0.88), (width + 0.14, 0.03, height + 0.14), frame),
            self.box((0, 0.02, 0.95), (width, 0.04, height), sky),
        ]

    def door(self) -> list[Solid]:
        """A closed door leaf."""
        return [self.box((0, 0.02, 0), (0.9, 0.04, 2.02), self.finish(wood=self.rng.random() < 0.6))]


def put(piece: list[Solid], x: float, y: float, heading: float) -> list[Solid]:
    """The piece moved to (x, y) on the floor, its own y axis (away from its wall) turned by ``heading`` radians."""
    cosine, sine = math.cos(heading), math.sin(heading)
    moved = []
    for solid in piece:
        along, away, up = solid.center
        center = (x + cosine * along - sine * away, y + sine * along + cosine * away, up)
        moved.append(replace(solid, center=center, heading=solid.heading + heading))
    return moved
