"""The splat model at toy size on a CPU: training, resume, densification, added Gaussians, outputs, masks and
weights.
"""

from __future__ import annotations

import logging
import math

import pytest
import torch
from helpers.plugin.splat_models import SIZE, camera, make_batch, make_model, make_optimizers, train_step
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

from fb_core.evaluation.metrics.lazy_lpips import LazyLpips
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.normals import normals_of_picture
from fb_core.splatting.normal_losses import alignment_loss, total_variation
from fb_nerfstudio.bridge import to_nerfstudio
from fb_nerfstudio.splats.gaussians import gaussians_at
from fb_nerfstudio.splats.schedulers import FloatExponentialDecaySchedulerConfig

OUTPUT_SHAPES = {
    "rgb": (SIZE, SIZE, 3),
    "depth": (SIZE, SIZE, 1),
    "accumulation": (SIZE, SIZE, 1),
    "background": (SIZE, SIZE, 3),
    "normal": (SIZE, SIZE, 3),
    "surface_normal": (SIZE, SIZE, 3),
}


@pytest.mark.parametrize("sh_degree", [0, 1])
def test_one_step_changes_the_parameters(sh_degree: int) -> None:
    model = make_model(sh_degree=sh_degree)
    optimizers = make_optimizers(model)
    before = {name: values.detach().clone() for name, values in model.gauss_params.items()}
    losses = train_step(model, optimizers, 1)
    assert all(isinstance(value, torch.Tensor) and value.isfinite() for value in losses.values())
    train_step(
        model, optimizers, 2
    )  # quaternions of round Gaussians have no gradient; after one step they are not round
    changed = {
        name for name, values in model.gauss_params.items() if values.numel() and not torch.equal(values, before[name])
    }
    assert changed >= {"means", "scales", "quats", "features_dc", "opacities"}


def test_training_fits_an_image() -> None:
    """The loss falls by a good part within forty steps."""
    torch.manual_seed(0)
    model = make_model(200, background_color="black", ssim_lambda=0.2)
    optimizers = make_optimizers(model, lr=3e-2)
    ramp = torch.linspace(0, 255, SIZE)
    batch = {
        "image": torch.stack(
            [ramp.expand(SIZE, SIZE), ramp.expand(SIZE, SIZE).T, torch.full((SIZE, SIZE), 128.0)], -1
        ).to(torch.uint8)
    }
    losses = [float(train_step(model, optimizers, step, batch)["main_loss"].detach()) for step in range(1, 41)]
    assert losses[-1] < 0.5 * losses[0]


