"""Every tensor is made where its inputs are: networks, sampling and splats on a pretended GPU, in both precisions.

What fake tensors cannot follow and is therefore not run here: the canonical frame of known rays and the checks of input
in `Fillerbuster.complete`, and streams of known tokens, whose sizes depend on values; memory asked of a GPU that is not
there. Plans of a completion are made on the CPU, whatever device cameras and points are on; with the answer no, no
pose is finite, which they refuse. The splat model's forward is in `tests/plugin/splats/test_splat_device.py`.
"""

from __future__ import annotations

import pytest
import torch
from helpers.pretended_device import DEVICE, drawn, made_there, pretended
from helpers.tiny_models import _SMALL_VAE

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import plan_completion
from fb_core.conditioning import Conditioning, Encoding, decode_in_chunks, encode_known, encode_null, split
from fb_core.geometry.cameras import Pinholes
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.sampling import SamplingConfig, noise_of, random_orders
from fb_core.sampling.denoising import Denoising
from fb_core.splatting.rasterizer import rasterization

VIEWS, SIDE = 4, 32
PRECISIONS = pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
APART = {"ray_frames": True, "known_tokens": "apart"}
DESIGNS = pytest.mark.parametrize(
    ("design", "answer"),
    [({}, False), ({}, True), (APART, False)],
    ids=["released, nothing", "released, all", "ray frames and known tokens apart, nothing"],
)

pytestmark = pytest.mark.usefixtures("shapes_unchecked")


def networks(dtype: torch.dtype, design: dict) -> tuple[VAE, VAE, DiT]:
    with made_there(dtype):
        image_vae = VAE(VAEConfig(**_SMALL_VAE))
        dit = DiT(DiTConfig(heads=2, head_dim=16, depth=2, text_width=0, index="flexible", **design))
    with made_there():
        raymap_vae = VAE(VAEConfig(in_channels=6, padding="replicate", **_SMALL_VAE | {"norm": "none"}))
    for network in (image_vae, raymap_vae, dit):
        network.requires_grad_(False).eval()
    return image_vae, raymap_vae, dit


def encoded(image_vae: VAE, raymap_vae: VAE, dit: DiT) -> tuple[Conditioning, Conditioning]:
    mask = drawn(VIEWS, 1, SIDE, SIDE)
    vaes = {"image_vae": image_vae, "raymap_vae": raymap_vae}
    pictures, rays = drawn(VIEWS, 3, SIDE, SIDE), drawn(VIEWS, 6, SIDE, SIDE)
    known = encode_known(pictures, mask, rays, mask, **vaes, encoding=Encoding(views_at_once=3), transformer=dit.config)
    return known, encode_null(known, **vaes, pixels=(SIDE, SIDE))


@PRECISIONS
@DESIGNS
@pytest.mark.parametrize("options", [{}, {"window": 2}, {"solver": "heun"}], ids=["plain", "windows", "heun"])
def test_sampling_stays_on_its_device(dtype: torch.dtype, design: dict, answer: bool, options: dict):
    with pretended(answer), torch.no_grad():
        image_vae, raymap_vae, dit = networks(dtype, design)
        known, null = encoded(image_vae, raymap_vae, dit)
        sampling = SamplingConfig(steps=2, precision="float32", **options)
        latents = Denoising(
            dit=dit,
            conditioning=known,
            null=null,
            noise=noise_of(0, VIEWS, (SIDE // 8, SIDE // 8)).to(DEVICE),
            orders=random_orders(0),
            sampling=sampling,
        ).run()
        image, rays = split(latents)
        assert latents.device == DEVICE and latents.dtype == torch.float32
        for network, part in ((image_vae, image), (raymap_vae, rays)):
            assert decode_in_chunks(network, part, views_at_once=3).device == DEVICE


def test_a_tensor_on_another_device_is_noticed():
    """The test's own test."""
    with pretended(True), pytest.raises(RuntimeError, match="device"):
        drawn(3) + torch.ones(3)


@pytest.mark.parametrize("degree", [None, 1], ids=["colours", "harmonics"])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_splats_are_drawn_where_they_are(degree: int | None, mode: str):
    with pretended(True):
        colors = drawn(40, 3) if degree is None else drawn(40, 4, 3)
        intrinsics, poses = drawn(1, 3, 3), drawn(1, 4, 4)
        picture, alpha, _ = rasterization(
            drawn(40, 3), drawn(40, 4), drawn(40, 3), drawn(40), colors, poses, intrinsics, 37, 29,
            sh_degree=degree, render_mode=mode,
        )  # fmt: skip
        assert picture.device == alpha.device == DEVICE


@pytest.mark.parametrize("anchors", [4, None], ids=["so many anchors", "what the capture needs"])
@pytest.mark.parametrize("context", ["spread", "stride", "overlap"])
def test_plans_are_made_on_the_cpu_wherever_cameras_and_points_are(anchors: int | None, context: str):
    with pretended(True):
        cameras = [
            Pinholes(camera_to_world=drawn(1, 3, 4), focal=drawn(1, 2), principal=drawn(1, 2), width=16, height=16)
            for _ in range(6)
        ]
        config = CompletionConfig(anchor_views=anchors, densify_rounds=1, context_choice=context)
        plan = plan_completion(cameras, drawn(30, 3), config, size=16)
        places = [plan.shape.center, plan.shell.log_radius, *(one.cameras.camera_to_world for one in plan.rounds)]
        assert {place.device.type for place in places} == {"cpu"} and plan.context
