"""A thousand draws of splats in every precision, layout and mode: finite and as the plain float32 call, or one clear
sentence.
"""

from __future__ import annotations

import contextlib
import math
import threading
from typing import Any

import pytest
import torch
from helpers.scenes.rasterizer_scenes import scene
from torch import Tensor

from fb_core.splatting.rasterizer import rasterization
from fb_nerfstudio.splats.strategies.mcmc import CappedMCMC, position_noise, shared_opacity_and_scale

LEAVES = ("means", "quats", "scales", "opacities", "colors")
DTYPES = (torch.float32, torch.float32, torch.float64, torch.float16, torch.bfloat16)
MODES = ("gradients", "gradients", "no_grad", "inference", "autocast bfloat16", "autocast float16")
LAYOUTS = ("plain", "transposed", "every second", "expanded")
DRAWS, PER_TEST = 1000, 100


class Dice:
    """Seeded choices."""

    def __init__(self, seed: int):
        self.generator = torch.Generator().manual_seed(seed)

    def of(self, choices: tuple | range) -> Any:
        return choices[int(torch.randint(len(choices), (), generator=self.generator))]

    def chance(self, share: float) -> bool:
        return float(torch.rand((), generator=self.generator)) < share


def laid_out(tensor: Tensor, layout: str) -> Tensor:
    """The same values in memory of another order."""
    if layout == "transposed" and tensor.ndim > 1:
        return tensor.transpose(0, -1).contiguous().transpose(0, -1)
    if layout == "every second":
        wide = torch.full((*tensor.shape, 2), math.nan, dtype=tensor.dtype)
        wide[..., 0] = tensor
        return wide[..., 0]
    if layout == "expanded" and len(tensor):
        return tensor[:1].expand_as(tensor)
    return tensor


