"""Turns of cameras for tests of one round after the other."""

from __future__ import annotations

TURNS = {
    "anchor_views": None,
    "densify_rounds": 2,
    "densify_views": 3,
    "at_step": 200,
    "rounds_apart": 50,
    "least_gain": 0.0,
}
