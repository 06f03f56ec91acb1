"""nerfstudio's cameras and batches <-> our types. Beside ``fb_core.data.capture.captures`` the only place that knows
OpenGL axes.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import flip_axes

# nerfstudio undistorts these into pinhole images when it caches a dataset, but leaves type and coefficients as they
# were.
_PINHOLE_AFTER_CACHING = (CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.FISHEYE624)


def to_pinholes(cameras: Cameras) -> Pinholes:
    """The cameras as one batch of OpenCV pinholes on the same device.

    Distortion coefficients are ignored: nerfstudio keeps them after it has undistorted the images. Convert cameras
    only after ``cached_train`` or ``cached_eval`` was touched, because undistortion changes the intrinsics in place.

    Raises ValueError when a camera is no pinhole (equirectangular, VR, orthographic) or when image sizes differ.
    """
    _require_pinhole(cameras)
    sizes = torch.stack([cameras.width.reshape(-1), cameras.height.reshape(-1)], dim=-1)
    if len(sizes) == 0:
        raise ValueError("cameras: got none, expected at least one camera")
    if not bool((sizes == sizes[0]).all()):
        distinct = sorted({tuple(size) for size in sizes.tolist()})
        raise ValueError(
            f"cameras: expected one image size, got (width, height) {distinct}; use to_pinhole_list for mixed sizes"
        )
    width, height = sizes[0].tolist()
    poses = cameras.camera_to_worlds  # whole numbers, where a camera path was written so
    poses = poses.to(torch.promote_types(poses.dtype, torch.float32))
    focal, principal = (
        torch.stack([x.reshape(-1), y.reshape(-1)], dim=-1)
        for x, y in ((cameras.fx, cameras.fy), (cameras.cx, cameras.cy))
    )
    return Pinholes(
        camera_to_world=flip_axes(poses.reshape(-1, 3, 4)),
        focal=focal.to(poses),  # some dataparsers, Blender's for one, give these in another precision
        principal=principal.to(poses),
        width=width,
        height=height,
    )


def to_pinhole_list(cameras: Cameras) -> list[Pinholes]:
    """One single-camera batch per camera, for captures whose images differ in size. Raises like :func:`to_pinholes`."""
    flat = cameras.flatten()
    return [to_pinholes(flat[index : index + 1]) for index in range(len(flat))]


def to_nerfstudio(pinholes: Pinholes, device: torch.device | str | None = None) -> Cameras:
    """Perspective nerfstudio cameras of shape (n,), without metadata; exactly undone by :func:`to_pinholes`.

    Without ``metadata["cam_idx"]`` the camera optimizer and the bilateral grid leave such a camera alone, as they must:
    a generated view has no index among the training images.
    """
    device = pinholes.camera_to_world.device if device is None else torch.device(device)
    return Cameras(
        camera_to_worlds=flip_axes(pinholes.camera_to_world).to(device),
        fx=pinholes.focal[:, 0:1].to(device),
        fy=pinholes.focal[:, 1:2].to(device),
        cx=pinholes.principal[:, 0:1].to(device),
        cy=pinholes.principal[:, 1:2].to(device),
        width=torch.full((len(pinholes), 1), pinholes.width, dtype=torch.int64, device=device),
        height=torch.full((len(pinholes), 1), pinholes.height, dtype=torch.int64, device=device),
        camera_type=CameraType.PERSPECTIVE,
    )


def batch_image(batch: dict, device: torch.device | str | None = None) -> Float[Tensor, "3 h w"]:
    """RGB in [0, 1] of ``batch["image"]`` ([h, w, 3 or 4], uint8 or float). An alpha channel is dropped, see
    :func:`batch_known`.

    Raises ValueError for other shapes.
    """
    image = _unit_range(batch["image"], "image")
    if image.ndim != 3 or image.shape[-1] not in (3, 4):
        raise ValueError(f"batch['image']: expected a shape [h, w, 3 or 4], got {list(image.shape)}")
    return image[..., :3].movedim(-1, 0).contiguous().to(device)


def batch_known(batch: dict, device: torch.device | str | None = None) -> Float[Tensor, "1 h w"]:
    """The known-mask (1 = known) of a batch: its ``mask`` ([h, w, 1]) times the image's alpha; all ones without
    either.

    Raises ValueError for a mask of another size than the image.
    """
    image = batch["image"]
    known = (
        _unit_range(image, "image")[..., 3:]
        if image.shape[-1] == 4
        else torch.ones(*image.shape[:2], 1, device=image.device)
    )
    if "mask" in batch:
        mask = batch["mask"]
        if mask.shape[:2] != image.shape[:2]:
            raise ValueError(
                f"batch['mask']: expected the image's size {list(image.shape[:2])}, got {list(mask.shape[:2])}"
            )
        known = known * _unit_range(mask.reshape(*mask.shape[:2], 1), "mask").to(known.device)
    return known.movedim(-1, 0).contiguous().to(device)


def _unit_range(values: Tensor, name: str) -> Tensor:
    """uint8, bool or float values as float32 in [0, 1]."""
    if values.dtype == torch.uint8:
        return values.float() / 255.0
    if values.dtype == torch.bool or values.is_floating_point():
        return values.float()
    raise ValueError(f"batch['{name}']: expected uint8, bool or float values, got {values.dtype}")


def _require_pinhole(cameras: Cameras) -> None:
    allowed = {kind.value for kind in _PINHOLE_AFTER_CACHING}
    unsupported = set(cameras.camera_type.reshape(-1).tolist()) - allowed
    if unsupported:
        names = ", ".join(sorted(CameraType(kind).name for kind in unsupported))
        raise ValueError(
            f"cameras: expected pinhole cameras, got {names}; convert these images to perspective views first"
        )
