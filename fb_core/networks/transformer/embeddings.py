"""Sinusoidal embeddings: where a token lies in its view, which view it belongs to, and how noisy the sequence is.

All three are the released model's: a token receives `layout_embedding` (place inside the view, relative to the view's
size) plus `sincos` of its view's index position (paper section 3.2, "index embedding"), and every block is modulated by
`timestep_embedding`. They are computed in float32 (or float64) whatever the precision of the network, because angles
reach 1000 radians.
"""

import math
from typing import Literal

import torch
import torch.nn.functional as F
from einops import repeat
from jaxtyping import Float
from torch import Tensor, nn

IndexMode = Literal["flexible", "fixed", "none"]
"""How views are told apart: random positions in training, evenly spaced ones always, or not at all."""

INDEX_MODES: tuple[IndexMode, ...] = ("flexible", "fixed", "none")
"""Every valid `IndexMode`."""

MAX_PERIOD = 10000.0
ANGLE_SCALE = 10.0
TIME_SCALE = 1000.0
TIME_CHANNELS = 256


def at_least_float32(dtype: torch.dtype) -> torch.dtype:
    """The dtype in which delicate arithmetic runs: float32 for half precision, else `dtype` itself (float64 stays)."""
    return torch.promote_types(dtype, torch.float32)


def sincos(positions: Float[Tensor, "*batch"], width: int) -> Float[Tensor, "*batch width"]:
    """Embed scalar positions: `width/2` sines followed by `width/2` cosines of `10 * position * frequency`.

    Frequencies fall geometrically from 1 to 1/10000, both included. `width` is even and at least 4.

    Raises ValueError for other widths than even ones from 4 on.
    """
    if width < 4 or width % 2:
        raise ValueError(f"width: expected an even number of at least 4 embedding channels, got {width}.")
    positions = positions.to(at_least_float32(positions.dtype))
    exponents = torch.linspace(0, 1, width // 2, device=positions.device, dtype=positions.dtype)
    angles = ANGLE_SCALE * positions[..., None] * MAX_PERIOD**-exponents
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def layout_embedding(
    height: int,
    width: int,
    channels: int,
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "height width channels"]:
    """Embed the places of a view's `height` x `width` tokens: column in the first half of the channels, row in the
    second.

    Places run over [0, 2 pi) with the end excluded, so they are relative to the view's size: half-way is pi at any
    resolution.
    """
    columns = torch.arange(width, device=device, dtype=dtype) * (2 * math.pi / width)
    rows = torch.arange(height, device=device, dtype=dtype) * (2 * math.pi / height)
    across = repeat(sincos(columns, channels // 2), "width c -> height width c", height=height)
    down = repeat(sincos(rows, channels // 2), "height c -> height width c", width=width)
    return torch.cat([across, down], dim=-1)


def index_positions(
    mode: IndexMode,
    batch: int,
    views: int,
    *,
    generator: torch.Generator | None = None,
    device: torch.device | str | None = None,
) -> Float[Tensor, "batch views"]:
    """Index positions in [0, 2 pi], one scalar per view.

    Without a generator (inference) views are spaced evenly from 0 to 2 pi inclusive; one view lies at 0. With a
    generator (training) "flexible" draws every view's position uniformly, which lets one model take any number of
    views; "fixed" keeps the even spacing and "none" gives zeros. Draws happen on the generator's device.

    Raises ValueError for unknown modes.
    """
    if mode not in INDEX_MODES:
        raise ValueError(f"mode: expected one of {', '.join(INDEX_MODES)}, got {mode!r}.")
    if mode == "none":
        return torch.zeros(batch, views, device=device, dtype=torch.float32)
    if mode == "flexible" and generator is not None:
        drawn = torch.rand(batch, views, generator=generator, device=generator.device, dtype=torch.float32)
        return (2 * math.pi * drawn).to(device or generator.device)
    return torch.linspace(0, 2 * math.pi, views, device=device, dtype=torch.float32).expand(batch, views)


def timestep_embedding(timesteps: Float[Tensor, "b"], channels: int) -> Float[Tensor, "b channels"]:
    """Embed timesteps on the released scale (0 data, 1000 noise, fractions allowed): cosines first, then sines."""
    timesteps = timesteps.to(at_least_float32(timesteps.dtype))
    steps = torch.arange(channels // 2, device=timesteps.device, dtype=timesteps.dtype)
    angles = timesteps[:, None] * torch.exp(-math.log(MAX_PERIOD) * steps / (channels // 2))
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


class TimestepEmbedder(nn.Module):
    """Two layers on the sinusoidal timestep."""

    def __init__(self, width: int):
        super().__init__()
        self.linear_1 = nn.Linear(TIME_CHANNELS, width)
        self.linear_2 = nn.Linear(width, width)

    def forward(self, time: Float[Tensor, "b"]) -> Float[Tensor, "b d"]:
        """Embedding of times in [0, 1]."""
        embedding = timestep_embedding(TIME_SCALE * time.to(at_least_float32(time.dtype)), TIME_CHANNELS)
        return self.linear_2(F.silu(self.linear_1(embedding.to(self.linear_1.weight.dtype))))


class TimeEmbedding(nn.Module):
    """Holds the time layers under their name in the checkpoint."""

    def __init__(self, width: int):
        super().__init__()
        self.timestep_embedder = TimestepEmbedder(width)
