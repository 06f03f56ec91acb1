"""The torch rasterizer against gsplat's golden pictures and gradients, against its dense twin, and against finite
differences.
"""

from __future__ import annotations

import pytest
import torch
from helpers.scenes.rasterizer_scenes import INPUTS, backward, relative, scene, with_gradients
from torch import Tensor
from twins.dense_rasterizer import covariance, dense_view, spherical_harmonics

from fb_core.splatting.rasterizer import rasterization
from fb_core.splatting.spherical_harmonics import basis

GOLDENS = {"basic": (5e-6, 1e-5), "sh3_aa_bg_ed_2cam": (5e-6, 1e-5), "stress_5ch": (1e-3, 2e-3)}


# ------------------------------------------------------------------------------------------------------------------
# goldens
@pytest.mark.parametrize("semantics", ["1.4", "1.5", "1.6"])
@pytest.mark.parametrize("name", GOLDENS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("engine", ["torch", "compiled"])
def test_golden_pictures_and_gradients(
    shared_path, request: pytest.FixtureRequest, name: str, semantics: str, dtype: torch.dtype, engine: str
):
    if engine == "compiled":
        request.getfixturevalue("compiled_library")
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
        engine=engine,
    )
    meta["means2d"].retain_grad()
    weights = {key: value.to(dtype) for key, value in golden["loss_weights"].items()}
    ((images * weights["render"]).sum() + (alphas * weights["alpha"]).sum()).backward()
    assert (images - expected["render"]).abs().max() <= image_tolerance
    assert (alphas - expected["alpha"]).abs().max() <= image_tolerance
    radii = meta["radii"] if semantics != "1.4" else meta["radii"][..., None].expand(-1, -1, 2)
    assert torch.equal(radii, expected["radii"])
    errors = {
        key: relative(inputs[key].grad, value) for key, value in expected["grads"].items() if key != "backgrounds"
    }
    errors["means2d"] = relative(meta["means2d"].grad, expected["means2d_grad"])
    errors["absgrad"] = relative(meta["means2d"].absgrad, expected["absgrad"])
    if backgrounds is not None:
        errors["backgrounds"] = relative(backgrounds.grad, expected["grads"]["backgrounds"])
    assert max(errors.values()) <= gradient_tolerance, errors


# --------------------------------------------------------------------------------------------------------------- dense
# twin
def check_against_twin(
    inputs: dict, covars: Tensor | None = None, values=None, backgrounds=None, mode: str = "RGB", **options
) -> None:
    """Pictures, gradients of every input, means2d gradients and absgrad against `dense_view`, camera by camera."""
    fast, slow = with_gradients(inputs), with_gradients(inputs)
    fast_covars, slow_covars = (
        (None, None) if covars is None else (covars.clone().requires_grad_(), covars.clone().requires_grad_())
    )
    images, alphas, meta = rasterization(
        **fast, covars=fast_covars, absgrad=True, backgrounds=backgrounds, render_mode=mode, **options
    )
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


@pytest.mark.parametrize("seed", range(8))
def test_no_pixel_is_missed_by_the_cell_lists(seed: int):
    """Scales from 3e-4 to 30 (needles, plates, giants), faint ones too, at odd image sizes: the lists may drop nothing
    visible.
    """
    g = torch.Generator().manual_seed(seed)
    width, height = (int(torch.randint(1, 70, (1,), generator=g)) for _ in range(2))
    inputs = scene(n=30, seed=seed, width=width, height=height)
    inputs["scales"] = 10 ** (5 * torch.rand(30, 3, generator=g, dtype=torch.float64) - 3.5)
    if seed % 3 == 0:
        inputs["opacities"] *= 0.03
    covars = covariance(inputs["quats"], inputs["scales"])
    for semantics in ("1.4", "1.6"):
        images = rasterization(**inputs, semantics=semantics)[0]
        values = [inputs[name] for name in ("opacities", "colors")]
        camera = (inputs["viewmats"][0], inputs["Ks"][0])
        expected = dense_view(inputs["means"], covars, *values, *camera, width, height, semantics=semantics)
        assert (images[0] - expected.image).abs().max() < 1e-9


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
        images, alphas, _ = rasterization(
            **{**inputs, **named}, eps2d=60.0, render_mode="RGB+D", rasterize_mode="antialiased"
        )
        return images, alphas

    assert torch.autograd.gradcheck(draw, [inputs[name].requires_grad_() for name in INPUTS], atol=1e-6, rtol=1e-4)
