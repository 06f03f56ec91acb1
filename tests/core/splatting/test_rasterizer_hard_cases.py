"""Degenerate scenes: whatever comes in, the torch rasterizer gives finite pictures and finite gradients, and says what
it dropped.
"""

from __future__ import annotations

import logging
import math
import warnings

import jaxtyping
import pytest
import torch
from torch import Tensor

from fb_core.splatting import rasterizer as torch_rasterizer
from fb_core.splatting.rasterizer import rasterization

LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def splats(n: int = 1, width: int = 24, height: int = 20, **changes) -> dict:
    """n round Gaussians of scale 0.1 and opacity 0.5, two metres in front of a camera that looks along z."""
    f = 30.0
    inputs = dict(
        means=torch.tensor([[0.0, 0.0, 2.0]]).repeat(n, 1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        scales=torch.full((n, 3), 0.1),
        opacities=torch.full((n,), 0.5),
        colors=torch.linspace(0.1, 0.9, 3 * n).view(n, 3),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]]]),
        width=width,
        height=height,
    )
    return {**inputs, **changes}


def draw(inputs: dict, **options) -> tuple[Tensor, Tensor, dict, dict[str, Tensor]]:
    """Picture, alpha, meta and gradients; fails unless all of them are finite."""
    inputs = {key: value.clone().requires_grad_() if key in LEAVES else value for key, value in inputs.items()}
    options = {"render_mode": "RGB+ED", "rasterize_mode": "antialiased", "absgrad": True, **options}
    images, alphas, meta = rasterization(**inputs, **options)
    ((images * torch.randn_like(images)).sum() + (alphas * torch.randn_like(alphas)).sum()).backward()
    gradients = {name: inputs[name].grad for name in LEAVES}
    for name, tensor in {"images": images, "alphas": alphas, "absgrad": meta["means2d"].absgrad, **gradients}.items():
        assert bool(tensor.isfinite().all()), name
    for name in ("means2d", "conics", "depths", "opacities"):
        assert bool(meta[name].isfinite().all()), name
    assert float(alphas.detach().min()) >= 0 and float(alphas.detach().max()) <= 1
    return images.detach(), alphas.detach(), meta, gradients


def test_an_empty_scene_shows_the_background():
    background = torch.tensor([[0.1, 0.2, 0.3]])
    images, alphas, meta, gradients = draw(splats(0), backgrounds=background)
    assert torch.equal(images[..., :3], background.expand(1, 20, 24, 3))
    assert float(alphas.abs().max()) == 0 and float(images[..., 3].abs().max()) == 0
    assert meta["radii"].shape == (1, 0) and gradients["means"].shape == (0, 3)


def test_a_scene_without_visible_gaussians_shows_the_background():
    background = torch.tensor([[0.1, 0.2, 0.3]])
    images, _, meta, _ = draw(
        splats(3, means=torch.tensor([[90.0, 0, 2.0], [0, -70, 1.0], [0, 0, -1.0]])), backgrounds=background
    )
    assert torch.equal(images[..., :3], background.expand(1, 20, 24, 3))
    assert int(meta["radii"].sum()) == 0


def test_an_image_of_one_pixel():
    images, alphas, _, gradients = draw(splats(5, width=1, height=1))
    assert images.shape == (1, 1, 1, 4)
    assert 0.9 < float(alphas) < 1
    assert float(gradients["colors"].abs().sum()) > 0


@pytest.mark.parametrize(("width", "height"), [(1, 33), (33, 1), (8, 8), (9, 7)])
def test_images_that_are_no_multiple_of_a_cell(width: int, height: int):
    images, alphas, _, _ = draw(splats(4, width=width, height=height, scales=torch.full((4, 3), 5.0)))
    assert images.shape == (1, height, width, 4) and float(alphas.min()) > 0.5


def test_a_gaussian_larger_than_the_world():
    _, alphas, _, _ = draw(splats(1, scales=torch.full((1, 3), 1e3), opacities=torch.tensor([0.6])))
    assert torch.allclose(alphas, torch.full_like(alphas, 0.6), atol=1e-3)


def test_the_camera_inside_a_huge_gaussian():
    draw(splats(1, means=torch.tensor([[0.2, 0.1, 0.02]]), scales=torch.full((1, 3), 1e3)))


