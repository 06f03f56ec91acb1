"""A picture of cameras in space: photos as frusta with their pictures, the new cameras and their path, drawn off-screen
by VTK.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.data.capture.point_cloud import Points
from fb_core.data.media import shrink
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.paths import up_of
from fb_core.machine.vtk_drawing import pyvista_off_screen

PHOTO_COLOR, NEW_COLOR = "#d9541e", "#1f6fb4"
_ELEVATION_DEGREES, _LENS_DEGREES = 35.0, 30.0
_FILLED = 0.9  # of the picture
_TEXTURE_SIDE = 256
_MOST_POINTS = 20_000


def draw_cameras(
    path: Path,
    cameras: Sequence[Pinholes],
    pictures: Sequence[Float[Tensor, "3 _h _w"]],
    *,
    new: Pinholes | None = None,
    points: Points | None = None,
    size: tuple[int, int] = (1500, 1000),
) -> None:
    """Draw photos' cameras with what they see, new cameras and the way from one to the next into a PNG.

    The view is from above at 35 degrees, from the side from which the cameras are spread widest and more photos are
    seen from behind, that is, the right way round.

    Args:
        path: the picture's file.
        cameras: one camera for each picture (sizes may differ), in one world.
        pictures: RGB in [0, 1].
        new: cameras of the path.
        points: of the scene.
        size: width and height of the figure in pixels.

    Raises ValueError for no cameras.
    """
    if not cameras:
        raise ValueError("camera figure: expected at least one camera, got none")
    pyvista = pyvista_off_screen()
    upright = _upright_axes(up_of(list(cameras)))
    photos = [_turned(one, upright) for one in cameras]
    fly = None if new is None else _turned(new, upright)
    centers = torch.cat([one.centers for one in [*photos, *([] if fly is None else [fly])]])
    length = _frustum_length(centers, len(photos))
    shown = torch.cat([centers, *(_corners(one, length) for one in photos)])
    plotter: Any = pyvista.Plotter(off_screen=True, window_size=list(size))
    try:
        plotter.set_background("white")
        plotter.enable_anti_aliasing("ssaa")
        for camera, picture in zip(photos, pictures, strict=True):
            _add_photo(plotter, camera, picture, length)
        if fly is not None:
            _add_path(plotter, fly, 0.5 * length)
        if points is not None:
            _add_points(plotter, points, upright, centers)
        _add_floor(plotter, shown)
        _add_caption(plotter, len(photos), 0 if fly is None else len(fly), height=size[1])
        _look(plotter, photos, shown, aspect=size[0] / size[1])
        plotter.screenshot(str(path))
    finally:
        plotter.close()


def _upright_axes(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """World to a frame whose z is up."""
    helper = F.one_hot(up.abs().argmin(), 3).to(up)
    first = F.normalize(torch.linalg.cross(helper, up), dim=0)
    return torch.stack([first, torch.linalg.cross(up, first), up]).double()


def _turned(cameras: Pinholes, rotation: Float[Tensor, "3 3"]) -> Pinholes:
    cameras = cameras.to("cpu", torch.float64)
    return Pinholes(
        camera_to_world=rotation @ cameras.camera_to_world,
        focal=cameras.focal,
        principal=cameras.principal,
        width=cameras.width,
        height=cameras.height,
    )


def _frustum_length(centers: Float[Tensor, "n 3"], photos: int) -> float:
    """Diagonal of pictures that can be recognised without hiding one camera behind another."""
    extent = float((centers.amax(dim=0) - centers.amin(dim=0)).norm())
    return extent * min(0.25, 0.7 / math.sqrt(photos)) if extent > 1e-6 else 1.0


def _corners(camera: Pinholes, diagonal: float) -> Float[Tensor, "4 3"]:
    """Of the picture, drawn so large that its diagonal has this length: left top, right top, right bottom, left
    bottom.
    """
    pixels = torch.tensor(
        [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], dtype=torch.float64
    )
    rays = F.pad((pixels - camera.principal[0]) / camera.focal[0], (0, 1), value=1.0)
    return camera.centers[0] + diagonal / (rays[0] - rays[2]).norm() * rays @ camera.rotations[0].T


def _frusta(cameras: Pinholes, diagonal: float) -> Any:
    """Edges of all cameras' pyramids."""
    import pyvista

    points = torch.cat(
        [torch.cat([one.centers, _corners(one, diagonal)]) for one in (cameras[index] for index in range(len(cameras)))]
    )
    edges = torch.tensor([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])
    pairs = (edges + 5 * torch.arange(len(cameras))[:, None, None]).reshape(-1, 2)
    return pyvista.PolyData(points.numpy(), lines=F.pad(pairs, (1, 0), value=2).numpy().ravel())


