"""Exact pictures of triangle meshes: for every pixel the first triangle that its ray meets. The ray caster's sibling
for meshes.

A ray d from the camera meets the triangle (a, b, c) (camera axes) where d (a x b), d (b x c) and d (c x a) have one
sign; their shares are the barycentric weights (Olano and Greer 1997). No clipping is needed, so the camera may stand
inside the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.geometry.cameras import Pinholes

_PAIRS_AT_ONCE = 2**21  # of pixels and triangles


@dataclass(frozen=True, kw_only=True)
class TriangleHits:
    """What the rays of one camera meet, in the order of its pixels."""

    face: Int[Tensor, "h w"]
    """Number of the triangle; -1 for the background."""
    weights: Float[Tensor, "h w 3"]
    """Shares of the triangle's corners, which add up to 1; zeros for the background."""
    depth: Float[Tensor, "h w"]
    """z-depth in scene units; infinite for the background."""


def cast_triangles(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], camera: Pinholes) -> TriangleHits:
    """First triangles, both sides of which are seen, on the rays through one camera's pixel centres. Raises ValueError
    unless there is one camera.
    """
    if len(camera) != 1:
        raise ValueError(f"cast_triangles: expected one camera, got {len(camera)}; cast them one by one")
    pose = camera.world_to_camera[0].double()
    corners = (vertices.double() @ pose[:3, :3].T + pose[:3, 3])[faces]
    focal, principal = camera.focal[0].double(), camera.principal[0].double()
    a, b, c = corners.unbind(1)
    edges = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=1)
    volume = (a * edges[:, 0]).sum(dim=-1)
    depth = torch.full((camera.height * camera.width,), torch.inf, dtype=torch.float64, device=vertices.device)
    face = torch.full_like(depth, -1, dtype=torch.long)
    x, y, size = _boxes(corners, focal, principal, camera)
    for rows in _batches(size.prod(dim=1)):
        which, pixel = _pairs(rows, x, y, size, camera.width)
        depths = _depths(edges[which], volume[which], _rays(pixel, focal, principal, camera.width))
        # Of several triangles on one pixel the nearest wins; of equals (a shared edge) the first.
        depth.scatter_reduce_(0, pixel, depths, reduce="amin")
        won = (depths == depth[pixel]) & torch.isfinite(depths)
        face[pixel[won].flip(0)] = which[won].flip(0)
    weights = torch.zeros(len(depth), 3, dtype=torch.float64, device=vertices.device)
    seen = (face >= 0).nonzero()[:, 0]
    shares = torch.einsum("nij,nj->ni", edges[face[seen]], _rays(seen, focal, principal, camera.width))
    weights[seen] = shares / shares.sum(dim=-1, keepdim=True)
    shape = camera.height, camera.width
    return TriangleHits(
        face=face.view(shape), weights=weights.view(*shape, 3).to(vertices), depth=depth.view(shape).to(vertices)
    )


def _rays(pixel: Tensor, focal: Tensor, principal: Tensor, width: int) -> Float[Tensor, "n 3"]:
    """Ray directions of pixel numbers, with z = 1."""
    place = torch.stack([pixel % width, pixel // width], dim=-1) + 0.5
    return torch.nn.functional.pad((place - principal) / focal, (0, 1), value=1.0)


def _boxes(corners: Tensor, focal: Tensor, principal: Tensor, camera: Pinholes) -> tuple[Tensor, Tensor, Tensor]:
    """First column and row of each triangle's box of pixels, and its (rows, columns); empty for what lies outside or
    behind.
    """
    z = corners[..., 2]
    limit = corners.new_tensor([camera.width, camera.height])
    place = corners[..., :2] / z[..., None].clamp(min=1e-9) * focal + principal
    low, high = place.amin(dim=1), place.amax(dim=1)
    astride = (z <= 1e-6).any(dim=1, keepdim=True)  # partly behind the camera: its projection has no bounds
    low, high = torch.where(astride, torch.zeros_like(low), low), torch.where(astride, limit.expand_as(high), high)
    first = (low - 0.5).ceil().clamp(min=0)
    last = torch.minimum((high - 0.5).floor(), limit - 1)
    size = (last - first + 1).clamp(min=0) * (z > 0).any(dim=1, keepdim=True)
    first, size = torch.minimum(first, limit).long(), size.long()
    return first[:, 0], first[:, 1], size.flip(1)


def _batches(pairs: Tensor) -> list[Tensor]:
    """Numbers of the triangles in groups of bounded work (a group has one triangle at least)."""
    order = (pairs > 0).nonzero()[:, 0]
    group = (pairs[order].cumsum(0) - 1) // _PAIRS_AT_ONCE
    return [order[group == number] for number in group.unique().tolist()]


def _pairs(rows: Tensor, x: Tensor, y: Tensor, size: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """(triangle, pixel number) of every pixel in the boxes of some triangles."""
    count = size[rows].prod(dim=1)
    which = rows.repeat_interleave(count)
    inside = torch.arange(len(which), device=which.device) - (count.cumsum(0) - count).repeat_interleave(count)
    columns = size[which, 1]
    return which, (y[which] + inside // columns) * width + x[which] + inside % columns


def _depths(
    edges: Float[Tensor, "n 3 3"], volume: Float[Tensor, "n"], rays: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """z-depth at which each ray meets its triangle, infinite where it does not."""
    sides = torch.einsum("nij,nj->ni", edges, rays)
    depth = volume / sides.sum(dim=-1)  # the ray has z = 1, so its parameter is the z-depth
    met = ((sides >= 0).all(dim=-1) | (sides <= 0).all(dim=-1)) & (depth > 0) & torch.isfinite(depth)
    return torch.where(met, depth, torch.full_like(depth, torch.inf))
