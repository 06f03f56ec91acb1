"""Captures on disk: nerfstudio's ``transforms.json`` folder, read into our types and written back without loss.

The file holds camera-to-world matrices with OpenGL axes (x right, y up, z backward); a :class:`Frame` holds OpenCV
axes. Only the signs of two columns change, and the stored camera is float64 as JSON numbers are, so poses and
intrinsics survive reading and writing bit for bit.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.frames import _SPLIT_KEYS, CAPTURE_KEYS, FRAME_KEYS, Capture, Frame, _wrong_size
from fb_core.data.capture.point_cloud import Points
from fb_core.data.capture.points import require_points, write_points
from fb_core.data.capture.transforms_json import (
    JSON_NAME,
    camera_entry,
    checked_pose,
    to_json,
)
from fb_core.data.capture.undistort import check_lens, check_straight
from fb_core.files.ownership import Target
from fb_core.files.whole import settled, whole_file, whole_folder
from fb_core.geometry.cameras import Pinholes

TRUST_KEY = "trust_path"
"""Of a generated frame: the picture of its pixels' trust, relative to the capture's folder."""
_ORIENTATIONS = ("pca", "up", "vertical", "none")  # nerfstudio's


@dataclass(frozen=True, kw_only=True)
class FrameToWrite:
    """One undistorted picture for :func:`write_capture`."""

    name: str
    """Name of the files without folder and suffix; unique within the capture."""
    image: Float[Tensor, "3 h w"]
    """RGB in [0, 1]; stored with 8 bits."""
    mask: Float[Tensor, "1 h w"] | None = None
    """1 = used; values below one half become 0. None = all used."""
    trust: Float[Tensor, "1 h w"] | None = None
    """How far each pixel of a generated picture is believed, 0 to 1; stored with 8 bits in trust/NAME.png, which the
    frame names.
    """
    camera: Pinholes
    """One camera of the image's size, OpenCV axes."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Further JSON keys of the frame."""


def read_capture(folder: str | Path) -> Capture:
    """The capture in a folder, or in the JSON file given.

    A folder holds a transforms.json, or is in one of the layouts of :mod:`fb_core.data.capture.layouts` (Blender's
    files for each split, ScanNet++, a COLMAP model). Intrinsics may stand at the top (they win, as in nerfstudio) or in
    each frame; a focal may be given as camera_angle_x; a missing size is taken from the picture. Pictures are not
    opened otherwise: see :func:`validate_capture`.

    Raises:
        ValueError: one sentence, for a missing folder or file, bad JSON, no frames, and bad or missing poses and
            intrinsics.
    """
    from fb_core.data.capture.layouts import (  # which read into the types of this module
        Layout,
        layout_of,
        other_tool,
        read_layout,
    )

    path = Path(folder)
    if not path.exists():
        settled(path.parent if path.suffix.lower() == ".json" else path)
    if not path.exists():
        raise ValueError(f"capture {path}: no such folder; check the path")
    layout = layout_of(path) if path.is_dir() else Layout(kind="transforms", path=path)
    if layout is None and (other := other_tool(path)) is not None:
        raise ValueError(f"capture {path}: this is {other[0]}, which is not read; {other[1]}")
    if layout is None:
        raise ValueError(
            f"capture {path}: no {JSON_NAME} in this folder, no transforms_train.json and no COLMAP model (sparse/0); "
            "run ns-process-data, "
            "or check the path"
        )
    return read_layout(layout)