def drawn(dice: Dice, seed: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Inputs in float32 and options of one call."""
    n, cameras = dice.of((0, 1, 2, 7, 24)), dice.of((0, 1, 1, 1, 2))
    width, height = dice.of(range(1, 24)), dice.of(range(1, 20))
    inputs = scene(n, max(cameras, 1), width, height, seed=seed, dtype=torch.float32)
    degree = dice.of((None, None, 0, 2, 4))
    options: dict[str, Any] = dict(
        render_mode=dice.of(("RGB", "D", "ED", "RGB+D", "RGB+ED")),
        rasterize_mode=dice.of(("classic", "antialiased")),
        semantics=dice.of(("1.4", "1.5", "1.6")),
        sh_degree=degree,
        absgrad=dice.chance(0.3),
    )
    if degree is not None:
        inputs["colors"] = torch.randn(n, 25, 3, generator=dice.generator)
    if not cameras:
        inputs.update(viewmats=inputs["viewmats"][:0], Ks=inputs["Ks"][:0])
    elif dice.chance(0.2):
        inputs["colors"] = inputs["colors"].expand(cameras, *inputs["colors"].shape).clone()
    if dice.chance(0.3) and options["render_mode"].startswith("RGB"):
        options["backgrounds"] = torch.rand(cameras, 3, generator=dice.generator)
    return inputs, options


def entered(mode: str) -> contextlib.AbstractContextManager:
    if mode == "no_grad":
        return torch.no_grad()
    if mode == "inference":
        return torch.inference_mode()
    if mode.startswith("autocast"):
        return torch.autocast("cpu", getattr(torch, mode.split()[1]))
    return contextlib.nullcontext()


def rendered(
    inputs: dict[str, Any], options: dict[str, Any], mode: str
) -> tuple[Tensor, Tensor, dict, dict[str, Tensor]]:
    """Picture, alpha, meta and gradients (none without autograd), all made inside the mode."""
    with entered(mode):
        learns = mode not in ("no_grad", "inference")
        given = {name: inputs[name].detach().requires_grad_(learns) for name in LEAVES}
        images, alphas, meta = rasterization(**{**inputs, **given}, **options)
        if images.requires_grad:
            (images.square().sum() + alphas.sum()).backward()
    gradients = {name: value.grad for name, value in given.items() if value.grad is not None}
    return images.detach(), alphas.detach(), meta, gradients


def in_a_thread(work):
    """The result of a call in a thread of its own, with what it raised."""
    caught: list[Any] = []

    def run() -> None:
        try:
            caught.append(work())
        except BaseException as error:  # handed on to the test
            caught.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    if isinstance(caught[0], BaseException):
        raise caught[0]
    return caught[0]


def close(got: Tensor, expected: Tensor, *, exact: bool) -> bool:
    """To the rounding of float32; across precisions a Gaussian at the edge of 1/255 may be drawn in one and not in the
    other.
    """
    assert got.shape == expected.shape
    if not got.numel():
        return True
    scale = max(1.0, float(expected.abs().max()))
    error = (got.double() - expected.double()).abs() / scale
    return float(error.max()) < 1e-5 if exact else float(error.median()) < 1e-4 and float(error.mean()) < 0.01


@pytest.mark.parametrize("first", range(0, DRAWS, PER_TEST))
def test_any_precision_layout_and_mode_draws_what_float32_draws(first: int) -> None:
    refused = 0
    for seed in range(first, first + PER_TEST):
        dice = Dice(seed)
        plain, options = drawn(dice, seed)
        dtype, mode, layout = dice.of(DTYPES), dice.of(MODES), dice.of(LAYOUTS)
        layouts = {name: layout if dice.chance(0.5) else "plain" for name in LEAVES}
        plain.update({name: laid_out(plain[name], layouts[name]).contiguous() for name in LEAVES})
        background = {} if "backgrounds" not in options else {"backgrounds": options["backgrounds"].to(dtype)}
        told = {name: value.to(dtype) if isinstance(value, Tensor) else value for name, value in plain.items()}
        told.update({name: laid_out(told[name], layouts[name]) for name in LEAVES})
        threads = torch.get_num_threads()
        torch.set_num_threads(dice.of((1, 2)))
        try:
            call = rendered if dice.chance(0.8) else lambda *args: in_a_thread(lambda: rendered(*args))
            if dtype.itemsize < 4:
                with pytest.raises(ValueError, match="float32 or float64"):
                    call(told, options | background, mode)
                refused += 1
                continue
            images, alphas, _, gradients = call(told, options | background, mode)
        finally:
            torch.set_num_threads(threads)
        wanted, wanted_alphas, _, wanted_gradients = rendered(plain, options, "gradients")
        what = (seed, dtype, mode, layouts, options)
        assert images.dtype == dtype and bool(images.isfinite().all() & alphas.isfinite().all()), what
        exact = dtype == torch.float32
        assert close(images, wanted, exact=exact) and close(alphas, wanted_alphas, exact=exact), what
        for name, gradient in gradients.items():
            assert bool(gradient.isfinite().all()), (name, *what)
            assert not exact or close(gradient, wanted_gradients[name], exact=True), (name, *what)
    assert 0 < refused < PER_TEST


@pytest.mark.parametrize("seed", range(100))
def test_one_broken_gaussian_is_left_out_and_costs_no_other_anything(seed: int) -> None:
    """The picture and the gradients of the others are those of the scene without it."""
    dice = Dice(10_000 + seed)
    plain, options = drawn(dice, seed)
    while len(plain["means"]) < 2 or not len(plain["viewmats"]):
        plain, options = drawn(dice, seed)
    options["render_mode"] = dice.of(("RGB", "RGB+D", "RGB+ED"))
    number = len(plain["means"])
    name, broken, bad = dice.of(LEAVES), dice.of(range(number)), dice.of((math.nan, math.inf, -math.inf))
    told = {key: value.clone() if isinstance(value, Tensor) else value for key, value in plain.items()}
    per_camera = told["colors"].ndim == (3 if options["sh_degree"] is None else 4)
    row = told[name].transpose(0, 1)[broken] if name == "colors" and per_camera else told[name][broken : broken + 1]
    row[(0,) * row.ndim] = bad
    keep = [index for index in range(number) if index != broken]
    without = {
        key: value[:, keep] if key == "colors" and per_camera else value[keep]
        for key, value in plain.items()
        if key in LEAVES
    }
    images, alphas, meta, gradients = rendered(told, options, "gradients")
    wanted, wanted_alphas, _, wanted_gradients = rendered({**plain, **without}, options, "gradients")
    assert meta["dropped"] == 1
    assert close(images, wanted, exact=True) and close(alphas, wanted_alphas, exact=True)
    for key, gradient in gradients.items():
        rows = gradient.transpose(0, 1) if key == "colors" and per_camera else gradient
        others = wanted_gradients[key].transpose(0, 1) if key == "colors" and per_camera else wanted_gradients[key]
        assert float(rows[broken].abs().sum()) == 0 and close(rows[keep], others, exact=True), key


def test_coefficients_that_take_no_part_may_hold_anything() -> None:
    inputs: dict[str, Any] = scene(7, dtype=torch.float32)
    inputs["colors"] = torch.randn(7, 25, 3)
    wanted = rasterization(**inputs, sh_degree=1)[0]
    inputs["colors"][:, 4:] = math.nan
    images, _, meta = rasterization(**inputs, sh_degree=1)
    assert torch.equal(images, wanted) and meta["dropped"] == 0
    assert (
        rasterization(**{**inputs, "colors": inputs["colors"] * math.nan}, sh_degree=1, render_mode="ED")[2]["dropped"]
        == 0
    )


def test_gaussians_of_millions_of_units_cover_the_picture() -> None:
    """Unturned ones, whose ellipses have no slant: zero times an overflow was no number, and no width of a strip."""
    inputs: dict[str, Any] = scene(6, dtype=torch.float32)
    inputs |= {"quats": torch.zeros(6, 4), "scales": inputs["scales"] * 1e8, "opacities": torch.full((6,), 0.4)}
    images, alphas, _, gradients = rendered(inputs, {"render_mode": "RGB"}, "gradients")
    drawn = int((rasterization(**inputs)[2]["radii"] > 0).sum())
    assert drawn >= 2 and torch.allclose(alphas, torch.full_like(alphas, 1 - 0.6**drawn), atol=1e-5)
    assert bool(images.isfinite().all()) and all(bool(gradient.isfinite().all()) for gradient in gradients.values())


@pytest.mark.parametrize("name", ["viewmats", "Ks", "backgrounds"])
def test_a_camera_that_is_not_finite_is_refused(name: str) -> None:
    inputs: dict[str, Any] = scene(7, dtype=torch.float32) | {"backgrounds": torch.zeros(1, 3)}
    inputs[name] = inputs[name] * math.nan
    with pytest.raises(ValueError, match=f"{name} should be finite"):
        rasterization(**inputs)


def test_a_lens_without_focal_length_is_refused() -> None:
    inputs: dict[str, Any] = scene(7, dtype=torch.float32)
    with pytest.raises(ValueError, match="focal lengths above 0"):
        rasterization(**{**inputs, "Ks": inputs["Ks"] * 0})


# ---------------------------------------------------------------------------------------------------------------- MCMC


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_mcmc_formulas_are_those_of_float32_in_any_precision(dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    opacities, log_scales, quats = (
        torch.rand(200, generator=generator),
        *(torch.randn(200, k, generator=generator) for k in (3, 4)),
    )
    opacities, log_scales, quats = (
        opacities.clamp(0.01, 0.99).to(dtype),
        (2 * log_scales - 4).to(dtype),
        quats.to(dtype),
    )
    copies = torch.randint(1, 9, (200,), generator=generator)
    tolerance = 4 * max(float(torch.finfo(dtype).eps), 1e-6)
    got = shared_opacity_and_scale(opacities, log_scales.exp(), copies)
    wanted = shared_opacity_and_scale(opacities.float(), log_scales.exp().float(), copies)
    for one, other in zip(got, wanted, strict=True):
        assert one.dtype == dtype and torch.allclose(one.float(), other, rtol=tolerance, atol=1e-6)
    if dtype != torch.float64:  # whose own draws are others
        noise = position_noise(quats, log_scales, opacities, 0.1, generator=torch.Generator().manual_seed(1))
        other = position_noise(
            quats.float(), log_scales.float(), opacities.float(), 0.1, generator=torch.Generator().manual_seed(1)
        )
        assert noise.dtype == dtype and torch.allclose(noise.float(), other, rtol=tolerance, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("autocast", [False, True])
def test_mcmc_trains_in_any_precision(dtype: torch.dtype, autocast: bool) -> None:
    """Opaque Gaussians (whose opacity rounds to 1) and tiny ones (whose scale rounds to 0) included."""
    generator = torch.Generator().manual_seed(0)
    widths = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "features_dc": 3}
    params = torch.nn.ParameterDict(
        {name: torch.randn(50, k, generator=generator).to(dtype) for name, k in widths.items()}
    )
    with torch.no_grad():
        params["opacities"][:5], params["opacities"][5:10], params["scales"][:3] = 20.0, -9.0, -19.0
    optimizers: dict[str, torch.optim.Optimizer] = {
        name: torch.optim.SGD([value], lr=1e-3, momentum=0.9) for name, value in params.items()
    }
    strategy = CappedMCMC(cap_max=80, refine_start_iter=0, refine_every=1, refine_stop_iter=100)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        for step in range(1, 6):
            for name, value in params.items():
                value.grad = torch.full_like(value, 0.01)
                optimizers[name].step()
            strategy.step_post_backward(params, optimizers, {}, step, {}, lr=1e-3)
    assert len(params["means"]) > 50
    for value in params.values():
        assert value.dtype == dtype and bool(value.isfinite().all())
