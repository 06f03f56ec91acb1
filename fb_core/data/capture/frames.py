"""A capture and its frames, as they are once read."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.transforms_json import (
    DISTORTION_KEYS,
    INTRINSIC_KEYS,
    camera_from,
    finite_number,
    listed_lens,
    load_transforms,
    model_of,
    with_suffix,
)
from fb_core.data.capture.undistort import check_lens, undistort
from fb_core.geometry.cameras import Pinholes

FRAME_KEYS = ("file_path", "mask_path", "transform_matrix", *INTRINSIC_KEYS)


CAPTURE_KEYS = ("frames", "ply_file_path", *INTRINSIC_KEYS)


_SPLIT_KEYS = ("train_filenames", "val_filenames", "test_filenames")  # lists of file_path


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One picture of a capture with its camera. Pictures of one capture may differ in size and lens."""

    image_path: Path
    """The picture's file."""
    mask_path: Path | None = None
    """A grey picture of the same size: white = used; None = all of it."""
    camera: Pinholes
    """One camera, float64, OpenCV axes, in the capture's world; focal and principal before undistortion."""
    distortion: dict[str, float] = field(default_factory=dict)
    """Lens coefficients k1, k2, k3, k4, p1, p2 as far as they are given; empty = none."""
    camera_model: str = "OPENCV"
    """Name of the lens model as nerfstudio spells it."""
    extra: dict[str, Any] = field(default_factory=dict)
    """All other keys of the frame, as they stand in the file."""

    @property
    def generated(self) -> bool:
        """Whether the frame says that no camera took it."""
        return bool(self.extra.get("generated", False))

    @property
    def is_bad(self) -> bool:
        """Whether the frame is marked as one not to be used (``is_bad`` of ScanNet++)."""
        return bool(self.extra.get("is_bad", False))

    def load_image(self) -> Float[Tensor, "3 h w"]:
        """RGB in [0, 1] of the camera's size, bent as the lens bent it. Raises ValueError for a bad file or another
        size.
        """
        return self._load()[0]

    def load_mask(self) -> Float[Tensor, "1 h w"]:
        """1 where the picture is to be used, else 0: mask file (lighter than half) and alpha channel (above half), all
        ones without.
        """
        return self._load()[1]

    def load_undistorted(self) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"], Pinholes]:
        """Image, mask and camera without lens distortion (see :func:`fb_core.data.capture.undistort.undistort`)."""
        check_lens(self.camera_model, self.distortion, f"image {self.image_path}")
        image, mask = self._load()
        return undistort(image, mask, self.camera, self.camera_model, self.distortion)

    def _load(self) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]:
        size = (self.camera.height, self.camera.width)
        upright = media.fits_only_upright(self.image_path, size)
        image, alpha = media.read_photo(self.image_path, apply_orientation=upright)
        if tuple(image.shape[1:]) != size:
            stored = media.image_size(self.image_path, apply_orientation=False)
            raise ValueError(_wrong_size(self, "image", self.image_path, stored))
        mask = torch.ones_like(image[:1]) if alpha is None else (alpha >= 0.5).to(image)
        if self.mask_path is not None:
            painted = media.read_mask(self.mask_path, apply_orientation=upright)
            if tuple(painted.shape[1:]) != size:
                raise ValueError(_wrong_size(self, "mask", self.mask_path, tuple(painted.shape[1:])))
            mask = mask * painted
        return image, mask


