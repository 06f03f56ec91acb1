"""A completed capture as a folder of its own that other tools train on: nerfstudio's transforms.json, or a COLMAP
model.

Captured pictures without lens distortion are copied byte for byte; bent ones are straightened, as splat tools want
them. Poses are in the capture's own world. Pictures are handled one at a time, so memory does not grow with their
number.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from fb_core.data import media
from fb_core.data.capture.captures import TRUST_KEY, split_lists, splits_of, write_transforms
from fb_core.data.capture.colmap.model import ColmapImage, write_colmap
from fb_core.data.capture.frames import Capture, Frame
from fb_core.data.capture.layouts import PROVENANCE_NAME
from fb_core.data.capture.own_files import own_pictures, own_points
from fb_core.data.capture.point_cloud import Points
from fb_core.data.capture.points import copy_points, read_points, write_points
from fb_core.files.ownership import Target, as_target
from fb_core.files.whole import whole_folder
from fb_nerfstudio.runs.saved_run import CompletedCapture

KIND = "export"
_COLMAP_FOLDER = Path("sparse/0")
_LENS_EXTRAS = ("distortion_params", "fisheye_crop_radius")  # of the bent pictures
_MODEL = "PINHOLE"


def write_export(
    completed: CompletedCapture,
    folder: Path | Target,
    *,
    format: Literal["nerfstudio", "colmap"],
    points: Points | None,
    held_out: bool = True,
) -> int:
    """Write captured and generated views as a dataset, whole or not at all; returns how many pictures it has.

    Args:
        completed: what a run has left.
        folder: of the dataset; new or empty, or as a target an earlier export that may be replaced.
        format: ``nerfstudio`` (transforms.json) or ``colmap`` (sparse/0 as text and binary).
        points: coloured points in the capture's world; None takes the capture's own cloud, if it has one that may be
            copied.
        held_out: also write the captured pictures that the run did not train on; lists of names tell them apart.

    Raises ValueError for a folder that holds something else, and OSError or ValueError when the disk is full.
    """
    with whole_folder(as_target(folder, KIND)) as unfinished:
        (unfinished / "images").mkdir()
        captured = _captured_frames(completed, unfinished, held_out)
        generated = _generated_frames(completed, unfinished, masked=any(frame.mask_path for frame in captured))
        frames = [*captured, *generated]
        (_write_colmap if format == "colmap" else _write_nerfstudio)(unfinished, completed.capture, frames, points)
    return len(frames)


def _captured_frames(completed: CompletedCapture, folder: Path, held_out: bool) -> list[Frame]:
    """The capture's pictures and masks in the folder. Masks are for all or for none, as nerfstudio wants."""
    frames = completed.capture.frames
    masked = any(frame.mask_path is not None or media.has_alpha(frame.image_path) for frame in frames)
    masked = masked or not bool(completed.generated.masks.all())
    chosen = [index for index in own_pictures(completed.capture) if held_out or index not in completed.held_out]
    if not chosen:
        raise ValueError(
            f"capture {completed.capture.root}: none of its pictures lies in its folder, so that none may be copied"
        )
    names = _file_names([frames[index] for index in chosen])
    return [
        _captured_frame(frames[index], folder / "images" / name, masked=masked, held_out=index in completed.held_out)
        for index, name in zip(chosen, names, strict=True)
    ]


def _captured_frame(frame: Frame, target: Path, *, masked: bool, held_out: bool) -> Frame:
    camera, mask = frame.camera, None
    if any(frame.distortion.values()):
        image, mask, camera = frame.load_undistorted()
        media.write_image(target, image)
    else:
        _require_picture(frame)
        shutil.copyfile(frame.image_path, target)
        mask = frame.load_mask() if masked else None
    mask_path = None
    if masked and mask is not None:
        mask_path = _mask_path(target)
        media.write_image(mask_path, mask)
    carried = {
        key: value for key, value in frame.extra.items() if not key.endswith("_path") and key not in _LENS_EXTRAS
    }
    extra = {**carried, "generated": False, "held_out": held_out}
    return Frame(image_path=target, mask_path=mask_path, camera=camera, camera_model=_MODEL, extra=extra)


