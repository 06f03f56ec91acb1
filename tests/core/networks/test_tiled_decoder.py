"""Decoding in tiles: the whole decoder's answer at every size of tile, with less memory."""

import pytest
import torch

from fb_core.memory.live_bytes import LiveBytes
from fb_core.networks.tiled_decoder import TiledDecoder
from fb_core.networks.vae import VAE, VAEConfig

WITH_NORMS = VAEConfig(widths=(8, 8, 16, 16), norm_groups=4, latent_channels=4, encoder_resnets=1, decoder_resnets=2)
WITHOUT = VAEConfig(
    in_channels=6, widths=(8, 8, 8, 8), norm="none", padding="replicate", latent_channels=4, encoder_resnets=1
)


def lively(config: VAEConfig) -> VAE:
    """A network in float64 whose norms and biases differ from channel to channel."""
    torch.manual_seed(0)
    vae = VAE(config).double().eval()
    for parameter in vae.parameters():
        if parameter.ndim == 1:
            torch.nn.init.normal_(parameter, mean=0.5, std=0.5)
    return vae


@pytest.mark.parametrize("config", [WITH_NORMS, WITHOUT])
@pytest.mark.parametrize(("tile", "size"), [(16, (5, 7)), (20, (9, 4)), (32, (8, 8)), (512, (3, 5)), (16, (1, 1))])
@torch.no_grad()
def test_tiles_equal_the_whole(config, tile, size):
    """The twin is the decoder itself; in float64 the difference is rounding, for tiles that do and do not divide the
    size.
    """
    vae = lively(config)
    latents = torch.randn(2, 4, *size, dtype=torch.float64)
    latents[0] *= 3  # pictures of one batch have statistics of their own
    whole = vae.decode(latents, clamp=False)
    tiles = vae.decode(latents, clamp=False, decoder=TiledDecoder(vae.decoder, tile))
    torch.testing.assert_close(tiles, whole, atol=1e-10 * whole.abs().max().item(), rtol=0)


@torch.no_grad()
def test_statistics_of_the_tile_alone_would_be_wrong():
    """What the extra passes are for: a picture whose halves differ, decoded with each tile's own statistics, is far
    off.
    """
    vae = lively(WITH_NORMS)
    latents = torch.randn(1, 4, 8, 8, dtype=torch.float64)
    latents[..., :4] *= 4
    whole = vae.decode(latents, clamp=False)
    apart = torch.cat([vae.decode(half, clamp=False) for half in latents.split(4, dim=3)], dim=3)
    assert (apart - whole).abs().max() > 0.05 * whole.abs().max()


@torch.no_grad()
def test_half_precision_is_as_near_as_the_whole():
    vae = lively(WITH_NORMS).float()
    latents = torch.randn(1, 4, 6, 6)
    exact = vae.decode(latents, clamp=False)
    vae = vae.to(torch.bfloat16)
    rough, tiles = (
        vae.decode(latents, clamp=False),
        vae.decode(latents, clamp=False, decoder=TiledDecoder(vae.decoder, 16)),
    )
    assert tiles.dtype == torch.float32
    assert (tiles - exact).abs().mean() < 1.5 * (rough - exact).abs().mean()


@torch.no_grad()
def test_tiles_need_less_memory():
    vae = lively(WITH_NORMS).float()
    peaks = []
    for tile in (None, 32):
        with LiveBytes() as live:
            vae.decode(torch.randn(1, 4, 16, 16), decoder=tile and TiledDecoder(vae.decoder, tile))
        peaks.append(live.peak)
    assert peaks[1] < peaks[0] / 2


@pytest.mark.parametrize("tile", [0, 12, 30, -16])
def test_impossible_tiles_are_refused(tile):
    with pytest.raises(ValueError, match=rf"tile: expected a multiple of 4 of at least 16 pixels, got {tile}"):
        TiledDecoder(lively(WITH_NORMS).decoder, tile)
