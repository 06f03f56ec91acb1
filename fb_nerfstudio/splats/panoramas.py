"""Panoramas and fisheye pictures of splats, for ns-render and the viewer: up to six perspective views, put together
along the rays.

Splats are drawn in perspective alone. Whatever camera sees all its rays from one place is drawn as the faces of a cube
around it; the rays are nerfstudio's own, so that its camera paths mean here what they mean for every other method.
Stereo cameras see every column from another place, and are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from fb_core.files.faults import Refused

_FINER = 1.25  # pixels of a face over those of the picture, per radian at the face's middle
_OVERLAP = 1.02  # half side of a face over that of a cube's, so that its outermost rays have neighbours on both sides
_MOST_SIDE = 4096
_ONE_PLACE = 1e-6
_FACES = (  # right, up, backward in the camera's own axes (OpenGL)
    ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
    ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
)


def is_panorama(camera: Cameras | RayBundle) -> bool:
    """Whether this is one camera that sees no perspective picture.

    Fisheye cameras of captures, whose pictures have been straightened, keep their type and their coefficients; those of
    camera paths have none.
    """
    if not isinstance(camera, Cameras) or camera.camera_to_worlds.numel() != 12:
        return False
    kind = int(camera.camera_type.reshape(-1)[0])
    lens = camera.distortion_params
    straightened = kind == CameraType.FISHEYE.value and lens is not None and bool((lens != 0).any())
    return kind != CameraType.PERSPECTIVE.value and not straightened


def draw_panorama(camera: Cameras, draw: Callable[[Cameras], dict[str, Tensor]]) -> dict[str, Tensor]:
    """The outputs of one camera of any type that sees all from one place; depth is the distance along the ray.

    Args:
        camera: one camera.
        draw: outputs ([h, w, c] each) of one perspective camera.

    Raises Refused for cameras that do not see all from one place.
    """
    flat = camera.flatten()
    rays = flat.generate_rays(camera_indices=0, keep_shape=True)
    pose = flat.camera_to_worlds[0]
    off = float((rays.origins - pose[:, 3]).abs().max())
    if off > _ONE_PLACE * (1.0 + float(pose[:, 3].abs().max())):
        name = CameraType(int(flat.camera_type.reshape(-1)[0])).name
        raise Refused(
            f"camera type {name}: splats are drawn from one place, and this camera sees from many; save the path as "
            "perspective, fisheye "
            "or equirectangular"
        )
    turn = F.normalize(pose[:, :3], dim=0)  # paths of scaled scenes carry the scale in their rotations
    directions = F.normalize(rays.directions, dim=-1) @ turn
    faces = torch.tensor(_FACES, dtype=directions.dtype, device=directions.device)  # [6, 3 axes, 3]
    ahead = -directions @ faces[:, 2].T
    nearest = ahead.argmax(dim=-1)
    density = float(flat.width[0]) / (2 * math.pi) if _goes_round(flat) else float(flat.fx[0])
    side = max(8, min(_MOST_SIDE, math.ceil(2 * _FINER * _OVERLAP * density)))
    outputs: dict[str, Tensor] = {}
    for number in sorted(set(nearest.reshape(-1).tolist())):
        face, there = faces[number], nearest == number
        drawn = draw(_face_camera(pose[:, 3], turn @ face.T, side))
        looked_up = _along(drawn, directions[there], face, side)
        for name, values in looked_up.items():
            outputs.setdefault(name, values.new_zeros(*nearest.shape, values.shape[-1]))[there] = values
    return outputs


def _goes_round(camera: Cameras) -> bool:
    return int(camera.camera_type.reshape(-1)[0]) == CameraType.EQUIRECTANGULAR.value


def _face_camera(center: Float[Tensor, "3"], rotation: Float[Tensor, "3 3"], side: int) -> Cameras:
    focal = side / 2 / _OVERLAP
    pose = torch.cat([rotation, center[:, None]], dim=1)
    return Cameras(pose[None], focal, focal, side / 2, side / 2, side, side, camera_type=CameraType.PERSPECTIVE)


def _along(
    drawn: dict[str, Tensor], directions: Float[Tensor, "n 3"], face: Float[Tensor, "3 3"], side: int
) -> dict[str, Tensor]:
    """A face's outputs [side, side, c] along unit directions in the camera's axes, [n, c] each."""
    right, up, back = (directions @ face.T).unbind(dim=-1)
    ahead = -back
    places = torch.stack([right / ahead, -up / ahead], dim=-1) / _OVERLAP
    sampled: dict[str, Tensor] = {}
    for name, picture in drawn.items():
        channels = picture.expand(side, side, picture.shape[-1]).movedim(-1, 0)[None]
        values = F.grid_sample(
            channels, places[None, :, None].to(channels), padding_mode="border", align_corners=False
        )[0, :, :, 0].T
        if name == "depth":
            values = values / ahead[:, None]
        elif name.endswith("normal"):
            values = ((2 * values - 1) @ face.to(values) + 1) / 2  # right, up, towards the camera: the face's own axes
        sampled[name] = values
    return sampled
