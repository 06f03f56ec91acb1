"""What a person asks for, before a training does it: the queue, fans of cameras, context by overlap, names of views."""

from __future__ import annotations

import dataclasses
import math
import threading

import pytest
import torch
from helpers.plugin.requests import UP, bank_of, ring

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.planning.plan import CompletionPlan, plan_completion
from fb_core.completion.requests import (
    MOST_VIEWS,
    MOST_WAITING,
    CompleteFrom,
    RegenerateRound,
    RemoveView,
    RequestQueue,
    fan_from,
    key_of,
    merged,
    place_of,
    plan_request,
    without_view,
)
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.shell import sphere


def scene_of(cameras: list[Pinholes]) -> CompletionPlan:
    return plan_completion(cameras, None, CompletionConfig(anchor_views=0, densify_rounds=0, context_views=4), size=16)


def asked(camera: Pinholes, **changes) -> CompleteFrom:
    return CompleteFrom(camera_to_world=camera.camera_to_world[0], **changes)


# ---- queue ----------------------------------------------------------------------------------------------------------


def test_the_queue_is_closed_until_a_training_opens_it_and_first_come_is_first_served():
    queue = RequestQueue()
    with pytest.raises(ValueError, match="Nothing trains here"):
        queue.put(RemoveView(key="a"))
    assert queue.take() is None
    queue.open()
    for key in "abc":
        queue.put(RemoveView(key=key))
    assert [queue.take().key for _ in range(3)] == ["a", "b", "c"] and queue.take() is None
    queue.put(RemoveView(key="d"))
    assert queue.close("Training has ended.") == 1 and queue.take() is None
    with pytest.raises(ValueError, match=r"Training has ended\."):
        queue.put(RemoveView(key="e"))


def test_a_queue_that_is_full_says_so():
    queue = RequestQueue()
    queue.open()
    for index in range(MOST_WAITING):
        queue.put(RemoveView(key=str(index)))
    with pytest.raises(ValueError, match="waiting already"):
        queue.put(RemoveView(key="more"))


def test_requests_of_many_threads_arrive_exactly_once():
    queue, taken = RequestQueue(), []
    queue.open()

    def ask(name: int) -> None:
        for index in range(50):
            while True:
                try:
                    queue.put(RemoveView(key=f"{name}-{index}"))
                    break
                except ValueError:  # full
                    threading.Event().wait(0.001)

    threads = [threading.Thread(target=ask, args=(name,)) for name in range(4)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads) or len(queue):
        request = queue.take()
        if request is not None:
            taken.append(request.key)
    assert sorted(taken) == sorted(f"{name}-{index}" for name in range(4) for index in range(50))
    for name in range(4):
        assert [key for key in taken if key.startswith(f"{name}-")] == [f"{name}-{index}" for index in range(50)]


@pytest.mark.parametrize("changes", [{"views": 0}, {"views": MOST_VIEWS + 1}, {"seed": -1}])
def test_a_request_that_makes_no_sense_is_refused(changes: dict):
    with pytest.raises(ValueError, match="expected"):
        asked(ring()[0], **changes)


# ---- fans -----------------------------------------------------------------------------------------------------------


def test_one_view_is_the_asked_for_camera_with_the_lens_of_the_context():
    cameras = ring()
    camera = cameras[3]
    fan = fan_from(asked(camera), scene_of(cameras), focal=20.0, size=16)
    assert len(fan) == 1 and (fan.width, fan.height) == (16, 16)
    assert torch.allclose(fan.camera_to_world[0], camera.camera_to_world[0], atol=1e-6)
    assert fan.focal.tolist() == [[20.0, 20.0]] and fan.principal.tolist() == [[8.0, 8.0]]


def test_a_fan_in_a_room_turns_where_it_stands_first_right_then_left():
    cameras = ring()
    tilted = Pinholes.looking_at(
        torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.3]]), up=UP, fov_degrees=60.0, width=16, height=16
    )
    fan = fan_from(asked(tilted, views=3), scene_of(cameras), focal=8.0, size=16)  # 90 degrees wide: 45 degrees apart
    assert torch.allclose(fan.centers, torch.zeros(3, 3), atol=1e-6)
    forward, right = fan.rotations[:, :, 2], fan.rotations[0, :, 0]
    assert float(forward[1] @ right) > 0.5 and float(forward[2] @ right) < -0.5
    assert torch.allclose(forward[:, 2], forward[:1, 2].expand(3), atol=1e-6), "all look equally far up"
    headings = torch.atan2(forward[:, 1], forward[:, 0]).rad2deg()
    assert torch.allclose(headings, torch.tensor([0.0, -45.0, 45.0]), atol=1e-3)
    assert torch.allclose(fan.rotations[:, 2, 0], torch.zeros(3), atol=1e-6), "the horizon stays level"
    assert torch.allclose(torch.linalg.det(fan.rotations), torch.ones(3), atol=1e-5)


def test_a_fan_of_many_views_goes_once_around():
    fan = fan_from(asked(ring()[0], views=12), scene_of(ring()), focal=8.0, size=16)
    forward = fan.rotations[:, :, 2]
    closest = (forward @ forward.T - 2 * torch.eye(12)).max(dim=1).values
    assert torch.allclose(closest, torch.full((12,), math.cos(math.radians(30))), atol=1e-4)


def test_a_fan_around_an_object_goes_around_it():
    cameras = ring(radius=2.0, outward=False)
    scene = scene_of(cameras)
    assert not scene.shape.outward
    fan = fan_from(asked(cameras[0], views=5), scene, focal=16.0, size=16)
    assert torch.allclose(fan.centers.norm(dim=1), torch.full((5,), 2.0), atol=1e-4)
    assert torch.allclose(fan.rotations[:, :, 2], -fan.centers / 2, atol=1e-4), "all look at the middle"
    assert len({tuple((10 * center).round().tolist()) for center in fan.centers}) == 5


