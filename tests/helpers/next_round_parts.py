"""What test_next_round shares."""

from __future__ import annotations

TURNS = {
    "anchor_views": None,
    "densify_rounds": 2,
    "densify_views": 3,
    "at_step": 200,
    "rounds_apart": 50,
    "least_gain": 0.0,
}