def _require_picture(frame: Frame) -> None:
    """Raises ValueError for a file that is not the picture that its camera took; only pictures are copied."""
    if media.image_size(frame.image_path, apply_orientation=False) != (frame.camera.height, frame.camera.width):
        frame.load_image()  # which says what is wrong, or that it lies on its side and fits


def _generated_frames(completed: CompletedCapture, folder: Path, *, masked: bool) -> list[Frame]:
    """The generated pictures in the folder; white in their masks is what the run trains on."""
    views, frames = completed.generated, []
    for index, origin in enumerate(views.origins):
        target = folder / "images" / f"generated_{origin.role}_{origin.round:02d}_{index:04d}.png"
        media.write_image(target, views.images[index].movedim(-1, 0).float() / 255)
        if masked:
            media.write_image(_mask_path(target), views.masks[index].movedim(-1, 0).float())
        extra = origin.record()
        if views.trust is not None:
            extra[TRUST_KEY] = f"trust/{target.stem}.png"
            (folder / "trust").mkdir(exist_ok=True)
            media.write_image(folder / extra[TRUST_KEY], views.trust[index].movedim(-1, 0).float() / 255)
        mask_path = _mask_path(target) if masked else None
        frames.append(
            Frame(image_path=target, mask_path=mask_path, camera=views.cameras[index], camera_model=_MODEL, extra=extra)
        )
    return frames


def _mask_path(image_path: Path) -> Path:
    """masks/NAME.png beside images/NAME.*."""
    folder = image_path.parent.parent / "masks"
    folder.mkdir(exist_ok=True)
    return folder / f"{image_path.stem}.png"


def _file_names(frames: Sequence[Frame]) -> list[str]:
    """Names without folders and blanks; numbered where they would collide with each other or with generated ones."""
    plain = ["_".join(frame.image_path.name.split()).lstrip(".") for frame in frames]
    names = [
        f"{Path(name).stem}.png" if any(frame.distortion.values()) else name
        for name, frame in zip(plain, frames, strict=True)
    ]
    stems = [Path(name).stem.lower() for name in names]
    if len(set(stems)) < len(stems) or any(stem.startswith("generated_") or not stem for stem in stems):
        return [f"captured_{index:04d}_{name}" for index, name in enumerate(names)]
    return names


def _write_nerfstudio(folder: Path, capture: Capture, frames: list[Frame], points: Points | None) -> None:
    """transforms.json with lists of the splits, and points3D.ply."""
    own = own_points(capture) if points is None else None
    points_path = None if points is None and own is None else folder / "points3D.ply"
    if points is not None:
        write_points(folder / "points3D.ply", points)
    elif points_path is not None and own is not None:
        copy_points(own, points_path)
    extra: dict[str, Any] = {
        key: value for key, value in capture.extra.items() if key not in _LENS_EXTRAS and key != "camera_model"
    }
    extra |= split_lists(frames, folder)
    write_transforms(Capture(root=folder, frames=tuple(frames), points_path=points_path, extra=extra), folder)


def _write_colmap(folder: Path, capture: Capture, frames: list[Frame], points: Points | None) -> None:
    """sparse/0, lists of the splits as nerfstudio's COLMAP reader takes them, and the provenance of every picture."""
    if points is None:
        own = own_points(capture)
        if own is None:
            raise ValueError(
                f"capture {capture.root}: a COLMAP model needs points, and it has none that may be copied; give points"
            )
        points = read_points(own)
    images = [ColmapImage(name=frame.image_path.name, camera=frame.camera) for frame in frames]
    write_colmap(folder / _COLMAP_FOLDER, images, points)
    for split, chosen in splits_of(frames).items():
        (folder / f"{split}_list.txt").write_text(
            "".join(f"{frame.image_path.name}\n" for frame in chosen), encoding="utf-8"
        )
    provenance = {frame.image_path.name: frame.extra for frame in frames}
    (folder / PROVENANCE_NAME).write_text(json.dumps(provenance, indent=1, allow_nan=False), encoding="utf-8")
