"""The two autoencoders: images and raymaps to latents at an eighth of the size, and back (paper section 3.1).

One class serves both. The image autoencoder is the customary KL autoencoder of latent diffusion; the raymap autoencoder
is a narrower one without normalisation and with replicated borders, because a raymap is smooth and its absolute values
matter. Parameter names are those of the released checkpoints. Callers hold values in [0, 1]; that the network sees [-1,
1] is its own business.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

LEVELS = 4
LOGVAR_RANGE = (-30.0, 20.0)


@dataclass(frozen=True, kw_only=True)
class VAEConfig:
    """Architecture of one autoencoder; `IMAGE_VAE` and `RAYMAP_VAE` are the released ones."""

    in_channels: int = 3
    """Channels of what is encoded and decoded: 3 for images, 6 for raymaps (origin, direction)."""
    widths: tuple[int, ...] = (128, 256, 512, 512)
    """Channels at full, half, quarter and eighth resolution."""
    latent_channels: int = 16
    """Channels of the latent."""
    encoder_resnets: int = 2
    """Residual blocks per encoder level."""
    decoder_resnets: int = 3
    """Residual blocks per decoder level."""
    norm: Literal["group", "none"] = "group"
    """Normalisation of every block: group norm, or the identity."""
    norm_groups: int = 32
    """Groups of every group norm; divides every width (ignored without normalisation)."""
    padding: Literal["zeros", "replicate"] = "zeros"
    """What 3x3 convolutions see beyond the border."""
    scaling: float = 0.18215
    """Latents are the encoder's output times this, so that their spread is about 1."""

    factor: ClassVar[int] = 2 ** (LEVELS - 1)

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))
        if len(self.widths) != LEVELS or not all(isinstance(width, int) and width > 0 for width in self.widths):
            raise ValueError(
                f"widths: expected {LEVELS} positive channel counts (spatial factor {self.factor}), got {self.widths}."
            )
        for name in ("in_channels", "latent_channels", "encoder_resnets", "decoder_resnets", "norm_groups"):
            if not isinstance(getattr(self, name), int) or getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a positive integer, got {getattr(self, name)!r}.")
        if self.norm not in ("group", "none"):
            raise ValueError(f"norm: expected 'group' or 'none', got {self.norm!r}.")
        if self.padding not in ("zeros", "replicate"):
            raise ValueError(f"padding: expected 'zeros' or 'replicate', got {self.padding!r}.")
        if self.norm == "group" and any(width % self.norm_groups for width in self.widths):
            raise ValueError(
                f"norm_groups: expected a divisor of every width in {self.widths}, got {self.norm_groups}."
            )
        if not 0 < self.scaling < float("inf"):
            raise ValueError(f"scaling: expected a positive number, got {self.scaling}.")


IMAGE_VAE = VAEConfig()
"""The released image autoencoder (84M parameters)."""

RAYMAP_VAE = VAEConfig(in_channels=6, widths=(32, 64, 128, 128), norm="none", padding="replicate")
"""The released raymap autoencoder (5M parameters)."""


def _norm(config: VAEConfig, channels: int) -> nn.Module:
    return nn.GroupNorm(config.norm_groups, channels, eps=1e-6) if config.norm == "group" else nn.Identity()


class _Conv3x3(nn.Conv2d):
    """A 3x3 convolution that keeps the size."""

    def __init__(self, config: VAEConfig, channels_in: int, channels_out: int):
        super().__init__(channels_in, channels_out, 3, padding=1, padding_mode=config.padding)

    def forward(self, input: Tensor) -> Tensor:
        """Same height and width."""
        if self.padding_mode == "replicate" and input.dtype == torch.bfloat16 and input.device.type == "cpu":
            # The same values; torch's padding in bfloat16 on a CPU takes twice to three times as long.
            wider = torch.cat([input[..., :1], input, input[..., -1:]], dim=-1)
            higher = torch.cat([wider[..., :1, :], wider, wider[..., -1:, :]], dim=-2)
            return F.conv2d(higher, self.weight, self.bias)
        return super().forward(input)


def _conv3x3(config: VAEConfig, channels_in: int, channels_out: int) -> nn.Conv2d:
    return _Conv3x3(config, channels_in, channels_out)


