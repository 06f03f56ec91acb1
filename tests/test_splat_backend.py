"""The choice of the rasterizer: what reaches which backend, and that both take the same keywords."""

from __future__ import annotations

import inspect
import logging
import sys
from types import ModuleType

import pytest
import torch
from torch import Tensor

from fb_nerfstudio import splat_backend
from fb_nerfstudio.splat_backend import installed_semantics, render_splats
from fb_nerfstudio.torch_rasterizer import rasterization


def splats(n: int = 20) -> dict:
    g = torch.Generator().manual_seed(0)
    return dict(
        means=torch.randn(n, 3, generator=g) * 0.3 + torch.tensor([0.0, 0.0, 2.0]),
        quats=torch.randn(n, 4, generator=g),
        scales=0.1 * torch.rand(n, 3, generator=g) + 0.02,
        opacities=torch.rand(n, generator=g),
        colors=torch.rand(n, 6, generator=g),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]]]),
        width=32,
        height=24,
    )


def test_on_the_cpu_it_is_the_torch_rasterizer():
    rendered = render_splats(**splats(), render_mode="RGB+ED", absgrad=True)
    images, alphas, _ = rasterization(**splats(), render_mode="RGB+ED", semantics=installed_semantics())
    assert torch.equal(rendered.colors, images) and torch.equal(rendered.alphas, alphas)
    assert rendered.colors.shape == (1, 24, 32, 7)


@pytest.mark.parametrize(
    ("version", "semantics"), [("1.4.0", "1.4"), ("1.5.3", "1.5"), ("1.6.0", "1.6"), ("1.10.2", "1.6"), ("0.1.13", "1.4")]
)
def test_the_semantics_follow_the_installed_gsplat(monkeypatch, version: str, semantics: str):
    monkeypatch.setattr(splat_backend, "version", lambda _: version)
    installed_semantics.cache_clear()
    try:
        assert installed_semantics() == semantics
    finally:
        installed_semantics.cache_clear()


def test_gsplat_takes_every_keyword_that_is_passed(monkeypatch):
    """The CUDA branch, with gsplat's own signature in front of a recorder (no kernel runs)."""
    from gsplat.rendering import rasterization as gsplat_rasterization

    signature, seen = inspect.signature(gsplat_rasterization), {}

    def recorder(*args, **kwargs):
        seen.update(signature.bind(*args, **kwargs).arguments)
        return torch.zeros(1, 24, 32, 7), torch.zeros(1, 24, 32, 1), {"radii": 0}

    fake = ModuleType("gsplat.rendering")
    fake.rasterization = recorder
    monkeypatch.setitem(sys.modules, "gsplat.rendering", fake)

    class OnCuda(Tensor):
        device = torch.device("cuda")

    inputs = splats()
    inputs["means"] = inputs["means"].as_subclass(OnCuda)
    rendered = render_splats(**inputs, absgrad=True, rasterize_mode="antialiased", render_mode="RGB+ED", sh_degree=None)
    assert rendered.meta == {"radii": 0}
    assert seen["packed"] is False and seen["absgrad"] is True and seen["rasterize_mode"] == "antialiased"
    assert set(splats()) <= set(seen)


def test_the_cpu_detour_gives_pictures_gradients_and_absgrad_and_says_so_once(caplog):
    """The way taken on mps, walked here from the CPU to the CPU."""
    splat_backend._say_once.cache_clear()
    direct, around = ({key: v.clone().requires_grad_() if torch.is_tensor(v) else v for key, v in splats().items()} for _ in range(2))
    tensors = {key: value for key, value in around.items() if torch.is_tensor(value)}
    options = dict(width=32, height=24, absgrad=True, packed=False)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            detour = splat_backend._through_cpu(tensors, options, None)
    assert len(caplog.records) == 1 and "drawn on the CPU" in caplog.text
    expected = render_splats(**direct, absgrad=True)
    expected.meta["means2d"].retain_grad()
    detour.meta["means2d"].retain_grad()  # what gsplat's strategies do: harmless on a leaf
    for rendered in (detour, expected):
        (rendered.colors.square().sum() + rendered.alphas.sum()).backward()
    assert torch.equal(detour.colors, expected.colors)
    assert torch.equal(around["means"].grad, direct["means"].grad)
    assert torch.equal(detour.meta["means2d"].grad, expected.meta["means2d"].grad)
    assert torch.equal(detour.meta["means2d"].absgrad, expected.meta["means2d"].absgrad)
    assert torch.equal(detour.meta["radii"], expected.meta["radii"])
