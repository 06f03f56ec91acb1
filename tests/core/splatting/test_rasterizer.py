"""The torch rasterizer: laws, a closed form, what gsplat's strategies need, errors."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from helpers.scenes.rasterizer_scenes import INPUTS, backward, relative, scene, with_gradients
from torch import Tensor
from twins.dense_rasterizer import covariance

from fb_core.splatting import rasterizer as torch_rasterizer
from fb_core.splatting.rasterizer import rasterization
from fb_core.splatting.single_thread import single_thread
from fb_core.splatting.tiles.compositing import CompositingSettings


# ---------------------------------------------------------------------------------------------------------------------
# laws
def test_block_and_list_budgets_do_not_change_the_result(monkeypatch):
    inputs = scene(n=120, cameras=2)
    inputs["opacities"][:40] = 0.995
    inputs["scales"][:40] *= 2.5

    def draw() -> tuple[Tensor, ...]:
        leaves = with_gradients(inputs)
        images, alphas, meta = rasterization(**leaves, absgrad=True, render_mode="RGB+ED")
        backward(images, alphas)
        return (images, alphas, meta["means2d"].absgrad, *(leaves[name].grad for name in INPUTS))

    whole = draw()
    for pairs, rows, kept in ((2000, 100, 2000), (2**15, 400, 0)):
        small = partial(CompositingSettings, pairs_per_block=pairs, rows_per_list=rows, kept_pairs=kept)
        monkeypatch.setattr(torch_rasterizer, "CompositingSettings", small)
        for got, expected in zip(draw(), whole, strict=True):
            assert relative(got, expected) < 1e-10


@pytest.mark.parametrize("rows", [100, 2**20])
def test_a_second_backward_gives_the_same_gradients(monkeypatch, rows: int):
    """Backward uses what forward kept, lists of one slab or of the last of many, and must leave it as it was."""
    monkeypatch.setattr(torch_rasterizer, "CompositingSettings", partial(CompositingSettings, rows_per_list=rows))
    leaves = with_gradients(scene(n=60))
    images, alphas, _ = rasterization(**leaves)
    loss = images.square().sum() + alphas.sum()
    first, second = (torch.autograd.grad(loss, [leaves[name] for name in INPUTS], retain_graph=True) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_order_of_gaussians_does_not_matter():
    inputs = scene(n=50)
    shuffled = dict(inputs)
    order = torch.randperm(50)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        shuffled[name] = inputs[name][order]
    assert (rasterization(**inputs)[0] - rasterization(**shuffled)[0]).abs().max() < 1e-12


def test_moving_world_and_camera_together_changes_nothing():
    inputs = scene()
    covars = covariance(inputs["quats"], inputs["scales"])
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.4, 0.3], [0.4, 0, 0.9], [-0.3, -0.9, 0]], dtype=torch.float64))
    shift = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, shift
    moved = {
        **inputs,
        "means": inputs["means"] @ turn.T + shift,
        "viewmats": inputs["viewmats"] @ torch.linalg.inv(pose),
    }
    before, after = rasterization(**inputs, covars=covars)[0], rasterization(**moved, covars=turn @ covars @ turn.T)[0]
    assert (before - after).abs().max() < 1e-10


def test_length_and_sign_of_quaternions_do_not_matter():
    inputs = scene()
    scaled = {**inputs, "quats": inputs["quats"] * torch.linspace(-5, 7, 40, dtype=torch.float64)[:, None]}
    assert (rasterization(**inputs)[0] - rasterization(**scaled)[0]).abs().max() < 1e-12


def test_pictures_are_linear_in_the_colors_and_alpha_is_the_picture_of_ones():
    inputs = scene()
    other = torch.rand_like(inputs["colors"])
    images, alphas, _ = rasterization(**inputs)
    mixed = rasterization(**{**inputs, "colors": 2 * inputs["colors"] - 3 * other})[0]
    assert (mixed - (2 * images - 3 * rasterization(**{**inputs, "colors": other})[0])).abs().max() < 1e-12
    ones = rasterization(**{**inputs, "colors": torch.ones_like(inputs["colors"])})[0]
    assert (ones - alphas).abs().max() < 1e-12


def test_cameras_do_not_disturb_each_other():
    inputs = scene(cameras=3)
    together = rasterization(**inputs)[0]
    for k in range(3):
        alone = rasterization(**{**inputs, "viewmats": inputs["viewmats"][k : k + 1], "Ks": inputs["Ks"][k : k + 1]})[0]
        assert torch.equal(alone[0], together[k]) or (alone[0] - together[k]).abs().max() < 1e-13


def test_covariances_give_what_quaternions_and_scales_give():
    inputs = scene()
    covars = covariance(inputs["quats"], inputs["scales"])
    from_covars = rasterization(**{**inputs, "quats": None, "scales": None}, covars=covars)[0]
    assert (rasterization(**inputs)[0] - from_covars).abs().max() < 1e-12


def test_one_gaussian_in_closed_form():
    """On the optical axis with isotropic scale s at depth z: covariance (f s / z)^2 + 0.3, alpha = o exp(-d^2 / 2
    cov).
    """
    f, z, s, o, color = 40.0, 2.0, 0.1, 0.8, torch.tensor([[0.2, 0.5, 0.9]], dtype=torch.float64)
    images, alphas, meta = rasterization(
        means=torch.tensor([[0.0, 0.0, z]], dtype=torch.float64),
        quats=torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64),
        scales=torch.full((1, 3), s, dtype=torch.float64),
        opacities=torch.tensor([o], dtype=torch.float64),
        colors=color,
        viewmats=torch.eye(4, dtype=torch.float64)[None],
        Ks=torch.tensor([[[f, 0, 8.0], [0, f, 8.0], [0, 0, 1]]], dtype=torch.float64),
        width=16,
        height=16,
        render_mode="RGB+ED",
    )
    variance = (f * s / z) ** 2 + 0.3
    offsets = torch.arange(16, dtype=torch.float64) + 0.5 - 8.0
    squared = offsets[:, None] ** 2 + offsets[None] ** 2
    expected = o * torch.exp(-0.5 * squared / variance)
    expected = torch.where(expected >= 1 / 255, expected, 0.0)
    assert (alphas[0, ..., 0] - expected).abs().max() < 1e-12
    assert (images[0, ..., :3] - expected[..., None] * color).abs().max() < 1e-12
    assert (images[0, ..., 3] - z * (expected > 0)).abs().max() < 1e-12
    assert meta["means2d"][0, 0].tolist() == [8.0, 8.0]
    assert meta["radii"][0, 0] == math.ceil(3 * math.sqrt(variance + math.sqrt(0.01)))


# ------------------------------------------------------------------------------------------------------ meta, modes of
# use
@pytest.mark.parametrize("absgrad", [False, True])
def test_meta_satisfies_default_strategy(absgrad: bool):
    from gsplat.strategy import DefaultStrategy

    inputs = scene(n=200, width=64, height=48, dtype=torch.float32)
    params = {
        "means": inputs["means"],
        "quats": inputs["quats"],
        "scales": inputs["scales"].log(),
        "opacities": torch.logit(inputs["opacities"]),
        "colors": inputs["colors"],
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(value) for name, value in params.items()})
    optimizers = {name: torch.optim.Adam([value], lr=1e-3) for name, value in params.items()}
    strategy = DefaultStrategy(absgrad=absgrad, refine_start_iter=0, refine_every=2, grow_grad2d=1e-6, verbose=False)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    for step in range(1, 4):
        images, alphas, meta = rasterization(
            means=params["means"],
            quats=params["quats"],
            scales=params["scales"].exp(),
            opacities=params["opacities"].sigmoid(),
            colors=params["colors"],
            viewmats=inputs["viewmats"],
            Ks=inputs["Ks"],
            width=64,
            height=48,
            absgrad=absgrad,
        )
        strategy.step_pre_backward(params, optimizers, state, step, meta)
        backward(images, alphas)
        strategy.step_post_backward(params, optimizers, state, step, meta, packed=False)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
    assert len(params["means"]) > 200


def test_without_gradients_nothing_is_kept():
    inputs = with_gradients(scene())
    with torch.no_grad():
        images, alphas, meta = rasterization(**inputs)
    assert images.grad_fn is None and alphas.grad_fn is None and not meta["means2d"].requires_grad
    assert (images - rasterization(**inputs)[0]).abs().max() == 0


def test_gradients_of_a_part_of_the_inputs():
    full, part = with_gradients(scene()), with_gradients(scene(), names=("colors", "viewmats"))
    for inputs in (full, part):
        backward(*rasterization(**inputs)[:2])
    assert torch.equal(full["colors"].grad, part["colors"].grad)
    assert torch.equal(full["viewmats"].grad, part["viewmats"].grad)
    assert part["means"].grad is None


def test_the_number_of_threads_is_given_back():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        inputs = with_gradients(scene())
        backward(*rasterization(**inputs)[:2])
        assert torch.get_num_threads() == 2
        with pytest.raises(KeyError), single_thread():
            assert torch.get_num_threads() == 1
            raise KeyError
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# -------------------------------------------------------------------------------------------------------------------
# errors
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(means=torch.zeros(40, 2, dtype=torch.float64)), "means should be"),
        (dict(means=torch.zeros(40, 3, dtype=torch.float16)), "means should be"),
        (dict(quats=torch.zeros(39, 4, dtype=torch.float64)), "quats should have shape"),
        (dict(quats=None), "quats and scales are needed"),
        (dict(scales=torch.zeros(40, 3, dtype=torch.float32)), "scales is torch.float32"),
        (dict(opacities=torch.zeros(40, 1, dtype=torch.float64)), "opacities should have shape"),
        (dict(colors=torch.zeros(41, 3, dtype=torch.float64)), "colors should have shape"),
        (dict(viewmats=torch.zeros(1, 3, 4, dtype=torch.float64)), "viewmats should have shape"),
        (dict(Ks=torch.zeros(2, 3, 3, dtype=torch.float64)), "Ks should have shape"),
        (dict(backgrounds=torch.zeros(1, 4, dtype=torch.float64)), "backgrounds should have shape"),
        (dict(covars=torch.zeros(40, 6, dtype=torch.float64)), "covars should have shape"),
        (dict(render_mode="depth"), "render_mode should be"),
        (dict(rasterize_mode="sharp"), "rasterize_mode should be"),
        (dict(semantics="2.0"), "semantics should be"),
        (dict(packed=True), "packed=True is not offered"),
        (dict(tile_size=10), "tile_size should be"),
        (dict(width=0), "width and height should be"),
        (dict(sh_degree=5, colors=torch.zeros(40, 36, 3, dtype=torch.float64)), "sh_degree should be"),
        (dict(sh_degree=2, colors=torch.zeros(40, 4, 3, dtype=torch.float64)), "colors should hold at least 9"),
    ],
)
def test_bad_arguments_say_what_is_wrong(change: dict, message: str):
    with pytest.raises(ValueError, match=message):
        rasterization(**{**scene(), **change})