def test_resolution_schedule_divides_focal_and_floors_size() -> None:
    model = make_model(num_downscales=2, resolution_schedule=10)
    model.train()
    pinhole = model.drawn_camera(camera(SIZE + 3))
    full = model.eval().drawn_camera(camera(SIZE + 3))
    assert (pinhole.width, pinhole.height) == ((SIZE + 3) // 4, (SIZE + 3) // 4)
    assert torch.allclose(pinhole.focal * 4, full.focal) and torch.allclose(pinhole.principal * 4, full.principal)
    train_step(
        model,
        make_optimizers(model),
        1,
        make_batch(SIZE + 3) | {"mask": torch.ones(SIZE + 3, SIZE + 3, 1, dtype=torch.bool)},
    )


def test_camera_optimizer_moves_only_indexed_views() -> None:
    """A generated view carries no cam_idx, so no pose correction learns from it."""
    model = make_model(camera_optimizer=CameraOptimizerConfig(mode="SO3xR3"))
    optimizers = make_optimizers(model)
    train_step(model, optimizers, 1)
    pose = model.camera_optimizer.pose_adjustment
    assert pose.abs().sum() == 0
    model.train()
    indexed = camera()
    indexed.metadata = {"cam_idx": 2}
    optimizers.zero_grad_all()
    losses = model.get_loss_dict(model(indexed), make_batch())
    losses["main_loss"].backward()
    assert pose.grad[2].abs().sum() > 0 and pose.grad[[0, 1, 3]].abs().sum() == 0


def test_bilateral_grid_of_indexed_views() -> None:
    model = make_model(use_bilateral_grid=True, grid_shape=(4, 4, 2)).train()
    optimizers = make_optimizers(model)
    model.step_cb(optimizers, 1)
    for metadata, learns in (({"cam_idx": 1}, True), (None, False)):
        view = camera()
        view.metadata = metadata
        optimizers.zero_grad_all()
        losses = model.get_loss_dict(model(view), make_batch())
        losses["main_loss"].backward()
        gradient = model.bil_grids.grids.grad
        assert (gradient is not None and gradient[1].abs().sum() > 0) == learns
        assert losses["tv_loss"].isfinite()


def test_outputs_in_evaluation() -> None:
    model = make_model().eval()
    outputs = model.get_outputs_for_camera(camera(distance=9.0))
    assert {name: tuple(value.shape) for name, value in outputs.items()} == OUTPUT_SHAPES
    for name in ("rgb", "accumulation", "normal", "surface_normal"):
        assert outputs[name].isfinite().all() and outputs[name].min() >= 0 and outputs[name].max() <= 1, name
    empty = outputs["accumulation"].squeeze(-1) == 0
    assert empty.any() and (outputs["normal"][empty] == 0.5).all(), "no Gaussian, no normal: grey and no NaN"
    drawn = ~empty
    assert torch.allclose((outputs["normal"][drawn] * 2 - 1).norm(dim=-1), torch.ones(int(drawn.sum())), atol=1e-4)


def test_an_empty_crop_has_the_same_keys() -> None:
    model = make_model().eval()
    nothing = OrientedBox(R=torch.eye(3), T=torch.tensor([50.0, 50.0, 50.0]), S=torch.ones(3))
    outputs = model.get_outputs_for_camera(camera(), obb_box=nothing)
    assert {name: tuple(value.shape) for name, value in outputs.items()} == OUTPUT_SHAPES
    assert outputs["accumulation"].sum() == 0 and torch.equal(outputs["rgb"], outputs["background"])
    model.set_crop(None)
    model.config.output_normals = False
    assert set(model.get_outputs_for_camera(camera())) == set(model.get_outputs_for_camera(camera(), obb_box=nothing))


def test_a_crop_draws_only_what_is_inside() -> None:
    model = make_model().eval()
    whole = model.get_outputs_for_camera(camera())
    everything = OrientedBox(R=torch.eye(3), T=torch.zeros(3), S=torch.full((3,), 10.0))
    assert torch.allclose(model.get_outputs_for_camera(camera(), obb_box=everything)["rgb"], whole["rgb"])
    half = OrientedBox(R=torch.eye(3), T=torch.tensor([5.0, 0.0, 0.0]), S=torch.full((3,), 10.0))
    assert model.get_outputs_for_camera(camera(), obb_box=half)["accumulation"].sum() < whole["accumulation"].sum()


def test_harmonics_evaluated_beforehand_give_the_same_picture() -> None:
    """With normals in the same pass the colours are evaluated outside the rasterizer."""
    model = make_model(sh_degree=3).eval()
    model.step = 1000
    with torch.no_grad():
        model.features_rest.normal_(std=0.2)
    with_normals = model.get_outputs_for_camera(camera())["rgb"]
    model.config.output_normals = False
    assert torch.allclose(model.get_outputs_for_camera(camera())["rgb"], with_normals, atol=1e-5)


def test_an_evaluation_render_leaves_the_strategy_alone() -> None:
    """The strategy reads the last training render; a render for the viewer or the completion in between changes
    nothing.
    """
    model = make_model()
    optimizers = make_optimizers(model)
    train_step(model, optimizers, 1)
    info = model.info
    model.eval().get_outputs_for_camera(camera())
    assert model.info is info


def test_a_wall_of_discs_has_its_normal_twice() -> None:
    """Flat Gaussians on the plane y = 0 seen from -y: both normals are the plane's, blue towards the camera."""
    model = make_model(1, sh_degree=0)
    grid = torch.linspace(-2, 2, 60)
    points = torch.stack(torch.meshgrid(grid, torch.zeros(1), grid, indexing="ij"), -1).reshape(-1, 3)
    rows = gaussians_at(points, torch.rand(len(points), 3), sh_degree=0, opacity=0.95)
    rows["scales"] = torch.log(torch.tensor([0.07, 0.001, 0.07])).expand(len(points), 3)
    rows["quats"] = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(points), 4)
    model.gauss_params = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(values.clone()) for name, values in rows.items()}
    )
    pinhole = Pinholes.looking_at(
        torch.tensor([[0.0, -3.0, 0.0]]),
        torch.zeros(1, 3),
        up=torch.tensor([0.0, 0.0, 1.0]),
        fov_degrees=40.0,
        width=32,
        height=32,
    )
    outputs = model.eval().get_outputs_for_camera(to_nerfstudio(pinhole))
    inside = (slice(4, -4), slice(4, -4))
    assert torch.allclose(outputs["normal"][inside], torch.tensor([0.5, 0.5, 1.0]).expand(24, 24, 3), atol=1e-3)
    assert torch.allclose(outputs["surface_normal"][inside], torch.tensor([0.5, 0.5, 1.0]).expand(24, 24, 3), atol=0.05)
    assert torch.allclose(outputs["depth"][inside], torch.full((24, 24, 1), 3.0), atol=0.02)


