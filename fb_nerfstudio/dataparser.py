"""nerfstudio's own dataparser without two of its obstacles, and with an eye for frames that no camera took.

It reads the capture's point cloud without open3d, which needs a system library (libusb), takes cameras that all stand in one place,
and keeps frames that are marked as generated out of every split: their place is the bank of generated views.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.utils.dataparsers_utils import (
    get_train_eval_split_all,
    get_train_eval_split_filename,
    get_train_eval_split_fraction,
    get_train_eval_split_interval,
)
from torch import Tensor

from fb_core.data.captures import Capture, Frame, read_capture
from fb_nerfstudio.bridge import flip_axes

_ONE_PLACE = 1e-6  # of the largest coordinate: what float32 cannot tell apart


class NerfstudioWithoutOpen3d(Nerfstudio):
    """Same outputs as its parent for photos, also where all cameras stand in one place (one photo, a pure rotation).

    The world is the parent's: that of all frames. Where the capture lists no splits, the parent's choice is made among the photos.
    """

    def generated_frames(self) -> list[Frame]:
        """Frames that are marked as generated and not held out, with cameras in the training world."""
        capture = read_capture(self.config.data)
        if not any(frame.generated for frame in capture.frames):
            return []
        outputs = self._outputs_of_all(capture, "train", load_3D_points=False)
        poses = flip_axes(outputs.cameras.camera_to_worlds.double())
        return [
            dataclasses.replace(frame, camera=dataclasses.replace(frame.camera, camera_to_world=poses[index : index + 1]))
            for index, frame in enumerate(self._frames_of(outputs, capture))
            if frame.generated
        ]

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        capture = read_capture(self.config.data)
        centers = capture.poses[:, :, 3]
        spread = float((centers - centers.mean(dim=0)).abs().max())
        if spread <= _ONE_PLACE * (1.0 + float(centers.abs().max())):
            self.config.auto_scale_poses = False  # the parent would divide by the spread
        if not any(frame.generated for frame in capture.frames):
            return super()._generate_dataparser_outputs(split)
        outputs = self._outputs_of_all(capture, split)
        photos = [index for index, frame in enumerate(self._frames_of(outputs, capture)) if not frame.generated]
        if not capture.has_split_lists:
            photos = [photos[place] for place in _split([outputs.image_filenames[index] for index in photos], split, self.config)]
        return _only(outputs, photos)

    def _outputs_of_all(self, capture: Capture, split: str, **options: Any) -> DataparserOutputs:
        """The parent's outputs for photos and generated frames: of the split that the capture lists, or of all frames."""
        given, listed = self.config, capture.has_split_lists
        everything = {} if listed else {"eval_mode": "fraction", "train_split_fraction": 1.0}
        self.config = dataclasses.replace(given, **everything, **options)
        try:
            return super()._generate_dataparser_outputs(split if listed else "train")
        finally:
            self.config = given

    def _frames_of(self, outputs: DataparserOutputs, capture: Capture) -> list[Frame]:
        """The capture's frames in the order of the outputs."""

        def name(path: Path) -> Path:  # of the file that the parent reads, which may be a smaller copy
            return self._get_fname(path.relative_to(capture.root) if path.is_relative_to(capture.root) else path, capture.root)

        by_name = {name(frame.image_path): frame for frame in capture.frames}
        return [by_name[path] for path in outputs.image_filenames]

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


def _split(names: list[Path], split: str, config: NerfstudioDataParserConfig) -> list[int]:
    """Places of the pictures that nerfstudio's options give to a split."""
    if config.eval_mode == "fraction":
        train, held_out = get_train_eval_split_fraction(names, config.train_split_fraction)
    elif config.eval_mode == "interval":
        train, held_out = get_train_eval_split_interval(names, config.eval_interval)
    else:
        train, held_out = (get_train_eval_split_filename if config.eval_mode == "filename" else get_train_eval_split_all)(names)
    return [int(place) for place in (train if split == "train" else held_out)]


def _only(outputs: DataparserOutputs, chosen: list[int]) -> DataparserOutputs:
    """The outputs without all other frames."""

    def of(names: list[Path] | None) -> list[Path] | None:
        return None if names is None else [names[index] for index in chosen]

    return dataclasses.replace(
        outputs,
        image_filenames=[outputs.image_filenames[index] for index in chosen],
        mask_filenames=of(outputs.mask_filenames),
        cameras=outputs.cameras[torch.tensor(chosen, dtype=torch.long)],
        metadata={**outputs.metadata, "depth_filenames": of(outputs.metadata["depth_filenames"])},
    )


def _colors_of(cloud: Any) -> np.ndarray:
    """8-bit colours of a point cloud or of a mesh's corners; [0, 3] where the file has none."""
    colors = getattr(cloud, "colors", None)
    if colors is None and getattr(getattr(cloud, "visual", None), "kind", None) == "vertex":
        colors = cloud.visual.vertex_colors
    if colors is None or len(colors) != len(cloud.vertices):
        return np.zeros((0, 3), dtype=np.uint8)
    return np.ascontiguousarray(colors[:, :3], dtype=np.uint8)
