"""Laws of the conditioning: what is unknown never reaches the network; views stay independent; channels are where they
belong.
"""

import pytest
import torch

from fb_core.conditioning import (
    Conditioning,
    Encoding,
    assemble,
    encode_known,
    encode_null,
    join,
    only_known,
    split,
    unsplit,
)
from fb_core.networks.vae import VAE, VAEConfig


@pytest.fixture(scope="module")
def vaes() -> tuple[VAE, VAE]:
    torch.manual_seed(0)
    small = {"widths": (8, 8, 8, 8), "encoder_resnets": 1, "decoder_resnets": 1, "norm_groups": 4}
    return VAE(VAEConfig(**small)).eval(), VAE(
        VAEConfig(in_channels=6, padding="replicate", **small | {"norm": "none"})
    ).eval()


def encoded(vaes, images, image_known, rays, rays_known) -> Conditioning:
    with torch.no_grad():
        return encode_known(
            images,
            image_known,
            rays,
            rays_known,
            image_vae=vaes[0],
            raymap_vae=vaes[1],
            encoding=Encoding(views_at_once=2),
        )


def random_views(count: int = 3):
    generator = torch.Generator().manual_seed(1)
    draw = lambda channels: torch.rand(count, channels, 16, 32, generator=generator)  # noqa: E731
    masks = (draw(1) > 0.5).float()
    return draw(3), masks, draw(6), (draw(1) > 0.3).float()


def test_nan_poison_in_unknown_pixels_never_reaches_the_network(vaes):
    images, image_known, rays, rays_known = random_views()
    clean = encoded(vaes, images, image_known, rays, rays_known)
    poisoned_images = torch.where(image_known > 0, images, torch.nan)
    poisoned_rays = torch.where(rays_known > 0, rays, torch.inf)
    poisoned = encoded(vaes, poisoned_images, image_known, poisoned_rays, rays_known)
    assert torch.equal(clean.channels, poisoned.channels)


def test_gradients_do_not_flow_into_unknown_pixels():
    values = torch.rand(1, 3, 4, 4, requires_grad=True)
    known = torch.zeros(1, 1, 4, 4)
    known[..., :2] = 1
    only_known(values, known).sum().backward()
    assert torch.equal(values.grad, known.expand_as(values))


def test_permuting_views_permutes_the_conditioning(vaes):
    parts = random_views()
    order = torch.tensor([2, 0, 1])
    straight = encoded(vaes, *parts).channels
    assert torch.allclose(encoded(vaes, *(part[order] for part in parts)).channels, straight[order], atol=1e-5)


@pytest.mark.parametrize("unknown", [[1], [0, 3], [1, 2, 4], [0, 1, 2, 3, 4]])
def test_views_of_which_nothing_is_known_are_encoded_as_one_and_told_the_same(vaes, unknown, monkeypatch):
    images, image_known, rays, rays_known = random_views(5)
    image_known[unknown], rays_known[unknown[:1]] = 0.0, 0.0
    each = [
        encoded(vaes, *(part[view : view + 1] for part in (images, image_known, rays, rays_known))).channels
        for view in range(5)
    ]
    encode, counted = VAE.encode, []
    monkeypatch.setattr(
        VAE, "encode", lambda self, pixels, *rest: (counted.append(len(pixels)), encode(self, pixels, *rest))[1]
    )
    together = encoded(vaes, images, image_known, rays, rays_known).channels
    torch.testing.assert_close(together, torch.cat(each), atol=1e-5, rtol=1e-5)
    assert sum(counted) == 5 - len(unknown) + 1 + 5


def test_null_is_the_conditioning_of_nothing_known(vaes):
    images, _, rays, _ = random_views()
    nothing = torch.zeros(3, 1, 16, 32)
    of_nothing = encoded(vaes, images, nothing, rays, nothing)
    with torch.no_grad():
        null = encode_null(of_nothing, image_vae=vaes[0], raymap_vae=vaes[1], pixels=(16, 32))
    assert torch.allclose(of_nothing.channels, null.channels, atol=1e-6)


def test_channels_are_in_the_order_of_the_released_weights():
    fill = lambda channels, value: torch.full((1, 2, channels, 4, 4), value)  # noqa: E731
    sequence = join(
        unsplit(fill(16, 0.0), fill(16, 1.0)), assemble(fill(16, 2.0), fill(16, 3.0), fill(1, 4.0), fill(1, 5.0))
    )
    assert sequence.shape == (1, 2, 66, 4, 4)
    assert sequence[0, 0, :, 0, 0].tolist() == [0.0] * 16 + [1.0] * 16 + [2.0] * 16 + [3.0] * 16 + [4.0, 5.0]


def test_split_is_the_inverse_of_unsplit():
    state = torch.rand(2, 3, 32, 4, 4)
    assert torch.equal(unsplit(*split(state)), state)


def test_masks_are_area_averaged_onto_the_latent_grid(vaes):
    images, _, rays, _ = random_views(1)
    known = torch.zeros(1, 1, 16, 32)
    known[..., :4] = 1
    conditioning = encoded(vaes, images, known, rays, torch.ones_like(known))
    assert torch.allclose(conditioning.image_known[0, 0, 0], torch.tensor([0.5, 0.0, 0.0, 0.0]))
    assert torch.equal(conditioning.rays_known, torch.ones(1, 1, 2, 4))
