"""Rays as lists: what a raymap gives the camera fit. Unusable rays are set aside and counted, the rest thinned evenly
over the image.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Rays:
    """``r`` rays of each of ``n`` views in float64: the usable ones first, then padding with weight 0 and harmless
    finite values.

    Any leading part of a list covers the image as evenly as it can. Components stand apart (a sum over a last axis of
    three is slow).
    """

    origins: Float[Tensor, "n 3 r"]
    """Where rays start, scene units: a noisy copy of their camera's centre each."""
    directions: Float[Tensor, "n 3 r"]
    """Unit vectors in the frame of the origins."""
    pixels: Float[Tensor, "n 2 r"]
    """(x, y) in the image; the centre of the top left pixel is (0.5, 0.5)."""
    weights: Float[Tensor, "n r"]
    """Inverse variances up to a common factor."""
    broken: Int[Tensor, " n"]
    """Rays with a weight that were rejected because they hold NaN, infinity or a direction of length zero."""
    precision: float
    """Relative rounding of the numbers that the rays came in; no residual below it means anything."""

    @property
    def usable(self) -> Bool[Tensor, "n r"]:
        """Rays that take part."""
        return self.weights > 0

    def leading(self, count: int) -> Rays:
        """At most so many rays of each view."""
        part = {name: getattr(self, name)[..., :count] for name in ("origins", "directions", "pixels", "weights")}
        return dataclasses.replace(self, **part)


def length_of(vectors: Float[Tensor, "n c *r"]) -> Float[Tensor, "n *r"]:
    """Lengths of vectors whose components are the second axis (ten times as fast as torch's norm there)."""
    return vectors.square().sum(dim=1).sqrt()


def sound_rays(rays: Float[Tensor, "n 6 *r"]) -> Bool[Tensor, "n *r"]:
    """Rays whose six numbers are finite and whose direction is not zero."""
    sound = (rays[:, 3] != 0) | (rays[:, 4] != 0) | (rays[:, 5] != 0)
    if bool(torch.isfinite(rays.sum())):  # nearly always, and then nothing more is to be looked at
        return sound
    return sound & torch.isfinite(rays).all(dim=1)


def rays_of(rays: Float[Tensor, "n 6 r"], pixels: Float[Tensor, "n 2 r"], weights: Float[Tensor, "n r"]) -> Rays:
    """All usable rays (origin, direction) of the given ones, in an order that looks random and is always the same."""
    sound = sound_rays(rays)
    order = torch.randperm(weights.shape[1], generator=torch.Generator().manual_seed(0)).to(weights.device)
    usable = ((weights > 0) & sound)[:, order]
    order = order[torch.sort(usable.to(torch.int8), dim=1, descending=True, stable=True).indices]
    return _rays(
        torch.gather(rays, 2, order[:, None].expand(-1, 6, -1)),
        torch.gather(pixels, 2, order[:, None].expand(-1, 2, -1)),
        torch.gather(weights * sound, 1, order),
        ((weights > 0) & ~sound).sum(dim=1),
    )


def rays_of_raymaps(
    raymaps: Float[Tensor, "n 6 h w"], weights: Float[Tensor, "n h w"], sound: Bool[Tensor, "n h w"], *, at_most: int
) -> Rays:
    """At most so many rays of every view that have a weight and are sound, spread evenly over what there is of it.

    Pixels are taken coarse grid first (every 2^k-th in both directions, then those between), so that any number of them
    covers the image, and the first few do as well as all. A view's choice does not depend on the other views.
    """
    height, width = raymaps.shape[-2:]
    asked = weights > 0
    usable = (asked & sound).flatten(1)
    counts = usable.sum(dim=1)
    length = min(at_most, int(counts.max())) if len(counts) else 0
    order = coarse_to_fine(height, width, device=raymaps.device)
    if bool((counts == height * width).all()):
        chosen = order[:length].expand(len(counts), -1)
    else:  # every taken pixel goes to its place in the list, all others to one place beyond its end, which is cut off
        usable = usable[:, order]
        place = usable.cumsum(dim=1) - 1
        chosen = order.new_zeros(len(counts), length + 1)
        chosen = chosen.scatter(1, torch.where(usable & (place < length), place, length), order.expand_as(place))[
            :, :length
        ]
    filled = torch.arange(length, device=order.device) < counts[:, None]
    rays = torch.gather(raymaps.flatten(2), 2, chosen[:, None].expand(-1, 6, -1))
    pixels = torch.stack([chosen % width, chosen // width], dim=1).double() + 0.5
    taken = torch.where(filled, torch.gather(weights.flatten(1), 1, chosen), 0.0)
    return _rays(rays, pixels, taken, (asked & ~sound).flatten(1).sum(dim=1))


def _rays(
    rays: Float[Tensor, "n 6 r"],
    pixels: Float[Tensor, "n 2 r"],
    weights: Float[Tensor, "n r"],
    broken: Int[Tensor, " n"],
) -> Rays:
    """In float64, with unit directions; the numbers of rays without weight are replaced, so that no NaN reaches a
    gradient.
    """
    usable = (weights > 0)[:, None]
    directions = torch.where(usable, rays[:, 3:].double(), 1.0)
    directions = directions / directions.detach().abs().amax(
        dim=1, keepdim=True
    )  # squares of tiny directions would vanish
    return Rays(
        origins=torch.where(usable, rays[:, :3].double(), 0.0),
        directions=directions / length_of(directions)[:, None],
        pixels=torch.where(usable, pixels.double(), 0.0),
        weights=weights.double(),
        broken=broken,
        precision=torch.finfo(rays.dtype).eps,
    )


def coarse_to_fine(height: int, width: int, *, device: torch.device | str | None = None) -> Int[Tensor, " hw"]:
    """Flat indices of all pixels such that every leading part of the list is spread evenly over the image."""
    y = torch.arange(height, device=device)[:, None]
    x = torch.arange(width, device=device)[None, :]
    key = torch.zeros(height, width, dtype=torch.long, device=device)
    for bit in range(
        max(height, width).bit_length()
    ):  # the lowest bits of x and y say how fine the first grid is that holds the pixel
        key = key * 4 + 2 * ((x ^ y) >> bit & 1) + (y >> bit & 1)
    return key.flatten().argsort()
