"""The datamanager in process at toy size: generation when due, mixing, persistence, resume, refusals, the viewer
panel.
"""

from __future__ import annotations

import dataclasses
import io
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
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
    toy_viewer,
    two_views,
)

from fb_core.completion.options import CompletionConfig, PlacementConfig
from fb_core.completion.planning.plan import plan_completion
from fb_core.completion.results.completed_views import CompletedViews
from fb_core.data.capture.captures import validate_capture
from fb_core.geometry.shell import sphere
from fb_core.views import Views
from fb_nerfstudio.capture.splat_renders import Rendered, surface_points
from fb_nerfstudio.capture.unseen import find_unseen, unseen_gaussians, with_matched_colors, with_unseen_masks
from fb_nerfstudio.datamanager import FillerbusterDataManager, FillerbusterDataManagerConfig, Refused


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
    manager = make(tiny_capture, options(view_weight=0.25))
    generated(manager)
    kinds = {}
    for step in range(60):
        camera, batch = manager.next_train(step)
        kinds["real" if "cam_idx" in (camera.metadata or {}) else "generated"] = (camera, batch)
    camera, batch = kinds["generated"]
    assert camera.shape == (1,) and not (camera.metadata or {})
    assert batch["image"].shape == (16, 16, 3) and batch["image"].dtype == torch.uint8
    assert batch["mask"].shape == (16, 16, 1) and batch["view_weight"] == 0.25
    camera, batch = kinds["real"]
    assert batch["image"].dtype == torch.uint8 and batch["image"].shape == (32, 48, 3) and "view_weight" not in batch


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
    manager = make(tiny_capture, options(generated_share=1.0), cache_images_type="float32")
    generated(manager)
    images = [batch["image"] for camera, batch in map(manager.next_train, range(30)) if not camera.metadata]
    assert images and images[0].dtype == torch.float32 and 0 <= float(images[0].min()) <= float(images[0].max()) <= 1


