"""Where planned cameras stand in rooms whose walls and furniture are known: never inside a solid or outside of it."""

from __future__ import annotations

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import plan_completion
from fb_core.data.rooms.room_captures import RoomCapture, casual_capture
from fb_core.geometry.free_space import FreeSpace

_DEPTH_ERROR = 0.03  # relative standard deviation, as of splats after some hundred steps


def planned_clearances(capture: RoomCapture, *, most: int, knows_free_space: bool) -> Float[Tensor, " n"]:
    """Distance in metres from each planned camera to the nearest surface, negative inside solids and outside the
    room: of the most cameras that a need-driven plan may ask for.
    """
    cameras = [capture.cameras[[view]] for view in range(len(capture.cameras))]
    config = CompletionConfig(densify_rounds=1, densify_views=most - CompletionConfig().most_anchors, least_gain=0.0)
    free = None
    if knows_free_space:
        generator = torch.Generator().manual_seed(capture.room.seed)
        depth = capture.images.depth
        noisy = depth * (1 + _DEPTH_ERROR * torch.randn(depth.shape, generator=generator))
        free = FreeSpace(cameras=tuple(cameras), depth=tuple(noisy))
    plan = plan_completion(cameras, capture.points.positions, config, size=64, free=free)
    return capture.room.clearance(torch.cat([one.cameras.centers for one in plan.rounds]).float())


@pytest.mark.parametrize(("family", "seed", "knows_free_space"), [("narrow", 3, True), ("medium", 5, False)])
def test_planned_cameras_stand_in_the_open(family: str, seed: int, *, knows_free_space: bool):
    capture = casual_capture(seed, family=family, size=48, held_out=2)
    clearances = planned_clearances(capture, most=40, knows_free_space=knows_free_space)
    assert len(clearances) == 40
    assert float(clearances.min()) > 0


@pytest.mark.slow(reason="20 rooms, three minutes; last run 2026-11-28, passed")
def test_of_2000_planned_cameras_none_stands_inside_a_solid():
    captures = [
        casual_capture(seed, family=family, held_out=2) for family in ("narrow", "medium") for seed in range(10)
    ]
    for knows_free_space in (False, True):
        clearances = [planned_clearances(one, most=100, knows_free_space=knows_free_space) for one in captures]
        together = torch.cat(clearances)
        assert len(together) == 2000
        assert float(together.min()) > 0
