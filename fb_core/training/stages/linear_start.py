"""A start for autoencoders without normalisation: a linear codec of block averages.

Raymaps are so smooth that 8x8 block averages, interpolated bilinearly, nearly reproduce them. From random weights the
loss needs thousands of steps to get there; starting from that codec, training only has to add what averages lose.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn

from fb_core.networks.vae import VAE

_LINEAR_POINT = 8.0  # SiLU(8 + x) is 8 + x up to 0.3 % for the values in [-1, 1] that pass
_LOG_VARIANCE = -8.0  # posterior spread of 2 % of the input's range
_JITTER = 0.05  # random part, relative to a random start, so that the spare latent channels come into use


@torch.no_grad()
def start_linear(network: VAE, generator: torch.Generator) -> VAE:
    """Set the weights to the codec of averages; the first ``in_channels`` latent channels are the averages, in [-1, 1].

    Raises ValueError for an autoencoder with group norms (which are not linear) or with fewer channels somewhere than
    it encodes.
    """
    config = network.config
    channels = config.in_channels
    if config.norm != "none" or min(*config.widths, config.latent_channels) < channels:
        raise ValueError(f"linear start: expected no norms and at least {channels} channels everywhere, got {config}")
    network.initialize(generator)
    average, smooth = torch.zeros(3, 3), torch.tensor([[1.0, 2.0, 1.0]]) / 4
    average[:2, :2] = 0.25
    delta = torch.zeros(3, 3)
    delta[1, 1] = 1.0
    encoder, decoder = (
        cast(Any, network.encoder),
        cast(Any, network.decoder),
    )  # lists of blocks, which nn.Module hides from type checkers
    for level in encoder.down_blocks:
        for step in level.downsamplers:
            _pass(step.conv, average, channels)
    for level in decoder.up_blocks:
        for step in level.upsamplers:
            _pass(step.conv, smooth.T @ smooth, channels)
    for conv in (encoder.conv_in, decoder.conv_in, encoder.conv_out, decoder.conv_out):
        _pass(conv, delta, channels)
    point = torch.ones(1, 1)
    for name, module in network.named_modules():
        if name.endswith("conv_shortcut") and isinstance(module, nn.Conv2d):
            _pass(module, point, channels)
    _pass(network.quant_conv, point, channels)
    _pass(network.post_quant_conv, point, channels)
    network.quant_conv.weight[config.latent_channels :] = 0
    cast(Tensor, network.quant_conv.bias)[config.latent_channels :] = _LOG_VARIANCE
    # The closing SiLU of each half works at its linear point: shifted there by the last layer before it, shifted back
    # after it.
    for before, after in (
        (encoder.mid_block.resnets[1], encoder.conv_out),
        (decoder.up_blocks[-1].resnets[-1], decoder.conv_out),
    ):
        before.conv2.bias[:channels] += _LINEAR_POINT
        after.bias[:channels] -= _LINEAR_POINT
    return network


def _pass(conv: nn.Conv2d, kernel: Tensor, channels: int) -> None:
    """Let the first channels through ``kernel``, each by itself."""
    conv.weight *= _JITTER
    conv.weight[:channels] = 0
    for channel in range(channels):
        conv.weight[channel, channel] = kernel