def test_generated_views_are_drawn_in_proportion_to_what_is_trained_on_in_them(tiny_capture: Path):
    manager = make(tiny_capture, options(generated_share=1.0))
    generated(manager)
    bank = manager.generated_views
    masks = torch.zeros_like(bank.masks)
    masks[0] = True
    masks[1, : masks.shape[1] // 2] = True
    manager.generation.set_views(dataclasses.replace(bank, masks=masks))
    assert manager.generated_probability == pytest.approx(1.5 / (1.5 + 6))
    covered = [
        float(batch["mask"].float().mean())
        for camera, batch in map(manager.next_train, range(600))
        if not camera.metadata
    ]
    assert set(covered) == {0.5, 1.0} and covered.count(1.0) > 1.3 * covered.count(0.5)


@pytest.mark.parametrize(("share", "expected"), [(0.2, 0.2), (1.0, 6 / 12), (0.0, 0.0)])
def test_generated_views_are_drawn_with_the_stated_probability(tiny_capture: Path, share: float, expected: float):
    manager = make(tiny_capture, options(generated_share=share, generated_pixels="all"))
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


@pytest.fixture()
def starts(monkeypatch) -> list[tuple[Views | None, float]]:
    """What each generation starts from, and its strength; the stand-in answers as ever."""
    given, complete = [], GreyFiller.complete

    def watched(self, views, *, sampling, current=None, **options):
        given.append((current, sampling.strength))
        return complete(self, views, sampling=sampling, **options)

    monkeypatch.setattr(GreyFiller, "complete", watched)
    return given


def test_generation_starts_from_what_the_splats_show_where_they_are_firm(tiny_capture: Path, starts):
    """Their left half is a grey wall; latents at its edge are told wholly, everything else is left to noise."""
    generated(make(tiny_capture, options(at_step=200, start="render", strength=0.4)), step=200)
    (anchors, strength), (densified, _) = starts
    assert strength == 0.4 and len(anchors) == 3 + 4 and len(densified) == 3 + 4 + 2
    new = anchors[[3, 4, 5, 6]]
    assert bool((new.image_known[..., :12] == 1).all()) and not bool(new.image_known[..., 12:].any())
    assert torch.allclose(new.images[..., :12], torch.tensor(0.5), atol=1 / 255)
    assert not bool(anchors[[0, 1, 2]].image_known.all()), "the margins of fitted photos are not told"


@pytest.mark.parametrize(
    ("options_of_start", "step"),
    [({"start": "noise"}, 200), ({"start": "render", "strength": 1.0}, 200), ({"start": "render"}, 0)],
)
def test_generation_starts_from_noise_when_asked_at_strength_one_and_before_anything_is_trained(
    tiny_capture: Path, starts, options_of_start, step
):
    generated(make(tiny_capture, options(at_step=step, **options_of_start)), step=step)
    assert starts == [(None, 1.0)] * 2


def test_fog_and_emptiness_leave_generation_to_noise(tiny_capture: Path, starts, monkeypatch):
    """To the bit: what the model is given does not differ, nor do the views."""
    shown = ToySplats.get_outputs_for_camera
    wanted = generated(
        make(tiny_capture, options(at_step=200, start="noise", match_colors=False)), step=200
    ).pipeline.datamanager.generated_views
    for opacity in (0.0, 0.7):
        fog = {"accumulation": torch.full((16, 16, 1), opacity), "rgb": torch.rand(16, 16, 3)}
        monkeypatch.setattr(
            ToySplats,
            "get_outputs_for_camera",
            lambda self, one, fog=fog: shown(self, one) | (fog if int(one.width) == 16 else {}),
        )
        starts.clear()
        got = generated(
            make(tiny_capture, options(at_step=200, start="render", match_colors=False)), step=200
        ).pipeline.datamanager
        assert starts == [(None, 1.0)] * 2
        assert torch.equal(got.generated_views.images, wanted.images)


def test_a_run_that_goes_on_starts_its_rounds_where_the_whole_run_did(tiny_capture: Path, tmp_path: Path, starts):
    whole = make(tiny_capture, options(at_step=200, start="render"))
    generated(whole, tmp_path, step=200)
    state = whole.state_dict()
    kept = CompletedViews.from_state(state["_extra_state"]["views"]).of_round(0)
    state["_extra_state"] |= {"views": kept.state(), "finished": False}
    resumed = make(tiny_capture, options(at_step=200, start="render"))
    resumed.load_state_dict(state, strict=False)
    generated(resumed, tmp_path, step=200)
    assert len(starts) == 3
    for field in dataclasses.fields(Views):
        assert torch.equal(getattr(starts[2][0], field.name)[-2:], getattr(starts[1][0], field.name)[-2:])


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
        len(attrs.pipeline.model.modes) == 6 + 6 + 6
    )  # captured views for the surface, new ones to start from and for the holes
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


def test_several_processes_are_refused(tiny_capture: Path):
    with pytest.raises(ValueError, match="one process, got 2"):
        FillerbusterDataManagerConfig(data=tiny_capture).setup(device="cpu", world_size=2)


def test_a_broken_capture_is_refused_before_anything_is_loaded(tiny_capture: Path):
    next((tiny_capture / "images").iterdir()).unlink()
    with pytest.raises(Refused, match=r"view_\d+"):
        make(tiny_capture)
    with pytest.raises(ValueError, match="no such folder"):
        make(tiny_capture / "nowhere")
    (tiny_capture / "transforms.json").write_text("{")
    with pytest.raises(ValueError, match="JSON"):
        make(tiny_capture)


def test_a_refusal_ends_a_command_with_its_sentence_and_code_one():
    # The class itself, without the seconds that importing nerfstudio takes.
    program = "class Refused(SystemExit, ValueError): pass\nraise Refused('the capture is empty')"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (1, "the capture is empty\n")
    assert issubclass(Refused, SystemExit) and issubclass(Refused, ValueError)


