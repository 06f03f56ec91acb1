"""Layouts of captures other than one transforms.json: Blender's one file per split, ScanNet++'s folders, COLMAP's
sparse models.

Each is read into the same :class:`~fb_core.data.capture.captures.Capture`. Nothing is written into the user's folders.
"""

from __future__ import annotations

import dataclasses
import logging
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from fb_core.data import media
from fb_core.data.capture.colmap.lenses import lens_of
from fb_core.data.capture.colmap.reader import ColmapPose, has_model, model_size, points_file, read_model
from fb_core.data.capture.frames import Capture, Frame, read_transforms
from fb_core.data.capture.transforms_json import JSON_NAME, with_suffix
from fb_core.files.json_files import read_json
from fb_core.files.whole import found_below
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.rotations import rotations_of

Kind = Literal["transforms", "blender", "scannetpp", "colmap"]
BLENDER_NAMES = tuple(f"transforms_{split}.json" for split in ("train", "val", "test"))
_SCANNETPP = ("dslr/nerfstudio", "nerfstudio", ".")
_SCANNETPP_IMAGES, _SCANNETPP_MASKS = "resized_images", "resized_anon_masks"
_MODELS = (
    ".",
    "sparse",
    "sparse/*",
    "colmap/sparse",
    "colmap/sparse/*",
    "colmap",
    "dense/sparse",
    "dense/*/sparse",
    "dense/*/sparse/*",
)
_UNDISTORTED = ("*_calibration_undistorted", "undistorted/sparse", "sfm", "sfm/*")
_PICTURES = ("images", ".", "rgb", "input", "image", "resized_undistorted_images", _SCANNETPP_IMAGES)
_UPWARDS = 4  # folders above a model in which its pictures are looked for
_REDUCED = re.compile(r"images_(\d+)")
_IDENTITY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
PROVENANCE_NAME = "frames.json"
"""Beside the COLMAP models of ``fillerbuster export``: what is known of each picture, by its name."""
_COLMAP_EXPORT = "export the cameras as a COLMAP text model"
_OTHER_TOOLS = (  # a file that tells the tool, the tool, what to do
    ("keyframes/cameras", "Polycam's raw data", "run ns-process-data polycam"),
    ("keyframes/corrected_cameras", "Polycam's raw data", "run ns-process-data polycam"),
    ("EXR_RGBD/metadata", "Record3D's data", "run ns-process-data record3d"),
    ("*.r3d", "a Record3D recording", "export it as EXR + RGB and run ns-process-data record3d"),
    ("rgbd/0.conf", "Record3D's data", "run ns-process-data record3d"),
    (
        "poses_bounds.npy",
        "an LLFF capture without its COLMAP model",
        "put the model's folder sparse/0 beside its images",
    ),
    ("opensfm/reconstruction.json", "an OpenDroneMap project", "run ns-process-data odm"),
    ("reconstruction.json", "an OpenSfM project", "export it with opensfm export_colmap"),
    ("sfm_data.json", "an OpenMVG project", "export it with openMVG_main_openMVG2Colmap"),
    ("*.nvm", "a VisualSFM model", "convert it to a COLMAP model"),
    ("bundle.out", "a Bundler model", "convert it to a COLMAP model"),
    ("cfg_args", "a trained model of 3D Gaussian splatting", "give the folder of the pictures that it was trained on"),
    ("cameras.xml", "a Metashape export", "run ns-process-data metashape"),
    ("doc.xml", "a Metashape project", _COLMAP_EXPORT),
    ("*.psx", "a Metashape project", _COLMAP_EXPORT),
    ("*.rcproj", "a RealityCapture project", _COLMAP_EXPORT),
    ("*.rspj", "a RealityScan project", _COLMAP_EXPORT),
    ("lowres_wide.traj", "an ARKitScenes scan", "use ns-train's arkit-data subcommand"),
    ("color/0.jpg", "a ScanNet scan", "use ns-train's scannet-data subcommand"),
    ("dataset.json", "a Nerfies or HyperNeRF capture", "use ns-train's dycheck-data subcommand"),
    ("cameras_sphere.npz", "a DTU scan", "use ns-train's sdfstudio-data subcommand after its conversion"),
    ("intrinsics.txt", "an NSVF scene", "convert it to transforms.json"),
    ("pair.txt", "an MVSNet scene", "convert it to a COLMAP model"),
    (
        "database.db",
        "a COLMAP project without a sparse model",
        "run colmap mapper, or fillerbuster complete on its folder of pictures",
    ),
)
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How a folder holds its capture."""

    kind: Kind
    path: Path
    """The JSON file, or the folder of the COLMAP model."""


def layout_of(folder: Path) -> Layout | None:
    """The layout of a folder; None for one without cameras. A transforms.json wins over all else."""
    if (folder / JSON_NAME).is_file() and not _is_scannetpp(folder):
        return Layout(kind="transforms", path=folder / JSON_NAME)
    for name in BLENDER_NAMES:
        if (folder / name).is_file():
            return Layout(kind="blender", path=folder / name)
    for below in _SCANNETPP:
        if (folder / below / JSON_NAME).is_file() and _is_scannetpp(folder / below):
            return Layout(kind="scannetpp", path=folder / below / JSON_NAME)
    model = _best_model(folder)
    return None if model is None else Layout(kind="colmap", path=model)


def read_layout(layout: Layout) -> Capture:
    """The capture. Raises ValueError in one sentence, as :func:`fb_core.data.capture.captures.read_capture`."""
    readers: dict[Kind, Callable[[Path], Capture]] = {
        "transforms": read_transforms,
        "blender": _read_blender,
        "scannetpp": _read_scannetpp,
        "colmap": _read_colmap,
    }
    return _with_reduced_pictures(readers[layout.kind](layout.path))


def layouts_below(folder: Path) -> list[Path]:
    """Every folder at or below this one that holds a capture, sorted; a capture's own COLMAP model is not another
    one.
    """
    files = {name: found_below(folder, name) for name in (JSON_NAME, *BLENDER_NAMES, "cameras.bin", "cameras.txt")}
    folders = {path.parent for path in files[JSON_NAME]}
    folders |= {path.parent for name in BLENDER_NAMES for path in files[name]}
    for path in (*files["cameras.bin"], *files["cameras.txt"]):
        if not has_model(path.parent):
            continue
        root = _folder_of(path.parent)
        if not any(root.is_relative_to(one) or one.is_relative_to(root) for one in folders if one != root):
            folders.add(root)
    return sorted(folders)


def other_tool(folder: Path) -> tuple[str, str] | None:
    """(what a folder is, what turns it into a capture) for folders of other tools that are not read; None for those not
    known.
    """
    for pattern, kind, remedy in _OTHER_TOOLS:
        if next(folder.glob(pattern), None) is not None:
            return kind, remedy
    return None


# ---- Blender: one file for each split --------------------------------------------------------------------------------


def _read_blender(path: Path) -> Capture:
    """transforms_train.json and those beside it, with the splits as lists."""
    captures = {split: read_transforms(path.with_name(name)) for split, name in _splits(path)}
    times = {frame.extra.get("time") for capture in captures.values() for frame in capture.frames}
    if len(times) > 1:
        _logger.warning(
            "capture %s: its frames have %d different times; what moves in them is taken as standing still",
            path,
            len(times),
        )
    frames: dict[Path, Frame] = {}
    for capture in captures.values():
        for frame in capture.frames:
            frames.setdefault(frame.image_path, frame)
    names = {
        split: [str(frame.image_path.relative_to(path.parent)) for frame in one.frames]
        for split, one in captures.items()
    }
    first = next(iter(captures.values()))
    lists = {f"{split}_filenames": listed for split, listed in names.items()}
    return dataclasses.replace(first, frames=tuple(frames.values()), extra={**first.extra, **lists})


def _splits(path: Path) -> list[tuple[str, str]]:
    pairs = zip(("train", "val", "test"), BLENDER_NAMES, strict=True)
    return [(split, name) for split, name in pairs if path.with_name(name).is_file()]


# ---- ScanNet++: transforms.json in a folder beside those of its pictures and masks -----------------------------------


def _is_scannetpp(folder: Path) -> bool:
    """Whether a folder with transforms.json has its pictures in ScanNet++'s place, beside the folder."""
    return folder.resolve().name == "nerfstudio" and (folder.resolve().parent / _SCANNETPP_IMAGES).is_dir()