@dataclass(frozen=True, kw_only=True)
class Capture:
    """A folder of posed pictures."""

    root: Path
    """The folder; relative names in ``extra`` are relative to it."""
    frames: tuple[Frame, ...]
    """In the order of the file (nerfstudio sorts them by name)."""
    points_path: Path | None = None
    """Coloured points in the capture's world: a PLY file, or COLMAP's points3D."""
    extra: dict[str, Any] = field(default_factory=dict)
    """All other top-level keys (applied_transform, train_filenames, ...), as they stand in the file."""
    reduced: int = 1
    """Where the full pictures are not there but images_2 (or 4, 8): that factor; cameras are of the pictures that are
    there.
    """

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def photos(self) -> Capture:
        """The capture without its generated frames and those marked as bad."""
        return dataclasses.replace(
            self, frames=tuple(frame for frame in self.frames if not frame.generated and not frame.is_bad)
        )

    @property
    def has_split_lists(self) -> bool:
        """Whether it says by name which frames are trained on and which are held out."""
        return any(key in self.extra for key in _SPLIT_KEYS)

    @property
    def cameras(self) -> Pinholes:
        """All cameras in one batch. Raises ValueError when the pictures differ in size."""
        return Pinholes.cat([frame.camera for frame in self.frames])

    @property
    def poses(self) -> Float[Tensor, "n 3 4"]:
        """All camera-to-world matrices (OpenCV axes, float64), whatever the sizes."""
        return torch.cat([frame.camera.camera_to_world for frame in self.frames])

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(height, width) of every picture."""
        return [(frame.camera.height, frame.camera.width) for frame in self.frames]


def read_transforms(path: Path, *, frames: str = "frames", optional: bool = False) -> Capture:
    """The capture of one JSON file.

    Args:
        path: the file.
        frames: key of the list of frames.
        optional: take a missing list for an empty one.

    Raises ValueError as :func:`read_capture`.
    """
    meta = load_transforms(path)
    entries = meta.get(frames)
    if not (optional and entries in (None, [])) and (not isinstance(entries, list) or not entries):
        got = "no frames" if entries in (None, []) else f"frames of type {type(entries).__name__}"
        raise ValueError(
            f"capture {path}: expected a list '{frames}' with at least one camera, got {got}; process the pictures "
            "again"
        )
    points = meta.get("ply_file_path")
    if not (points is None or isinstance(points, str)):
        raise ValueError(f"capture {path}: expected a file name for ply_file_path, got {points!r}; correct the file")
    return Capture(
        root=path.parent,
        frames=tuple(_read_frame(path, index, entry, meta) for index, entry in enumerate(entries or ())),
        points_path=None if points is None else path.parent / points,
        extra={key: value for key, value in meta.items() if key not in CAPTURE_KEYS},
    )


def _read_frame(json_path: Path, index: int, entry: Any, shared: dict[str, Any]) -> Frame:
    where = f"capture {json_path}, frame {index}"
    if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
        raise ValueError(
            f"{where}: expected an object with a 'file_path', got {str(entry)[:80]}; process the pictures again"
        )
    where += f" ({entry['file_path']})"
    image_path = with_suffix(json_path.parent / entry["file_path"])
    lens = listed_lens(
        where, shared if any(key in shared for key in (*DISTORTION_KEYS, "distortion_params")) else entry
    )
    mask = entry.get("mask_path")
    if not (mask is None or isinstance(mask, str)):
        raise ValueError(f"{where}: expected a file name for mask_path, got {mask!r}; correct the file")
    return Frame(
        image_path=image_path,
        mask_path=None if mask is None else json_path.parent / mask,
        camera=camera_from(where, image_path, entry, shared),
        distortion={key: finite_number(where, lens, key) for key in DISTORTION_KEYS if key in lens},
        camera_model=model_of(entry, shared),
        extra={key: value for key, value in entry.items() if key not in FRAME_KEYS},
    )


def _wrong_size(frame: Frame, kind: str, path: Path, stored: tuple[int, ...]) -> str:
    height, width = frame.camera.height, frame.camera.width
    message = f"{kind} {path}: expected {width} x {height} pixels as its camera says, got {stored[1]} x {stored[0]}"
    if stored == (width, height) and media.image_size(path) == (height, width):
        return (
            f"{message} stored lying on the side (EXIF orientation), which nerfstudio does not turn; save the "
            "picture upright"
        )
    return f"{message}; resize the {kind}, or process the pictures again"
