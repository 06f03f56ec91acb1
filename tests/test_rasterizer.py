"""The torch rasterizer: gsplat's golden pictures and gradients, its dense twin, laws, closed forms, meta, errors."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from dense_rasterizer import covariance, dense_view, spherical_harmonics
from torch import Tensor

from fb_nerfstudio import torch_rasterizer
from fb_nerfstudio.single_thread import single_thread
from fb_nerfstudio.torch_compositing import CompositingSettings
from fb_nerfstudio.torch_rasterizer import rasterization
from fb_nerfstudio.torch_spherical_harmonics import basis

GOLDENS = {"basic": (5e-6, 1e-5), "sh3_aa_bg_ed_2cam": (5e-6, 1e-5), "stress_5ch": (1e-3, 2e-3)}
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def look_at(eye: tuple[float, float, float], target=(0.0, 0.0, 0.0), dtype=torch.float64) -> Tensor:
    """World to camera, OpenCV axes, world z up."""
    eye, target = torch.tensor(eye, dtype=dtype), torch.tensor(target, dtype=dtype)
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=dtype)), dim=0)
    viewmat = torch.eye(4, dtype=dtype)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


def scene(n: int = 40, cameras: int = 1, width: int = 37, height: int = 29, channels: int = 3, seed: int = 0, dtype=torch.float64) -> dict:
    """A cloud around the origin seen from a ring, with an off-centre principal point."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=dtype)

    eyes = [(3.0 * math.cos(0.8 * k), 3.0 * math.sin(0.8 * k), 0.7 - 0.2 * k) for k in range(cameras)]
    K = torch.tensor([[1.1 * width, 0, 0.47 * width], [0, 1.2 * width, 0.55 * height], [0, 0, 1]], dtype=dtype)
    return dict(
        means=0.7 * normal(n, 3),
        quats=normal(n, 4),
        scales=0.15 * torch.exp(0.6 * normal(n, 3)),
        opacities=torch.sigmoid(1.5 * normal(n)),
        colors=torch.rand(n, channels, generator=g, dtype=dtype),
        viewmats=torch.stack([look_at(eye, dtype=dtype) for eye in eyes]),
        Ks=K.expand(cameras, 3, 3).contiguous(),
        width=width,
        height=height,
    )


def with_gradients(inputs: dict, names=INPUTS) -> dict:
    return {name: value.detach().clone().requires_grad_() if name in names else value for name, value in inputs.items()}


def relative(got: Tensor, expected: Tensor) -> float:
    got, expected = got.detach().double(), expected.detach().double()
    return float((got - expected).norm() / expected.norm().clamp(min=1e-12))


def backward(images: Tensor, alphas: Tensor, seed: int = 1) -> None:
    g = torch.Generator().manual_seed(seed)
    weights = [torch.randn(t.shape, generator=g, dtype=torch.float64).to(t.dtype) for t in (images, alphas)]
    ((images * weights[0]).sum() + (alphas * weights[1]).sum()).backward()