def _read_scannetpp(path: Path) -> Capture:
    """Frames to train on, and ``test_frames`` as those held out."""
    root = path.parent.resolve().parent
    train, test = read_transforms(path), read_transforms(path, frames="test_frames", optional=True)
    extra = {key: value for key, value in train.extra.items() if key != "test_frames"}
    frames = [
        dataclasses.replace(
            frame,
            image_path=_beside(root / _SCANNETPP_IMAGES, frame.image_path),
            mask_path=None if frame.mask_path is None else _beside(root / _SCANNETPP_MASKS, frame.mask_path),
            extra={**frame.extra, **({"held_out": True} if held_out else {})},
        )
        for held_out, one in ((False, train), (True, test))
        for frame in one.frames
    ]
    if any(frame.mask_path is not None and not frame.mask_path.is_file() for frame in frames):
        _logger.warning("capture %s: %s lacks masks, so that none are used", path, root / _SCANNETPP_MASKS)
        frames = [dataclasses.replace(frame, mask_path=None) for frame in frames]
    if len(test):
        chosen = {"train": frames[: len(train)], "val": frames[len(train) :], "test": frames[len(train) :]}
        extra |= {
            f"{split}_filenames": [str(one.image_path.relative_to(root)) for one in part]
            for split, part in chosen.items()
        }
    return Capture(root=root, frames=tuple(frames), points_path=train.points_path, extra=extra)