def _add_photo(plotter: Any, camera: Pinholes, picture: Float[Tensor, "3 h w"], length: float) -> None:
    import pyvista

    corners = _corners(camera, length)
    small = shrink(picture.detach().cpu().float().clamp(0, 1), _TEXTURE_SIDE)
    pixels = np.ascontiguousarray((small * 255).round().to(torch.uint8).movedim(0, -1).numpy())
    board = pyvista.PolyData(corners.numpy(), faces=np.array([4, 0, 1, 2, 3]))
    board.active_texture_coordinates = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=np.float32)
    plotter.add_mesh(board, texture=pyvista.Texture(pixels), lighting=False)
    plotter.add_mesh(_frusta(camera, length), color=PHOTO_COLOR, line_width=3, lighting=False)


def _add_path(plotter: Any, cameras: Pinholes, length: float) -> None:
    import pyvista

    plotter.add_mesh(_frusta(cameras, length), color=NEW_COLOR, line_width=1.5, lighting=False)
    centers = cameras.centers.numpy()
    plotter.add_mesh(
        pyvista.PolyData(centers), color=NEW_COLOR, point_size=9, render_points_as_spheres=True, lighting=False
    )
    if len(centers) > 1:
        plotter.add_mesh(pyvista.lines_from_points(centers), color=NEW_COLOR, line_width=4, lighting=False, opacity=0.5)


def _add_points(plotter: Any, points: Points, upright: Float[Tensor, "3 3"], centers: Float[Tensor, "n 3"]) -> None:
    """The scene's points, those far away left out."""
    import pyvista

    positions = points.positions.double() @ upright.T
    middle = centers.mean(dim=0)
    reach = 4 * float((centers - middle).norm(dim=1).max())
    near = ((positions - middle).norm(dim=1) < reach).nonzero()[:_MOST_POINTS, 0]
    if len(near) == 0:
        return
    colors = (points.colors[near].double().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    plotter.add_mesh(pyvista.PolyData(positions[near].numpy()), scalars=colors, rgb=True, point_size=3, lighting=False)


def _add_floor(plotter: Any, shown: Float[Tensor, "n 3"]) -> None:
    """A pale level grid below everything, which tells what is up."""
    import pyvista

    low, high = shown.amin(dim=0), shown.amax(dim=0)
    middle, side = (low + high) / 2, 1.1 * float((high - low)[:2].max())
    place = (float(middle[0]), float(middle[1]), float(low[2]))
    grid = pyvista.Plane(center=place, direction=(0, 0, 1), i_size=side, j_size=side, i_resolution=10, j_resolution=10)
    plotter.add_mesh(grid, style="wireframe", color="#d0d0d0", line_width=1, lighting=False)


def _add_caption(plotter: Any, photos: int, new: int, *, height: int) -> None:
    plotter.add_text(_counted(photos, "photo"), position=(30, height - 60), font_size=16, color=PHOTO_COLOR)
    if new:
        plotter.add_text(_counted(new, "new camera"), position=(30, height - 105), font_size=16, color=NEW_COLOR)


def _counted(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _look(plotter: Any, photos: list[Pinholes], shown: Float[Tensor, "n 3"], *, aspect: float) -> None:
    """From above, across the direction in which cameras are spread widest, so near that all of them just fit."""
    flat = (shown - shown.mean(dim=0))[:, :2]
    spread, axes = torch.linalg.eigh(flat.T @ flat)
    forward = torch.cat([one.camera_to_world[:, :2, 2] for one in photos]).mean(dim=0)
    toward = axes[:, 0]
    if float(spread[1]) < 1.5 * float(spread[0]) and float(forward.norm()) > 0.2:  # as wide one way as the other
        toward = F.normalize(forward, dim=0)
    toward = toward if float(toward @ forward) >= 0 else -toward
    slope = math.radians(_ELEVATION_DEGREES)
    direction = torch.cat([math.cos(slope) * toward, toward.new_tensor([-math.sin(slope)])])
    right = F.normalize(torch.linalg.cross(direction, toward.new_tensor([0.0, 0.0, 1.0])), dim=0)
    above = torch.linalg.cross(right, direction)
    tangent = math.tan(math.radians(_LENS_DEGREES / 2)) * _FILLED
    middle = shown.mean(dim=0)
    for _ in range(20):  # the middle of the picture depends on the distance, and the distance on the middle
        across, height, depth = ((shown - middle) @ axis for axis in (right, above, direction))
        distance = float(torch.maximum(across.abs() / (aspect * tangent), height.abs() / tangent).sub(depth).max())
        scale = distance / (distance + depth)
        middle = middle + sum(
            ((one * scale).amax() + (one * scale).amin()) / 2 * axis for one, axis in ((across, right), (height, above))
        )
    plotter.camera.view_angle = _LENS_DEGREES
    plotter.camera.focal_point = middle.tolist()
    plotter.camera.up = (0.0, 0.0, 1.0)
    plotter.camera.position = (middle - direction * distance).tolist()
    plotter.reset_camera_clipping_range()
