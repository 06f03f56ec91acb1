"""The camera that splats are drawn from: one of nerfstudio's as a pinhole camera of ours."""

from __future__ import annotations

import dataclasses

import torch
import torch.nn.functional as F
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle

from fb_core.files.faults import Refused
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.bridge import to_pinholes


def one_pinhole(camera: Cameras | RayBundle) -> Pinholes:
    """One camera; ns-render reads the focal lengths of camera paths in double precision.

    Raises Refused with one sentence for single rays, and ValueError for anything but one camera.
    """
    if isinstance(camera, RayBundle):
        raise Refused(
            "splats are drawn picture by picture and answer no single rays; ns-export has gaussian-splat and "
            "cameras for them"
        )
    if not isinstance(camera, Cameras) or camera.camera_to_worlds.numel() != 12:
        got = (
            f"{camera.camera_to_worlds.numel() // 12} cameras" if isinstance(camera, Cameras) else type(camera).__name__
        )
        raise ValueError(f"camera: expected one nerfstudio camera, got {got}; render cameras one by one")
    return to_pinholes(camera)


def with_unit_axes(pinhole: Pinholes) -> Pinholes:
    """Paths of scaled scenes (nerfstudio's Blender add-on) carry the scale in their rotations; here it is gone."""
    turn = F.normalize(pinhole.rotations, dim=1)
    return dataclasses.replace(pinhole, camera_to_world=torch.cat([turn, pinhole.camera_to_world[:, :, 3:]], dim=2))


def shrunk(pinhole: Pinholes, factor: int) -> Pinholes:
    """The camera of a picture that is so many times smaller.

    Not `Pinholes.scaled`: pictures are averaged over whole blocks and a remainder is dropped, so the factor is exact.
    """
    if factor == 1:
        return pinhole
    return dataclasses.replace(
        pinhole,
        focal=pinhole.focal / factor,
        principal=pinhole.principal / factor,
        width=pinhole.width // factor,
        height=pinhole.height // factor,
    )
