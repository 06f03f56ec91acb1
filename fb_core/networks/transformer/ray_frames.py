"""Frames of known rays in attention: what a token asks and answers is told in the frame of its own rays, so that
attention depends on how two tokens' rays lie to each other and not on where the world's axes are.

A token's frame G is the 4 x 4 matrix of the similarity from the frame of its patch's rays to the sequence's canonical
frame: its third axis is the ray through the patch's centre, its first the direction in which columns grow, made
orthogonal to it; its origin is the rays' origin, in units of the canonical frame (so the scale that the canonical frame
gives a scene matters, and nothing else of the world does). On half of each head's channels, read as vectors of 4,
queries are multiplied by the inverse transpose of their frame, keys and values by their frame, and what is gathered by
the inverse of the query's frame:

    q_i' . k_j' = (G_i^-T q_i) . (G_j k_j) = q_i . (G_i^-1 G_j) k_j,     y_i = G_i^-1 sum_j a_ij G_j v_j

A token without known rays has the identity. The idea is that of geometric-transform attention (Miyato et al. 2024) and
of projective position encodings (Li et al. 2025), here from raymaps alone, so that it holds for any lens, any crop, and
any mix of known and unknown rays.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.networks.transformer.embeddings import at_least_float32

VECTOR = 4
"""Channels that a frame acts on together."""
_LEAST_SPREAD = 1e-6
"""Least determinant, over that of a whole patch, of the places at which a patch's rays are known: below it (one row or
column) they tell no axes.
"""


class RayFrames(NamedTuple):
    """Frames of the tokens of b sequences, in the order of the tokens."""

    frame: Float[Tensor, "b tokens 4 4"]
    """From the frame of a token's rays to the canonical one."""
    inverse: Float[Tensor, "b tokens 4 4"]
    """Its inverse."""

    @staticmethod
    def of(frames: Float[Tensor, "b n h w 4 4"]) -> RayFrames:
        """Frames of sequences of n views of h x w tokens, with their inverses: rigid motions, whose rotation is
        transposed.
        """
        frame = rearrange(frames, "b n h w i j -> b (n h w) i j")
        rotation = frame[..., :3, :3].mT
        inverse = torch.zeros_like(frame)
        inverse[..., :3, :3] = rotation
        inverse[..., :3, 3:] = -(rotation @ frame[..., :3, 3:])
        inverse[..., 3, 3] = 1.0
        return RayFrames(frame, inverse)

    def of_some(self, places: Tensor) -> RayFrames:
        """Those of the tokens at these places of every sequence."""
        return RayFrames(*(values[:, places] for values in self))

    def chosen(self, places: Tensor) -> RayFrames:
        """One sequence of the tokens at these places of all sequences in a row."""
        return RayFrames(*(values.flatten(0, 1)[places][None] for values in self))


def frames_of_rays(
    raymaps: Float[Tensor, "*b 6 height width"], known: Float[Tensor, "*b 1 height width"], side: int
) -> Float[Tensor, "*b h w 4 4"]:
    """The frame of every patch of ``side`` pixels, from its known rays alone; the identity where they do not tell one.

    Args:
        raymaps: canonical raymaps (`fb_core.geometry.raymap`); what stands in unknown rays may be anything, NaN
            included.
        known: 1 = known; a ray counts where it is wholly known.
        side: pixels per side of a token's patch; divides height and width.

    Direction and its growth along columns come from a linear fit to the patch's known rays, so that a patch that is cut
    by the border of a picture has the frame that the whole one would have, up to the fit's error.
    """
    split = {"p": side, "q": side}
    dtype = at_least_float32(raymaps.dtype)
    weight = rearrange((known >= 1).to(dtype), "... 1 (h p) (w q) -> ... h w (p q)", **split)
    rays = torch.where(known >= 1, raymaps, torch.zeros((), dtype=raymaps.dtype, device=raymaps.device)).to(dtype)
    rays = rearrange(rays, "... c (h p) (w q) -> ... h w (p q) c", **split)
    steps = torch.arange(side, device=raymaps.device, dtype=dtype) - (side - 1) / 2
    down, right = (axis.flatten() for axis in torch.meshgrid(steps, steps, indexing="ij"))
    basis = torch.stack([torch.ones_like(right), right, down], dim=1)
    normal = torch.einsum("...p,pi,pj->...ij", weight, basis, basis)
    whole = torch.linalg.det(basis.T @ basis)
    determined = torch.linalg.det(normal) > _LEAST_SPREAD * whole
    identity = torch.eye(3, device=raymaps.device, dtype=dtype)
    fit = torch.linalg.solve(
        torch.where(determined[..., None, None], normal, identity), torch.einsum("...pc,pi->...ic", rays, basis)
    )
    forward = F.normalize(fit[..., 0, 3:], dim=-1)
    across = fit[..., 1, 3:]
    across = F.normalize(across - (across * forward).sum(dim=-1, keepdim=True) * forward, dim=-1)
    origin = rays[..., :3].sum(dim=-2) / weight.sum(dim=-1, keepdim=True).clamp(min=1)
    frames = torch.zeros(*forward.shape[:-1], VECTOR, VECTOR, device=raymaps.device, dtype=dtype)
    frames[..., :3, 0], frames[..., :3, 1], frames[..., :3, 2] = across, torch.linalg.cross(forward, across), forward
    frames[..., :3, 3] = origin
    frames[..., 3, 3] = 1.0
    determined = determined & (forward.norm(dim=-1) > 0.5) & (across.norm(dim=-1) > 0.5)
    return torch.where(determined[..., None, None], frames, torch.eye(VECTOR, device=raymaps.device, dtype=dtype))


def transformed(
    x: Float[Tensor, "b heads tokens k"], matrices: Float[Tensor, "b tokens 4 4"]
) -> Float[Tensor, "b heads tokens k"]:
    """The first half of every head's channels multiplied by the token's matrix, in vectors of 4; the other half as it
    was.
    """
    moved, still = x.chunk(2, dim=-1)
    vectors = rearrange(moved, "b heads tokens (m i) -> b tokens (heads m) i", i=VECTOR)
    vectors = vectors @ matrices.mT.to(x.dtype)
    return torch.cat(
        [rearrange(vectors, "b tokens (heads m) i -> b heads tokens (m i)", heads=x.shape[1]), still], dim=-1
    )
