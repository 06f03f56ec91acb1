"""The adversarial part of the autoencoders' loss: a patch discriminator, and the losses of both sides (paper, section
3.1 and appendix).
"""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

_WIDTHS = (64, 128, 256, 512)
_SLOPE = 0.2
_SPREAD = 0.02  # of the first weights


class PatchDiscriminator(nn.Module):
    """PatchGAN (Isola et al. 2017): judges overlapping patches of 70 x 70 pixels, each by one logit; above 0 means
    "real".

    Batch norms always use the batch at hand: there is no running state that an average of weights or a checkpoint could
    get wrong.
    """

    def __init__(self, channels: int):
        super().__init__()
        layers: list[nn.Module] = [nn.Conv2d(channels, _WIDTHS[0], 4, stride=2, padding=1), nn.LeakyReLU(_SLOPE)]
        for number, (before, after) in enumerate(itertools.pairwise(_WIDTHS)):
            stride = 2 if number < len(_WIDTHS) - 2 else 1
            layers += [
                nn.Conv2d(before, after, 4, stride=stride, padding=1, bias=False),
                nn.BatchNorm2d(after, track_running_stats=False),
                nn.LeakyReLU(_SLOPE),
            ]
        self.main = nn.Sequential(*layers, nn.Conv2d(_WIDTHS[-1], 1, 4, padding=1))

    def forward(self, values: Float[Tensor, "b c h w"]) -> Float[Tensor, "b 1 ph pw"]:
        """Logits of values in [-1, 1], of at least 24 x 24 pixels."""
        return self.main(values)

    @torch.no_grad()
    def initialize(self, generator: torch.Generator) -> PatchDiscriminator:
        """Draw weights for training from scratch."""
        for name, parameter in self.named_parameters():
            drawn = _SPREAD * torch.randn(parameter.shape, generator=generator, device=generator.device)
            is_gain = parameter.ndim == 1 and name.endswith("weight")
            parameter.copy_(torch.zeros_like(drawn) if name.endswith("bias") else 1 + drawn if is_gain else drawn)
        return self


def generator_loss(discriminator: nn.Module, reconstruction: Float[Tensor, "b c h w"]) -> Float[Tensor, ""]:
    """How little the discriminator takes the reconstruction for real (non-saturating).

    Its gradient reaches the reconstruction only: the discriminator is applied with weights that are held fixed.
    """
    fixed = {name: parameter.detach() for name, parameter in discriminator.named_parameters()}
    return F.softplus(-torch.func.functional_call(discriminator, fixed, (reconstruction,))).mean()


def discriminator_loss(
    discriminator: nn.Module, real: Float[Tensor, "b c h w"], reconstruction: Float[Tensor, "b c h w"]
) -> Float[Tensor, ""]:
    """How badly the discriminator tells real values from reconstructions. Its gradient reaches the discriminator
    only.
    """
    return (
        F.softplus(-discriminator(real.detach())).mean() + F.softplus(discriminator(reconstruction.detach())).mean()
    ) / 2
