"""Scenes for the splat benchmark: Gaussians on the surfaces of a seeded room, or on the points of a real capture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.data.rooms.ray_caster import render
from fb_core.data.rooms.room import FAMILIES, Room, make_room
from fb_core.data.rooms.room_cameras import CAMERA_CLEARANCE_METRES, cameras_by_angles, free_positions
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.splats.gaussians import neighbour_distance

LEAVES = ("means", "quats", "scales", "opacities", "colors")
"""What a fit would optimise."""
_PIXELS_AT_3_METRES = 2.6  # standard deviation on the screen: what splats of a fitted room have
_FLATNESS = 0.3  # thickness of a Gaussian against its extent on the surface
_FOV_DEGREES = 70.0
_FACE = 128  # pixels of the pictures that surface points are drawn from


@dataclass(frozen=True, kw_only=True)
class SplatScene:
    """What one rasterization needs, in float32: Gaussians with rasterizer values (no logarithms) and one camera."""

    name: str
    """As in "10k@256"."""
    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    scales: Float[Tensor, "n 3"]
    opacities: Float[Tensor, " n"]
    colors: Float[Tensor, "n 3"]
    viewmats: Float[Tensor, "1 4 4"]
    Ks: Float[Tensor, "1 3 3"]
    width: int
    height: int

    def inputs(
        self, dtype: torch.dtype = torch.float32, *, gradients: bool = False, device: torch.device | str = "cpu"
    ) -> dict[str, Any]:
        """Fresh keyword arguments for a rasterization; with ``gradients`` the Gaussians are leaves that want some."""
        tensors = {name: getattr(self, name).to(device, dtype, copy=True) for name in (*LEAVES, "viewmats", "Ks")}
        if gradients:
            tensors |= {name: tensors[name].requires_grad_() for name in LEAVES}
        return {**tensors, "width": self.width, "height": self.height}


def room_scene(count: int, size: int, *, seed: int = 0) -> SplatScene:
    """``count`` flat Gaussians on the surfaces of a room, seen from a corner at ``size`` x ``size`` pixels; the same
    for the same seed.

    On the screen they are as large at 3 m whatever the size of the picture (2.6 pixels, log-normal), opacities are
    sigmoid(1.5 N): the statistics of the scenes for which the bars were set. About two thirds lie in the picture.

    Raises ValueError for no Gaussians and for pictures below 8 pixels.
    """
    if count < 1 or size < 8:
        raise ValueError(f"count and size: expected at least 1 Gaussian and 8 pixels, got {count} and {size}")
    room = make_room(seed, FAMILIES["medium"])
    generator = torch.Generator().manual_seed(seed)
    points, normals, colors = _surface(room, count, generator)
    camera = _corner_camera(room, size)
    sigma = _PIXELS_AT_3_METRES * 3.0 / float(camera.focal[0, 0])
    spread = sigma * torch.exp(0.5 * torch.randn(count, 3, generator=generator))
    spread[:, 2] *= _FLATNESS
    return SplatScene(
        name=f"{count // 1000}k@{size}" if count % 1000 == 0 else f"{count}@{size}",
        means=points,
        quats=_onto(normals, generator),
        scales=spread,
        opacities=torch.sigmoid(1.5 * torch.randn(count, generator=generator)),
        colors=colors,
        viewmats=camera.world_to_camera,
        Ks=camera.intrinsics,
        width=size,
        height=size,
    )


def capture_scene(path: Path, *, seed: int = 0) -> SplatScene:
    """Gaussians on the points of an npz file: means3d [n, 3], colors [n, 3] (bytes), viewmats, Ks, width, height; its
    first camera.

    They are round, as large as the distance to their neighbours, with opacities sigmoid(1.5 N).
    Raises ValueError when the file is missing or lacks an entry.
    """
    import numpy as np

    wanted = ("means3d", "colors", "viewmats", "Ks", "width", "height")
    if not path.is_file():
        raise ValueError(f"capture: expected an npz file of points and cameras, {path} is none; check the path")
    with np.load(path) as file:
        missing = [name for name in wanted if name not in file]
        if missing:
            raise ValueError(f"capture: {path.name} should hold {', '.join(wanted)} but lacks {', '.join(missing)}")
        data = {name: torch.from_numpy(np.asarray(file[name])) for name in wanted}
    means, generator = data["means3d"].float(), torch.Generator().manual_seed(seed)
    width, height = int(data["width"]), int(data["height"])
    return SplatScene(
        name=f"{path.stem.removeprefix('test_')}, {round(len(means) / 1000)}k@{width}x{height}",
        means=means,
        quats=F.normalize(torch.randn(len(means), 4, generator=generator), dim=-1),
        scales=neighbour_distance(means)[:, None].repeat(1, 3),
        opacities=torch.sigmoid(1.5 * torch.randn(len(means), generator=generator)),
        colors=data["colors"].float() / 255.0,
        viewmats=data["viewmats"][:1].float(),
        Ks=data["Ks"][:1].float(),
        width=width,
        height=height,
    )


def _surface(room: Room, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Points, unit normals (world) and colours of ``count`` random pixels of pictures all around, with repetition if
    need be.
    """
    places = max(1, -(-count // (6 * _FACE * _FACE)))
    centers = free_positions(room, places, generator=generator, reach=0.9)[:, None].expand(places, 6, 3).reshape(-1, 3)
    # Four horizontal faces, up and down (cameras need some heading, so not quite vertical).
    heading = torch.tensor([0.0, 0.5, 1.0, 1.5, 0.0, 0.0]).mul(math.pi).repeat(places)
    pitch = torch.tensor([0.0, 0.0, 0.0, 0.0, 1.55, -1.55]).repeat(places)
    cameras = cameras_by_angles(centers, heading, pitch, torch.full_like(heading, 90.0), size=_FACE)
    images = render(room, cameras)
    points = cameras.unproject(images.depth).flatten(0, 2)
    pixels = points.shape[0]
    chosen = torch.randperm(pixels, generator=generator)[:count]
    if count > pixels:
        chosen = torch.randint(pixels, (count,), generator=generator)
    jitter = 0.005 * torch.randn(count, 3, generator=generator)  # as fitted splats scatter about a surface, metres
    return points[chosen] + jitter, _columns(images.normals)[chosen], _columns(images.rgb)[chosen]


def _columns(images: Float[Tensor, "v 3 h w"]) -> Float[Tensor, "p 3"]:
    return images.permute(0, 2, 3, 1).flatten(0, 2)


def _onto(normals: Float[Tensor, "n 3"], generator: torch.Generator) -> Float[Tensor, "n 4"]:
    """Unit quaternions (wxyz) that turn z onto the normals, after a random turn about z."""
    x, y, z = normals.unbind(-1)
    tilt = torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=-1)  # the half-way rotation of z onto (x, y, z)
    tilt = torch.where((z < -0.9999)[:, None], torch.tensor([0.0, 1.0, 0.0, 0.0]), tilt)
    half = math.pi * torch.rand(len(normals), generator=generator)
    w, i, j, _ = F.normalize(tilt, dim=-1).unbind(-1)
    c, s = half.cos(), half.sin()
    return torch.stack([w * c, i * c + j * s, j * c - i * s, w * s], dim=-1)


def _corner_camera(room: Room, size: int) -> Pinholes:
    """From the freest corner at eye height across the room; it sees most of it."""
    x, y = (room.size[:2] / 2 - 2 * CAMERA_CLEARANCE_METRES).tolist()
    corners = torch.tensor([[sx * x, sy * y, 1.5] for sx in (-1, 1) for sy in (-1, 1)])
    corner = corners[room.clearance(corners).argmax()][None]
    target = torch.tensor([[0.0, 0.0, 1.2]])
    return Pinholes.looking_at(
        corner, target, up=torch.tensor([0.0, 0.0, 1.0]), fov_degrees=_FOV_DEGREES, width=size, height=size
    )
