"""Captures for nerfstudio, read by this project's reader: whatever the check lets pass is trained, and as it is meant.

Same outputs as nerfstudio's own dataparser where that reads a capture rightly (tests compare them), without its
obstacles: open3d, which needs a system library; questions on a terminal that may not be there; poses in single
precision before they are centred; keys that must be written its way. Frames that no camera took are kept out of every
split: their place is the bank of generated views.
"""

from __future__ import annotations

import dataclasses
import logging
import os
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import (
    MAX_AUTO_RESOLUTION,
    Nerfstudio,
    NerfstudioDataParserConfig,
)
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.data.utils.dataparsers_utils import (
    get_train_eval_split_all,
    get_train_eval_split_filename,
    get_train_eval_split_fraction,
    get_train_eval_split_interval,
)
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.captures import read_capture
from fb_core.data.capture.frames import Capture, Frame
from fb_core.data.capture.points import read_points
from fb_core.data.capture.transforms_json import DISTORTION_KEYS
from fb_core.data.capture.undistort import FISHEYE_MODELS, is_too_wide, straight_camera
from fb_core.geometry.rotations import flip_axes
from fb_nerfstudio.capture.pictures import SMALLER_BY, WIDE_LENSES, WideLens

_ONE_PLACE = 1e-6  # of the largest coordinate, in single precision: what it cannot tell apart
_FAR_OFF = (
    1000.0  # spreads from the origin: beyond, single precision rounds poses by more than a ten thousandth of the spread
)
_STRAIGHT_FISHEYE = 1e-12  # nerfstudio takes a fisheye lens without any coefficient for a pinhole
_OLD_COLMAP_AXES = [
    [0.0, 1.0, 0.0, 0.0],
    [1.0, 0.0, 0.0, 0.0],
    [0.0, 0.0, -1.0, 0.0],
]  # of captures before applied_transform was written
_logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _World:
    """From the capture's world to that of the training."""

    transform: Tensor
    """[3, 4], float64: turn and shift."""
    scale: float
    """Factor after that."""
    poses: Tensor
    """[n, 3, 4] cameras there, float32, OpenGL axes."""


