"""Autoencoders: the released numbers, what constant raymaps and single pictures must give, and refusals."""

import copy
import dataclasses

import jaxtyping
import numpy as np
import pytest
import torch

from fb_core.networks.released import read_released
from fb_core.networks.vae import IMAGE_VAE, RAYMAP_VAE, VAE, Attention, VAEConfig

SMALL_IMAGE = VAEConfig(widths=(8, 16, 16, 16), norm_groups=4, latent_channels=4, encoder_resnets=1, decoder_resnets=1)
SMALL_RAYMAP = dataclasses.replace(SMALL_IMAGE, in_channels=6, norm="none", padding="replicate")


def small(config: VAEConfig, seed: int = 0) -> VAE:
    """A network whose residual branches are awake."""
    torch.manual_seed(seed)
    return VAE(config).eval()


def golden(shared_path, name: str) -> dict[str, torch.Tensor]:
    """Tensors of one golden file."""
    with np.load(shared_path(f"golden/reference/{name}.npz")) as file:
        return {key: torch.from_numpy(file[key]) for key in file.files}


@pytest.fixture(scope="module")
def released(shared_path):
    """The golden networks, through the reader of the released layout."""
    return read_released(shared_path("golden/reference/transformer.ckpt").parent)


@pytest.mark.parametrize("case", ["0", "1", "2"])
@pytest.mark.parametrize(("name", "network"), [("image_vae_tiny", "image_vae"), ("pose_vae_tiny", "raymap_vae")])
@torch.no_grad()
def test_released_numbers(shared_path, released, name, network, case):
    """In float32 through the public methods, and once more in float64, where only the goldens' own rounding is left.

    (The goldens are float32 with values up to 14, hence up to 1.5e-5 off themselves; decoded values are compared in [0,
    1] units.)
    """
    tensors, vae = golden(shared_path, name), getattr(released, network)
    for dtype in (torch.float32, torch.float64):
        vae = copy.deepcopy(vae).to(dtype)
        mean, logvar = vae.posterior(tensors["x" + case].to(dtype) / 2 + 0.5)
        decoded = vae.decode(tensors["z" + case].to(dtype) * vae.config.scaling, clamp=False)
        assert (mean - tensors["mean" + case]).abs().max() <= 2e-5
        assert (logvar - tensors["logvar" + case]).abs().max() <= 2e-5
        assert (decoded - (tensors["dec" + case] / 2 + 0.5)).abs().max() <= (2e-5 if dtype == torch.float32 else 1e-5)


@torch.no_grad()
def test_released_scaling_and_ranges(shared_path, released):
    tensors, vae = golden(shared_path, "encode_decode_image"), released.image_vae
    latents = vae.encode(tensors["image"][0])
    assert (latents - tensors["latents"][0]).abs().max() <= 2e-5
    stretched = 1.3 * tensors["latents"][0]  # what this golden decoded, so that the clamp has something to do
    for clamp, expected in ((True, "decoded"), (False, "decoded_unclamped")):
        assert (vae.decode(stretched, clamp=clamp) - tensors[expected][0]).abs().max() <= 2e-5


@pytest.mark.parametrize(("config", "file"), [(IMAGE_VAE, "image_vae"), (RAYMAP_VAE, "raymap_vae")])
def test_parameter_names_are_the_released_ones(shared_path, config, file):
    with torch.device("meta"):
        state = VAE(config).state_dict()
    expected = shared_path(f"facts/reference_keys_{file}.txt").read_text().splitlines()
    assert sorted(f"model.{key} {list(value.shape)}" for key, value in state.items()) == sorted(
        line for line in expected if line
    )


@torch.no_grad()
def test_a_constant_raymap_has_a_constant_latent_up_to_its_border():
    """Replicated borders and no normalisation: a view whose rays are all alike looks the same everywhere."""
    vae = small(SMALL_RAYMAP)
    constant = torch.rand(2, 6, 1, 1).expand(2, 6, 24, 40)
    latents = vae.encode(constant)
    torch.testing.assert_close(latents, latents[:, :, :1, :1].expand_as(latents), atol=1e-6, rtol=0)
    decoded = vae.decode(latents, clamp=False)
    torch.testing.assert_close(decoded, decoded[:, :, :1, :1].expand_as(decoded), atol=1e-6, rtol=0)


@pytest.mark.parametrize("config", [SMALL_IMAGE, SMALL_RAYMAP])
@torch.no_grad()
def test_pictures_do_not_see_each_other(config):
    vae = small(config)
    pictures = torch.rand(3, config.in_channels, 16, 32)
    latents = vae.encode(pictures)
    assert latents.shape == (3, 4, 2, 4)
    torch.testing.assert_close(latents[1:2], vae.encode(pictures[1:2]), atol=1e-6, rtol=0)
    torch.testing.assert_close(vae.decode(latents)[1:2], vae.decode(latents[1:2]), atol=1e-5, rtol=0)


