"""Where new cameras may stand: in space that captured rays have crossed; where nobody can tell, at captured places
alone.
"""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.scenes.completions import MeanFiller, box_points, room_cameras
from helpers.scenes.coverages import AUTO, UP, turning

from fb_core.completion.planning.plan import plan_completion
from fb_core.completion.rounds import announcement_of_rounds
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace, cameras_beside


def looking_along_x(depth: float, side: int = 8) -> FreeSpace:
    """One camera at the origin, 90 degrees wide, in front of a wall."""
    origin, ahead = torch.zeros(1, 3).double(), torch.tensor([[1.0, 0.0, 0.0]]).double()
    camera = Pinholes.looking_at(origin, ahead, up=UP, fov_degrees=90.0, width=side, height=side)
    return FreeSpace(cameras=(camera,), depth=(torch.full((side, side), depth),))


@pytest.mark.parametrize(
    ("point", "crossed"),
    [
        *[((1.0, 0.0, 0.0), True), ((1.7, 0.5, 0.0), True), ((1.95, 0.0, 0.0), False), ((2.5, 0.0, 0.0), False)],
        *[
            ((-1.0, 0.0, 0.0), False),
            ((1.0, 1.5, 0.0), False),
            ((0.0, 0.0, 0.0), False),
            ((float("nan"), 0.0, 0.0), False),
        ],
    ],
)
def test_what_lies_before_the_wall_is_free_and_nothing_else_is(
    point: tuple[float, float, float], crossed: bool
) -> None:
    assert looking_along_x(2.0).crossed(torch.tensor([point]).double()).tolist() == [crossed]


@pytest.mark.parametrize("depth", [0.0, float("nan"), float("inf"), -1.0])
def test_pixels_without_a_surface_tell_nothing(depth: float) -> None:
    space = looking_along_x(depth)
    assert not space.is_known and not bool(space.crossed(torch.tensor([[1.0, 0.0, 0.0]]).double()).any())
    assert looking_along_x(2.0).is_known and not FreeSpace(cameras=(), depth=()).is_known


def test_more_pictures_never_make_less_space_free() -> None:
    cameras = turning(6)
    spaces = [
        FreeSpace(cameras=tuple(cameras[:count]), depth=(torch.full((16, 16), 2.0),) * count) for count in range(7)
    ]
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4 - 2
    shares = [float(space.crossed(points).double().mean()) for space in spaces]
    assert shares == sorted(shares) and shares[0] == 0 and 0.2 < shares[-1] < 1


def test_new_cameras_stand_in_crossed_space_or_where_somebody_stood() -> None:
    cameras = room_cameras(6)
    free = FreeSpace(cameras=tuple(cameras), depth=(torch.full((16, 16), 0.8),) * 6)
    plan = plan_completion(cameras, box_points().double(), AUTO, size=16, free=free)
    centers = torch.cat([one.cameras.centers for one in plan.rounds]).double()
    stood = torch.cdist(centers, torch.cat([camera.centers for camera in cameras]).double()).min(dim=1).values < 1e-5
    assert bool((stood | free.crossed(centers)).all())
    assert plan.shape.outward and not plan.blind


def test_where_nobody_can_tell_new_cameras_stay_at_captured_places_and_a_sentence_says_so() -> None:
    cameras = room_cameras(6)
    plan = plan_completion(cameras, None, AUTO, size=16)
    centers = torch.cat([one.cameras.centers for one in plan.rounds]).double()
    assert (
        plan.shape.outward
        and float(
            torch.cdist(centers, torch.cat([camera.centers for camera in cameras]).double()).min(dim=1).values.max()
        )
        < 1e-5
    )
    assert plan.blind and announcement_of_rounds(plan, AUTO, MeanFiller()).startswith(
        "Nobody can tell yet where surfaces are"
    )
    free = FreeSpace(cameras=tuple(cameras), depth=(torch.full((16, 16), 2.0),) * 6)
    for told in (
        plan_completion(cameras, box_points().double(), AUTO, size=16),
        plan_completion(cameras, None, AUTO, size=16, free=free),
    ):
        assert not told.blind and "Nobody can tell" not in announcement_of_rounds(told, AUTO, MeanFiller())


def test_an_allowed_collision_is_no_reason_to_stay() -> None:
    anywhere = dataclasses.replace(AUTO, placement=dataclasses.replace(AUTO.placement, clearance=0.0))
    assert not plan_completion(room_cameras(6), None, anywhere, size=16).blind


def test_places_beside_a_capture_lie_to_all_sides_of_each_camera() -> None:
    cameras = turning(5)
    beside = cameras_beside(cameras)
    centers = torch.cat([camera.centers for camera in cameras])
    reach = 0.5 * float((centers - centers.mean(dim=0)).norm(dim=1).max())
    assert len(beside) == 20
    for index, camera in enumerate(cameras):
        steps = torch.cat([one.centers for one in beside[4 * index : 4 * index + 4]]) - camera.centers
        assert torch.allclose(steps.norm(dim=1), torch.full((4,), reach).double(), rtol=1e-6)
        assert torch.allclose(steps.sum(dim=0), torch.zeros(3).double(), atol=1e-9)
        assert all(torch.equal(one.rotations, camera.rotations) for one in beside[4 * index : 4 * index + 4])


def test_a_turn_on_the_spot_and_no_camera_have_nothing_beside() -> None:
    one = turning(4)[0]
    assert cameras_beside([one]) == [] and cameras_beside([one, one]) == [] and cameras_beside([]) == []