class NerfstudioWithoutOpen3d(Nerfstudio):
    """Same outputs as its parent for what that reads rightly; the world is the parent's, that of all frames.

    Where the capture lists no splits, the parent's choice is made among the photos.
    """

    def generated_frames(self) -> list[Frame]:
        """Frames that are marked as generated and not held out, with cameras in the training world."""
        capture = read_capture(self.config.data)
        if not any(frame.generated for frame in capture.frames):
            return []
        frames, world = self._world_of(capture)
        poses = flip_axes(world.poses.double())
        chosen = range(len(frames))
        if "train_filenames" in capture.extra:
            listed = _listed(capture, "train")
            chosen = [place for place in chosen if _name(frames[place].image_path) in listed]
        return [
            dataclasses.replace(
                frames[place],
                camera=dataclasses.replace(frames[place].camera, camera_to_world=poses[place : place + 1]),
            )
            for place in chosen
            if frames[place].generated
        ]

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        capture = read_capture(self.config.data)
        frames, world = self._world_of(capture)
        self._decide_factor(frames[0].image_path, capture)
        photos = [place for place, frame in enumerate(frames) if not frame.generated and not frame.is_bad]
        chosen = self._chosen(capture, frames, photos, split)
        files = [self._file(frames[place].image_path, capture, "images_") for place in chosen]
        wide = {
            str(path): _lens_of_frame(frames[place])
            for place, path in zip(chosen, files, strict=True)
            if _is_wide(frames[place])
        }
        frames = [_straight(frame) if _is_wide(frame) else frame for frame in frames]
        masks = [frames[place].mask_path for place in chosen]
        scale, applied = world.scale, capture.extra.get("applied_transform")
        transform = world.transform
        if applied is None and (capture.root / "colmap" / "sparse" / "0").exists():
            applied = _OLD_COLMAP_AXES
        if applied is not None:
            applied = torch.tensor(applied, dtype=torch.float64)[:3]
            transform = transform @ torch.cat([applied, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)])
        reach = self.config.scene_scale
        points = {} if not self.config.load_3D_points else self._points(capture, world)
        return DataparserOutputs(
            image_filenames=files,
            cameras=self._cameras([frames[place] for place in chosen], world.poses[chosen], capture, files),
            scene_box=SceneBox(aabb=torch.tensor([[-reach] * 3, [reach] * 3], dtype=torch.float32)),
            mask_filenames=[self._file(mask, capture, "masks_") for mask in masks if mask is not None] or None,
            dataparser_scale=scale * float(capture.extra.get("applied_scale", 1.0)),
            dataparser_transform=transform if self._is_far(capture) else transform.float(),
            metadata={
                "depth_filenames": self._depths(frames, chosen, capture),
                "depth_unit_scale_factor": self.config.depth_unit_scale_factor,
                "mask_color": self.config.mask_color,
                **self._made_smaller(files, [frames[place].image_path for place in chosen], capture),
                **({WIDE_LENSES: wide} if wide else {}),
                **points,
            },
        )

    def _world_of(self, capture: Capture) -> tuple[list[Frame], _World]:
        """All frames that are of use, in the parent's order, that of their names, and the world that they are trained
        in. Frames that are marked as bad decide nothing: their poses may lie anywhere.
        """
        usable = [frame for frame in capture.frames if not frame.is_bad]
        frames = sorted(usable or capture.frames, key=lambda frame: frame.image_path)
        poses = flip_axes(torch.cat([frame.camera.camera_to_world for frame in frames]))  # float64, OpenGL
        shift = poses[:, :, 3].mean(dim=0) if self._is_far(capture) else torch.zeros(3, dtype=torch.float64)
        near = torch.cat([poses[:, :, :3], poses[:, :, 3:] - shift[:, None]], dim=2).float()
        corner = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(len(near), 1, 4)
        oriented, turn = camera_utils.auto_orient_and_center_poses(
            torch.cat([near, corner], dim=1),
            method=capture.extra.get("orientation_override", self.config.orientation_method),
            center_method=self.config.center_method,
        )
        scale = float(self.config.scale_factor)
        centers = near[:, :, 3]
        spread = float((centers - centers.mean(dim=0)).abs().max())
        if self.config.auto_scale_poses and spread > _ONE_PLACE * (1.0 + float(centers.abs().max())):
            scale /= float(oriented[:, :3, 3].abs().max())  # of cameras in one place there is nothing to divide by
        oriented = oriented[:, :3].clone()
        oriented[:, :, 3] *= scale
        transform = turn.double()
        transform[:, 3] -= transform[:, :3] @ shift
        return frames, _World(transform=transform, scale=scale, poses=oriented)

    @staticmethod
    def _is_far(capture: Capture) -> bool:
        """Whether the capture lies so far off the origin that single precision would move its cameras (geo-referenced
        ones do).
        """
        usable = [number for number, frame in enumerate(capture.frames) if not frame.is_bad]
        centers = capture.poses[usable or slice(None), :, 3]
        spread = float((centers - centers.mean(dim=0)).abs().max())
        return float(centers.abs().max()) > max(_FAR_OFF * spread, 1.0 / _ONE_PLACE)

    def _chosen(self, capture: Capture, frames: list[Frame], photos: list[int], split: str) -> list[int]:
        """Places of the frames of a split."""
        if not capture.has_split_lists:
            return [
                photos[place] for place in _split([frames[place].image_path for place in photos], split, self.config)
            ]
        listed = {
            name: _listed(capture, name) for name in ("train", "val", "test") if f"{name}_filenames" in capture.extra
        }
        names = {_name(frame.image_path) for frame in capture.frames}
        for name, files in listed.items():
            if foreign := sorted(files - names):
                _logger.warning(
                    "capture %s: %s_filenames names %s, which no frame is; left out", capture.root, name, foreign[0]
                )
        if split in listed:
            wanted = listed[split]
        elif split == "train":  # what is not held out
            wanted = names.difference(*listed.values())
        else:
            other = {"val": "test", "test": "val"}[split]
            wanted = listed[other] if other in listed else names - listed["train"]
        return [place for place in photos if _name(frames[place].image_path) in wanted]

    def _cameras(self, frames: list[Frame], poses: Tensor, capture: Capture, files: list[Path]) -> Cameras:
        lenses = [{key: frame.distortion.get(key, 0.0) for key in DISTORTION_KEYS} for frame in frames]
        for frame, lens in zip(frames, lenses, strict=True):
            if frame.camera_model in FISHEYE_MODELS and not any(lens.values()):
                lens["k1"] = _STRAIGHT_FISHEYE
        types = [CAMERA_MODEL_TO_TYPE[frame.camera_model] for frame in frames]
        radius = capture.extra.get("fisheye_crop_radius")
        bent = any(frame.camera_model in FISHEYE_MODELS for frame in capture.frames)
        numbers = torch.tensor(
            [[*frame.camera.focal[0].tolist(), *frame.camera.principal[0].tolist()] for frame in frames]
        ).reshape(-1, 4)
        sizes = torch.tensor(
            [[frame.camera.height, frame.camera.width] for frame in frames], dtype=torch.int32
        ).reshape(-1, 2)
        one_type = types[0] if len(set(types)) == 1 else None if types else CameraType.PERSPECTIVE
        cameras = Cameras(
            fx=numbers[:, 0], fy=numbers[:, 1], cx=numbers[:, 2], cy=numbers[:, 3],
            distortion_params=torch.stack([camera_utils.get_distortion_params(**lens) for lens in lenses])
            if lenses
            else torch.zeros(0, 6),
            height=sizes[:, 0],
            width=sizes[:, 1],
            camera_to_worlds=poses,
            camera_type=one_type if one_type is not None else torch.tensor([[one.value] for one in types]),
            metadata={"fisheye_crop_radius": radius} if bent and radius is not None else {},
        )  # fmt: skip
        if self._takes_copies(capture):
            assert self.downscale_factor is not None  # `_decide_factor` has set it
            cameras.rescale_output_resolution(scaling_factor=capture.reduced / self.downscale_factor)
            _sizes_on_disk(cameras, frames, files)
        return cameras

    def _decide_factor(self, path: Path, capture: Capture) -> None:
        """Sets the factor of smaller copies: the one asked for, or without one the first that nerfstudio finds small
        enough.
        """
        if self.downscale_factor is None:
            self.downscale_factor = self.config.downscale_factor or self._automatic_factor(path, capture)

    def _takes_copies(self, capture: Capture) -> bool:
        """Whether pictures smaller than the capture's own are asked for."""
        return self.downscale_factor is not None and self.downscale_factor > capture.reduced

    def _file(self, path: Path, capture: Capture, prefix: str) -> Path:
        """The picture, or its smaller copy; where there is no such copy the picture itself, which is made small when it
        is read (`fb_nerfstudio.capture.pictures`), as a mask is with its picture.
        """
        if not self._takes_copies(capture):
            return path
        copy = smaller_copy(path, capture, prefix, self.downscale_factor or 1)
        return copy if copy.exists() else path

    def _made_smaller(self, files: list[Path], full: list[Path], capture: Capture) -> dict[str, list[float]]:
        """By what factor each picture is to be read smaller; nothing where all smaller copies that were asked for are
        there.
        """
        if not self._takes_copies(capture):
            return {}
        factor = (self.downscale_factor or 1) / capture.reduced
        factors = [factor if file == whole else 1.0 for file, whole in zip(files, full, strict=True)]
        return {SMALLER_BY: factors} if any(one > 1 for one in factors) else {}

    @staticmethod
    def _automatic_factor(path: Path, capture: Capture) -> int:
        longest, factor = max(media.image_size(path)), capture.reduced
        while (
            longest * capture.reduced / factor > MAX_AUTO_RESOLUTION
            and smaller_copy(path, capture, "images_", 2 * factor).exists()
        ):
            factor *= 2
        return factor

    def _depths(self, frames: list[Frame], chosen: list[int], capture: Capture) -> list[Path] | None:
        """Depth pictures, where all frames have one."""
        named = [frame.extra.get("depth_file_path") for frame in frames]
        if not all(isinstance(name, str) for name in named):
            return None
        return [self._file(capture.root / str(named[place]), capture, "depths_") for place in chosen] or None

    def _points(self, capture: Capture, world: _World) -> dict[str, Tensor]:
        """Positions in the training world (float32 [n, 3]) and colours (uint8 [n, 3]); nothing without points."""
        if capture.points_path is None:
            return {}
        points = read_points(capture.points_path)
        if len(points) == 0:
            return {}
        moved = (points.positions @ world.transform[:, :3].T + world.transform[:, 3]) * world.scale
        return {"points3D_xyz": moved.float(), "points3D_rgb": (points.colors * 255).round().to(torch.uint8)}


