"""Cameras of raymaps by plain gradient descent: the slow, readable twin of `fb_core.geometry.pose_solver`, as
benchmarks need it.

What the original does, restated: quaternion, centre and two focal lengths of every view, moved by AdamW so that origins
and points one unit along the rays agree in the mean absolute difference. Its principal points are the image's centre;
its pixels count from 0, which `half_pixel` mends.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import rotations_of


def fit_cameras_plainly(
    raymaps: Float[Tensor, "n 6 h w"],
    *,
    steps: int = 700,
    stride: int = 1,
    half_pixel: bool = True,
    weights: Float[Tensor, "n 1 h w"] | None = None,
    principal: Float[Tensor, "n 2"] | None = None,
    rate: float = 1e-2,
) -> Pinholes:
    """Cameras after so many steps on every `stride`-th pixel in both directions, starting with no rotation and a right
    angle of view.
    """
    count, _, height, width = raymaps.shape
    rays = raymaps[..., ::stride, ::stride].float().flatten(2).transpose(1, 2)
    shares = (
        torch.ones_like(rays[..., :1])
        if weights is None
        else weights[..., ::stride, ::stride].float().flatten(1)[..., None]
    )
    shares = shares / shares.sum(dim=1, keepdim=True).clamp_min(1) / (3 * count)
    shift = 0.5 if half_pixel else 0.0
    y, x = torch.meshgrid(
        torch.arange(0, height, stride) + shift, torch.arange(0, width, stride) + shift, indexing="ij"
    )
    middle = rays.new_tensor([width / 2, height / 2]).expand(count, 2) if principal is None else principal.to(rays)
    pixels = (torch.stack([x, y], dim=-1).flatten(0, 1).to(rays) - middle[:, None]) / rays.new_tensor(
        [width / 2, height / 2]
    )
    quaternions = rays.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1).requires_grad_()
    centers = (rays[..., :3] * shares * 3 * count).sum(dim=1).requires_grad_()
    focal = rays.new_ones(count, 2).requires_grad_()
    optimizer = torch.optim.AdamW([quaternions, centers, focal], lr=rate)
    for _ in range(steps):
        in_camera = torch.cat([pixels / focal[:, None], torch.ones_like(pixels[..., :1])], dim=-1)
        directions = F.normalize(in_camera @ rotations_of(F.normalize(quaternions, dim=-1)).transpose(1, 2), dim=-1)
        ends = centers[:, None] + directions - rays[..., :3] - rays[..., 3:]
        loss = (ends.abs() * shares).sum() + ((rays[..., :3] - centers[:, None]).abs() * shares).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        return Pinholes(
            camera_to_world=torch.cat([rotations_of(F.normalize(quaternions, dim=-1)), centers[..., None]], dim=2),
            focal=focal * focal.new_tensor([width / 2, height / 2]),
            principal=middle.clone(),
            width=width,
            height=height,
        )
