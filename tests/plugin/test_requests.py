"""A training that takes what a person asks for in the viewer, whole or not at all."""

from __future__ import annotations

from pathlib import Path

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
from helpers.plugin.requests import TrackedSplats, ask_for, said
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from fb_core.completion.requests import (
    CompleteFrom,
    RegenerateRound,
    RemoveView,
    key_of,
)
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.data.capture.captures import validate_capture
from fb_nerfstudio.capture.unseen import seen_by_nobody_else
from fb_nerfstudio.generation import scene as trained_scene
from fb_nerfstudio.generation.scene import TrainedScene

_ = stand_in_model  # no test here loads real weights either


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
    # The toy's wall moves with each camera: from beside the captured places it stands where holes are.
    monkeypatch.setattr(trained_scene, "cameras_beside", lambda cameras: [])
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
