"""The datamanager in process at toy size: generation when due, mixing, persistence, resume."""

from __future__ import annotations

import dataclasses
import io
import math
from pathlib import Path

import pytest
import torch
from helpers.plugin.datamanagers import (
    GreyFiller,
    ToySplats,
    attributes,
    draws,
    generated,
    make,
    options,
    run_callbacks,
    stand_in_model,  # noqa: F401
)

from fb_core.completion.options import PlacementConfig
from fb_core.completion.planning.plan import plan_completion
from fb_core.data.capture.captures import validate_capture
from fb_nerfstudio.capture.splat_renders import surface_points
from fb_nerfstudio.datamanager import Refused


@pytest.mark.parametrize(
    ("start", "steps", "said"), [(0, 500, True), (0, 501, False), (400, 100, True), (400, 101, False)]
)
def test_a_training_that_ends_before_views_are_due_says_so(tiny_capture, tmp_path, capsys, start, steps, said):
    manager = make(tiny_capture, options(at_step=500))
    attrs = attributes(manager, tmp_path)
    attrs.trainer.config.max_num_iterations, attrs.trainer._start_step = steps, start
    manager.get_training_callbacks(attrs)
    told = " ".join(capsys.readouterr().out.split())
    assert (
        "none will be generated. Train longer, or set --pipeline.datamanager.completion.at-step below 500" in told
    ) == said


@pytest.mark.parametrize("opaque", [1.0, 0.5])
def test_views_of_which_trained_splats_show_all_are_not_generated(tiny_capture, capsys, opaque):
    """The capture decides, and the splats know better than its shell: an orbit that sees all sides of an object needs
    nothing.
    """
    manager = make(tiny_capture, options(anchor_views=None, at_step=200, least_gain=0.0))
    attrs = attributes(manager)
    everywhere = attrs.pipeline.model.get_outputs_for_camera

    def shown(camera):
        outputs = everywhere(camera)
        accumulation = torch.zeros_like(outputs["accumulation"])
        accumulation[:, : int(opaque * accumulation.shape[1])] = 1.0
        return outputs | {"accumulation": accumulation, "depth": torch.full_like(accumulation, 2.0)}

    attrs.pipeline.model.get_outputs_for_camera = shown
    run_callbacks(manager, attrs, 200)
    told = " ".join(capsys.readouterr().out.split())
    if opaque == 1.0:
        assert GreyFiller.calls == 0 and manager.generated_views is None and "no view is generated" in told
    else:
        assert GreyFiller.calls > 0 and all(bool(mask.any()) for mask in manager.generated_views.masks)


def test_the_model_is_tried_once_and_views_are_believed_accordingly(tiny_capture, tmp_path, capsys):
    manager = make(tiny_capture, options(context_views=4, trust="measured"))
    generated(manager, tmp_path)
    views = manager.generated_views
    assert GreyFiller.calls == 3  # the trial, the anchors, one round
    assert "hidden view" in capsys.readouterr().out
    state = manager.get_extra_state()
    assert 0.05 <= state["trust"] <= 1 and state["measured"]["hidden"] == 1
    assert views.trust is not None and all(0.05 <= origin.trust <= 1 for origin in views.origins)
    means = (views.trust.double() / 255).mean(dim=(1, 2, 3)).tolist()
    assert [origin.trust for origin in views.origins] == pytest.approx(means, abs=3e-3), (
        "a view is believed as its pixels are"
    )
    state |= {"finished": False, "views": views.of_round(0).state()}
    resumed = make(tiny_capture, options(context_views=4, trust="measured"))
    resumed.set_extra_state(state)
    run_callbacks(resumed, attributes(resumed), 0)
    assert GreyFiller.calls == 4, "no second trial"
    assert torch.equal(resumed.generated_views.trust, views.trust)


def test_nothing_is_generated_before_it_is_due(tiny_capture: Path):
    manager = make(tiny_capture, options(at_step=5))
    attrs = attributes(manager)
    for step in range(5):
        run_callbacks(manager, attrs, step)
        assert manager.generated_views is None and GreyFiller.loads == 0
    run_callbacks(manager, attrs, 5)
    assert len(manager.generated_views) == 6 and GreyFiller.loads == 1 and GreyFiller.calls == 2
    run_callbacks(manager, attrs, 6)
    assert GreyFiller.loads == 1


def test_a_run_without_completion_is_plain_nerfstudio(tiny_capture: Path):
    manager = make(tiny_capture, options(enabled=False))
    generated(manager)
    assert manager.generated_views is None and GreyFiller.loads == 0
    seen = draws(manager, range(12))
    assert sorted(seen[:6]) == sorted(seen[6:]) == [0, 1, 2, 3, 4, 5]  # every view once per epoch


