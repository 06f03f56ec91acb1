"""Planning and running a completion with a stand-in model: who sees what, what comes back, what is stored."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from helpers.scenes.completions import UP, MeanFiller, box_points, captured, room_cameras, small

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import plan_completion
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.completion.rounds import CapturedView, announcement_of_rounds, fitted_view, run_completion
from fb_core.data.capture.captures import validate_capture
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import raymaps_of
from fb_core.inpainter import SamplingConfig


def complete(config: CompletionConfig, model: MeanFiller, done: CompletedViews | None = None) -> list[CompletedViews]:
    cameras = room_cameras()
    plan = plan_completion(cameras, box_points(), config, size=16)
    views = captured(cameras)
    return list(run_completion(plan, [views[index] for index in plan.context], model, config, done=done))


def test_the_plan_has_anchors_then_rounds_of_the_asked_sizes():
    plan = plan_completion(room_cameras(), box_points(), small(), size=16)
    assert [(one.role, one.number, len(one.cameras)) for one in plan.rounds] == [
        ("anchor", 0, 5),
        ("densify", 1, 3),
        ("densify", 2, 3),
    ]
    assert plan.new_views == 11 and len(plan.context) == 4 and plan.shape.outward
    assert len({one.seed for one in plan.rounds}) == 3
    for one in plan.rounds:
        assert (one.cameras.width, one.cameras.height) == (16, 16)
        assert torch.allclose(one.cameras.focal, torch.tensor(16 / 2 / math.tan(math.radians(30))), rtol=1e-4)


def test_new_views_look_where_the_capture_did_not_and_stay_inside_the_room():
    plan = plan_completion(room_cameras(), box_points(), small(anchor_views=8), size=16)
    forward = plan.rounds[0].cameras.rotations[:, :, 2]
    assert float((forward[:, 0] < 0).float().mean()) > 0.6
    for one in plan.rounds:
        assert plan.shell.contains(one.cameras.centers).all()
        assert float(torch.cdist(one.cameras.centers, box_points()).min()) > 0.1


def test_the_plan_is_decided_by_its_seed():
    first, again = (plan_completion(room_cameras(), box_points(), small(seed=3), size=16) for _ in range(2))
    other = plan_completion(room_cameras(), box_points(), small(seed=4), size=16)
    assert torch.equal(first.rounds[0].cameras.camera_to_world, again.rounds[0].cameras.camera_to_world)
    assert not torch.equal(first.rounds[0].cameras.camera_to_world, other.rounds[0].cameras.camera_to_world)


@pytest.mark.parametrize("points", [None, torch.empty(0, 3), torch.full((3, 3), math.nan)])
def test_a_plan_needs_no_points(points):
    plan = plan_completion(room_cameras(), points, small(), size=16)
    assert torch.isfinite(plan.rounds[0].cameras.camera_to_world).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_captures_of_one_two_and_three_views(count: int):
    config = small(context_views=16)
    plan = plan_completion(room_cameras()[:count], None, config, size=16)
    assert sorted(plan.context) == list(range(count))
    text = announcement_of_rounds(plan, config, MeanFiller())
    assert "asked for 16" in text and f"{count} of {count} captured" in text and "01234567" in text


def test_an_orbit_is_completed_all_around():
    angle = torch.linspace(0, 2.0, 8)
    centers = 2 * torch.stack([angle.cos(), angle.sin(), torch.zeros(8)], dim=1)
    capture = Pinholes.looking_at(centers, torch.zeros_like(centers), up=UP, fov_degrees=60.0, width=16, height=16)
    plan = plan_completion([capture[index] for index in range(8)], None, small(anchor_views=8), size=16)
    anchors = plan.rounds[0].cameras
    assert not plan.shape.outward
    assert float((anchors.centers[:, 1] < -1.0).float().sum()) >= 2  # also where nobody stood
    inward = torch.nn.functional.normalize(-anchors.centers, dim=1)
    assert float((inward * anchors.rotations[:, :, 2]).sum(dim=1).min()) > 0.2


def test_rounds_see_the_context_and_the_anchors_and_only_the_new_views_come_back():
    model = MeanFiller()
    rounds = complete(small(), model)
    assert [len(views) for views in model.asked] == [4 + 5, 4 + 5 + 3, 4 + 5 + 3]
    assert [len(views) for views in rounds] == [5, 3, 3]
    for asked in model.asked[1:]:
        assert bool((asked.image_known[:9] == 1).all()) and bool((asked.image_known[9:] == 0).all())
        assert torch.allclose(asked.images[4:9], rounds[0].images.permute(0, 3, 1, 2) / 255.0)
    assert model.sampling[0] == SamplingConfig(steps=2, guidance_unknown=7.0, guidance_known=1.1, precision="auto")
    assert {origin.role for origin in rounds[0].origins} == {"anchor"} and rounds[2].rounds == [2]
    assert all(origin.model_hash == model.model_hash for origin in rounds[1].origins)


def test_an_interrupted_run_goes_on_with_the_next_round_and_gives_the_same_views():
    whole = complete(small(), MeanFiller())
    rest_model = MeanFiller()
    rest = complete(small(), rest_model, done=whole[0])
    assert len(rest_model.asked) == 2
    for first, second in zip(whole[1:], rest, strict=True):
        assert torch.equal(first.images, second.images)
        assert torch.equal(first.cameras.camera_to_world, second.cameras.camera_to_world)


def test_no_anchors_and_no_rounds_are_allowed():
    assert complete(small(anchor_views=0, densify_rounds=0), MeanFiller()) == []
    only_dense = complete(small(anchor_views=0, densify_rounds=1), MeanFiller())
    assert [view.origins[0].role for view in only_dense] == ["densify"]


def test_progress_is_told_for_every_step():
    told = []
    cameras = room_cameras()
    config = small()
    plan = plan_completion(cameras, None, config, size=16)
    context = [captured(cameras)[index] for index in plan.context]
    list(
        run_completion(
            plan, context, MeanFiller(), config, on_step=lambda one, step, steps: told.append((one.number, step, steps))
        )
    )
    assert told == [(0, 1, 2), (0, 2, 2), (1, 1, 2), (1, 2, 2), (2, 1, 2), (2, 2, 2)]


def test_a_wide_picture_is_padded_with_unknown_pixels_and_its_camera_follows():
    camera = Pinholes.looking_at(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), up=UP, fov_degrees=80.0, width=64, height=32
    )
    view = CapturedView(image=torch.rand(3, 32, 64), known=torch.ones(1, 32, 64), camera=camera)
    fitted = fitted_view(view, 16)
    assert fitted.size == (16, 16)
    assert bool((fitted.image_known[0, 0, 4:12] == 1).all())
    assert float(fitted.image_known.sum()) == 8 * 16
    expected = raymaps_of(camera.scaled(16, 8))
    assert torch.allclose(fitted.raymaps[:, :, 4:12], expected, atol=1e-6)
    corner = fitted.raymaps[0, 3:, 0, 8]
    assert float(corner[2]) > float(expected[0, 5, 0, 8])  # the padding looks further up than the picture


def test_a_portrait_of_odd_size_and_a_tiny_picture_are_fitted():
    for height, width in ((37, 21), (5, 3), (16, 16), (1, 40)):
        camera = Pinholes.looking_at(
            torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), up=UP, fov_degrees=60.0, width=width, height=height
        )
        fitted = fitted_view(
            CapturedView(image=torch.rand(3, height, width), known=torch.ones(1, height, width), camera=camera), 16
        )
        assert fitted.size == (16, 16) and bool(fitted.image_known.any())


def test_unknown_pixels_never_bleed_into_known_ones():
    camera = Pinholes.looking_at(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), up=UP, fov_degrees=60.0, width=64, height=64
    )
    image, known = torch.full((3, 64, 64), 0.5), torch.ones(1, 64, 64)
    known[:, 20:41, 20:41] = 0
    image[:, 20:41, 20:41] = math.nan
    fitted = fitted_view(CapturedView(image=image, known=known, camera=camera), 16)
    assert torch.isfinite(fitted.images).all()
    inside = fitted.image_known.expand_as(fitted.images) > 0
    assert torch.allclose(fitted.images[inside], torch.tensor(0.5), atol=1e-6)
    assert 0 < float((fitted.image_known == 0).float().mean()) < 0.3


def test_views_of_mixed_sizes_make_one_sequence():
    cameras = room_cameras()
    cameras[2] = cameras[2].scaled(40, 20)
    config, model = small(), MeanFiller()
    plan = plan_completion(cameras, None, config, size=16)
    views = captured(cameras)
    rounds = list(run_completion(plan, [views[index] for index in plan.context], model, config))
    assert len(rounds) == 3


def test_state_round_trips_exactly_and_loads_with_weights_only(tmp_path: Path):
    views = CompletedViews.cat(complete(small(), MeanFiller()))
    torch.save(views.state(), tmp_path / "state.pt")
    back = CompletedViews.from_state(torch.load(tmp_path / "state.pt", weights_only=True))
    assert torch.equal(back.images, views.images) and torch.equal(back.masks, views.masks)
    for name in ("camera_to_world", "focal", "principal"):
        assert torch.equal(getattr(back.cameras, name), getattr(views.cameras, name))
    assert back.origins == views.origins and back.rounds == [0, 1, 2] and len(back.of_round(1)) == 3


def test_a_state_of_the_future_is_refused():
    views = CompletedViews.cat(complete(small(), MeanFiller()))
    with pytest.raises(ValueError, match="update fillerbuster"):
        CompletedViews.from_state({**views.state(), "version": 99})


def test_views_must_agree_in_number_and_size():
    views = CompletedViews.cat(complete(small(), MeanFiller()))
    with pytest.raises(ValueError, match="expected origins"):
        dataclasses.replace(views, origins=views.origins[:-1])
    assert len(views[[0, 4]]) == 2


def test_the_saved_folder_is_a_valid_capture_that_says_how_it_was_made(tmp_path: Path):
    views = CompletedViews.cat(complete(small(), MeanFiller()))
    views.save_capture(tmp_path / "completion")
    views.save_capture(tmp_path / "completion")  # a later round replaces the folder
    capture = validate_capture(tmp_path / "completion", decode=True)
    assert len(capture) == len(views)
    by_name = sorted(capture.frames, key=lambda frame: frame.image_path.name)
    assert (
        by_name[0].extra["generated"] is True
        and by_name[0].extra["role"] == "anchor"
        and by_name[0].extra["round"] == 0
    )
    assert torch.allclose(by_name[0].camera.camera_to_world.float(), views.cameras[0].camera_to_world, atol=1e-6)
    assert (by_name[0].load_image() * 255 - views.images[0].permute(2, 0, 1)).abs().max() < 0.51
    partial = dataclasses.replace(views, masks=torch.zeros_like(views.masks))
    partial.save_capture(tmp_path / "masked")
    assert float(validate_capture(tmp_path / "masked").frames[0].load_mask().max()) == 0.0


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("context_views", 0),
        ("image_size", 8),
        ("generated_share", 1.5),
        ("steps", 0),
        ("at_step", -1),
        ("generated_share", 0.6),
    ],
)
def test_nonsense_options_are_refused(option: str, value):
    with pytest.raises(ValueError, match=option):
        CompletionConfig(**{option: value})


def test_options_that_are_not_given_come_from_the_model():
    recommended = SamplingConfig(steps=9, guidance_unknown=1.5, guidance_known=1.0, solver="euler")
    assert CompletionConfig().sampling(recommended) == dataclasses.replace(recommended, precision="auto")
    given = CompletionConfig(steps=5, guidance_unknown=3.0).sampling(recommended)
    assert (given.steps, given.guidance_unknown, given.guidance_known, given.solver) == (5, 3.0, 1.0, "euler")


# ---- what is said beforehand ----------------------------------------------------------------------------------------


def test_the_announcement_tells_model_views_passes_seconds_and_memory():
    """Of what is left to do, from the model's own estimate; nothing is made up for a model that cannot tell."""
    config = small(anchor_views=4, densify_rounds=2, densify_views=3)
    plan = plan_completion(room_cameras(), box_points(), config, size=16)
    asked: list[tuple[int, int]] = []

    class Telling(MeanFiller):
        def expected(self, *, views, known, size, sampling, prompted):
            asked.append((views, known))
            return 50.0 * len(asked), views * 2**28

    context = len(plan.context)
    text = announcement_of_rounds(plan, config, Telling())
    assert asked == [(context + 4, context), (context + 4 + 3, context + 4), (context + 4 + 3, context + 4)]
    gib = max(views for views, _ in asked) / 4
    assert (
        text.endswith(f"; about 5 min, up to {gib:.1f} GiB of memory.")
        and "10 new views of 16x16 pixels in 3 passes" in text
    )
    asked.clear()
    views = next(run_completion(plan, [captured(room_cameras())[i] for i in plan.context], MeanFiller(), config))
    announcement_of_rounds(plan, config, Telling(), done=views)
    assert len(asked) == 2, "the anchors are there already"
    assert "about" not in announcement_of_rounds(plan, config, MeanFiller())


def test_the_lazy_model_tells_without_its_weights(tmp_path: Path):
    from helpers.tiny_models import save_tiny_model

    from fb_core.completion.inpainters.lazy_inpainter import LazyInpainter

    model = LazyInpainter(save_tiny_model(tmp_path / "model", image_size=16), "cpu")
    sampling = model.recommended_sampling
    few, many = (model.expected(views=views, known=2, size=16, sampling=sampling) for views in (4, 16))
    assert not model.loaded and 0 < few[0] < many[0] and 0 < few[1] < many[1]