def test_only_one_camera_is_drawn_at_a_time() -> None:
    model = make_model().eval()
    with pytest.raises(ValueError, match="2 cameras"):
        model.get_outputs(Cameras(torch.eye(4)[None, :3].repeat(2, 1, 1), 20.0, 20.0, 8.0, 8.0, 16, 16))
    with pytest.raises(ValueError, match="NoneType"):
        model.get_outputs(None)


@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2])
def test_unknown_pixels_have_no_influence(ssim_lambda: float) -> None:
    model = make_model(ssim_lambda=ssim_lambda, background_color="black").train()
    model.step_cb(make_optimizers(model), 1)
    batch = make_batch()
    mask = torch.ones(SIZE, SIZE, 1, dtype=torch.bool)
    mask[:, :14] = False
    other = {"image": torch.where(mask, batch["image"], 255 - batch["image"])}
    gradients = []
    for image in (batch, other):
        loss = model.get_loss_dict(model(camera()), image | {"mask": mask})["main_loss"]
        gradients.append(torch.autograd.grad(loss, model.features_dc)[0])
    assert torch.equal(gradients[0], gradients[1]) and gradients[0].abs().sum() > 0


def test_a_masked_mean_divides_by_the_known_pixels() -> None:
    model = make_model(ssim_lambda=0.0).train()
    outputs = {"rgb": torch.zeros(SIZE, SIZE, 3), "background": torch.zeros(3)}
    image = torch.zeros(SIZE, SIZE, 3)
    image[:, :8] = 0.5
    mask = torch.zeros(SIZE, SIZE, 1)
    mask[:, :8] = 1.0
    loss = model.get_loss_dict(outputs, {"image": image, "mask": mask})["main_loss"]
    assert loss == pytest.approx(0.5), "all known pixels are wrong by one half"
    nothing = model.get_loss_dict(outputs, {"image": image, "mask": torch.zeros_like(mask)})["main_loss"]
    assert nothing == 0.0
    metrics = model.get_metrics_dict(outputs, {"image": image, "mask": mask})
    assert metrics["psnr"] == pytest.approx(-10 * math.log10(0.25)) and metrics["gaussian_count"] == 60


def test_view_weight_multiplies_the_loss() -> None:
    model = make_model(normal_loss_from=0, background_color="black").train()
    model.step_cb(make_optimizers(model), 1)
    outputs = model(camera())
    batch = make_batch()
    plain = model.get_loss_dict(outputs, batch)
    weighted = model.get_loss_dict(outputs, batch | {"view_weight": 0.25})
    for name in ("main_loss", "normal_alignment", "normal_tv"):
        assert weighted[name].item() == pytest.approx(0.25 * plain[name].item(), rel=1e-5)
    assert model.get_loss_dict(outputs, batch | {"view_weight": 0.0})["main_loss"] == 0


def test_a_view_beside_adds_its_losses_and_its_screen_gradients() -> None:
    """To the bit what two renders and one backward pass give; without it nothing changes."""
    other = make_batch() | {"view_weight": 0.5}
    gradients, counted = [], []
    for beside in (True, False):
        model = make_model(background_color="black").train()
        optimizers = make_optimizers(model)
        model.step_cb(optimizers, 1)
        batch = make_batch()
        losses = model.get_loss_dict(model(camera()), batch | ({"beside": (camera(), other)} if beside else {}))
        if beside:
            first = dict(model.info)
            assert losses["beside_main_loss"].item() == pytest.approx(0.5 * losses["main_loss"].item())
            assert {name for name in losses if name.startswith("beside")} == {"beside_main_loss"}
            total = losses["main_loss"] + losses["beside_main_loss"]
            total.backward()
            assert model.info_beside is not None and model.info["means2d"] is first["means2d"]
        else:
            assert model.info_beside is None
            (1.5 * losses["main_loss"]).backward()
        gradients.append(model.gauss_params["means"].grad.clone())
        model.step_post_backward(1)
        assert model.info_beside is None
        counted.append(model.strategy_state["count"].clone())
    assert torch.allclose(gradients[0], gradients[1], rtol=1e-4, atol=1e-8)
    assert torch.equal(counted[0], 2 * counted[1]) and int(counted[1].sum()) > 0


def test_a_mask_of_another_size_is_refused() -> None:
    model = make_model().eval()
    with pytest.raises(ValueError, match="mask"):
        model.get_loss_dict(
            model.get_outputs_for_camera(camera()), make_batch() | {"mask": torch.ones(SIZE, SIZE + 1, 1)}
        )


