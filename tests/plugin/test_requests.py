"""What a person asks for in the viewer: the queue, fans of cameras, context by overlap, and the training that takes
requests.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.folders.camera_paths import write_path
from helpers.plugin.datamanagers import (
    GreyFiller,
    attributes,
    generated,
    make,
    options,
    run_callbacks,
    stand_in_model,
    toy_viewer,
)
from helpers.plugin.requests import UP, TrackedSplats, ask_for, bank_of, opened_panel, ring, said
from nerfstudio.engine.callbacks import TrainingCallbackLocation

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
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.data.capture.captures import validate_capture
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.shell import sphere
from fb_nerfstudio.capture.unseen import seen_by_nobody_else
from fb_nerfstudio.generation.scene import TrainedScene

_ = stand_in_model  # no test here loads real weights either


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


# ---- training -------------------------------------------------------------------------------------------------------


def here(manager, **changes) -> CompleteFrom:
    """From the first captured camera."""
    _ = manager.cached_train  # train_cameras come with it
    pose = manager.train_cameras.camera_to_worlds[0] * torch.tensor([1.0, -1.0, -1.0, 1.0])
    return CompleteFrom(camera_to_world=pose, **changes)


def test_without_requests_nothing_happens(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture)
    attrs = generated(manager, tmp_path)
    bank, loads = manager.generated_views, GreyFiller.loads
    state = torch.get_rng_state()
    for step in range(1, 4):
        run_callbacks(manager, attrs, step)
    assert manager.generated_views is bank and GreyFiller.loads == loads and torch.equal(torch.get_rng_state(), state)
    assert [path.name for path in (tmp_path / "nerfstudio_models").iterdir()] == ["step-000000000.ckpt"]


def test_requested_views_join_the_bank_the_checkpoint_and_the_folder(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture)
    attrs = generated(manager, tmp_path)
    before = manager.generated_views
    ask_for(manager, here(manager, views=3, seed=42))
    torch.manual_seed(3)
    expected = torch.rand(2)
    torch.manual_seed(3)
    run_callbacks(manager, attrs, 150)
    assert torch.equal(torch.rand(2), expected), "training draws what it would have drawn"
    bank = manager.generated_views
    assert len(bank) == 9 and torch.equal(bank.images[:6], before.images) and torch.equal(bank.masks[:6], before.masks)
    assert {(origin.role, origin.round, origin.seed) for origin in bank.origins[6:]} == {("requested", 2, 42)}
    pose = manager.train_cameras.camera_to_worlds[0] * torch.tensor([1.0, -1.0, -1.0, 1.0])
    assert torch.allclose(bank.cameras.camera_to_world[6], pose, atol=1e-6)
    assert GreyFiller.loads == 2 and "Requested 2: 3 views" in said(manager)
    frames = validate_capture(tmp_path / "completion").frames
    assert len(frames) == 9 and sum(frame.extra["role"] == "requested" for frame in frames) == 3
    state = torch.load(tmp_path / "nerfstudio_models" / "step-000000149.ckpt", weights_only=True)["pipeline"][
        "_extra_state"
    ]
    resumed = make(tiny_capture)
    resumed.set_extra_state(state)
    assert [origin.role for origin in resumed.generated_views.origins].count("requested") == 3
    # The same on a resumed run, where nothing but the request loads the model.
    again = attributes(resumed, tmp_path / "again")
    run_callbacks(resumed, again, 151)
    assert GreyFiller.loads == 2
    ask_for(resumed, here(resumed, seed=43))
    run_callbacks(resumed, again, 152)
    assert (
        len(resumed.generated_views) == 10 and GreyFiller.loads == 3 and resumed.generated_views.origins[9].round == 3
    )


def test_requested_views_are_masked_and_seeded_in_holes_only(tiny_capture: Path, monkeypatch: pytest.MonkeyPatch):
    manager = make(tiny_capture)
    attrs = generated(manager, step=150)
    added = len(attrs.pipeline.model.added)
    ask_for(manager, here(manager))
    run_callbacks(manager, attrs, 151)
    mask = manager.generated_views.masks[6, :, :, 0]
    assert not mask[6:10, 1:7].any() and mask[:, 8:].all(), (
        "the toy splats cover the left half, which the capture has seen"
    )
    points, _ = attrs.pipeline.model.added[added]
    assert len(attrs.pipeline.model.added) == added + 1 and len(points) == 16 * 8, "one per pixel of the right half"
    # A view that the splats cover wholly is given none.
    attrs.pipeline.model.get_outputs_for_camera = lambda camera: {
        "depth": torch.full((16, 16, 1), 2.0),
        "accumulation": torch.ones(16, 16, 1),
        "rgb": torch.full((16, 16, 3), 0.5),
    }
    manager.completion_panel.requests.put(RegenerateRound(number=2, seed=9))
    monkeypatch.setattr(TrainedScene, "seen_points", lambda *_: None)
    run_callbacks(manager, attrs, 152)
    assert len(attrs.pipeline.model.added) == added + 1 and manager.generated_views.origins[6].seed == 9


def test_removed_views_are_gone_everywhere(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture)
    attrs = generated(manager, tmp_path)
    bank = manager.generated_views
    keys = [key_of(bank, index) for index in range(6)]
    ask_for(manager, RemoveView(key=keys[1]))
    ask_for(manager, RemoveView(key=keys[1]))
    run_callbacks(manager, attrs, 1)
    assert (
        len(manager.generated_views) == 5
        and len(validate_capture(tmp_path / "completion")) == 5
        and "5 views left" in said(manager)
    )
    run_callbacks(manager, attrs, 2)
    assert len(manager.generated_views) == 5 and "not there any more" in said(manager)
    for key in keys:
        if key != keys[1]:
            ask_for(manager, RemoveView(key=key))
            run_callbacks(manager, attrs, 3)
    assert (
        manager.generated_views is None
        and not (tmp_path / "completion").exists()
        and manager.generated_probability == 0
    )
    manager.next_train(4)
    state = torch.load(tmp_path / "nerfstudio_models" / "step-000000002.ckpt", weights_only=True)["pipeline"][
        "_extra_state"
    ]
    resumed = make(tiny_capture)
    resumed.set_extra_state(state)
    loads = GreyFiller.loads
    run_callbacks(resumed, attributes(resumed), 5)
    assert resumed.generated_views is None and GreyFiller.loads == loads, "what was removed is not generated again"


def test_a_round_generated_anew(tiny_capture: Path):
    manager = make(tiny_capture)
    attrs = generated(manager)
    before = manager.generated_views
    ask_for(manager, RegenerateRound(number=0, seed=77))
    run_callbacks(manager, attrs, 1)
    after = manager.generated_views
    assert [origin.seed for origin in after.origins] == [77] * 4 + [before.origins[4].seed] * 2
    assert torch.equal(after.cameras.camera_to_world, before.cameras.camera_to_world)
    assert not torch.equal(after.images[:4], before.images[:4]) and torch.equal(after.images[4:], before.images[4:])


def test_new_anchors_bring_the_rounds_that_stand_on_them_one_per_iteration(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture, options(densify_rounds=2))
    attrs = generated(manager, tmp_path)
    before = manager.generated_views
    ask_for(manager, RegenerateRound(number=0, seed=77))
    run_callbacks(manager, attrs, 1)
    assert "new anchors: 2 rounds" in said(manager)
    assert torch.equal(manager.generated_views.images[4:], before.images[4:]), "they wait for the next iterations"
    state = torch.load(tmp_path / "nerfstudio_models" / "step-000000000.ckpt", weights_only=True)["pipeline"][
        "_extra_state"
    ]

    GreyFiller.calls = 0
    for number, calls in ((2, 1), (3, 2), (4, 2)):
        run_callbacks(manager, attrs, number)
        assert GreyFiller.calls == calls
    after = manager.generated_views
    assert [origin.seed for origin in after.origins[4:]] == [origin.seed for origin in before.origins[4:]], (
        "only what conditions them is new"
    )

    resumed = make(tiny_capture, options(densify_rounds=2))  # killed before the first of them
    resumed.set_extra_state(state)
    attrs = attributes(resumed)
    run_callbacks(resumed, attrs, 1)
    ask_for(resumed, RegenerateRound(number=2, seed=5))  # a person comes first
    for number in (2, 3):
        run_callbacks(resumed, attrs, number)
    assert torch.equal(resumed.generated_views.of_round(1).images, after.of_round(1).images)
    assert resumed.generated_views.of_round(2).origins[0].seed == 5, "it was up to date, and not done again"


def test_a_following_round_that_fails_is_said_once_and_not_tried_forever(tiny_capture: Path, monkeypatch):
    manager = make(tiny_capture)
    attrs = generated(manager)
    ask_for(manager, RegenerateRound(number=0, seed=77))
    run_callbacks(manager, attrs, 1)

    def fail(self, *args, **options):
        GreyFiller.calls += 1
        raise RuntimeError("out of memory")

    GreyFiller.calls = 0
    monkeypatch.setattr(GreyFiller, "complete", fail)
    run_callbacks(manager, attrs, 2)
    run_callbacks(manager, attrs, 3)
    assert GreyFiller.calls == 1 and said(manager) == "Not done: out of memory"


@pytest.mark.parametrize("anew", [False, True])
def test_gaussians_that_only_a_removed_view_saw_go_with_it(tiny_capture: Path, anew: bool):
    manager = make(tiny_capture, options(generated_pixels="all"))
    attrs = generated(manager)
    bank, cameras, before = manager.generated_views, manager.captured_cameras(), TrackedSplats().means
    leaving = range(4) if anew else [0]  # all anchors, or one of them
    staying = bank[[index for index in range(6) if index not in leaving]]
    lone = seen_by_nobody_else(before, bank[leaving], staying, cameras, manager.known_parts)
    assert 0 < int(lone.sum()) < 200
    splats = attrs.pipeline.model = TrackedSplats()
    ask_for(manager, RegenerateRound(number=0, seed=3) if anew else RemoveView(key=key_of(bank, 0)))
    run_callbacks(manager, attrs, 1)
    assert torch.equal(splats.means, before[~lone])
    assert anew or f"with {int(lone.sum())} Gaussians that no other view shows" in said(manager)


def test_a_round_of_a_camera_path_anew_keeps_its_margins_without_the_file(tiny_capture: Path, tmp_path: Path):
    file = write_path(tmp_path / "path.json", 5, width=32, height=16)
    manager = make(tiny_capture, options(anchor_views=3, camera_path=file, generated_pixels="all"))
    attrs = generated(manager)
    state = manager.get_extra_state()
    before = manager.generated_views.masks
    assert not bool(before[:, :4].any())
    resumed = make(tiny_capture, options(anchor_views=3, generated_pixels="all"))  # another day, without the file
    resumed.set_extra_state(state)
    attrs = attributes(resumed)
    run_callbacks(resumed, attrs, 1)
    ask_for(resumed, RegenerateRound(number=1, seed=3))
    run_callbacks(resumed, attrs, 2)
    assert resumed.generated_views.of_round(1).origins[0].seed == 3 and torch.equal(
        resumed.generated_views.masks, before
    )


def test_views_asked_for_before_the_automatic_ones_do_not_change_these(tiny_capture: Path):
    expected = make(tiny_capture, options(at_step=3))
    generated(expected, step=3)
    manager = make(tiny_capture, options(at_step=3))
    attrs = generated(manager, step=0)
    _ = manager.cached_train
    ask_for(manager, here(manager))
    run_callbacks(manager, attrs, 1)
    assert [origin.round for origin in manager.generated_views.origins] == [2]
    early = manager.generated_views
    run_callbacks(manager, attrs, 3)
    bank = manager.generated_views
    assert [origin.round for origin in bank.origins] == [0, 0, 0, 0, 1, 1, 2]
    for name in ("images", "masks"):
        assert torch.equal(getattr(bank, name)[:6], getattr(expected.generated_views, name))
        assert torch.equal(getattr(bank, name)[6:], getattr(early, name))


@pytest.mark.parametrize(
    "error",
    [
        ValueError("prompt: this model reads no text; complete without a prompt, got 'x'"),
        RuntimeError("CUDA out of memory\nat"),
    ],
)
def test_what_cannot_be_done_is_one_sentence_and_training_goes_on(tiny_capture: Path, monkeypatch, error: Exception):
    manager = make(tiny_capture)
    attrs = generated(manager)
    bank = manager.generated_views

    def refuse(self, views, *, generator, sampling, on_step, prompt, current):
        assert prompt == "x"
        raise error

    monkeypatch.setattr(GreyFiller, "complete", refuse)
    ask_for(manager, here(manager, prompt="x"))
    run_callbacks(manager, attrs, 1)
    assert said(manager) == f"Not done: {str(error).splitlines()[0]}" and manager.generated_views is bank
    manager.next_train(1)
    ask_for(manager, RemoveView(key=key_of(bank, 0)))
    run_callbacks(manager, attrs, 2)
    assert len(manager.generated_views) == 5


def test_a_prompt_reaches_the_model_and_the_record(tiny_capture: Path, monkeypatch):
    manager = make(tiny_capture)
    attrs = generated(manager)
    complete, prompts = GreyFiller.complete, []
    monkeypatch.setattr(
        GreyFiller,
        "complete",
        lambda self, views, prompt=None, **options: prompts.append(prompt) or complete(self, views, **options),
    )
    ask_for(manager, here(manager, prompt="a red door"))
    run_callbacks(manager, attrs, 1)
    assert prompts == ["a red door"] and manager.generated_views.origins[-1].prompt == "a red door"
    back = CompletedViews.from_state(manager.generated_views.state())
    assert back.origins == manager.generated_views.origins


def test_the_end_of_the_training_is_said_and_waiting_requests_are_dropped(tiny_capture: Path):
    manager, viewer = make(tiny_capture), toy_viewer()
    manager.completion_panel._setup(viewer)
    attrs = generated(manager)
    ask_for(manager, here(manager))
    for callback in manager.get_training_callbacks(attrs):
        callback.run_callback_at_location(9, TrainingCallbackLocation.AFTER_TRAIN)
    server = viewer.viser_server
    assert (
        "Training has ended: nothing will be generated" in server.status.content
        and "1 waiting" in server.status.content
    )
    looking = {"Pictures show", "What nobody has seen"}  # what is there can still be looked at
    assert all(field.disabled for label, field in server.fields.items() if label not in looking)
    with pytest.raises(ValueError, match="Training has ended"):
        ask_for(manager, here(manager))


def test_a_run_without_completion_takes_no_requests(tiny_capture: Path):
    manager = make(tiny_capture, options(enabled=False))
    attrs = generated(manager)
    with pytest.raises(ValueError, match="without new views"):
        ask_for(manager, RemoveView(key="a"))
    run_callbacks(manager, attrs, 1)
    assert GreyFiller.loads == 0


# ---- panel ----------------------------------------------------------------------------------------------------------


def test_the_button_asks_for_views_from_where_the_person_stands():
    panel, viewer = opened_panel(bank_of(("anchor", 0, 2)))
    server = viewer.viser_server
    server.client.camera.position = (10.0, 20.0, 30.0)
    server.fields["Views"].value, server.fields["Prompt"].value, server.fields["Seed"].value = 5, "  a door ", 11
    server.click("Complete from here")
    request = panel.requests.take()
    assert (request.views, request.seed, request.prompt) == (5, 11, "a door") and server.fields["Seed"].value == 12
    assert torch.allclose(
        request.camera_to_world, torch.cat([torch.eye(3), torch.tensor([[1.0], [2.0], [3.0]])], dim=1)
    )
    assert "5 views from here" in server.status.content and "Waiting for the training" in server.status.content
    viewer.trainer = SimpleNamespace(training_state="paused")
    server.click("Complete from here")
    assert "paused" in server.status.content
    server.fields["Views"].value = 0
    server.click("Complete from here")
    assert "expected 1 to" in server.status.content and len(panel.requests) == 1


def test_a_click_selects_a_view_and_the_button_asks_to_remove_it():
    bank = bank_of(("anchor", 0, 2), ("densify", 1, 2))
    panel, viewer = opened_panel(bank)
    server = viewer.viser_server
    assert server.fields["Remove this view"].disabled and not server.fields["Complete from here"].disabled
    server.click("/completion/round_01/view_001")
    assert "Selected: Round 1, seed 101" in server.status.content and "/completion/selected" in server.nodes
    server.click("Go to selected view")
    assert torch.allclose(torch.tensor(server.client.camera.position).float(), 10 * bank.cameras.centers[3], atol=1e-5)
    server.click("Remove this view")
    assert panel.requests.take() == RemoveView(key=key_of(bank, 3))
    other = server.nodes["/completion/round_00/view_000"]
    panel.show(without_view(bank, key_of(bank, 3)))
    assert "/completion/selected" not in server.nodes and server.fields["Remove this view"].disabled
    assert server.nodes["/completion/round_00/view_000"] is other, "rounds that did not change are not drawn again"
    assert "/completion/round_01/view_001" not in server.nodes and "3 generated views" in server.status.content


def test_a_hidden_round_stays_hidden_when_it_changes():
    bank = bank_of(("anchor", 0, 3))
    panel, viewer = opened_panel(bank)
    server = viewer.viser_server
    server.switch("Anchors (3)", False)
    panel.show(bank[[0, 2]])
    assert list(server.boxes) == ["Captured (0)", "Anchors (2)"]
    assert not server.boxes["Anchors (2)"].value and not server.nodes["/completion/round_00"].visible


def test_rounds_are_offered_to_be_generated_anew():
    panel, viewer = opened_panel(bank_of(("anchor", 0, 2), ("densify", 1, 2), ("requested", 4, 1)))
    server = viewer.viser_server
    assert server.fields["Round"].options == ("Anchors (2)", "Round 1 (2)", "Requested 4 (1)")
    server.fields["Round"].value = "Requested 4 (1)"
    server.click("Regenerate round")
    assert panel.requests.take() == RegenerateRound(number=4, seed=1)


def test_progress_is_a_bar_while_something_runs():
    panel, viewer = opened_panel(bank_of(("anchor", 0, 1)))
    bar = viewer.viser_server.bar
    assert not bar.visible
    panel.report("Generating, step 3 of 12", share=0.25)
    assert bar.visible and bar.value == 25.0
    panel.report("")
    assert not bar.visible