def without_open3d(config: DataParserConfig) -> DataParserConfig:
    """The same config; a plain nerfstudio one now builds :class:`NerfstudioWithoutOpen3d`."""
    if config._target is Nerfstudio:
        config._target = NerfstudioWithoutOpen3d
    return config


def files_read(outputs: DataparserOutputs, data: Path | None) -> tuple[Path, ...]:
    """What a run reads of its capture: the file that describes it, and one picture or mask of every folder of them.

    Not the capture's folder as such: nerfstudio names runs after it, so that ``--data outputs/room --output-dir
    outputs`` has its runs in ``outputs/room``.
    """
    pictures = [Path(path).resolve() for path in (*outputs.image_filenames, *(outputs.mask_filenames or ()))]
    described = () if data is None else (data if data.is_file() else data / "transforms.json",)
    return (*described, *{path.parent: path for path in pictures}.values())


def smaller_copy(path: Path, capture: Capture, prefix: str, factor: int) -> Path:
    """Where the copy of a picture, mask or depth lies that is smaller by a factor: in images_4 and the like, with or
    without the folders below images in which a rig's pictures lie.
    """
    folder = capture.root / f"{prefix}{factor}"
    parts = path.relative_to(capture.root).parts[1:] if path.is_relative_to(capture.root) else ()
    deep = folder.joinpath(*parts)
    return deep if len(parts) > 1 and deep.exists() else folder / path.name