def validate_capture(folder: str | Path, *, decode: bool = False) -> Capture:
    """Reads a capture and checks all that ``ns-train`` needs, so that nothing fails halfway through a training.

    Beyond :func:`read_capture`: every picture and mask exists, is complete, and has its camera's size in stored pixels;
    masks are given for all frames or for none; the lens can be undistorted; the points file exists.

    Args:
        folder: the capture.
        decode: also decode every picture (seconds instead of milliseconds for a hundred photos).

    Raises:
        ValueError: one sentence about the first fault found.
    """
    capture = read_capture(folder)
    masked = sum(frame.mask_path is not None for frame in capture.frames)
    if masked not in (0, len(capture)):
        raise ValueError(
            f"capture {folder}: expected mask_path in all frames or in none, got {masked} of {len(capture)}; add "
            "white masks"
        )
    if capture.points_path is not None and not capture.points_path.is_file():
        raise ValueError(
            f"capture {folder}: ply_file_path names {capture.points_path}, which is missing; restore it or remove the "
            "key"
        )
    orientation = capture.extra.get("orientation_override", "none")
    if orientation not in _ORIENTATIONS:
        raise ValueError(
            f"capture {folder}: expected orientation_override as one of {', '.join(_ORIENTATIONS)}, got "
            f"{orientation!r}; correct the file"
        )
    if capture.points_path is not None:
        require_points(capture.points_path)
    for frame in capture.frames:
        check_lens(frame.camera_model, frame.distortion, f"image {frame.image_path}")
        check_straight(frame.camera, frame.camera_model, frame.distortion, f"image {frame.image_path}")
        for kind, path in (("image", frame.image_path), ("mask", frame.mask_path)):
            if path is None:
                continue
            stored = media.posed_size(path)
            if stored != (frame.camera.height, frame.camera.width):
                raise ValueError(_wrong_size(frame, kind, path, stored))
        if decode:
            frame.load_image()
    return capture


def write_transforms(capture: Capture, folder: str | Path, *, overwrite: bool = False) -> Path:
    """Writes the transforms.json of a capture into ``folder``; pictures stay where they are and are named relative to
    it.

    Reading the result gives bit-equal poses, intrinsics and extras. Names of files among the extras (per-frame keys
    that end in ``_path``, and the lists of train, val and test files) are re-expressed for the new folder. Returns the
    path of the JSON file.

    Raises ValueError where the file exists and ``overwrite`` is not set.
    """
    folder = Path(folder)
    target = folder / JSON_NAME
    if target.exists() and not overwrite:
        raise ValueError(f"write_transforms: {target} exists already; choose another folder or pass overwrite=True")

    meta = dict(capture.extra)
    for key in set(_SPLIT_KEYS) & set(meta):
        meta[key] = [_relative(capture.root / name, folder) for name in meta[key]]
    models = {frame.camera_model for frame in capture.frames}
    if len(models) == 1:  # nerfstudio looks for it at the top only
        meta["camera_model"] = next(iter(models))
    if capture.points_path is not None:
        meta["ply_file_path"] = _relative(capture.points_path, folder)
    meta["frames"] = [_frame_entry(frame, capture.root, folder, with_model=len(models) > 1) for frame in capture.frames]
    folder.mkdir(parents=True, exist_ok=True)
    text = to_json(meta, str(target))
    with whole_file(target) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
    return target


def splits_of(frames: Sequence[Frame]) -> dict[str, list[Frame]]:
    """What readers are to train on (generated frames too), and what frames with ``held_out`` among their extras are
    for.
    """
    held_out = [frame for frame in frames if frame.extra.get("held_out")]
    return {"train": [frame for frame in frames if not frame.extra.get("held_out")], "val": held_out, "test": held_out}


def split_lists(frames: Sequence[Frame], root: Path) -> dict[str, list[str]]:
    """The splits as top-level keys of a transforms.json in ``root``: train_filenames, val_filenames, test_filenames."""
    return {
        f"{split}_filenames": [_relative(frame.image_path, root) for frame in chosen]
        for split, chosen in splits_of(frames).items()
    }


def write_capture(
    folder: str | Path | Target,
    frames: Sequence[FrameToWrite],
    *,
    points: Points | None = None,
    extra: dict[str, Any] | None = None,
    overwrite: bool = False,
) -> Capture:
    """Writes a capture that nerfstudio's own reader takes as it is: images/NAME.png, masks/NAME.png, points3D.ply,
    transforms.json.

    Masks are written for all frames as soon as one has a mask, because nerfstudio wants all or none. All is written
    beside the target and then renamed, so the folder is there whole or not at all.

    Args:
        folder: where the capture goes; it may exist if it is empty. As a target it says itself what may be replaced.
        frames: at least one, with names of their own.
        points: coloured points in the world of the cameras.
        extra: further top-level JSON keys, e.g. ``orientation_override``; values of plain JSON types.
        overwrite: replace the capture that the folder holds now, if it was written by this function.

    Returns:
        The capture as :func:`read_capture` reads it.
    """
    target, extra = (
        folder if isinstance(folder, Target) else Target(folder=Path(folder), kind="capture", overwrite=overwrite),
        extra or {},
    )
    _check_to_write(frames, extra)
    with whole_folder(target) as unfinished:
        written = tuple(
            _write_frame(frame, unfinished, any(one.mask is not None for one in frames)) for frame in frames
        )
        if points is not None:
            write_points(unfinished / "points3D.ply", points)
        points_path = None if points is None else unfinished / "points3D.ply"
        write_transforms(Capture(root=unfinished, frames=written, points_path=points_path, extra=extra), unfinished)
    return read_capture(target.folder)