def test_a_bad_model_folder_is_refused_before_training(tiny_capture: Path, tmp_path: Path, monkeypatch):
    monkeypatch.undo()
    manager = make(tiny_capture, options(model=tmp_path / "absent", at_step=1000))
    with pytest.raises(Refused, match="absent"):
        manager.get_training_callbacks(attributes(manager))


def test_points_of_the_capture_come_without_open3d(tiny_capture: Path):
    manager = make(tiny_capture)
    outputs = manager.train_dataparser_outputs
    points, colors = outputs.metadata["points3D_xyz"], outputs.metadata["points3D_rgb"]
    assert points.shape == colors.shape == (50, 3) and colors.dtype == torch.uint8 and points.dtype == torch.float32
    # Cameras and points went through one similarity: their distances keep their ratios.
    before, after = validate_capture(tiny_capture), manager.train_dataset.cameras.camera_to_worlds[:, :, 3]
    import trimesh

    original = torch.from_numpy(trimesh.load(before.points_path).vertices.copy()).float()
    names = [path.name for path in outputs.image_filenames]
    place = {frame.image_path.name: frame.camera.centers[0].float() for frame in before.frames}
    centers = torch.stack([place[name] for name in names])
    ratio = torch.cdist(after, points) / torch.cdist(centers, original)
    assert torch.allclose(ratio, torch.full_like(ratio, outputs.dataparser_scale), rtol=1e-4)


def test_images_are_not_pinned_without_a_driver(tiny_capture: Path, monkeypatch):
    def pinned(_):
        raise RuntimeError("no driver")

    monkeypatch.setattr(torch.Tensor, "pin_memory", pinned)
    manager = make(tiny_capture, cache_images="cpu")  # what nerfstudio switches to beyond 500 images
    assert len(manager.cached_train) == 6
    manager.next_train(0)


def test_the_config_survives_nerfstudios_yaml(tiny_capture: Path):
    config = FillerbusterDataManagerConfig(data=tiny_capture, completion=options(model=Path("weights"), seed=7))
    back = yaml.load(yaml.dump(config), Loader=yaml.Loader)
    assert dataclasses.asdict(back.completion) == dataclasses.asdict(config.completion)
    assert back._target is FillerbusterDataManager


def test_every_option_is_a_flag_with_a_description(capsys):
    import tyro

    parsed = tyro.cli(
        CompletionConfig, args=["--anchor-views", "3", "--placement.radius", "0.5", "--model", "somewhere"]
    )
    assert parsed.anchor_views == 3 and parsed.placement.radius == 0.5 and parsed.model == Path("somewhere")
    with pytest.raises(SystemExit):
        tyro.cli(CompletionConfig, args=["--help"])
    text = " ".join(capsys.readouterr().out.split())
    for field in dataclasses.fields(CompletionConfig):
        assert field.name == "placement" or f"--{field.name.replace('_', '-')}" in text
    assert "Views generated together in the first round" in text


# ---- unseen pixels --------------------------------------------------------------------------------------------------


def test_the_captured_direction_is_seen_and_the_other_is_not():
    views = two_views()
    captured = dataclasses.replace(views.cameras[0], focal=views.cameras.focal[:1] / 2)  # looks the same way, wider
    unseen = find_unseen(views.cameras, [captured], sphere(torch.zeros(3), 3.0), None)
    assert not unseen.mask[0].any() and unseen.mask[1].all()
    assert torch.allclose(unseen.points.norm(dim=-1), torch.tensor(3.0), atol=1e-3)
    points, colors = unseen_gaussians(views, unseen, limit=10, generator=torch.Generator().manual_seed(0))
    assert points.shape == (10, 3) and bool((points[:, 0] < 0).all()) and torch.allclose(colors, torch.tensor(0.2))
    masked = with_unseen_masks(views, unseen)
    assert not masked.masks[0].any() and masked.masks[1].all()