def test_scales_of_1e_minus_8_become_the_blur_alone():
    tiny = splats(2, scales=torch.full((2, 3), 1e-8))
    _, alphas, meta, _ = draw(tiny, rasterize_mode="classic")
    assert float(alphas.max()) > 0.3
    assert torch.allclose(meta["conics"][0, 0], torch.tensor([1 / 0.3, 0, 1 / 0.3]), rtol=1e-4)
    _, alphas, _, _ = draw(tiny, rasterize_mode="antialiased")
    assert float(alphas.max()) == 0  # no energy


def test_scales_of_exactly_0():
    draw(splats(2, scales=torch.zeros(2, 3)))
    draw(splats(2, scales=torch.zeros(2, 3)), rasterize_mode="classic")


def test_opacity_of_exactly_0_is_invisible_without_gradient():
    _, alphas, _, gradients = draw(splats(2, opacities=torch.zeros(2)))
    assert float(alphas.abs().max()) == 0
    assert float(gradients["opacities"].abs().max()) == 0


def test_opacity_of_exactly_1_is_capped():
    _, alphas, _, gradients = draw(
        splats(1, opacities=torch.ones(1), scales=torch.full((1, 3), 30.0)), rasterize_mode="classic"
    )
    assert torch.allclose(alphas, torch.full_like(alphas, 0.999), atol=1e-3)
    assert float(alphas.max()) == pytest.approx(0.999, abs=1e-6)
    assert float(gradients["colors"].abs().sum()) > 0  # colours still learn under the cap


def test_a_zero_quaternion_is_the_identity_rotation_with_a_zero_gradient():
    scales = torch.tensor([[0.3, 0.1, 0.05]])
    expected = draw(splats(1, scales=scales))[0]
    images, _, _, gradients = draw(splats(1, scales=scales, quats=torch.zeros(1, 4)))
    assert torch.equal(images, expected)
    assert float(gradients["quats"].abs().max()) == 0


def test_a_hundred_thousand_gaussians_on_one_pixel():
    n = 100_000
    depth = 1.0 + torch.rand(n)
    crowd = splats(
        n, means=torch.stack([torch.zeros(n), torch.zeros(n), depth], dim=1), scales=torch.full((n, 3), 1e-6)
    )
    crowd["Ks"][0, :2, 2] += 0.5  # on a pixel centre
    _, alphas, _, gradients = draw({**crowd, "opacities": torch.full((n,), 0.01)}, rasterize_mode="classic")
    assert float(alphas.max()) == pytest.approx(1 - 1e-4, abs=2e-4)
    drawn = gradients["colors"].abs().sum(dim=1) > 0
    # (1 - 0.01)^k <= 1e-4 after 917: only the nearest ones are drawn
    assert int(drawn.sum()) == pytest.approx(math.log(1e-4) / math.log(0.99), abs=3)
    assert float(depth[drawn].max()) <= float(depth[~drawn].min())


def test_gaussians_on_and_around_the_near_plane():
    near = 0.01
    means = torch.tensor([[0.0, 0, near], [0.001, 0, math.nextafter(near, 0)], [0, 0, near * 1.001], [5.0, 0, near]])
    _, _, meta, _ = draw(splats(4, means=means, scales=torch.full((4, 3), 1e-3)), rasterize_mode="classic")
    assert (meta["radii"][0] > 0).tolist() == [True, meta["depths"][0, 1] > 0, True, False]


def test_gaussians_behind_the_camera_and_in_its_plane_are_not_drawn():
    means = torch.tensor([[0.0, 0, -2.0], [0, 0, 0.0], [1, 1, 0.0], [0, 0, -1e-30]])
    _, alphas, meta, gradients = draw(splats(4, means=means, scales=torch.full((4, 3), 10.0)))
    assert float(alphas.max()) == 0 and int(meta["radii"].abs().sum()) == 0
    assert float(gradients["means"].abs().max()) == 0


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_values_that_are_not_finite_are_dropped_counted_and_said_once(name: str, bad: float, caplog):
    torch_rasterizer._say_once.cache_clear()
    inputs = splats(6, means=torch.tensor([[0.0, 0.0, 2.0]]) + 0.2 * torch.randn(6, 3))
    healthy = {key: value[2:] if key in LEAVES[:5] else value for key, value in inputs.items()}
    expected = draw(healthy)[0]
    inputs[name] = inputs[name].clone()
    inputs[name][:2] = bad
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            images, _, meta, gradients = draw(inputs)
    assert torch.allclose(images, expected, atol=1e-6)
    assert meta["dropped"] == 2
    assert sum("not finite" in record.message for record in caplog.records) == 1
    assert all(float(gradients[key][:2].abs().max()) == 0 for key in LEAVES[:5])


