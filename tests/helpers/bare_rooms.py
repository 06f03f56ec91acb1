"""A room without furniture."""

from __future__ import annotations

from fb_core.data.rooms.furniture import Material, Solid
from fb_core.data.rooms.room import FAMILIES, Room, build_room

GREY = Material(base=(0.5, 0.5, 0.5), second=(0.5, 0.5, 0.5))


def bare_room(*solids: Solid, shell: Material = GREY) -> Room:
    """A 4 x 6 x 3 m room of given solids."""
    return build_room(
        list(solids),
        [shell] * 6,
        size=(4.0, 6.0, 3.0),
        light=(0.5, 0.4, 2.6),
        ambient=0.5,
        seed=0,
        family=FAMILIES["narrow"],
    )
