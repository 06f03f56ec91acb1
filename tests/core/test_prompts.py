"""Prompts and posterior sampling: what they change, what they cost, and what is said when a model cannot."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.scenes.mixed_views import mixed_views, seeded
from helpers.tiny_models import save_tiny_model, tiny_model

from fb_core.checkpoint import Loaded, load
from fb_core.conditioning import encode_known, encode_null, split
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.networks.released import read_released
from fb_core.networks.text import TextEncoder
from fb_core.networks.transformer.dit import DiT
from fb_core.networks.transformer.prepared import Prepared
from fb_core.sampling import guidance_map, guided, integrate

QUICK = SamplingConfig(steps=2, guidance_unknown=3.0)


class Letters(TextEncoder):
    """Stands in for CLIP: an embedding drawn from the prompt's letters."""

    def __init__(self, width: int):
        super().__init__(None, None)
        self.width = width

    def encode(self, prompts: list[str]) -> torch.Tensor:
        return torch.stack([torch.randn(77, self.width, generator=seeded(sum(map(ord, prompt)))) for prompt in prompts])


@pytest.fixture(scope="module")
def loaded(tmp_path_factory) -> Loaded:
    """The tiny model with a transformer that reads text."""
    plain = load(save_tiny_model(tmp_path_factory.mktemp("prompts") / "model"))
    config = dataclasses.replace(plain.config, transformer=dataclasses.replace(plain.config.transformer, text_width=8))
    torch.manual_seed(0)
    return dataclasses.replace(plain, dit=DiT(config.transformer).eval(), config=config)


def done(model: Fillerbuster, sampling: SamplingConfig = QUICK, **options) -> torch.Tensor:
    return model.complete(mixed_views(), generator=seeded(), sampling=sampling, **options).images


def test_a_prompt_has_an_effect_on_pictures_and_an_empty_one_none(loaded):
    model = Fillerbuster(loaded, text_encoder=Letters(8))
    nothing, empty, cat, dog = (done(model, prompt=prompt) for prompt in (None, "", "a cat", "a dog"))
    assert torch.equal(nothing, empty)
    assert not torch.equal(nothing, cat) and not torch.equal(cat, dog)
    assert torch.equal(nothing, done(model, dataclasses.replace(QUICK, guidance_text=0.0), prompt="a cat"))


def test_branches_are_evaluated_as_often_as_they_differ(loaded, monkeypatch):
    counts: list[int] = []
    original = Prepared.__call__
    monkeypatch.setattr(Prepared, "__call__", lambda self, *a: counts.append(self.branches) or original(self, *a))
    model, unguided = (
        Fillerbuster(loaded, text_encoder=Letters(8)),
        dataclasses.replace(QUICK, guidance_unknown=1.0, guidance_known=1.0),
    )
    for sampling, prompt in ((QUICK, None), (QUICK, "a cat"), (unguided, None), (unguided, "a cat")):
        done(model, sampling, prompt=prompt)
    assert counts == [2, 2, 3, 3, 1, 1, 2, 2]


def test_guidance_of_text_is_for_the_image_channels():
    velocities = torch.randn(3, 2, 32, 4, 4, generator=seeded(1))
    scale = torch.full((2, 32, 4, 4), 3.0)
    got = guided(lambda *_: velocities, scale, text_scale=10.0)(velocities[0], 1.0)
    u, c, t = velocities
    wanted = u + 3 * (c - u)
    assert torch.allclose(got[:, 16:], wanted[:, 16:])
    assert torch.allclose(got[:, :16], (wanted + 10 * (t - c))[:, :16], atol=1e-5)


@pytest.mark.parametrize(("name", "prompted"), [("sampler_cfg", False), ("sampler_cfg_text", True)])
@torch.no_grad()
def test_whole_samplings_equal_the_reference_s(shared_path, name, prompted):
    """Four Euler steps on its grid, guidance 7 / 1.1 / 10; beside 2e-5 per evaluation stand guidance and steps that
    amplify it.
    """
    with np.load(shared_path(f"golden/reference/{name}.npz")) as file:
        golden = {key: torch.from_numpy(file[key]).float() for key in file.files}
    networks = read_released(shared_path("golden/reference/transformer.ckpt").parent)
    images, image_known, rays_known = (golden[key][0] for key in ("image", "image_mask", "rays_mask"))
    vaes = {"image_vae": networks.image_vae, "raymap_vae": networks.raymap_vae}
    rays = torch.cat([golden["origins"][0], golden["directions"][0]], dim=1)  # in [0, 1] already
    known = encode_known(images, image_known, rays, rays_known, **vaes)
    null = encode_null(known, **vaes, pixels=(64, 64))
    scale = guidance_map(known, known=1.1, unknown=7.0)
    times = [*torch.linspace(1.0, 0.001, 4).tolist(), 0.0]
    channels, texts = [null.channels, known.channels], [golden["uncond_text"]] * 2
    if prompted:
        channels, texts = [*channels, known.channels], [*texts, golden["text"]]
    prepared = Prepared(networks.dit, torch.stack(channels), times[:-1], text=torch.cat(texts))
    latents = integrate(guided(prepared, scale, text_scale=10.0 if prompted else None), golden["noise"][0], times)
    wanted = golden["final"][0, :, :32]
    assert (known.channels - golden["final"][0, :, 32:]).abs().max() <= 2e-5
    assert (latents - wanted).abs().max() <= 1e-4 * wanted.abs().max()
    decoded = networks.image_vae.decode(split(latents)[0])
    assert (decoded - golden["decoded_image"][0]).abs().max() <= 1e-3


# Refusals ----------------------------------------------------------------------------------------------------------


def test_a_prompt_for_a_model_that_reads_no_text(tmp_path):
    with pytest.raises(ValueError, match="prompt: this model reads no text; complete without a prompt, got 'a cat'"):
        done(tiny_model(tmp_path), prompt="a cat")
    with pytest.raises(ValueError, match=r"text_encoder: the model in .* reads no text"):
        Fillerbuster.from_pretrained(tmp_path / "model", text_encoder=tmp_path)


def test_a_prompt_without_an_encoder(loaded):
    model = Fillerbuster(dataclasses.replace(loaded, empty_prompt=torch.zeros(77, 8)))
    assert torch.isfinite(done(model)).all(), "multi-view use needs no encoder"
    with pytest.raises(
        ValueError, match=r"prompt: 'a cat' needs a text encoder; install fillerbuster\[text\] and load the model with"
    ):
        done(model, prompt="a cat")


def test_a_model_that_reads_text_without_the_empty_prompt(loaded):
    with pytest.raises(ValueError, match="its folder has no embedding of the empty prompt"):
        done(Fillerbuster(loaded))


# Posterior ---------------------------------------------------------------------------------------------------------


def test_posterior_samples_are_reproducible_and_do_not_depend_on_the_cut(tmp_path):
    model, sampled = tiny_model(tmp_path), dataclasses.replace(QUICK, sample_posterior=True)
    mean, once, again = done(model), done(model, sampled), done(model, sampled)
    assert torch.equal(once, again) and not torch.equal(once, mean)
    one_by_one = done(model, dataclasses.replace(sampled, views_at_once=1))
    assert torch.allclose(one_by_one, once, atol=1e-4)