def test_holes_of_trained_splats_are_unseen_and_so_is_what_no_camera_looked_at():
    views = two_views()
    captured = dataclasses.replace(views.cameras[0], focal=views.cameras.focal[:1] / 2)
    accumulation = torch.ones(2, 8, 8)
    accumulation[0, :, 4:] = 0.1
    rendered = Rendered(depth=torch.full((2, 8, 8), 2.0), accumulation=accumulation, rgb=torch.full((2, 3, 8, 8), 0.5))
    unseen = find_unseen(views.cameras, [captured], sphere(torch.zeros(3), 3.0), rendered)
    matched = with_matched_colors(views, unseen, rendered).images.float() / 255
    assert float((matched[0, :, :4] - 0.5).abs().max()) < 0.01, "what is seen has the splats' colour"
    assert torch.equal(with_matched_colors(views, unseen, rendered).images[1], views.images[1]), (
        "nothing seen, nothing changed"
    )
    assert not unseen.mask[0, :, :4].any() and unseen.mask[0, :, 4:].all() and unseen.mask[1].all()
    masked = with_unseen_masks(views, unseen)
    assert masked.masks[0, :, 4:].all() and not masked.masks[0, :, :4].any()


# ---- viewer ---------------------------------------------------------------------------------------------------------


def test_without_a_viewer_the_panel_does_nothing(tiny_capture: Path):
    manager = make(tiny_capture)
    generated(manager)
    assert not manager.completion_panel.is_open


def test_frustums_stand_in_one_group_per_round_with_a_switch_each(tiny_capture: Path):
    manager, viewer = make(tiny_capture), toy_viewer()
    manager.completion_panel._setup(viewer)
    server = viewer.viser_server
    assert list(server.boxes) == ["Captured (6)"] and "No generated" in server.status.content
    assert "Nothing trains here" in server.status.content and all(field.disabled for field in server.fields.values())
    generated(manager)
    assert list(server.boxes) == ["Captured (6)", "Anchors (4)", "Round 1 (2)"]
    assert len([name for name in server.nodes if "view_" in name]) == 6
    assert server.status.content == "6 generated views"
    server.switch("Anchors (4)", False)
    assert not server.nodes["/completion/round_00"].visible and server.nodes["/completion/round_01"].visible
    server.switch("Captured (6)", False)
    assert viewer.visible == [False]
    frustum, camera = server.nodes["/completion/round_00/view_000"], manager.generated_views.cameras
    assert torch.allclose(torch.from_numpy(frustum.position).float(), 10 * camera.centers[0], atol=1e-5)
    assert frustum.image.shape == (16, 16, 3)


def test_a_saved_run_is_drawn_whether_the_viewer_comes_first_or_last(tiny_capture: Path):
    trained = make(tiny_capture)
    generated(trained)
    state = trained.state_dict()
    for viewer_first in (True, False):
        manager, viewer = make(tiny_capture, test_mode="test"), toy_viewer()
        if viewer_first:  # ns-train --load-dir
            manager.completion_panel._setup(viewer)
        manager.load_state_dict(state, strict=False)
        if not viewer_first:  # ns-viewer
            manager.completion_panel._setup(viewer)
        assert len([name for name in viewer.viser_server.nodes if "view_" in name]) == 6
        manager.generation.set_views(None)
        assert viewer.viser_server.nodes == {}


def test_nerfstudios_viewer_finds_the_panel(tiny_capture: Path):
    from nerfstudio.viewer.utils import parse_object
    from nerfstudio.viewer.viewer_elements import ViewerControl

    manager = make(tiny_capture)
    holder = torch.nn.Module()
    holder.datamanager = manager
    assert [found for _, found in parse_object(holder, ViewerControl, "Custom Elements")] == [manager.completion_panel]
