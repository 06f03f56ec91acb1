"""COLMAP's sparse models, read: cameras, images and points, from binary files or from text (COLMAP's documentation,
"Output Format").

Models of COLMAP up to 4.2 are read, with and without rigs and frames: poses of the images are stored whole beside
those. Every fault is one sentence.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from fb_core.data.capture.point_cloud import Points
from fb_core.files.limits import is_finite

CAMERA_MODELS = (
    *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV"),
    *(
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "THIN_PRISM_FISHEYE",
        "RAD_TAN_THIN_PRISM_FISHEYE",
        "SIMPLE_DIVISION",
        "DIVISION",
    ),
    *("SIMPLE_FISHEYE", "FISHEYE", "EUCM", "EQUIRECTANGULAR"),
)
"""COLMAP's names, in the order of their numbers."""
_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)  # of each model
_LONGEST_NAME = 4096


@dataclass(frozen=True, kw_only=True)
class ColmapCamera:
    """One lens of a model."""

    model: str
    """A name of ``CAMERA_MODELS``."""
    width: int
    height: int
    params: tuple[float, ...]
    """In COLMAP's order; lengths in pixels."""


@dataclass(frozen=True, kw_only=True)
class ColmapPose:
    """One picture of a model."""

    name: str
    """File name relative to the folder of the pictures."""
    camera: int
    """Number of its lens."""
    quaternion: tuple[float, float, float, float]
    """World to camera, w first; not yet of unit length."""
    translation: tuple[float, float, float]


def has_model(folder: Path) -> bool:
    """Whether a folder holds a sparse model."""
    return any(
        (folder / f"cameras{suffix}").is_file() and (folder / f"images{suffix}").is_file()
        for suffix in (".bin", ".txt")
    )


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapPose]]:
    """Lenses by their numbers, and pictures in the order of their names. Binary files win where both are there.

    Raises ValueError for damaged files, unknown camera models, and poses of unknown lenses.
    """
    if (folder / "cameras.bin").is_file() and (folder / "images.bin").is_file():
        cameras, poses = _binary_cameras(folder / "cameras.bin"), _binary_images(folder / "images.bin")
    else:
        cameras, poses = _text_cameras(folder / "cameras.txt"), _text_images(folder / "images.txt")
    if not poses:
        raise ValueError(
            f"COLMAP model {folder}: expected at least one image with a pose, got none; run the mapper again"
        )
    for pose in poses:
        if pose.camera not in cameras:
            raise ValueError(
                f"COLMAP model {folder}: image {pose.name} has camera {pose.camera}, which the model lacks; export it "
                "again"
            )
    return cameras, sorted(poses, key=lambda pose: pose.name)


def model_size(folder: Path) -> int:
    """How many images a model has, from the beginning of a binary file; text is read."""
    path = folder / "images.bin"
    if not path.is_file():
        return len(_text_images(folder / "images.txt"))
    with path.open("rb") as file:
        start = file.read(8)
    return struct.unpack("<Q", start)[0] if len(start) == 8 else 0


def points_file(folder: Path) -> Path | None:
    """The file of a model's points, if there is one."""
    return next((path for suffix in (".bin", ".txt") if (path := folder / f"points3D{suffix}").is_file()), None)


def read_colmap_points(path: Path) -> Points:
    """Coloured points of points3D.bin or points3D.txt; those that are not finite are left out."""
    rows = list(_binary_points(path) if path.suffix == ".bin" else _text_points(path))
    values = torch.tensor(rows, dtype=torch.float64).reshape(-1, 6)
    values = values[torch.isfinite(values).all(dim=1)]
    return Points(positions=values[:, :3].contiguous(), colors=(values[:, 3:] / 255).clamp(0, 1))


# ---- binary ---------------------------------------------------------------------------------------------------------


class _Bytes:
    """A file's bytes, taken one piece after the other."""

    def __init__(self, path: Path, least: int):
        """``least`` is how many bytes an entry takes at least: a count that the file cannot hold is refused."""
        self.path, self.data, self.place = path, path.read_bytes(), 0
        (self.count,) = self.take("<Q")
        if self.count * least > len(self.data):
            raise self.damaged(
                f"its header promises {self.count:,} entries, more than its {len(self.data):,} bytes hold"
            )

    def take(self, kinds: str) -> tuple:
        try:
            values = struct.unpack_from(kinds, self.data, self.place)
        except struct.error:
            raise self.damaged("it ends too early") from None
        self.place += struct.calcsize(kinds)
        return values

    def name(self) -> str:
        end = self.data.find(b"\0", self.place, self.place + _LONGEST_NAME)
        if end < 0:
            raise self.damaged("a name has no end")
        text = self.data[self.place : end].decode("utf-8", errors="surrogateescape")
        self.place = end + 1
        return text

    def skip(self, bytes_: int) -> None:
        self.place += bytes_
        if self.place > len(self.data):
            raise self.damaged("it ends too early")

    def damaged(self, why: str) -> ValueError:
        return ValueError(f"COLMAP file {self.path}: damaged or truncated ({why}); copy it again from its source")