def _beside(folder: Path, path: Path) -> Path:
    return path if path.is_file() else folder / path.name


# ---- COLMAP ----------------------------------------------------------------------------------------------------------


def _best_model(folder: Path) -> Path | None:
    """The model with the most pictures among those in the first place that has any."""
    for pattern in (*_MODELS, *_UNDISTORTED):
        places = [folder] if pattern == "." else sorted(folder.glob(pattern))
        models = [place for place in places if place.is_dir() and has_model(place)]
        if len(models) == 1:
            return models[0]
        if models:
            sizes = [model_size(model) for model in models]
            best = models[sizes.index(max(sizes))]
            _logger.warning(
                "capture %s: %d COLMAP models; %s is read, which has most pictures (%s)",
                folder,
                len(models),
                best,
                max(sizes),
            )
            return best
    return None


def _read_colmap(model: Path) -> Capture:
    """The pictures of a model that are there, with masks where a folder ``masks`` has them."""
    cameras, poses = read_model(model)
    pictures, root, reduced = _pictures_of(model, poses)
    files = {pose.name: with_suffix(pictures / pose.name) for pose in poses}
    there = [pose for pose in poses if files[pose.name].is_file()]
    if len(there) < len(poses):
        gone = next(pose.name for pose in poses if not files[pose.name].is_file())
        _logger.warning(
            "capture %s: %d of %d pictures are missing, such as %s; left out",
            root,
            len(poses) - len(there),
            len(poses),
            gone,
        )
    lenses = {number: lens_of(camera, f"COLMAP model {model}") for number, camera in cameras.items()}
    provenance = _provenance(root)
    frames = []
    for pose in there:
        camera, lens = cameras[pose.camera], lenses[pose.camera]
        pinhole = Pinholes(
            camera_to_world=_camera_to_world(pose),
            focal=torch.tensor([lens.focal], dtype=torch.float64),
            principal=torch.tensor([lens.principal], dtype=torch.float64),
            width=camera.width,
            height=camera.height,
        )
        frames.append(
            Frame(
                image_path=files[pose.name],
                mask_path=_mask_of(root / "masks", pose.name),
                camera=_of_size_on_disk(pinhole, files[pose.name]),
                distortion=lens.distortion,
                camera_model=lens.camera_model,
                extra=provenance.get(pose.name, {}),
            )
        )
    extra = {"applied_transform": _IDENTITY, **_lists(root, pictures, {frame.image_path for frame in frames})}
    return Capture(root=root, frames=tuple(frames), points_path=points_file(model), extra=extra, reduced=reduced)


def _camera_to_world(pose: ColmapPose) -> torch.Tensor:
    """[1, 3, 4]; COLMAP's axes are ours."""
    quaternion = torch.tensor([pose.quaternion], dtype=torch.float64)
    turn = rotations_of((quaternion / quaternion.norm()).double())[0].T
    center = -turn @ torch.tensor(pose.translation, dtype=torch.float64)
    return torch.cat([turn, center[:, None]], dim=1)[None]