def test_batches_have_what_the_splat_model_reads(tiny_capture: Path):
    manager = make(tiny_capture, options(generated_steps="shared"))
    generated(manager)
    kinds = {}
    for step in range(60):
        camera, batch = manager.next_train(step)
        kinds["real" if "cam_idx" in (camera.metadata or {}) else "generated"] = (camera, batch)
    camera, batch = kinds["generated"]
    assert camera.shape == (1,) and not (camera.metadata or {})
    assert batch["image"].shape == (16, 16, 3) and batch["image"].dtype == torch.uint8
    assert batch["mask"].shape == (16, 16, 1) and batch["view_weight"] == float(batch["mask"].float().mean())
    camera, batch = kinds["real"]
    assert batch["image"].dtype == torch.uint8 and batch["image"].shape == (32, 48, 3) and "view_weight" not in batch
    assert "beside" not in batch


def test_captured_views_keep_their_steps(tiny_capture: Path):
    """Every step draws the captured view that it draws without completion; generated ones come beside it, in the same
    proportion to them as where they share the steps.
    """
    plain, added, shared = (
        make(tiny_capture, options(**changes))
        for changes in (
            {"enabled": False},
            {"generated_share": 0.4},
            {"generated_share": 0.4, "generated_steps": "shared"},
        )
    )
    for manager in (plain, added, shared):
        generated(manager)
    drawn, drawn_shared = draws(added, range(600)), draws(shared, range(600))
    assert [one for one in drawn if isinstance(one, int)] == draws(plain, range(600))
    beside = [one for one in drawn if isinstance(one, str)]
    assert set(beside) == {one for one in drawn_shared if isinstance(one, str)} and len(set(beside)) == 6
    assert len(beside) / 600 == pytest.approx(added.generated_probability, abs=0.08)
    assert added.generated_probability == pytest.approx(
        shared.generated_probability / (1 - shared.generated_probability)
    )
    camera, batch = next(batch["beside"] for _, batch in map(added.next_train, range(600, 700)) if "beside" in batch)
    assert not (camera.metadata or {}) and batch["image"].shape == (16, 16, 3) and batch["mask"].shape == (16, 16, 1)


def test_a_memory_budget_reaches_the_sampler_and_what_does_not_fit_is_one_sentence(tiny_capture: Path, monkeypatch):
    assert options(memory_budget=1.5).sampling().memory_budget_bytes == 3 * 2**29
    with pytest.raises(ValueError, match=r"completion\.memory_budget"):
        options(memory_budget=0.0)

    def too_small(self, views, *, sampling, **_):
        raise ValueError(f"memory budget of {sampling.memory_budget_bytes} bytes: too small; 4 views would fit")

    monkeypatch.setattr(GreyFiller, "complete", too_small)
    with pytest.raises(Refused, match="4 views would fit"):
        generated(make(tiny_capture, options(memory_budget=1.5)))


def test_a_capture_without_points_starts_from_its_photos(tiny_capture: Path):
    manager = make(tiny_capture, points=False, start_points=50)
    metadata = manager.train_dataparser_outputs.metadata
    assert 30 <= len(metadata["points3D_xyz"]) <= 50 and metadata["points3D_rgb"].dtype == torch.uint8
    assert metadata["points3D_xyz"].shape == metadata["points3D_rgb"].shape and bool(
        metadata["points3D_xyz"].isfinite().all()
    )
    again = make(tiny_capture, points=False, start_points=50).train_dataparser_outputs.metadata
    assert torch.equal(metadata["points3D_xyz"], again["points3D_xyz"])
    assert "points3D_xyz" not in make(tiny_capture, points=False, start_points=0).train_dataparser_outputs.metadata


def test_float_caches_give_float_generated_images(tiny_capture: Path):
    manager = make(tiny_capture, options(generated_share=1.0, generated_steps="shared"), cache_images_type="float32")
    generated(manager)
    images = [batch["image"] for camera, batch in map(manager.next_train, range(30)) if not camera.metadata]
    assert images and images[0].dtype == torch.float32 and 0 <= float(images[0].min()) <= float(images[0].max()) <= 1