@torch.no_grad()
def test_a_given_generator_samples_the_posterior():
    vae = small(SMALL_IMAGE)
    picture = torch.rand(1, 3, 16, 16)
    mean, logvar = vae.posterior(picture)
    torch.testing.assert_close(vae.encode(picture), 0.18215 * mean)
    samples = vae.encode(picture.expand(1000, -1, -1, -1), torch.Generator().manual_seed(3)) / 0.18215
    std = (0.5 * logvar).exp()
    assert ((samples.mean(0, keepdim=True) - mean).abs() < 5 * std / 1000**0.5).all()
    assert ((samples.std(0, keepdim=True) / std - 1).abs() < 0.15).all()
    once, again = (vae.encode(picture, torch.Generator().manual_seed(5)) for _ in range(2))
    assert torch.equal(once, again)


@torch.no_grad()
def test_decoded_values_are_clamped_unless_asked_otherwise():
    vae = small(SMALL_IMAGE)
    torch.nn.init.constant_(vae.decoder.conv_out.bias, 2.0)
    latents = torch.randn(1, 4, 2, 2)
    free = vae.decode(latents, clamp=False)
    assert free.max() > 1
    assert torch.equal(vae.decode(latents), free.clamp(0, 1))


@torch.no_grad()
def test_no_pictures_give_no_latents():
    vae = small(SMALL_IMAGE)
    assert vae.encode(torch.zeros(0, 3, 16, 24)).shape == (0, 4, 2, 3)
    assert vae.decode(torch.zeros(0, 4, 2, 3)).shape == (0, 3, 16, 24)


@torch.no_grad()
def test_half_precision_answers_in_the_precision_of_its_input():
    vae = small(SMALL_IMAGE)
    picture = torch.rand(1, 3, 16, 16)
    exact = vae.encode(picture)
    rough = vae.to(torch.bfloat16).encode(picture)
    assert rough.dtype == torch.float32
    assert (rough - exact).abs().max() < 0.05 * exact.abs().max()


def test_attention_equals_the_sum_written_out():
    """Readable twin: every place is the softmax-weighted sum of the values of all places; values and gradients in
    float64.
    """
    torch.manual_seed(0)
    attention = Attention(SMALL_IMAGE, 16).double()
    x = torch.randn(2, 16, 2, 3, dtype=torch.float64, requires_grad=True)
    tokens = attention.group_norm(x).flatten(2).transpose(1, 2)
    q, k, v = attention.to_q(tokens), attention.to_k(tokens), attention.to_v(tokens)
    weights = (q @ k.transpose(1, 2) / 16**0.5).softmax(dim=-1)
    slow = x + attention.to_out[0](weights @ v).transpose(1, 2).reshape(x.shape)
    fast = attention(x)
    torch.testing.assert_close(fast, slow, atol=1e-12, rtol=0)
    probe = torch.randn_like(slow)
    for a, b in zip(
        *(torch.autograd.grad((y * probe).sum(), [x, attention.to_q.weight]) for y in (fast, slow)), strict=True
    ):
        torch.testing.assert_close(a, b, atol=1e-12, rtol=0)


@pytest.mark.parametrize("config", [SMALL_IMAGE, SMALL_RAYMAP])
def test_fresh_weights_are_reproducible_and_trainable(config):
    one, two = (VAE(config).initialize(torch.Generator().manual_seed(4)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), two.state_dict().values(), strict=True))
    picture = torch.rand(2, config.in_channels, 16, 16)
    loss = (one.decode(one.encode(picture), clamp=False) - picture).square().mean()
    loss.backward()
    assert loss < 10
    assert one.encoder.conv_in.weight.grad.abs().max() > 0
    assert one.decoder.conv_out.weight.grad.abs().max() > 0


@pytest.mark.parametrize("size", [(15, 16), (16, 20), (0, 16), (4, 8)])
def test_a_size_that_is_no_multiple_of_eight_is_refused(size):
    with pytest.raises(ValueError, match=f"positive multiples of 8, got {size[0]} x {size[1]}"):
        small(SMALL_IMAGE).encode(torch.zeros(1, 3, *size))


def test_wrong_channels_are_refused():
    vae = small(SMALL_IMAGE)
    with pytest.raises(ValueError, match="x01: expected 3 channels, got 6"):
        vae.encode(torch.zeros(1, 6, 16, 16))
    with pytest.raises(ValueError, match="latents: expected 4 channels, got 16"):
        vae.decode(torch.zeros(1, 16, 2, 2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"widths": (8, 16, 16)}, "widths: expected 4"),
        ({"widths": (8, 16, 16, 0)}, "widths: expected 4"),
        ({"norm_groups": 3}, "norm_groups: expected a divisor"),
        ({"norm": "batch"}, "norm: expected 'group' or 'none', got 'batch'"),
        ({"padding": "reflect"}, "padding: expected"),
        ({"scaling": 0.0}, "scaling: expected a positive number"),
        ({"latent_channels": 0}, "latent_channels: expected a positive integer"),
    ],
)
def test_nonsense_configurations_are_refused(monkeypatch, change, message):
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # users run without the tests' type checks
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL_IMAGE, **change)