# ------------------------------------------------------------------------------------------------------------------ goldens
@pytest.mark.parametrize("semantics", ["1.4", "1.5", "1.6"])
@pytest.mark.parametrize("name", GOLDENS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
def test_golden_pictures_and_gradients(shared_path, name: str, semantics: str, dtype: torch.dtype):
    golden = torch.load(shared_path(f"golden/splat/{name}.pt"), weights_only=True)
    image_tolerance, gradient_tolerance = GOLDENS[name] if dtype == torch.float32 else (1e-10, 1e-6)
    expected, args = golden["variants"][semantics], golden["args"]
    inputs = {key: value.to(dtype) if torch.is_tensor(value) else value for key, value in golden["inputs"].items()}
    inputs = with_gradients(inputs)
    backgrounds = None if args["backgrounds"] is None else args["backgrounds"].to(dtype).requires_grad_()
    images, alphas, meta = rasterization(
        **inputs,
        sh_degree=args["sh_degree"],
        render_mode=args["render_mode"],
        backgrounds=backgrounds,
        rasterize_mode="antialiased" if args["antialiased"] else "classic",
        absgrad=True,
        semantics=semantics,
    )
    meta["means2d"].retain_grad()
    weights = {key: value.to(dtype) for key, value in golden["loss_weights"].items()}
    ((images * weights["render"]).sum() + (alphas * weights["alpha"]).sum()).backward()
    assert (images - expected["render"]).abs().max() <= image_tolerance
    assert (alphas - expected["alpha"]).abs().max() <= image_tolerance
    radii = meta["radii"] if semantics != "1.4" else meta["radii"][..., None].expand(-1, -1, 2)
    assert torch.equal(radii, expected["radii"])
    errors = {key: relative(inputs[key].grad, value) for key, value in expected["grads"].items() if key != "backgrounds"}
    errors["means2d"] = relative(meta["means2d"].grad, expected["means2d_grad"])
    errors["absgrad"] = relative(meta["means2d"].absgrad, expected["absgrad"])
    if backgrounds is not None:
        errors["backgrounds"] = relative(backgrounds.grad, expected["grads"]["backgrounds"])
    assert max(errors.values()) <= gradient_tolerance, errors


# --------------------------------------------------------------------------------------------------------------- dense twin
def check_against_twin(inputs: dict, covars: Tensor | None = None, values=None, backgrounds=None, mode: str = "RGB", **options) -> None:
    """Pictures, gradients of every input, means2d gradients and absgrad against `dense_view`, camera by camera."""
    fast, slow = with_gradients(inputs), with_gradients(inputs)
    fast_covars, slow_covars = (None, None) if covars is None else (covars.clone().requires_grad_(), covars.clone().requires_grad_())
    images, alphas, meta = rasterization(**fast, covars=fast_covars, absgrad=True, backgrounds=backgrounds, render_mode=mode, **options)
    meta["means2d"].retain_grad()
    antialiased = options.pop("rasterize_mode", "classic") == "antialiased"
    # gsplat bounds the slope of the compensation's root by adding 1e-6 to it, and so do we; plain autograd does not.
    tolerance = 1e-5 if antialiased else 1e-9
    options.pop("sh_degree", None)
    views = []
    for k, (viewmat, K) in enumerate(zip(slow["viewmats"], slow["Ks"], strict=True)):
        colors = slow["colors"][k] if values is None and slow["colors"].ndim == 3 else slow["colors"]
        colors = values(slow["means"], slow["colors"], viewmat) if values is not None else colors
        colors = colors[:, :0] if mode in ("D", "ED") else colors
        view = dense_view(
            slow["means"],
            covariance(slow["quats"], slow["scales"]) if covars is None else slow_covars,
            slow["opacities"],
            colors,
            viewmat,
            K,
            slow["width"],
            slow["height"],
            antialiased=antialiased,
            with_depth="D" in mode,
            **options,
        )
        views.append(view)
    slow_alphas = torch.stack([view.alpha for view in views])
    slow_images = torch.stack([view.image for view in views])
    if mode.endswith("ED"):
        slow_images = torch.cat([slow_images[..., :-1], slow_images[..., -1:] / slow_alphas.clamp(min=1e-10)], dim=-1)
    if backgrounds is not None:
        behind = torch.nn.functional.pad(backgrounds, (0, slow_images.shape[-1] - backgrounds.shape[-1]))
        slow_images = slow_images + (1 - slow_alphas) * behind[:, None, None]
    backward(images, alphas)
    backward(slow_images, slow_alphas)
    assert (images - slow_images).abs().max() < 1e-9
    assert (alphas - slow_alphas).abs().max() < 1e-9
    for name in INPUTS:
        if fast[name].grad is None or slow[name].grad is None:  # quats and scales where covars is given
            assert slow[name].grad is None or float(slow[name].grad.norm()) == 0
        else:
            assert relative(fast[name].grad, slow[name].grad) < tolerance, name
    if covars is not None:
        assert relative(fast_covars.grad, slow_covars.grad) < tolerance
    for k, view in enumerate(views):
        expected = torch.zeros_like(view.means2d).index_copy(0, view.order, view.means2d_by_pixel.grad.abs().sum(dim=0))
        assert relative(meta["means2d"].absgrad[k], expected) < 1e-9
        assert relative(meta["means2d"].grad[k], view.means2d.grad) < 1e-9


@pytest.mark.parametrize("semantics", ["1.4", "1.5", "1.6"])
def test_twin_agrees_in_every_semantics(semantics: str):
    inputs = scene(n=60)
    inputs["opacities"][:12] = 0.9999  # the cap and the stop
    inputs["scales"][:12] *= 3
    check_against_twin(inputs, semantics=semantics)


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_twin_agrees_in_every_render_mode_with_background(mode: str):
    backgrounds = None if mode in ("D", "ED") else torch.rand(2, 3, dtype=torch.float64)
    check_against_twin(scene(cameras=2), backgrounds=backgrounds, mode=mode)


@pytest.mark.parametrize("semantics", ["1.4", "1.6"])
def test_twin_agrees_antialiased(semantics: str):
    inputs = scene()
    inputs["scales"] *= 0.2
    check_against_twin(inputs, rasterize_mode="antialiased", semantics=semantics)


@pytest.mark.parametrize("antialiased", [False, True])
def test_twin_agrees_with_covariances(antialiased: bool):
    inputs = scene()
    covars = covariance(inputs["quats"], inputs["scales"])
    check_against_twin(inputs, covars=covars, rasterize_mode="antialiased" if antialiased else "classic")


def test_twin_agrees_with_colors_of_each_camera_and_many_channels():
    inputs = scene(cameras=3, channels=40)
    inputs["colors"] = torch.rand(3, 40, 40, dtype=torch.float64)
    check_against_twin(inputs)


@pytest.mark.parametrize(
    "options",
    [
        dict(near_plane=2.8),
        dict(far_plane=3.2),
        dict(radius_clip=6.0),
        dict(eps2d=1.1),
        dict(tile_size=4),
        dict(tile_size=12),
        dict(tile_size=32),
    ],
)
def test_twin_agrees_with_options(options: dict):
    check_against_twin(scene(), **options)


@pytest.mark.parametrize("degree", range(5))
def test_twin_agrees_with_spherical_harmonics(degree: int):
    inputs = scene(n=25, cameras=2)
    inputs["colors"] = 0.4 * torch.randn(25, 27, 3, dtype=torch.float64)

    def values(means: Tensor, coefficients: Tensor, viewmat: Tensor) -> Tensor:
        directions = torch.nn.functional.normalize(means - torch.linalg.inv(viewmat)[:3, 3], dim=-1)
        weights = basis(degree, directions)  # itself checked against Legendre functions below
        return ((weights[..., None] * coefficients[:, : weights.shape[1]]).sum(dim=1) + 0.5).clamp(min=0)

    check_against_twin(inputs, values=values, sh_degree=degree)


def test_spherical_harmonics_are_legendre_functions():
    directions = torch.nn.functional.normalize(torch.randn(200, 3, dtype=torch.float64), dim=-1)
    expected = torch.from_numpy(spherical_harmonics(4, directions.numpy()))
    assert (basis(4, directions) - expected).abs().max() < 1e-7


def test_gradcheck_in_double():
    inputs = scene(n=3, width=3, height=2)
    inputs["opacities"] = torch.tensor([0.3, 0.6, 0.9], dtype=torch.float64)

    def draw(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        named = dict(zip(INPUTS, tensors, strict=True))
        # alpha jumps at 1/255, where finite differences mean nothing: a wide blur keeps every pixel of the image inside
        images, alphas, _ = rasterization(**{**inputs, **named}, eps2d=60.0, render_mode="RGB+D", rasterize_mode="antialiased")
        return images, alphas

    assert torch.autograd.gradcheck(draw, [inputs[name].requires_grad_() for name in INPUTS], atol=1e-6, rtol=1e-4)


# --------------------------------------------------------------------------------------------------------------------- laws
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
    for pairs, rows in ((64, 100), (3000, 10**6), (2**15, 200)):
        small = partial(CompositingSettings, pairs_per_block=pairs, rows_per_list=rows)
        monkeypatch.setattr(torch_rasterizer, "CompositingSettings", small)
        for got, expected in zip(draw(), whole, strict=True):
            assert relative(got, expected) < 1e-10


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
    moved = {**inputs, "means": inputs["means"] @ turn.T + shift, "viewmats": inputs["viewmats"] @ torch.linalg.inv(pose)}
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
    """On the optical axis with isotropic scale s at depth z: covariance (f s / z)^2 + 0.3, alpha = o exp(-d^2 / 2 cov)."""
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


# ------------------------------------------------------------------------------------------------------ meta, modes of use
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


# ------------------------------------------------------------------------------------------------------------------- errors
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