def _binary_cameras(path: Path) -> dict[int, ColmapCamera]:
    file, cameras = _Bytes(path, 24), {}
    for _ in range(file.count):
        number, model, width, height = file.take("<iiQQ")
        if not 0 <= model < len(CAMERA_MODELS):
            raise _unknown_model(path, f"number {model}")
        cameras[number] = _camera(path, CAMERA_MODELS[model], width, height, file.take(f"<{_PARAMETERS[model]}d"))
    return cameras


def _binary_images(path: Path) -> list[ColmapPose]:
    file, poses = _Bytes(path, 73), []
    for _ in range(file.count):
        _, *pose, camera = file.take("<i7di")
        name = file.name()
        (seen,) = file.take("<Q")
        file.skip(seen * 24)  # two coordinates and a point's number each
        poses.append(_pose(path, name, camera, pose))
    return poses


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    file = _Bytes(path, 51)
    for _ in range(file.count):
        _, *values, _, track = file.take("<Q3d3BdQ")
        file.skip(track * 8)
        yield tuple(values)


# ---- text -----------------------------------------------------------------------------------------------------------


def _lines(path: Path) -> list[str]:
    """The lines without comments; empty ones count, as pictures without features have such a line."""
    return [
        line.rstrip("\r")
        for line in path.read_text(encoding="utf-8-sig", errors="surrogateescape").split("\n")
        if line[:1] != "#"
    ]


def _text_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for line in filter(str.strip, _lines(path)):
        words = line.split()
        try:
            number, model, (width, height) = int(words[0]), words[1], map(int, words[2:4])
            params = tuple(map(float, words[4:]))
        except (ValueError, IndexError):
            raise _not_a_line(path, line) from None
        if model not in CAMERA_MODELS:
            raise _unknown_model(path, model)
        cameras[number] = _camera(path, model, width, height, params)
    return cameras


def _text_images(path: Path) -> list[ColmapPose]:
    poses, features = [], False
    for line in _lines(path):
        if features and (
            not line.strip() or _is_of_features(line)
        ):  # the line after a picture's; some tools leave it out
            features = False
            continue
        features = bool(line.strip())
        if not features:
            continue
        words = line.split(maxsplit=9)
        try:
            poses.append(_pose(path, words[9].strip(), int(words[8]), [float(word) for word in words[1:8]]))
        except (ValueError, IndexError) as error:
            raise (error if "COLMAP" in str(error) else _not_a_line(path, line)) from None
    return poses


def _is_of_features(line: str) -> bool:
    """Whether a line holds places of features with the numbers of their points, and is no picture's, which ends with a
    name.
    """
    words = line.split()
    try:
        return len(words) % 3 == 0 and (int(words[-1]) >= -1 and all(math.isfinite(float(word)) for word in words[:12]))
    except ValueError:
        return False


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for line in filter(str.strip, _lines(path)):
        try:
            values = tuple(map(float, line.split(maxsplit=7)[1:7]))
        except ValueError:
            raise _not_a_line(path, line) from None
        if len(values) != 6:
            raise _not_a_line(path, line)
        yield values


# ---- what both share ------------------------------------------------------------------------------------------------


def _camera(path: Path, model: str, width: int, height: int, params: tuple[float, ...]) -> ColmapCamera:
    expected = _PARAMETERS[CAMERA_MODELS.index(model)]
    if len(params) != expected or not all(map(is_finite, params)) or not (0 < width < 2**31 and 0 < height < 2**31):
        raise ValueError(
            f"COLMAP file {path}: expected a {model} camera with a size and {expected} finite numbers, got {width} x "
            f"{height} and "
            f"{[*params][:16]}; calibrate it again"
        )
    return ColmapCamera(model=model, width=width, height=height, params=params)


def _pose(path: Path, name: str, camera: int, values: list[float]) -> ColmapPose:
    w, x, y, z, *translation = values
    if not name or not all(map(is_finite, values)) or not w * w + x * x + y * y + z * z > 1e-12:
        raise ValueError(
            f"COLMAP file {path}: image {name!r} has no pose (got {values}); leave it out or run the mapper again"
        )
    return ColmapPose(
        name=name, camera=camera, quaternion=(w, x, y, z), translation=(translation[0], translation[1], translation[2])
    )


def _unknown_model(path: Path, model: str) -> ValueError:
    return ValueError(
        f"COLMAP file {path}: camera model {model} is not known here, expected one of {', '.join(CAMERA_MODELS)}; run "
        "colmap "
        "image_undistorter, which writes PINHOLE cameras"
    )


def _not_a_line(path: Path, line: str) -> ValueError:
    return ValueError(f"COLMAP file {path}: not a line of COLMAP's text format: {line[:80]!r}; export the model again")
