"""nerfstudio's own dataparser without two of its obstacles.

It reads the capture's point cloud without open3d, which needs a system library (libusb), and takes cameras that all stand in one place.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from torch import Tensor

from fb_core.data.captures import read_capture

_ONE_PLACE = 1e-6  # of the largest coordinate: what float32 cannot tell apart


class NerfstudioWithoutOpen3d(Nerfstudio):
    """Same outputs as its parent, which cannot read captures whose cameras all stand in one place (one photo, a pure rotation)."""

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        centers = read_capture(self.config.data).poses[:, :, 3]
        spread = float((centers - centers.mean(dim=0)).abs().max())
        if spread <= _ONE_PLACE * (1.0 + float(centers.abs().max())):
            self.config.auto_scale_poses = False  # the parent would divide by the spread
        return super()._generate_dataparser_outputs(split)

    def _load_3D_points(self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Tensor] | None:
        """Positions in the training world (float32 [n, 3]) and colours (uint8 [n, 3]; empty without any); None for no points."""
        import trimesh

        cloud: Any = trimesh.load(str(ply_file_path), process=False)
        if len(cloud.vertices) == 0:
            return None
        points = torch.from_numpy(np.array(cloud.vertices, dtype=np.float32))
        points = (points @ transform_matrix[:, :3].T + transform_matrix[:, 3]) * scale_factor
        return {"points3D_xyz": points, "points3D_rgb": torch.from_numpy(_colors_of(cloud))}


def without_open3d(config: DataParserConfig) -> DataParserConfig:
    """The same config; a plain nerfstudio one now builds :class:`NerfstudioWithoutOpen3d`."""
    if config._target is Nerfstudio:
        config._target = NerfstudioWithoutOpen3d
    return config


def _colors_of(cloud: Any) -> np.ndarray:
    """8-bit colours of a point cloud or of a mesh's corners; [0, 3] where the file has none."""
    colors = getattr(cloud, "colors", None)
    if colors is None and getattr(getattr(cloud, "visual", None), "kind", None) == "vertex":
        colors = cloud.visual.vertex_colors
    if colors is None or len(colors) != len(cloud.vertices):
        return np.zeros((0, 3), dtype=np.uint8)
    return np.ascontiguousarray(colors[:, :3], dtype=np.uint8)
