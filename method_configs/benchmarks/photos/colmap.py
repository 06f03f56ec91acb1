"""COLMAP's incremental mapping of the same photos, by its package pycolmap; an extra of the benchmark alone."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from method_configs.benchmarks.photos.stages import between, clocks

if TYPE_CHECKING:
    from fb_core.data.photos.photo import Photo
    from fb_core.geometry.cameras import Pinholes


def cameras_by_colmap(
    photos: Sequence[Photo], threads: int
) -> tuple[list[Pinholes | None], dict[str, tuple[float, float]]]:
    """Cameras of the photos (all pairs matched on the CPU, its own options otherwise), and the seconds of each
    stage.
    """
    from fb_core.data import media

    colmap: Any = importlib.import_module("pycolmap")
    extraction, matching = colmap.FeatureExtractionOptions(), colmap.FeatureMatchingOptions()
    mapping = colmap.IncrementalPipelineOptions()
    for options in (extraction, matching, mapping):
        options.num_threads = threads
    one_size = len({photo.size for photo in photos}) == 1
    camera_mode = colmap.CameraMode.SINGLE if one_size else colmap.CameraMode.AUTO
    with tempfile.TemporaryDirectory(prefix="fillerbuster-colmap-") as folder:
        pictures, database, models = (Path(folder) / name for name in ("images", "database.db", "models"))
        for made in (pictures, models):
            made.mkdir()
        for number, photo in enumerate(photos):
            media.write_image(pictures / f"{number:05d}.png", photo.load())
        marks = [clocks()]
        colmap.extract_features(
            database, pictures, camera_mode=camera_mode, extraction_options=extraction, device=colmap.Device.cpu
        )
        marks.append(clocks())
        colmap.match_exhaustive(database, matching_options=matching, device=colmap.Device.cpu)
        marks.append(clocks())
        found = colmap.incremental_mapping(database, pictures, models, options=mapping)
        marks.append(clocks())
    cameras: list[Pinholes | None] = [None] * len(photos)
    if found:
        largest = max(found.values(), key=lambda one: one.num_reg_images())
        for image in largest.images.values():
            if image.has_pose:
                cameras[int(Path(image.name).stem)] = camera_of(image, largest.cameras[image.camera_id])
    return cameras, between(marks)


def camera_of(image: Any, lens: Any) -> Pinholes:
    """A batch of one from pycolmap's image and camera; the lens's distortion is left out."""
    import numpy as np
    import torch

    from fb_core.geometry.cameras import Pinholes

    pose = torch.from_numpy(np.asarray(image.cam_from_world().matrix(), dtype=np.float64))
    rotation, shift = pose[:, :3].T, pose[:, 3:]
    return Pinholes(
        camera_to_world=torch.cat([rotation, -rotation @ shift], dim=1)[None],
        focal=torch.tensor([[lens.focal_length_x, lens.focal_length_y]], dtype=torch.float64),
        principal=torch.tensor([[lens.principal_point_x, lens.principal_point_y]], dtype=torch.float64),
        width=lens.width,
        height=lens.height,
    )