class Resnet(nn.Module):
    """Two normalised 3x3 convolutions added to their input (through a 1x1 convolution where the width changes)."""

    def __init__(self, config: VAEConfig, channels_in: int, channels_out: int):
        super().__init__()
        self.norm1 = _norm(config, channels_in)
        self.conv1 = _conv3x3(config, channels_in, channels_out)
        self.norm2 = _norm(config, channels_out)
        self.conv2 = _conv3x3(config, channels_out, channels_out)
        self.conv_shortcut = nn.Conv2d(channels_in, channels_out, 1) if channels_in != channels_out else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Same height and width, `channels_out` channels."""
        y = self.conv1(F.silu(self.norm1(x)))
        y = self.conv2(F.silu(self.norm2(y)))
        return self.conv_shortcut(x) + y


class Attention(nn.Module):
    """Self-attention over all places of the coarsest level, one head over the full width, added to its input."""

    def __init__(self, config: VAEConfig, channels: int):
        super().__init__()
        self.group_norm = _norm(config, channels)
        self.to_q = nn.Linear(channels, channels)
        self.to_k = nn.Linear(channels, channels)
        self.to_v = nn.Linear(channels, channels)
        self.to_out = nn.ModuleList([nn.Linear(channels, channels)])

    def forward(self, x: Tensor) -> Tensor:
        """Same shape as the input."""
        tokens = rearrange(self.group_norm(x), "n c h w -> n 1 (h w) c")
        y = F.scaled_dot_product_attention(self.to_q(tokens), self.to_k(tokens), self.to_v(tokens))
        return x + rearrange(self.to_out[0](y), "n 1 (h w) c -> n c h w", h=x.shape[-2])


class Downsampler(nn.Module):
    """Halve the size: one more row and column at the lower right border, then a 3x3 convolution of stride 2."""

    def __init__(self, config: VAEConfig, channels: int):
        super().__init__()
        self.border = "constant" if config.padding == "zeros" else "replicate"
        self.conv = nn.Conv2d(channels, channels, 3, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """Half the height and width."""
        return self.conv(F.pad(x, (0, 1, 0, 1), mode=self.border))


class Upsampler(nn.Module):
    """Double the size: repeat every pixel, then a 3x3 convolution."""

    def __init__(self, config: VAEConfig, channels: int):
        super().__init__()
        self.conv = _conv3x3(config, channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """Twice the height and width."""
        return self.conv(F.interpolate(x, scale_factor=2.0, mode="nearest"))


class Level(nn.Module):
    """The residual blocks of one resolution, then the step to the next resolution (none after the last)."""

    def __init__(
        self, config: VAEConfig, channels_in: int, channels_out: int, resnets: int, step: type[nn.Module] | None
    ):
        super().__init__()
        self.resnets = nn.ModuleList(
            Resnet(config, channels_in if i == 0 else channels_out, channels_out) for i in range(resnets)
        )
        steps = [step(config, channels_out)] if step else []
        self.downsamplers = nn.ModuleList(steps if step is Downsampler else [])
        self.upsamplers = nn.ModuleList(steps if step is Upsampler else [])

    def forward(self, x: Tensor) -> Tensor:
        """Run the blocks, then the change of resolution."""
        for module in (*self.resnets, *self.downsamplers, *self.upsamplers):
            x = module(x)
        return x


class Middle(nn.Module):
    """The coarsest level's residual block, attention, residual block."""

    def __init__(self, config: VAEConfig, channels: int):
        super().__init__()
        self.attentions = nn.ModuleList([Attention(config, channels)])
        self.resnets = nn.ModuleList([Resnet(config, channels, channels) for _ in range(2)])

    def forward(self, x: Tensor) -> Tensor:
        """Same shape as the input."""
        return self.resnets[1](self.attentions[0](self.resnets[0](x)))


class Encoder(nn.Module):
    """Values in [-1, 1] to the (not yet projected) mean and log variance of the latent."""

    def __init__(self, config: VAEConfig):
        super().__init__()
        widths = config.widths
        self.conv_in = _conv3x3(config, config.in_channels, widths[0])
        self.down_blocks = nn.ModuleList(
            Level(
                config,
                widths[max(i - 1, 0)],
                widths[i],
                config.encoder_resnets,
                Downsampler if i < LEVELS - 1 else None,
            )
            for i in range(LEVELS)
        )
        self.mid_block = Middle(config, widths[-1])
        self.conv_norm_out = _norm(config, widths[-1])
        self.conv_out = _conv3x3(config, widths[-1], 2 * config.latent_channels)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n z h//8 w//8"]:
        """Eighth of the height and width, twice the latent channels."""
        x = self.conv_in(x)
        for level in self.down_blocks:
            x = level(x)
        return self.conv_out(F.silu(self.conv_norm_out(self.mid_block(x))))


