"""Photos of a bent lens as a straight one would have taken them."""

from __future__ import annotations

import dataclasses

from fb_core.data.capture.undistort import straight_camera, undistort
from fb_core.data.media import shrink
from fb_core.data.photos.collection import THUMBNAIL_SIDE
from fb_core.data.photos.photo import Photo, Pixels
from fb_core.geometry.cameras import Pinholes

_MODEL = "OPENCV"


def straightened(photo: Photo, camera: Pinholes, distortion: dict[str, float]) -> tuple[Photo, Pinholes]:
    """The photo without its lens's distortion, at the same size, and the camera that would have taken it.

    Args:
        photo: as it was taken; it is decoded and straightened each time its pixels are asked for.
        camera: of the whole photo, with the bent lens's focal length and principal point.
        distortion: k1 and k2 of OpenCV's model.
    """
    straight = straight_camera(camera, _MODEL, distortion)

    def pixels() -> Pixels:
        return undistort(*photo.pixels(), camera, _MODEL, distortion)[:2]

    thumbnail = shrink(pixels()[0], THUMBNAIL_SIDE)
    focal = float(straight.focal.mean())
    return dataclasses.replace(
        photo, pixels=pixels, thumbnail=thumbnail, focal_prior=focal, stored=False, bent=(camera, distortion)
    ), straight
