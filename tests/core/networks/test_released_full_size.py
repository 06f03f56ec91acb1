"""The released architecture at its full size, with weights made by rule: the right weights, and all the way from file
to velocity.
"""

import hashlib
import importlib.util
import json
import time
from pathlib import Path

import pytest
import torch

from fb_core.checkpoint import convert, load
from fb_core.networks.released import STATE_KEYS
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import IMAGE_VAE, RAYMAP_VAE, VAE
from fb_core.networks.weights import without_weights

SEEDS = {"image_vae": 11, "pose_vae": 12, "transformer": 13}


def full_state(shared_path, name: str) -> dict[str, torch.Tensor]:
    """The rule's weights of a full-size network, under the released names."""
    spec = importlib.util.spec_from_file_location("weights_rule", shared_path("golden/reference/weights_rule.py"))
    rule = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(rule)
    build = {
        "image_vae": lambda: VAE(IMAGE_VAE),
        "pose_vae": lambda: VAE(RAYMAP_VAE),
        "transformer": lambda: DiT(DiTConfig()),
    }[name]
    prefix = "" if name == "transformer" else "model."
    return rule.fill({prefix + key: value for key, value in without_weights(build).state_dict().items()}, SEEDS[name])


@pytest.mark.parametrize("name", ["pose_vae", pytest.param("image_vae", marks=pytest.mark.slow)])
def test_full_size_weights_are_the_reference_s(shared_path, name):
    """Names, shapes and hence every redrawn value agree with the reference: the hash is over (name, bytes) in sorted
    order.
    """
    digest, state = hashlib.sha256(), full_state(shared_path, name)
    for key in sorted(state):
        digest.update(key.encode())
        digest.update(state[key].numpy().tobytes())
    assert (
        digest.hexdigest() == json.loads(shared_path("golden/reference/meta.json").read_text())[f"sha256_full_{name}"]
    )


@pytest.mark.slow
@torch.no_grad()
def test_full_size_from_released_files_to_velocity(shared_path, tmp_path: Path, record_property):
    """646M + 84M + 5M parameters; needs 8 GB of disk and of memory."""
    for (file, key), name in zip(STATE_KEYS.items(), ("transformer", "image_vae", "pose_vae"), strict=True):
        torch.save({key: full_state(shared_path, name), "global_step": 1}, tmp_path / file)
    begin = time.perf_counter()
    folder = convert(tmp_path, tmp_path / "model")
    record_property("convert_seconds", time.perf_counter() - begin)
    for file in STATE_KEYS:
        (tmp_path / file).unlink()
    begin = time.perf_counter()
    model = load(folder)
    record_property("load_seconds", time.perf_counter() - begin)
    assert sum(p.numel() for p in model.dit.parameters()) == 645_917_824
    latents = model.image_vae.encode(torch.rand(1, 3, 64, 64))
    rays = model.raymap_vae.encode(torch.rand(1, 6, 64, 64))
    sequence = torch.cat([torch.randn(1, 32, 8, 8), latents, rays, torch.ones(1, 2, 8, 8)], dim=1)[None]
    begin = time.perf_counter()
    velocity = model.dit(sequence, torch.ones(1), torch.randn(1, 77, 768))
    record_property("step_seconds", time.perf_counter() - begin)
    assert velocity.shape == (1, 1, 32, 8, 8) and velocity.isfinite().all()
    assert model.image_vae.decode(latents).isfinite().all() and model.raymap_vae.decode(rays).isfinite().all()
