"""Seeded procedural rooms: a painted box seen from inside, furniture along the walls, pictures, windows; z is up,
metres.

A room is a small table of analytic solids, so that a ray caster renders it exactly (``ray_caster``) and ``mesh`` gives
the same surfaces as triangles. Rooms are redundant as real ones are: one paint, one floor, one ceiling all round.
"""

from __future__ import annotations

import dataclasses
import math
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.data.rooms.furniture import KINDS, PATTERNS, Joiner, Material, Solid, colour, material, put, shifted

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, kw_only=True)
class RoomFamily:
    """How varied rooms and cameras are. A training curriculum goes from narrow to wide."""

    name: str
    """Enters the random stream, so that two families differ at the same seed."""
    side_metres: tuple[float, float] = (3.5, 6.0)
    """Range of the floor's two side lengths."""
    height_metres: tuple[float, float] = (2.4, 3.0)
    """Range of the ceiling height."""
    pieces: tuple[int, int] = (2, 3)
    """Fewest and most pieces of furniture."""
    furniture: tuple[str, ...] = ("cabinet", "bookcase", "stool", "cushion", "sofa")
    """Which pieces stand at the walls."""
    wall_pieces: tuple[int, int] = (0, 2)
    """Fewest and most pictures, windows and doors."""
    contrast: float = 0.12
    """Distance of a pattern's two colours, 0 to 1."""
    busyness: float = 0.0
    """Frequency and hardness of patterns, 0 (soft) to 1."""
    accent_odds: float = 0.25
    """Probability that one wall has a paint of its own."""
    camera_reach: float = 0.2
    """Cameras stay within this share of the half sides around the room's centre, 0 to 1."""
    camera_height_metres: tuple[float, float] = (1.2, 1.7)
    """Range of camera heights above the floor."""
    pitch_degrees: float = 12.0
    """Standard deviation of the pitch of most training cameras."""
    steep_odds: float = 0.2
    """Probability that a training camera looks far up or down (uniform up to 60 degrees)."""
    fov_degrees: tuple[float, float] = (60.0, 80.0)
    """Range of the fields of view across the image."""

    def __post_init__(self):
        if not 0 < self.side_metres[0] <= self.side_metres[1]:
            raise ValueError(f"side_metres must be an increasing range of positive lengths, got {self.side_metres}")
        if not 0 <= self.camera_reach <= 1:
            raise ValueError(f"camera_reach must lie in [0, 1], got {self.camera_reach}")


_ALL_FURNITURE = ("cabinet", "bookcase", "stool", "cushion", "sofa", "bed", "table", "lamp", "plant")
FAMILIES = {
    family.name: family
    for family in (
        RoomFamily(name="narrow"),
        RoomFamily(
            name="medium", pieces=(3, 5), furniture=_ALL_FURNITURE, wall_pieces=(1, 4), contrast=0.25, busyness=0.4,
            accent_odds=0.35, camera_reach=0.5, camera_height_metres=(1.0, 1.9),
        ),
        RoomFamily(
            name="wide", side_metres=(3.0, 8.0), height_metres=(2.3, 3.6), pieces=(3, 8), furniture=_ALL_FURNITURE,
            wall_pieces=(2, 6),
            contrast=0.4, busyness=1.0, accent_odds=0.5, camera_reach=0.9, camera_height_metres=(0.6, 2.1),
            pitch_degrees=18.0, steep_odds=0.25,
        ),
    )
}  # fmt: skip
"""The curriculum by name: narrow, medium, wide."""


def require_family(name: str) -> None:
    """Raises ValueError unless there is such a family."""
    if name not in FAMILIES:
        raise ValueError(f"room family: expected one of {sorted(FAMILIES)}, got {name!r}")