def test_a_pixel_counts_alike_however_many_of_its_view_are_trained_on(tiny_capture: Path):
    """The rate of draws goes by what is trained on; a view's loss, a mean over its mask, weighs as much as its mask."""
    manager = make(tiny_capture, options(generated_share=1.0, generated_steps="shared"))
    generated(manager)
    bank = manager.generated_views
    masks = torch.zeros_like(bank.masks)
    masks[0] = True
    masks[1, : masks.shape[1] // 2] = True
    manager.generation.set_views(dataclasses.replace(bank, masks=masks))
    assert manager.generated_probability == pytest.approx(1.5 / (1.5 + 6))
    drawn = [
        (float(batch["mask"].float().mean()), batch["view_weight"])
        for camera, batch in map(manager.next_train, range(600))
        if not camera.metadata
    ]
    assert set(drawn) == {(0.5, 0.5), (1.0, 1.0)}, "and none of the views without a pixel"
    assert 0.6 < drawn.count((1.0, 1.0)) / drawn.count((0.5, 0.5)) < 1.6


@pytest.mark.parametrize(("share", "expected"), [(0.2, 0.2), (1.0, 6 / 12), (0.0, 0.0)])
def test_generated_views_are_drawn_with_the_stated_probability(tiny_capture: Path, share: float, expected: float):
    manager = make(tiny_capture, options(generated_share=share, generated_steps="shared", generated_pixels="all"))
    generated(manager)
    assert manager.generated_probability == pytest.approx(expected)
    seen = draws(manager, range(400))
    got = sum(isinstance(one, str) for one in seen) / len(seen)
    assert got == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / 400) + 1e-9)
    if share > 0:
        assert len({one for one in seen if isinstance(one, str)}) == 6


def test_the_dataset_never_grows(tiny_capture: Path):
    manager = make(tiny_capture)
    before = len(manager.train_dataset), len(manager.cached_train), len(manager.eval_dataset)
    generated(manager)
    assert (len(manager.train_dataset), len(manager.cached_train), len(manager.eval_dataset)) == before
    assert len(manager.train_cameras) == before[0]


def test_no_reference_to_pipeline_trainer_or_model_is_kept(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture)
    attrs = generated(manager, tmp_path)
    assert [name for name, _ in manager.named_modules()] == [""]
    assert not any(value in (attrs.pipeline, attrs.trainer, attrs) for value in vars(manager).values())
    manager.train()
    manager.eval()
    assert list(manager.state_dict()) == ["_extra_state"]


def test_generation_leaves_global_randomness_and_the_splats_mode_alone(tiny_capture: Path):
    manager = make(tiny_capture)
    torch.manual_seed(11)
    expected = torch.rand(3)
    torch.manual_seed(11)
    attrs = attributes(manager)
    attrs.pipeline.model.train()
    run_callbacks(manager, attrs, 500)
    assert torch.equal(torch.rand(3), expected)
    assert attrs.pipeline.model.training and attrs.pipeline.model.modes and not any(attrs.pipeline.model.modes)


def test_views_folder_and_checkpoint_are_there_when_training_goes_on(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture)
    generated(manager, tmp_path / "run")
    assert len(validate_capture(tmp_path / "run" / "completion")) == 6
    checkpoints = list((tmp_path / "run" / "nerfstudio_models").iterdir())
    assert [path.name for path in checkpoints] == ["step-000000000.ckpt"]
    assert [path.name for path in (tmp_path / "run").iterdir() if path.name.startswith(".")] == []
    state = torch.load(checkpoints[0], weights_only=True)["pipeline"]["_extra_state"]
    assert state["finished"] and len(state["views"]["origins"]) == 6


def test_a_later_generation_counts_as_the_state_after_the_step_before(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture, options(at_step=7))
    generated(manager, tmp_path, step=7)
    assert [path.name for path in (tmp_path / "nerfstudio_models").iterdir()] == ["step-000000006.ckpt"]


def test_a_resumed_run_generates_nothing_and_draws_the_same_views(tiny_capture: Path, tmp_path: Path):
    whole = make(tiny_capture)
    generated(whole)
    draws(whole, range(23))
    buffer = io.BytesIO()
    torch.save(whole.state_dict(), buffer)
    expected = draws(whole, range(23, 80))
    buffer.seek(0)
    loads = GreyFiller.loads

    resumed = make(tiny_capture)
    resumed.load_state_dict(torch.load(buffer, weights_only=True), strict=False)
    run_callbacks(resumed, attributes(resumed), 23)
    assert GreyFiller.loads == loads
    assert draws(resumed, range(23, 80)) == expected