def _pictures_of(model: Path, poses: list[ColmapPose]) -> tuple[Path, Path, int]:
    """(folder that the names are relative to, the capture's folder, factor by which the pictures are smaller than the
    model says).

    Raises ValueError where no folder near the model has any of them.
    """
    above = [model, *model.absolute().parents][: _UPWARDS + 1]
    for folder in above:
        reduced = {
            path.name: int(match[1]) for path in folder.glob("images_*") if (match := _REDUCED.fullmatch(path.name))
        }
        places = [*((name, 1) for name in _PICTURES), *sorted(reduced.items(), key=lambda pair: pair[1])]
        counts = [sum(with_suffix(folder / name / pose.name).is_file() for pose in poses) for name, _ in places]
        if max(counts):
            name, factor = places[counts.index(max(counts))]
            return (folder if name == "." else folder / name), _folder_of(model) if folder == model else folder, factor
    names = f"{poses[0].name} and {len(poses) - 1} more" if len(poses) > 1 else poses[0].name
    raise ValueError(
        f"COLMAP model {model}: its pictures ({names}) are in no folder images beside it; put the model's folder "
        "sparse beside images"
    )


def _folder_of(model: Path) -> Path:
    """The capture's folder for a model in its sparse/0, colmap/sparse/0 or sparse."""
    while model.name.isdigit() or model.name in ("sparse", "colmap"):
        model = model.parent
    return model


def _of_size_on_disk(camera: Pinholes, path: Path) -> Pinholes:
    """The camera of the picture as it lies there: people make pictures smaller after COLMAP has run, and keep the
    model.
    """
    try:
        height, width = media.posed_size(path)
    except ValueError:
        return camera  # the check tells what is wrong with the file
    shape = abs(width * camera.height - height * camera.width)
    same_shape = shape <= max(camera.height, camera.width)  # sides rounded by up to one pixel
    return camera.scaled(width, height) if same_shape and (width, height) != (camera.width, camera.height) else camera


def _mask_of(folder: Path, name: str) -> Path | None:
    """COLMAP's NAME.jpg.png, or a mask named as the picture."""
    if not folder.is_dir():
        return None
    names = (f"{name}.png", name, str(Path(name).with_suffix(".png")))
    return next((folder / one for one in names if (folder / one).is_file()), None)


def _lists(root: Path, pictures: Path, there: set[Path]) -> dict[str, list[str]]:
    """Splits of train_list.txt, val_list.txt and test_list.txt, as nerfstudio's COLMAP reader takes them."""
    lists = {}
    for split in ("train", "val", "test"):
        path = root / f"{split}_list.txt"
        if path.is_file():
            named = [pictures / line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
            lists[f"{split}_filenames"] = [str(one.relative_to(root)) for one in named if one in there]
    return lists


def _provenance(root: Path) -> dict[str, dict[str, Any]]:
    """What ``fillerbuster export`` has told of each picture: generated ones are no photos."""
    path = root / PROVENANCE_NAME
    try:
        content = read_json(path) if path.is_file() else {}
    except ValueError:
        return {}
    entries = content.items() if isinstance(content, dict) else []
    return {name: entry for name, entry in entries if isinstance(entry, dict) and "generated" in entry}


# ---- smaller copies alone --------------------------------------------------------------------------------------------


def _with_reduced_pictures(capture: Capture) -> Capture:
    """The capture with the pictures of images_2 (or 4, 8) where the full ones are missing (DL3DV), cameras alike."""
    if capture.reduced > 1 or any(frame.image_path.is_file() for frame in capture.frames):
        return capture
    for factor, folder in _reduced_folders(capture.root.glob("images_*")):
        copies = [folder / frame.image_path.name for frame in capture.frames]
        if all(copy.is_file() for copy in copies):
            _logger.info("capture %s: its pictures are those of %s", capture.root, folder.name)
            masks = capture.root / f"masks_{factor}"
            frames = [
                dataclasses.replace(
                    frame,
                    image_path=copy,
                    mask_path=None if frame.mask_path is None else masks / frame.mask_path.name,
                    camera=_of_size_on_disk(frame.camera, copy),
                )
                for frame, copy in zip(capture.frames, copies, strict=True)
            ]
            extra = {
                key: _renamed(value, folder.name) if key.endswith("_filenames") else value
                for key, value in capture.extra.items()
            }
            return dataclasses.replace(capture, frames=tuple(frames), extra=extra, reduced=factor)
    return capture


def _renamed(names: Any, folder: str) -> Any:
    return [f"{folder}/{Path(name).name}" for name in names]


def _reduced_folders(paths: Iterable[Path]) -> list[tuple[int, Path]]:
    """(factor, folder), the largest pictures first."""
    return sorted((int(match[1]), path) for path in paths if path.is_dir() and (match := _REDUCED.fullmatch(path.name)))
