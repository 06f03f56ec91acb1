"""Where the splats of a capture without a point cloud begin: triangulated features, and more points on the guessed
surface.

Random points in a cube, nerfstudio's fallback, leave a training of a few thousand steps in coloured fog.
"""

from __future__ import annotations

import logging

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from torch import Tensor

from fb_core.completion.planning.site import shell_of
from fb_core.data.capture.undistort import check_lens, straight_directions
from fb_core.data.media import fits_only_upright, read_mask, read_photo, resize
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.triangulation import Features, detect, triangulate
from fb_core.geometry.shell import intersect
from fb_core.geometry.viewpoints.paths import CaptureShape
from fb_core.masks import wholly_known
from fb_nerfstudio.bridge import to_pinholes
from fb_nerfstudio.capture.pictures import WIDE_LENSES, straightened_picture

_SIDE = 960  # pixels of the longer side in which features are sought
_MODELS = {CameraType.PERSPECTIVE.value: "OPENCV", CameraType.FISHEYE.value: "OPENCV_FISHEYE"}
_logger = logging.getLogger(__name__)


def start_points(
    outputs: DataparserOutputs, *, count: int, seed: int
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Points in the training world and their colours in [0, 1]: what can be triangulated, filled up to ``count`` from
    the shell.

    The filling takes random pixels of the photos with their colours and puts them on the shell that is fitted to the
    triangulated points (a sphere when there are none). Lenses that OpenCV cannot undistort give no points at all.

    Args:
        outputs: a dataparser's train split; files are read at their own size.
        count: at most as many with the filling (masked pixels give none); triangulated points are never thrown away.
        seed: draws the filling.
    """
    photos = [
        photo for index in range(len(outputs.image_filenames)) if (photo := _Photo.of(outputs, index)) is not None
    ]
    points, colors = triangulate([photo.features() for photo in photos])
    _logger.info("triangulated %d points from %d photos", len(points), len(photos))
    missing = count - len(points)
    if missing <= 0 or not photos:
        return points, colors
    filling = _filling(photos, points, missing, torch.Generator().manual_seed(seed))
    return tuple(torch.cat(pair) for pair in zip((points, colors), filling, strict=True))  # type: ignore[return-value]


class _Photo:
    """One picture, small, with the camera and the lens it was taken with."""

    def __init__(self, image: Tensor, known: Tensor | None, camera: Pinholes, model: str, distortion: dict[str, float]):
        self.image, self.known, self.camera, self.model, self.distortion = image, known, camera, model, distortion

    @classmethod
    def of(cls, outputs: DataparserOutputs, index: int) -> _Photo | None:
        cameras = outputs.cameras
        lens = _lens(cameras, index)
        if lens is None:
            return None
        path = outputs.image_filenames[index]
        turned = fits_only_upright(path, (int(cameras.height[index]), int(cameras.width[index])))
        image, alpha = read_photo(path, apply_orientation=turned)
        scale = min(1.0, _SIDE / max(image.shape[1:]))
        height, width = (max(1, round(side * scale)) for side in image.shape[1:])
        masks = [] if alpha is None else [alpha]
        if outputs.mask_filenames is not None:
            mask = read_mask(outputs.mask_filenames[index], apply_orientation=turned)
            masks.append(
                F.interpolate(mask[None], size=image.shape[1:])[0]
            )  # masks may be larger than a small copy of their picture
        wide = outputs.metadata.get(WIDE_LENSES, {}).get(str(path))
        known = (
            torch.stack([(mask >= 0.5).to(image) for mask in masks]).amin(dim=0)
            if masks
            else torch.ones_like(image[:1])
        )
        if wide is not None:
            image, known = straightened_picture(image, known, wide)
            masks.append(known)
        image, known = wholly_known(image, known, lambda channels: resize(channels, height, width))
        camera = to_pinholes(cameras[index : index + 1]).scaled(width, height)
        return cls(image, known if masks else None, camera, *lens)

    def world_directions(self, places: Float[Tensor, "k 2"]) -> Float[Tensor, "k 3"]:
        return straight_directions(places, self.camera, self.model, self.distortion) @ self.camera.rotations[0].T

    def features(self) -> Features:
        places, descriptors, colors = detect(self.image, self.known)
        return Features(
            center=self.camera.centers[0],
            directions=self.world_directions(places),
            descriptors=descriptors,
            colors=colors,
        )


def _lens(cameras: Cameras, index: int) -> tuple[str, dict[str, float]] | None:
    """OpenCV's name of the lens and its coefficients; None for one that cannot be undistorted."""
    model = _MODELS.get(int(cameras.camera_type[index]))
    if model is None:
        return None
    values = [0.0] * 6 if cameras.distortion_params is None else cameras.distortion_params[index].tolist()
    distortion: dict[str, float] = dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), values, strict=True))
    try:
        check_lens(model, distortion, "start_points")
    except ValueError:
        return None
    return model, distortion


def _filling(photos: list[_Photo], points: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Random pixels of all photos, moved out to the shell."""
    shell = shell_of(CaptureShape.of([photo.camera for photo in photos]), points)
    draws = torch.rand(count, 3, generator=generator)
    chosen = (draws[:, 0] * len(photos)).long().clamp(max=len(photos) - 1)
    positions, colors = [], []
    for index, photo in enumerate(photos):
        places = draws[chosen == index, 1:] * torch.tensor([photo.camera.width, photo.camera.height])
        column, row = places.long().T
        usable = torch.ones(len(places), dtype=torch.bool) if photo.known is None else photo.known[0, row, column] > 0
        directions = photo.world_directions(places[usable])
        origins = photo.camera.centers.expand_as(directions)
        distance = intersect(shell, origins, directions)
        hit = torch.isfinite(distance) & torch.isfinite(directions).all(dim=-1)
        positions.append((origins + distance[:, None] * directions)[hit])
        colors.append(photo.image[:, row[usable], column[usable]].T[hit])
    return torch.cat(positions), torch.cat(colors)