def test_needles_of_aspect_1e4():
    n = 60
    quats = torch.nn.functional.normalize(torch.randn(n, 4), dim=1)
    means = torch.tensor([[0.0, 0.0, 2.0]]) + 0.5 * torch.randn(n, 3)
    scales = torch.tensor([[1.0, 1e-4, 1e-4]]).repeat(n, 1)
    for mode in ("classic", "antialiased"):
        single = draw(splats(n, quats=quats, means=means, scales=scales), rasterize_mode=mode, render_mode="RGB")
        inputs = splats(n, quats=quats, means=means, scales=scales, colors=torch.rand(n, 3))
        double = {key: value.double() if torch.is_tensor(value) else value for key, value in inputs.items()}
        drawn, exact = (rasterization(**version, rasterize_mode=mode)[0] for version in (inputs, double))
        assert float((drawn - exact).abs().mean()) < 1e-4
        if mode == "classic":  # antialiased, such needles carry too little to be drawn at all
            assert float(single[3]["quats"].abs().sum()) > 0


def test_needles_along_the_viewing_ray():
    draw(splats(3, scales=torch.tensor([[1e-4, 1e-4, 0.9]]).repeat(3, 1)))


def test_covariances_that_are_not_positive_are_not_drawn():
    covars = torch.diag_embed(torch.tensor([[-50.0, 50.0, 50.0], [-50.0, -50.0, -50.0], [0.01, 0.01, 0.01]]))
    _, _, meta, _ = draw({**splats(3), "covars": covars}, rasterize_mode="classic")
    assert (meta["radii"][0] > 0).tolist() == [False, False, True]


def test_equal_depths_keep_the_order_of_the_input():
    colors = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]])
    images = draw(splats(3, colors=colors, opacities=torch.full((3,), 0.9)), rasterize_mode="classic")[0]
    red, green, blue = images[0, 10, 12, :3].tolist()
    assert red > green > blue


@pytest.mark.parametrize(
    "changes",
    [
        {"opacities": torch.full((1,), 0.003)},  # nowhere as strong as 1/255
        {
            "means": torch.tensor([[1.05, 0.9, 2.0]]),
            "opacities": torch.full((1,), 0.3),
        },  # the picture meets its box, not its ellipse
        {
            "scales": torch.full((1, 3), 1e-8),
            "means": torch.tensor([[0.0166, 0.0166, 2.0]]),
            "opacities": torch.full((1,), 0.0045),
        },
    ],
)
def test_gaussians_that_reach_no_pixel_get_no_gradient(changes):
    images, alphas, _, gradients = draw(splats(1, **changes), rasterize_mode="classic")
    assert float(alphas.max()) == 0 and float(images[..., :3].abs().max()) == 0
    assert all(float(gradients[name].abs().max()) == 0 for name in ("means", "scales", "opacities"))


NAN = math.nan


@pytest.mark.parametrize(
    "option", [{"near_plane": NAN}, {"far_plane": NAN}, {"radius_clip": NAN}, {"eps2d": NAN}, {"eps2d": -1.0}]
)
def test_options_that_are_no_numbers_are_refused(option: dict):
    with pytest.raises(ValueError, match=f"{next(iter(option))} should be"):
        rasterization(**splats(), **option)


@pytest.mark.parametrize(
    ("size", "told"),
    [({"width": 24.5}, "whole numbers"), ({"width": 2**20, "height": 2**20}, "at most 268435456 pixels")],
)
def test_sizes_that_no_picture_has_are_refused_before_anything_is_allocated(
    size: dict, told: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match=told):
        rasterization(**{**splats(), **size})


def test_cameras_that_are_trained_too_are_no_reason_for_a_warning() -> None:
    inputs = splats()
    inputs["viewmats"].requires_grad_()
    torch.set_warn_always(True)  # else torch warns once in a process
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            rasterization(**inputs, backgrounds=torch.ones(1, 3).to(inputs["means"]).requires_grad_())
    finally:
        torch.set_warn_always(False)