class Decoder(nn.Module):
    """Latents to values in about [-1, 1]."""

    def __init__(self, config: VAEConfig):
        super().__init__()
        widths = config.widths[::-1]
        self.conv_in = _conv3x3(config, config.latent_channels, widths[0])
        self.mid_block = Middle(config, widths[0])
        self.up_blocks = nn.ModuleList(
            Level(
                config, widths[max(i - 1, 0)], widths[i], config.decoder_resnets, Upsampler if i < LEVELS - 1 else None
            )
            for i in range(LEVELS)
        )
        self.conv_norm_out = _norm(config, widths[-1])
        self.conv_out = _conv3x3(config, widths[-1], config.in_channels)

    def forward(self, z: Float[Tensor, "n z h w"]) -> Float[Tensor, "n c 8*h 8*w"]:
        """Eight times the height and width."""
        x = self.mid_block(self.conv_in(z))
        for level in self.up_blocks:
            x = level(x)
        return self.conv_out(F.silu(self.conv_norm_out(x)))


class VAE(nn.Module):
    """An autoencoder of pictures with values in [0, 1] (images, or raymaps as origin/2 + 1/2 and direction/2 + 1/2).

    Computes in its parameters' precision and answers in its input's. Zero pictures are allowed and give zero latents.
    """

    def __init__(self, config: VAEConfig):
        super().__init__()
        self.config = config
        self.encoder = Encoder(config)
        self.decoder = Decoder(config)
        self.quant_conv = nn.Conv2d(2 * config.latent_channels, 2 * config.latent_channels, 1)
        self.post_quant_conv = nn.Conv2d(config.latent_channels, config.latent_channels, 1)

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the parameters."""
        return self.quant_conv.weight.dtype

    def posterior(
        self, x01: Float[Tensor, "n c h w"]
    ) -> tuple[Float[Tensor, "n z h//8 w//8"], Float[Tensor, "n z h//8 w//8"]]:
        """Mean and log variance of the latent, NOT scaled; training's KL term needs them.

        Raises ValueError unless height and width are positive multiples of 8 and the channels are the configuration's.
        """
        channels, height, width = x01.shape[1:]
        factor = self.config.factor
        if channels != self.config.in_channels:
            raise ValueError(f"x01: expected {self.config.in_channels} channels, got {channels}.")
        if height % factor or width % factor or not height or not width:
            raise ValueError(
                f"x01: expected height and width to be positive multiples of {factor}, got {height} x {width}; crop "
                "or resize."
            )
        moments = self.quant_conv(self.encoder((2 * x01 - 1).to(self.dtype)))
        mean, logvar = moments.to(x01.dtype).chunk(2, dim=1)
        return mean, logvar.clamp(*LOGVAR_RANGE)

    def encode(
        self, x01: Float[Tensor, "n c h w"], generator: torch.Generator | Sequence[torch.Generator] | None = None
    ) -> Float[Tensor, "n z h//8 w//8"]:
        """Scaled latents of pictures: the posterior's mean, or a sample of it when a generator is given (or one for
        each picture).
        """
        mean, logvar = self.posterior(x01)
        if generator is not None:
            if isinstance(generator, torch.Generator):
                noise = torch.randn(mean.shape, generator=generator, device=generator.device, dtype=torch.float32).to(
                    mean
                )
            else:
                drawn = [
                    torch.randn(mean.shape[1:], generator=one, device=one.device, dtype=torch.float32)
                    for one in generator
                ]
                noise = torch.stack(drawn).to(mean)
            mean = mean + (0.5 * logvar).exp() * noise
        return self.config.scaling * mean

    def decode(
        self, latents: Float[Tensor, "n z h w"], clamp: bool = True, decoder: Callable[[Tensor], Tensor] | None = None
    ) -> Float[Tensor, "n c 8*h 8*w"]:
        """Pictures of scaled latents, in [0, 1], or unclamped for training's losses.

        `decoder` stands in for the whole decoder: a `TiledDecoder` of it, for large pictures.

        Raises ValueError for another number of channels.
        """
        if latents.shape[1] != self.config.latent_channels:
            raise ValueError(f"latents: expected {self.config.latent_channels} channels, got {latents.shape[1]}.")
        z = (latents / self.config.scaling).to(self.dtype)
        x01 = (decoder or self.decoder)(self.post_quant_conv(z)).to(latents.dtype) / 2 + 0.5
        return x01.clamp(0, 1) if clamp else x01

    @torch.no_grad()
    def initialize(self, generator: torch.Generator) -> "VAE":
        """Draw weights for training from scratch: every residual branch starts at zero, all else keeps the variance."""
        for name, module in self.named_modules():
            if isinstance(module, nn.GroupNorm):
                module.reset_parameters()
            elif isinstance(module, nn.Conv2d | nn.Linear):
                closes_branch = name.endswith(("conv2", "to_out.0"))
                std = 0.0 if closes_branch else module.weight[0].numel() ** -0.5
                module.weight.copy_(
                    torch.randn(module.weight.shape, generator=generator, device=generator.device) * std
                )
                if module.bias is not None:
                    module.bias.zero_()
        return self