def _sizes_on_disk(cameras: Cameras, frames: list[Frame], files: list[Path]) -> None:
    """Copies whose sides were rounded up, which nerfstudio counts as rounded down, get their real sizes."""
    for index, (frame, path) in enumerate(zip(frames, files, strict=True)):
        try:
            height, width = media.posed_size(path)
        except ValueError:
            continue  # reading it tells what is wrong
        asked = (int(cameras.width[index]), int(cameras.height[index]))
        if (width, height) == asked or max(abs(width - asked[0]), abs(height - asked[1])) > 1:
            continue  # as expected, or no copy of this picture, which its reader tells
        camera = frame.camera.scaled(width, height)
        cameras.width[index], cameras.height[index] = width, height
        cameras.fx[index], cameras.fy[index] = camera.focal[0]
        cameras.cx[index], cameras.cy[index] = camera.principal[0]


def _is_wide(frame: Frame) -> bool:
    """Whether nerfstudio cannot straighten a frame's picture, so that it is straightened while it is read."""
    return is_too_wide(frame.camera, frame.camera_model, frame.distortion)


def _lens_of_frame(frame: Frame) -> WideLens:
    return frame.camera, frame.camera_model, frame.distortion


def _straight(frame: Frame) -> Frame:
    """The frame as a pinhole camera took it."""
    camera = straight_camera(frame.camera, frame.camera_model, frame.distortion)
    return dataclasses.replace(frame, camera=camera, camera_model="PINHOLE", distortion={})


def _name(path: Path) -> str:
    return os.path.normpath(path)


def _listed(capture: Capture, split: str) -> set[str]:
    """The files that the capture lists for a split."""
    return {_name(capture.root / name) for name in capture.extra[f"{split}_filenames"]}


def _split(names: list[Path], split: str, config: NerfstudioDataParserConfig) -> list[int]:
    """Places of the pictures that nerfstudio's options give to a split."""
    if config.eval_mode == "fraction":
        train, held_out = get_train_eval_split_fraction(names, config.train_split_fraction)
    elif config.eval_mode == "interval":
        train, held_out = get_train_eval_split_interval(names, config.eval_interval)
    else:
        train, held_out = (
            get_train_eval_split_filename if config.eval_mode == "filename" else get_train_eval_split_all
        )(names)
    return [int(place) for place in np.asarray(train if split == "train" else held_out)]
