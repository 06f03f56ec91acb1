"""Decoding of large pictures in tiles, with the whole decoder's answer: no seams and no blending, only less memory.

Three things let a tile see beyond its border. The mid block's attention and the coarse levels run on the whole picture,
where they are cheap. From half resolution on, a tile carries a margin as wide as the convolutions reach, which is cut
off again. And group norms use the statistics of the whole picture: those of the k-th norm are gathered over all tiles,
given those of the k - 1 before, then the tiles run once more to the next norm. A decoder with group norms therefore
computes its fine levels about six times, one without once.
"""

import math
from collections.abc import Iterator
from typing import cast

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from fb_core.networks.vae import LEVELS, Decoder, Level, Resnet

FIRST_TILED_LEVEL = 2
"""The levels before run on the whole picture: their activations are at most a quarter as high and wide as it."""
SMALLEST_TILE = 16


class TiledDecoder:
    """Stands in for `decoder` (in `VAE.decode`) and computes the same, up to rounding, in tiles of `tile` x `tile`
    pixels.
    """

    def __init__(self, decoder: Decoder, tile: int):
        if tile < SMALLEST_TILE or tile % 4:
            raise ValueError(f"tile: expected a multiple of 4 of at least {SMALLEST_TILE} pixels, got {tile}.")
        self.decoder = decoder
        self.tile = tile

    @torch.no_grad()
    def __call__(self, z: Float[Tensor, "n z h w"]) -> Float[Tensor, "n c 8*h 8*w"]:
        """Eight times the height and width."""
        levels = cast(list[Level], list(self.decoder.up_blocks))
        x = self.decoder.mid_block(self.decoder.conv_in(z))
        for level in levels[: FIRST_TILED_LEVEL - 1]:
            x = level(x)
        for resnet in levels[FIRST_TILED_LEVEL - 1].resnets:
            x = resnet(x)
        for number in range(FIRST_TILED_LEVEL, LEVELS):
            x = _Stage(self.decoder, number).run(x, self.tile // 2 ** (LEVELS - number))
        return x


class _Stage:
    """One doubling of the resolution: upsampler, residual blocks and, at the last level, the output layers."""

    def __init__(self, decoder: Decoder, number: int):
        levels = cast(list[Level], list(decoder.up_blocks))
        self.upsampler = levels[number - 1].upsamplers[0]
        self.resnets = cast(list[Resnet], list(levels[number].resnets))
        self.output = (decoder.conv_norm_out, decoder.conv_out) if number == LEVELS - 1 else None
        norms = [norm for resnet in self.resnets for norm in (resnet.norm1, resnet.norm2)]
        self.norms: list[nn.Module] = [*norms, decoder.conv_norm_out] if self.output else norms
        reach = 1 + 2 * len(self.resnets) + bool(self.output)
        self.margin = math.ceil(reach / 2)
        """Pixels of the input beyond a tile's border that have an influence inside."""

    def run(self, x: Float[Tensor, "n c h w"], tile: int) -> Float[Tensor, "n d 2*h 2*w"]:
        """The whole output, tile after tile of `tile` x `tile` pixels of the input."""
        fixed: list[_FixedNorm] = []
        for norm in self.norms:
            if not isinstance(norm, nn.GroupNorm):
                break
            moments = _Moments(norm)
            for window in _windows(x, tile, self.margin):
                moments.add(window.inside(self._until(window.pixels, fixed, stop=len(fixed))))
            fixed.append(moments.fixed())
        output: Tensor | None = None
        for window in _windows(x, tile, self.margin):
            piece = window.inside(self._until(window.pixels, fixed, stop=None))
            if output is None:
                output = piece.new_empty(x.shape[0], piece.shape[1], 2 * x.shape[2], 2 * x.shape[3])
            output[window.place] = piece
        assert output is not None
        return output

    def _until(self, x: Tensor, fixed: "list[_FixedNorm]", stop: int | None) -> Tensor:
        """The input of norm number `stop`, or the stage's output; norms without groups are the identity."""
        norms = [*fixed, *self.norms[len(fixed) :]]
        x = self.upsampler(x)
        for index, resnet in enumerate(self.resnets):
            if stop == 2 * index:
                return x
            y = resnet.conv1(F.silu(norms[2 * index](x)))
            if stop == 2 * index + 1:
                return y
            y = resnet.conv2(F.silu(norms[2 * index + 1](y)))
            x = resnet.conv_shortcut(x) + y
        if stop is not None or self.output is None:
            return x
        return self.output[1](F.silu(norms[-1](x)))


class _Window:
    """A tile with its margin: the pixels to compute on, and which part of the answer is the tile's."""

    def __init__(self, pixels: Tensor, inside: tuple[slice, slice], place: tuple[slice, slice]):
        self.pixels = pixels
        self._inside = inside
        self.place = (..., *place)
        """Where the tile lies in the stage's output."""

    def inside(self, answer: Tensor) -> Tensor:
        """The tile's own part of what was computed on `pixels`."""
        return answer[(..., *self._inside)]


def _windows(x: Tensor, tile: int, margin: int) -> Iterator[_Window]:
    """Tiles of a stage's input that cover it once; answers are twice as large as the input."""
    for top in range(0, x.shape[2], tile):
        for left in range(0, x.shape[3], tile):
            rows, row_inside, row_place = _span(top, tile, margin, x.shape[2])
            columns, column_inside, column_place = _span(left, tile, margin, x.shape[3])
            yield _Window(x[:, :, rows, columns], (row_inside, column_inside), (row_place, column_place))


def _span(start: int, length: int, margin: int, limit: int) -> tuple[slice, slice, slice]:
    """Of one axis: the input with its margin, the tile within the doubled answer, and the tile within the doubled
    whole.
    """
    stop = min(start + length, limit)
    first, last = max(start - margin, 0), min(stop + margin, limit)
    return slice(first, last), slice(2 * (start - first), 2 * (stop - first)), slice(2 * start, 2 * stop)


class _FixedNorm:
    """A group norm whose statistics are given: one multiplication and one addition per channel, in float32 at least."""

    def __init__(self, scale: Float[Tensor, "n c 1 1"], shift: Float[Tensor, "n c 1 1"]):
        self.scale, self.shift = scale, shift

    def __call__(self, x: Tensor) -> Tensor:
        return torch.addcmul(self.shift, x.to(self.scale.dtype), self.scale).to(x.dtype)


class _Moments:
    """Mean and variance of each picture's channel groups, gathered tile by tile (Chan's update, which does not
    cancel).
    """

    def __init__(self, norm: nn.GroupNorm):
        self.norm = norm
        self.count = 0
        self.mean: Tensor | float = 0.0
        self.squares: Tensor | float = 0.0

    def add(self, tile: Float[Tensor, "n c h w"]) -> None:
        """Take in one tile."""
        values = rearrange(tile, "n (g c) h w -> n g (c h w)", g=self.norm.num_groups)
        variance, mean = torch.var_mean(values.to(torch.promote_types(tile.dtype, torch.float32)), dim=-1, correction=0)
        count = values.shape[-1]
        difference, total = mean - self.mean, self.count + count
        self.mean = self.mean + difference * (count / total)
        self.squares = self.squares + variance * count + difference.square() * (self.count * count / total)
        self.count = total

    def fixed(self) -> _FixedNorm:
        """The norm with these statistics."""
        assert isinstance(self.mean, Tensor) and isinstance(self.squares, Tensor)
        per_group = (self.squares / self.count + self.norm.eps).rsqrt()
        repeats = self.norm.num_channels // self.norm.num_groups
        gain, bias = (value.to(per_group.dtype) for value in (self.norm.weight, self.norm.bias))
        scale = per_group.repeat_interleave(repeats, dim=1) * gain
        shift = bias - self.mean.repeat_interleave(repeats, dim=1) * scale
        return _FixedNorm(scale[:, :, None, None], shift[:, :, None, None])