def test_a_run_killed_between_rounds_goes_on_with_the_next_round(tiny_capture: Path, tmp_path: Path, monkeypatch):
    expected = make(tiny_capture)
    generated(expected)

    def killed(self, *_args, **_kwargs):
        raise KeyboardInterrupt

    manager = make(tiny_capture)
    with monkeypatch.context() as patch:
        complete = GreyFiller.complete
        calls = []
        patch.setattr(
            GreyFiller, "complete", lambda *a, **k: killed(*a) if calls else calls.append(1) or complete(*a, **k)
        )
        with pytest.raises(KeyboardInterrupt):
            generated(manager, tmp_path)
    state = torch.load(tmp_path / "nerfstudio_models" / "step-000000000.ckpt", weights_only=True)["pipeline"]
    assert not state["_extra_state"]["finished"] and len(state["_extra_state"]["views"]["origins"]) == 4

    resumed = make(tiny_capture)
    resumed.load_state_dict(state, strict=False)
    GreyFiller.calls = 0
    generated(resumed, tmp_path, step=1)
    assert GreyFiller.calls == 1
    assert torch.equal(resumed.generated_views.images, expected.generated_views.images)
    assert torch.equal(
        resumed.generated_views.cameras.camera_to_world, expected.generated_views.cameras.camera_to_world
    )


def test_checkpoints_of_other_methods_load(tiny_capture: Path):
    manager = make(tiny_capture)
    manager.load_state_dict({}, strict=False)
    assert manager.generated_views is None


@pytest.mark.parametrize("test_mode", ["test", "inference"])
def test_evaluation_commands_restore_the_bank_without_the_model(tiny_capture: Path, test_mode: str):
    trained = make(tiny_capture)
    generated(trained)
    state, loads = trained.state_dict(), GreyFiller.loads
    manager = make(tiny_capture, test_mode=test_mode)
    manager.load_state_dict(state, strict=False)
    assert len(manager.generated_views) == 6 and GreyFiller.loads == loads


def test_untrained_splats_are_not_asked_what_was_seen(tiny_capture: Path):
    manager = make(tiny_capture)
    attrs = generated(manager, step=0)
    assert attrs.pipeline.model.modes == []
    points, colors = attrs.pipeline.model.added[0]
    assert points.shape == colors.shape and len(points) > 0 and torch.isfinite(points).all()


def test_trained_splats_tell_where_the_holes_are(tiny_capture: Path):
    manager = make(tiny_capture, options(at_step=200, max_seed_gaussians=50), points=False)
    attrs = generated(manager, step=200)
    assert (
        len(attrs.pipeline.model.modes) == 6 + 6 + 6 + 4 * 6
    )  # captured views for the surface, new ones to start from and for the holes, four places beside each captured one
    assert 0 < len(attrs.pipeline.model.added[0][0]) <= 50


def test_no_camera_is_placed_near_to_what_the_splats_show(tiny_capture: Path, monkeypatch):
    """The collision rule knows the depth of the current splats: the capture brings no points here, and none are
    triangulated.
    """
    shown = ToySplats.get_outputs_for_camera
    near = {
        "depth": torch.full((32, 48, 1), 0.25),
        "accumulation": torch.ones(32, 48, 1),
    }  # something stands in front of each camera
    monkeypatch.setattr(
        ToySplats, "get_outputs_for_camera", lambda self, one: shown(self, one) | (near if int(one.width) == 48 else {})
    )
    config = options(at_step=200, anchor_views=12, placement=PlacementConfig(clearance=1.0))
    manager = make(tiny_capture, config, points=False, start_points=0)
    generated(manager, step=200)
    cameras = manager.captured_cameras()
    points = surface_points(ToySplats(), cameras)
    clearance = float(plan_completion(cameras, points, config, size=16).shell.log_radius.median().exp())

    def too_near(centers: torch.Tensor) -> torch.Tensor:
        home = torch.cdist(centers, torch.cat([camera.centers for camera in cameras])).min(dim=1).values
        return (torch.cdist(centers, points).min(dim=1).values < 0.9 * clearance) & (
            home > 1e-3
        )  # points are thinned for the rule

    blind = torch.cat([one.cameras.centers for one in plan_completion(cameras, None, config, size=16).rounds])
    assert bool(too_near(blind).any()) and not bool(too_near(manager.generated_views.cameras.centers).any())


def test_no_gaussians_are_added_when_not_wanted(tiny_capture: Path):
    manager = make(tiny_capture, options(seed_gaussians=False))
    assert generated(manager).pipeline.model.added == []


def test_training_on_unseen_pixels_alone_masks_the_rest(tiny_capture: Path):
    manager = make(tiny_capture, options(generated_pixels="unseen"))
    generated(manager)
    masks = manager.generated_views.masks
    assert 0 < int(masks.sum()) < masks.numel()
