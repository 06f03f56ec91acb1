"""The choice of the rasterizer: what reaches which backend, and that both take the same keywords."""

from __future__ import annotations

import inspect
import logging
import sys
from collections.abc import Callable
from types import ModuleType

import pytest
import torch
from torch import Tensor

from fb_core.splatting.rasterizer import rasterization
from fb_nerfstudio.splats import backend as splat_backend
from fb_nerfstudio.splats.backend import installed_semantics, render_splats


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
    ("version", "semantics"),
    [("1.4.0", "1.4"), ("1.5.3", "1.5"), ("1.6.0", "1.6"), ("1.10.2", "1.6"), ("0.1.13", "1.4")],
)
def test_the_semantics_follow_the_installed_gsplat(monkeypatch, version: str, semantics: str):
    monkeypatch.setattr(splat_backend, "version", lambda _: version)
    installed_semantics.cache_clear()
    try:
        assert installed_semantics() == semantics
    finally:
        installed_semantics.cache_clear()


# What gsplat's rasterization can be called with, from its releases; the installed one is asked itself.
COMMON = (
    "means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree "
    "packed tile_size "
    "backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed camera_model"
).split()
KEYWORDS = {
    "1.4": [*COMMON, "covars"],
    "1.5": [
        *COMMON,
        *"segmented covars with_ut with_eval3d radial_coeffs tangential_coeffs thin_prism_coeffs "
        "rolling_shutter".split(),
    ],
    "installed": None,
}


class OnCuda(Tensor):
    """A tensor of the CPU that says it were on a GPU."""

    device = torch.device("cuda")


def recorder(version: str, seen: dict) -> Callable[..., tuple]:
    """A stand-in for gsplat's rasterization that takes what this version takes, and keeps it."""
    names = KEYWORDS[version]
    if names is None:
        from gsplat.rendering import rasterization as installed

        signature = inspect.signature(installed)
    else:
        required, kind = COMMON.index("near_plane"), inspect.Parameter.POSITIONAL_OR_KEYWORD
        empty = inspect.Parameter.empty
        signature = inspect.Signature(
            [
                inspect.Parameter(name, kind, default=empty if place < required else None)
                for place, name in enumerate(names)
            ]
        )

    def rasterize(*args, **kwargs):
        seen.update(signature.bind(*args, **kwargs).arguments)
        cameras, channels = len(seen["viewmats"]), seen["colors"].shape[-1] + (seen["render_mode"] == "RGB+ED")
        radii = torch.zeros(cameras, 20) if version == "1.4" else torch.zeros(cameras, 20, 2)
        return torch.zeros(cameras, 24, 32, channels), torch.zeros(cameras, 24, 32, 1), {"radii": radii}

    return rasterize


@pytest.mark.parametrize("version", KEYWORDS)
@pytest.mark.parametrize("normals", [False, True])
def test_on_cuda_it_is_gsplat_with_keywords_that_each_version_takes(monkeypatch, version: str, normals: bool):
    """No kernel runs here: the call is bound to the version's signature. Normals are three more channels, on either
    backend.
    """
    seen: dict = {}
    fake = ModuleType("gsplat.rendering")
    fake.rasterization = recorder(version, seen)
    monkeypatch.setitem(sys.modules, "gsplat.rendering", fake)
    inputs = splats()
    inputs["means"] = inputs["means"].as_subclass(OnCuda)
    inputs["colors"] = inputs["colors"] if normals else inputs["colors"][:, :3]
    rendered = render_splats(**inputs, absgrad=True, rasterize_mode="antialiased", render_mode="RGB+ED", sh_degree=None)
    assert rendered.colors.shape == (1, 24, 32, 7 if normals else 4) and rendered.meta["radii"].shape[:2] == (1, 20)
    assert seen["packed"] is False and seen["absgrad"] is True and seen["rasterize_mode"] == "antialiased"
    assert set(splats()) <= set(seen)
    assert (
        render_splats(**{**inputs, "means": splats()["means"]}, render_mode="RGB+ED").colors.shape
        == rendered.colors.shape
    )


def test_mps_takes_the_detour_over_the_cpu(monkeypatch):
    class OnMps(Tensor):
        device = torch.device("mps")

    called = []
    monkeypatch.setattr(
        splat_backend, "_through_cpu", lambda splats, options, backgrounds: called.append((splats, options))
    )
    inputs = splats()
    inputs["means"] = inputs["means"].as_subclass(OnMps)
    render_splats(**inputs)
    ((tensors, options),) = called
    assert set(tensors) | set(options) >= set(splats())


def test_the_cpu_detour_gives_pictures_gradients_and_absgrad_and_says_so_once(caplog):
    """The way taken on mps, walked here from the CPU to the CPU."""
    splat_backend._say_once.cache_clear()
    direct, around = (
        {key: v.clone().requires_grad_() if torch.is_tensor(v) else v for key, v in splats().items()} for _ in range(2)
    )
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