@dataclass(frozen=True, kw_only=True)
class Room:
    """Solids, materials and light of one room; solid 0 is the shell. Boxes come first, then cylinders, then spheres.

    The shell spans [-x/2, x/2] x [-y/2, y/2] x [0, z]. Materials 0 to 5 belong to the shell's faces (-x, +x, -y, +y,
    floor, ceiling); solid i >= 1 has material 5 + i.
    """

    seed: int
    family: RoomFamily = field(repr=False)
    kinds: Int[Tensor, "p"]
    """Position in ``KINDS``, ascending."""
    centers: Float[Tensor, "p 3"]
    halves: Float[Tensor, "p 3"]
    """Half sizes along the solid's own axes; radius, radius, half height for round kinds."""
    headings: Float[Tensor, "p"]
    """Rotation about z in radians."""
    base: Float[Tensor, "m 3"]
    """First colours in [0, 1]."""
    second: Float[Tensor, "m 3"]
    """Second colours in [0, 1]."""
    patterns: Int[Tensor, "m"]
    """Position in ``PATTERNS``."""
    waves: Float[Tensor, "m 2 2"]
    """Two wave vectors in cycles per metre."""
    phases: Float[Tensor, "m 2"]
    sharpness: Float[Tensor, "m"]
    glow: Float[Tensor, "m"]
    light: Float[Tensor, "3"]
    """Position of the lamp."""
    ambient: Float[Tensor, ""]
    """Share of the light that comes from everywhere, 0 to 1."""

    @property
    def size(self) -> Float[Tensor, "3"]:
        """Full extents of the shell in metres."""
        return self.halves[0] * 2

    def to(self, *args, **kwargs) -> Room:
        """Like ``Tensor.to`` for every tensor (give a device; integer fields stay integers under a float dtype)."""

        def move(value):
            if not isinstance(value, Tensor):
                return value
            moved = value.to(*args, **kwargs)
            return moved if value.is_floating_point() else moved.to(value.dtype)

        return dataclasses.replace(self, **{f.name: move(getattr(self, f.name)) for f in dataclasses.fields(self)})

    def clearance(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance in metres to the nearest surface: positive in free space, negative inside a solid or outside
        the room.
        """
        local = _into_frames(points[None] - self.centers[:, None], self.headings)
        beyond = local.abs() - self.halves[:, None]
        box = beyond.clamp(min=0).norm(dim=-1) + beyond.amax(dim=-1).clamp(max=0)
        radial = torch.stack([local[..., :2].norm(dim=-1) - self.halves[:, None, 0], beyond[..., 2]], dim=-1)
        cylinder = radial.clamp(min=0).norm(dim=-1) + radial.amax(dim=-1).clamp(max=0)
        sphere = local.norm(dim=-1) - self.halves[:, None, 0]
        distance = torch.where(self.kinds[:, None] == 0, box, torch.where(self.kinds[:, None] == 1, cylinder, sphere))
        distance = torch.cat([-distance[:1], distance[1:]])
        return distance.amin(dim=0)

    def mesh(self) -> trimesh.Trimesh:
        """The room's surfaces as one coloured triangle mesh (shell turned inside out); round solids are finely
        faceted.
        """
        import trimesh
        from trimesh.visual import ColorVisuals

        parts: list[trimesh.Trimesh] = []
        for index, (kind, center, half, heading) in enumerate(
            zip(
                self.kinds.tolist(),
                self.centers.double().cpu(),
                self.halves.double().cpu(),
                self.headings.tolist(),
                strict=True,
            )
        ):
            if KINDS[kind] == "box":
                part = trimesh.creation.box(extents=(2 * half).numpy())
            elif KINDS[kind] == "cylinder":
                part = trimesh.creation.cylinder(radius=float(half[0]), height=float(2 * half[2]), sections=96)
            else:
                part = trimesh.creation.icosphere(subdivisions=4, radius=float(half[0]))
            part.apply_transform(trimesh.transformations.rotation_matrix(heading, [0, 0, 1]))
            part.apply_translation(center.numpy())
            colours = (
                self.base[index + 5].expand(len(part.faces), 3)
                if index
                else self.base[self._shell_faces(part.face_normals)]
            )
            part.visual = ColorVisuals(part, face_colors=(colours.cpu().clamp(0, 1) * 255).round().byte().numpy())
            if index == 0:
                part.invert()
            parts.append(part)
        return cast("trimesh.Trimesh", trimesh.util.concatenate(parts))

    @staticmethod
    def _shell_faces(outward: np.ndarray) -> Tensor:
        """Shell face number (0 to 5) of outward axis-aligned normals."""
        normals = torch.as_tensor(np.array(outward))
        axis = normals.abs().argmax(dim=-1)
        return 2 * axis + (normals.gather(-1, axis[:, None])[:, 0] > 0)


def _into_frames(vectors: Float[Tensor, "p n 3"], headings: Float[Tensor, "p"]) -> Float[Tensor, "p n 3"]:
    """World vectors in frames turned by ``headings`` about z."""
    cosine, sine = torch.cos(headings)[:, None], torch.sin(headings)[:, None]
    x, y, z = vectors.unbind(-1)
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x, z], dim=-1)


def make_room(seed: int, family: RoomFamily) -> Room:
    """The room of a seed; the same on every machine, whatever ran before."""
    rng = np.random.default_rng([seed, zlib.crc32(family.name.encode())])
    size = (rng.uniform(*family.side_metres), rng.uniform(*family.side_metres), rng.uniform(*family.height_metres))
    shell_materials = _shell_materials(rng, family)
    light = (rng.uniform(-0.25, 0.25) * size[0], rng.uniform(-0.25, 0.25) * size[1], rng.uniform(0.75, 0.95) * size[2])
    ambient = rng.uniform(0.45, 0.7)
    joiner = Joiner(rng, contrast=family.contrast, busyness=family.busyness)
    solids = _furnish(rng, family, size, joiner) + _dress_walls(rng, family, size, joiner)
    if rng.random() < 0.3:
        solids.append(_rug(rng, size, joiner))
    return build_room(solids, shell_materials, size=size, light=light, ambient=ambient, seed=seed, family=family)


def build_room(
    solids: list[Solid],
    shell_materials: list[Material],
    *,
    size: tuple[float, float, float],
    light: tuple[float, float, float],
    ambient: float,
    seed: int,
    family: RoomFamily,
) -> Room:
    """A room of given solids in world coordinates (any order of kinds); six shell materials for -x, +x, -y, +y, floor,
    ceiling.
    """
    shell = Solid(
        kind="box",
        center=(0.0, 0.0, size[2] / 2),
        half=(size[0] / 2, size[1] / 2, size[2] / 2),
        material=shell_materials[0],
    )
    solids = [shell, *sorted(solids, key=lambda solid: KINDS.index(solid.kind))]
    return Room(
        seed=seed,
        family=family,
        kinds=torch.tensor([KINDS.index(solid.kind) for solid in solids]),
        centers=torch.tensor([solid.center for solid in solids], dtype=torch.float32),
        halves=torch.tensor([solid.half for solid in solids], dtype=torch.float32),
        headings=torch.tensor([solid.heading for solid in solids], dtype=torch.float32),
        light=torch.tensor(light, dtype=torch.float32),
        ambient=torch.tensor(ambient, dtype=torch.float32),
        **_material_tensors([*shell_materials, *(solid.material for solid in solids[1:])]),
    )


def _material_tensors(materials: list[Material]) -> dict[str, Tensor]:
    """The columns of the material table."""

    def column(name: str) -> Tensor:
        return torch.tensor([getattr(item, name) for item in materials], dtype=torch.float32)

    columns = {name: column(name) for name in ("base", "second", "waves", "phases", "sharpness", "glow")}
    return {**columns, "patterns": torch.tensor([PATTERNS.index(item.pattern) for item in materials])}


def _shell_materials(rng: np.random.Generator, family: RoomFamily) -> list[Material]:
    """Four walls of one paint (perhaps one accent wall), a floor and a pale ceiling."""
    calm = 0.5 * family.busyness
    paint = material(rng, colour(rng, (0.0, 1.0), (0.05, 0.4), (0.55, 0.92)), contrast=family.contrast, busyness=calm)
    walls = []
    for _ in range(4):
        tint = rng.uniform(0.97, 1.03)
        walls.append(
            dataclasses.replace(
                paint,
                base=tuple(min(1.0, c * tint) for c in paint.base),
                phases=tuple(rng.uniform(0, 6.28, 2).tolist()),
            )
        )
    if rng.random() < family.accent_odds:
        accent = shifted(rng, paint.base, 0.2 + family.contrast)
        walls[rng.integers(4)] = material(rng, accent, contrast=family.contrast, busyness=family.busyness)
    if rng.random() < 0.6:
        boards = colour(rng, (0.05, 0.1), (0.25, 0.55), (0.35, 0.7))
    else:
        boards = colour(rng, (0.0, 1.0), (0.0, 0.25), (0.3, 0.75))
    floor = material(rng, boards, contrast=family.contrast, busyness=family.busyness)
    ceiling_colour = colour(rng, (0.08, 0.15), (0.0, 0.08), (0.85, 0.98))
    ceiling = Material(base=ceiling_colour, second=ceiling_colour)
    return [*walls, floor, ceiling]


def _furnish(rng: np.random.Generator, family: RoomFamily, size: tuple, joiner: Joiner) -> list[Solid]:
    """Pieces that stand with their backs to the walls and do not overlap; what finds no place is left out."""
    placed, boxes = [], []
    for _ in range(rng.integers(family.pieces[0], family.pieces[1] + 1)):
        piece = getattr(joiner, str(rng.choice(family.furniture)))()
        low, high = _footprint(piece)
        for _ in range(12):
            wall = int(rng.integers(4))
            heading = wall * math.pi / 2
            away, run = (size[1], size[0]) if wall % 2 == 0 else (size[0], size[1])
            room_left = run / 2 - 0.15 - max(-low[0], high[0])
            if room_left <= 0:
                continue
            along, gap = rng.uniform(-room_left, room_left), rng.uniform(0.02, 0.12)
            # The wall's own axes in the room: heading turns (1, 0) to the run and (0, 1) to the inward direction.
            cosine, sine = round(math.cos(heading)), round(math.sin(heading))
            back = -away / 2 + gap
            x, y = cosine * along - sine * back, sine * along + cosine * back
            candidate = put(piece, x, y, heading)
            box = np.array(_footprint(candidate))
            inside = (np.abs(box) <= np.array(size[:2]) / 2 - 0.01).all()
            if inside and all((box[1] + 0.1 < other[0]).any() or (other[1] + 0.1 < box[0]).any() for other in boxes):
                placed += put(
                    piece, x, y, heading + (rng.uniform(-0.06, 0.06) if gap > 0.06 and len(piece) == 1 else 0.0)
                )
                boxes.append(box)
                break
    return placed


def _footprint(piece: list[Solid]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lower and upper corner on the floor of a piece whose headings are multiples of 90 degrees."""
    spans = [solid.half[:2] if round(solid.heading / (math.pi / 2)) % 2 == 0 else solid.half[1::-1] for solid in piece]
    low = [min(solid.center[axis] - span[axis] for solid, span in zip(piece, spans, strict=True)) for axis in (0, 1)]
    high = [max(solid.center[axis] + span[axis] for solid, span in zip(piece, spans, strict=True)) for axis in (0, 1)]
    return (low[0], low[1]), (high[0], high[1])


def _dress_walls(rng: np.random.Generator, family: RoomFamily, size: tuple, joiner: Joiner) -> list[Solid]:
    """Pictures, windows and at most one door, at most two of them on a wall, without overlap."""
    solids, taken, doors = [], {wall: [] for wall in range(4)}, 0
    for _ in range(rng.integers(family.wall_pieces[0], family.wall_pieces[1] + 1)):
        kind = str(rng.choice(["picture", "picture", "window", "door"]))
        if kind == "door" and doors:
            kind = "picture"
        piece = getattr(joiner, kind)()
        reach = max(solid.half[0] for solid in piece)
        wall = int(rng.integers(4))
        away, run = (size[1], size[0]) if wall % 2 == 0 else (size[0], size[1])
        along = rng.uniform(-1, 1) * max(run / 2 - reach - 0.2, 0)
        if any(abs(along - other) < reach + other_reach + 0.1 for other, other_reach in taken[wall]):
            continue
        taken[wall].append((along, reach))
        doors += kind == "door"
        heading = wall * math.pi / 2
        cosine, sine = round(math.cos(heading)), round(math.sin(heading))
        solids += put(piece, cosine * along + sine * away / 2, sine * along - cosine * away / 2, heading)
    return solids


def _rug(rng: np.random.Generator, size: tuple, joiner: Joiner) -> Solid:
    """A thin carpet about the room's centre."""
    half = (size[0] * rng.uniform(0.15, 0.3), size[1] * rng.uniform(0.15, 0.3), 0.008)
    center = (size[0] * rng.uniform(-0.08, 0.08), size[1] * rng.uniform(-0.08, 0.08), 0.008)
    return Solid(kind="box", center=center, half=half, material=joiner.finish())