# ---- reading --------------------------------------------------------------------------------------------------------


# ---- writing --------------------------------------------------------------------------------------------------------


def _relative(path: Path, folder: Path) -> str:
    """The file's name seen from a folder; links are followed only where the way leads out of the folder."""
    plain = os.path.relpath(path, folder)
    return os.path.relpath(path.parent.resolve() / path.name, folder.resolve()) if plain.startswith("..") else plain


def _frame_entry(frame: Frame, root: Path, folder: Path, *, with_model: bool) -> dict[str, Any]:
    """The JSON object of one frame."""
    entry: dict[str, Any] = {"file_path": _relative(frame.image_path, folder)}
    if frame.mask_path is not None:
        entry["mask_path"] = _relative(frame.mask_path, folder)
    if with_model:
        entry["camera_model"] = frame.camera_model
    files = {key: value for key, value in frame.extra.items() if key.endswith("_path") and isinstance(value, str)}
    moved = {key: _relative(root / value, folder) for key, value in files.items()}
    return {**entry, **frame.distortion, **frame.extra, **moved, **camera_entry(frame.camera)}


def _check_to_write(frames: Sequence[FrameToWrite], extra: dict[str, Any]) -> None:
    if not frames:
        raise ValueError("write_capture: expected at least one frame, got none")
    if taken := sorted(set(extra) & set(CAPTURE_KEYS)):
        raise ValueError(
            f"write_capture: extra must not hold {taken}, which are written from the frames and points; rename them"
        )
    names = [frame.name for frame in frames]
    for frame in frames:
        where = f"write_capture, frame {frame.name!r}"
        if (
            not frame.name
            or frame.name.startswith(".")
            or "/" in frame.name
            or "\\" in frame.name
            or names.count(frame.name) > 1
        ):
            raise ValueError(f"{where}: expected a file name of its own without folder or leading dot; rename it")
        size = (frame.camera.height, frame.camera.width)
        sizes = [tuple(frame.image.shape[1:])] + ([] if frame.mask is None else [tuple(frame.mask.shape[1:])])
        if len(frame.camera) != 1 or any(one != size for one in sizes):
            raise ValueError(
                f"{where}: expected one camera and image and mask of its (height, width) {size}, got {sizes}; resize "
                "them"
            )
        if taken := sorted(set(frame.extra) & set(FRAME_KEYS)):
            raise ValueError(
                f"{where}: extra must not hold {taken}, which are written from the camera and files; rename them"
            )
        checked_pose(where, frame.camera.camera_to_world[0].tolist())
        values = torch.cat([frame.camera.focal[0], frame.camera.principal[0]])
        if not bool(torch.isfinite(values).all() and (frame.camera.focal > 0).all()):
            raise ValueError(
                f"{where}: expected a finite focal above 0 and a finite principal point, got {values.tolist()}"
            )


def _write_frame(frame: FrameToWrite, folder: Path, with_mask: bool) -> Frame:
    """Writes the pictures of one frame; returns the frame that names them."""
    image_path, mask_path = folder / "images" / f"{frame.name}.png", folder / "masks" / f"{frame.name}.png"
    image_path.parent.mkdir(exist_ok=True)
    media.write_image(image_path, frame.image)
    if with_mask:
        mask_path.parent.mkdir(exist_ok=True)
        mask = torch.ones_like(frame.image[:1]) if frame.mask is None else frame.mask
        media.write_image(mask_path, (mask >= 0.5).to(frame.image))
    extra = frame.extra
    if frame.trust is not None:
        extra = {**extra, TRUST_KEY: f"trust/{frame.name}.png"}
        (folder / "trust").mkdir(exist_ok=True)
        media.write_image(folder / extra[TRUST_KEY], frame.trust)
    return Frame(image_path=image_path, mask_path=mask_path if with_mask else None, camera=frame.camera, extra=extra)