def test_normals_are_rendered_only_when_a_loss_needs_them() -> None:
    model = make_model(normal_loss_from=5).train()
    optimizers = make_optimizers(model)
    model.step_cb(optimizers, 4)
    assert set(model(camera())) == {"rgb", "accumulation", "background"}
    model.step_cb(optimizers, 5)
    outputs = model(camera())
    assert {"normal", "surface_normal", "depth"} <= set(outputs)
    assert {"normal_alignment", "normal_tv"} <= set(model.get_loss_dict(outputs, make_batch()))
    model.config.normal_alignment_weight = model.config.normal_tv_weight = 0.0
    assert "normal" not in model(camera())


def test_normal_losses_begin_at_their_step_with_the_papers_weights() -> None:
    """lambda_align is 0.01 (appendix of the paper); before the step neither loss is there, and from it on they are
    weight times term.
    """
    model = make_model(normal_loss_from=5).train()
    optimizers, batch = make_optimizers(model), make_batch()
    for step, begins in ((4, False), (5, True), (6, True)):
        model.step_cb(optimizers, step)
        outputs = model(camera())
        losses = model.get_loss_dict(outputs, batch)
        assert ("normal_alignment" in losses, "normal_tv" in losses) == (begins, begins), step
    rendered, surface = (normals_of_picture(outputs[name]) for name in ("normal", "surface_normal"))
    assert float(losses["normal_alignment"]) == pytest.approx(0.01 * float(alignment_loss(rendered, surface)))
    assert float(losses["normal_tv"]) == pytest.approx(0.001 * float(total_variation(outputs["normal"])))
    assert float(losses["normal_alignment"]) > 0 and float(losses["normal_tv"]) > 0


def test_normal_losses_train_without_nan() -> None:
    model = make_model(normal_loss_from=0, normal_alignment="absolute", normal_alignment_weight=0.1)
    optimizers = make_optimizers(model)
    for step in range(1, 4):
        train_step(model, optimizers, step)
    assert all(values.isfinite().all() for values in model.gauss_params.values())


def test_evaluation_metrics(monkeypatch: pytest.MonkeyPatch, tmp_path, caplog: pytest.LogCaptureFixture) -> None:
    """Without weights in the torch cache LPIPS is left out, with one message for many images and no download."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", lambda *a, **k: pytest.fail("tried to download"))
    model = make_model().eval()
    outputs = model.get_outputs_for_camera(camera())
    same = {"image": outputs["rgb"]}
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            metrics, images = model.get_image_metrics_and_images(outputs, same)
    assert len([record for record in caplog.records if "LPIPS" in record.message]) == 1
    assert set(metrics) == {"psnr", "ssim"} and metrics["psnr"] > 100 and metrics["ssim"] == pytest.approx(1.0)
    assert images["img"].shape == (SIZE, 2 * SIZE, 3)
    model.config.color_corrected_metrics = True
    assert "cc_psnr" in model.get_image_metrics_and_images(outputs, same)[0]


def test_lpips_is_used_where_it_can_be_had() -> None:
    class Distance(torch.nn.Module):
        def forward(self, first, second):
            assert first.shape == (1, 3, SIZE, SIZE)
            return (first - second).abs().mean()

        def reset(self) -> None: ...

    lpips = LazyLpips()
    lpips._metric = Distance()
    assert lpips(torch.zeros(SIZE, SIZE, 3), torch.full((SIZE, SIZE, 3), 0.25)) == 0.25
    assert lpips(torch.zeros(8, 8, 3), torch.zeros(8, 8, 3)) is None, "too small for AlexNet"


@pytest.mark.parametrize("ramp", ["cosine", "linear"])
def test_schedule_equals_nerfstudios_in_floats(ramp: str) -> None:
    options = {"lr_final": 1e-6, "max_steps": 50, "warmup_steps": 7, "lr_pre_warmup": 1e-8, "ramp": ramp}
    rates: list[list[float]] = []
    for config in (FloatExponentialDecaySchedulerConfig(**options), ExponentialDecaySchedulerConfig(**options)):
        optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=1e-3)
        scheduler = config.setup().get_scheduler(optimizer, lr_init=1e-3)
        rates.append([])
        for _ in range(60):
            rates[-1].append(scheduler.get_last_lr()[0])
            optimizer.step()
            scheduler.step()
    assert all(type(rate) is float for rate in rates[0])
    assert rates[0] == pytest.approx([float(rate) for rate in rates[1]], rel=1e-9)
