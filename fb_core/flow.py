"""Rectified flow (paper, section 3.1): z_t = (1 - t) z + t eps with t = 0 data and t = 1 noise; the network predicts
eps - z.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Network = Callable[[Float[Tensor, "b n 32 h w"], Float[Tensor, "b"]], Float[Tensor, "b n 32 h w"]]
"""State and time to velocity, the conditioning already bound."""


def at_time(
    data: Float[Tensor, "b *rest"], noise: Float[Tensor, "b *rest"], time: Float[Tensor, "b"]
) -> Float[Tensor, "b *rest"]:
    """The straight path's point z_t."""
    t = time.reshape(-1, *[1] * (data.ndim - 1))
    return (1 - t) * data + t * noise


def velocity(data: Float[Tensor, "*any"], noise: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
    """dz_t/dt of the straight path: the network's target."""
    return noise - data


def logit_normal_times(count: int, *, generator: torch.Generator) -> Float[Tensor, "b"]:
    """Training times in (0, 1): the sigmoid of a standard normal, as in Esser et al. 2024."""
    return torch.sigmoid(torch.randn(count, generator=generator, device=generator.device, dtype=torch.float32))


def masked_loss(
    predicted: Float[Tensor, "b n c h w"],
    target: Float[Tensor, "b n c h w"],
    weight: Float[Tensor, "b n 1 h w"] | None = None,
    *,
    channels: slice = slice(None),
) -> Float[Tensor, ""]:
    """The loss of training and validation: mean squared error of some channels, 0 at positions of weight 0 (where there
    is no ground truth, such as rays of unposed photos).

    The mean is over all positions, whatever their weights: so the losses of a batch's equal parts, on one process or on
    many, average to the whole batch's, and an unposed photo among posed ones does not make their rays count for more.
    """
    error = (predicted - target).square()[:, :, channels]
    return error.mean() if weight is None else (error * weight).mean()


@torch.no_grad()
def validation_loss(
    network: Network, data: Float[Tensor, "b n 32 h w"], noise: Float[Tensor, "b n 32 h w"], *, steps: int = 20
) -> Tensor:
    """VAL of the paper's table 2: velocity error of image and raymap channels at ``steps`` equally spaced times. Shape
    [steps, 2].
    """
    half = data.shape[2] // 2
    losses, wanted = [], velocity(data, noise)
    for time in torch.linspace(1.0, 1.0 / steps, steps).tolist():
        batch_time = data.new_full((len(data),), time)
        predicted = network(at_time(data, noise, batch_time), batch_time)
        modalities = slice(half), slice(half, None)
        losses.append(torch.stack([masked_loss(predicted, wanted, channels=channels) for channels in modalities]))
    return torch.stack(losses)