def test_a_place_outside_of_the_room_or_nowhere_is_refused():
    cameras = ring()
    outside = dataclasses.replace(
        cameras[0], camera_to_world=cameras[0].camera_to_world + torch.tensor([0.0, 0.0, 0.0, 50.0])
    )
    with pytest.raises(ValueError, match="outside the walls"):
        fan_from(asked(outside), scene_of(cameras), focal=8.0, size=16)
    nowhere = dataclasses.replace(cameras[0], camera_to_world=cameras[0].camera_to_world * math.nan)
    with pytest.raises(ValueError, match="no finite place"):
        fan_from(asked(nowhere), scene_of(cameras), focal=8.0, size=16)


# ---- context --------------------------------------------------------------------------------------------------------


def test_context_shows_what_the_new_view_will_show():
    cameras = ring(8)
    chosen = nearest_context(cameras, cameras[5], sphere(torch.zeros(3), 5.0), 3)
    assert set(chosen) == {4, 5, 6}
    assert sorted(nearest_context(cameras, cameras[5], sphere(torch.zeros(3), 5.0), 100)) == list(range(8))


def test_one_view_of_each_side_is_better_than_two_of_one():
    """A fan to both sides, and a capture that holds the left side twice."""
    cameras = [*ring(8), ring(8)[2]]
    targets = Pinholes.cat([cameras[2], cameras[6]])
    assert set(nearest_context(cameras, targets, sphere(torch.zeros(3), 5.0), 2)) <= {2, 6, 8}
    assert 6 in nearest_context(cameras, targets, sphere(torch.zeros(3), 5.0), 2)


def test_where_nothing_is_shown_the_nearest_views_are_taken():
    cameras = ring(8)
    up = Pinholes.looking_at(
        cameras[1].centers, cameras[1].centers + UP, up=torch.tensor([1.0, 0, 0]), fov_degrees=20.0, width=8, height=8
    )
    assert 1 in nearest_context(cameras, up, sphere(torch.zeros(3), 5.0), 1)


def test_the_most_level_view_comes_first():
    cameras = ring(8)
    roll = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rolled = cameras[5].camera_to_world.clone()
    rolled[0, :, :3] = rolled[0, :, :3] @ roll
    cameras[5] = dataclasses.replace(cameras[5], camera_to_world=rolled)
    chosen = nearest_context(cameras, ring(8)[5], sphere(torch.zeros(3), 5.0), 3)
    assert 5 in chosen and chosen[0] != 5


# ---- bank -----------------------------------------------------------------------------------------------------------


def test_names_of_views_stay_while_others_go():
    bank = bank_of(("anchor", 0, 3), ("densify", 1, 2))
    keys = [key_of(bank, index) for index in range(5)]
    assert len(set(keys)) == 5
    fewer = without_view(bank, keys[1])
    assert [key_of(fewer, index) for index in range(4)] == [keys[0], keys[2], keys[3], keys[4]]
    assert place_of(fewer, keys[4]) == 3 and place_of(fewer, keys[1]) is None and place_of(None, keys[0]) is None
    with pytest.raises(ValueError, match="not there any more"):
        without_view(fewer, keys[1])
    assert without_view(bank[[2]], keys[2]) is None


def test_new_views_go_behind_the_others_or_in_the_places_of_those_they_replace():
    bank, new = bank_of(("anchor", 0, 2), ("densify", 1, 2)), bank_of(("requested", 7, 2))
    assert merged(None, (), new) is new
    assert [origin.round for origin in merged(bank, (), new).origins] == [0, 0, 1, 1, 7, 7]
    replaced = merged(bank, (0, 3), new)
    assert replaced.images[:, 0, 0, 0].tolist() == [70, 1, 10, 71] and [
        origin.round for origin in replaced.origins
    ] == [7, 0, 1, 7]
    with pytest.raises(ValueError, match="one image size"):
        merged(bank, (), bank_of(("requested", 7, 1), size=16))


def test_requested_rounds_have_numbers_behind_all_automatic_ones():
    cameras, config = ring(), CompletionConfig(densify_rounds=3, context_views=4)
    scene = scene_of(cameras)
    first = plan_request(asked(cameras[0], seed=5, prompt="a door"), scene, None, cameras, config)
    (planned,) = first.plan.rounds
    assert (planned.number, planned.role, planned.seed, planned.prompt) == (4, "requested", 5, "a door")
    assert first.replaces == () and first.done is None and len(first.plan.context) == 4 and first.plan.size == 16
    bank = bank_of(("anchor", 0, 2), ("requested", 4, 1))
    second = plan_request(asked(cameras[0]), scene, bank, cameras, config)
    assert second.plan.rounds[0].number == 5 and len(second.done) == 3 and second.plan.size == 8


def test_a_round_anew_keeps_cameras_and_role_and_has_another_seed():
    cameras, config = ring(), CompletionConfig(context_views=4)
    scene, bank = scene_of(cameras), bank_of(("anchor", 0, 2), ("densify", 1, 3))
    planned = plan_request(RegenerateRound(number=1, seed=101), scene, bank, cameras, config)
    (again,) = planned.plan.rounds
    assert (again.number, again.role, again.seed) == (1, "densify", 102) and planned.replaces == (2, 3, 4)
    assert torch.equal(again.cameras.camera_to_world, bank.cameras.camera_to_world[2:]) and planned.done.rounds == [0]
    assert planned.plan.context == scene.context, "an automatic round keeps its context"
    with pytest.raises(ValueError, match="Round 9 has no views"):
        plan_request(RegenerateRound(number=9), scene, bank, cameras, config)
