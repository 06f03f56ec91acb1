"""Which files that a transforms.json names may be copied into another folder: those inside of its capture, and of the
kind they claim.

Names in a capture from somebody else may lead anywhere (absolute, through ``..`` or a link). Reading such a file as a
picture harms nobody, and nerfstudio allows it; copying it into a folder that is perhaps passed on would publish what
nobody meant to publish.
"""

from __future__ import annotations

import logging
from pathlib import Path

from fb_core.data.capture.frames import Capture
from fb_core.data.capture.points import is_colmap

_HEADER_BYTES = 1 << 16
_FORMATS = (b"format ascii 1.0", b"format binary_little_endian 1.0", b"format binary_big_endian 1.0")
_logger = logging.getLogger(__name__)


def lies_inside(path: Path, folder: Path) -> bool:
    """Whether a file lies in a folder once all links are followed."""
    return path.resolve().is_relative_to(folder.resolve())


def own_points(capture: Capture) -> Path | None:
    """The capture's point cloud if it may be copied, else None; a warning says why not."""
    path = capture.points_path
    if path is None:
        return None
    if not lies_inside(path, capture.root):
        _logger.warning(
            "left out: ply_file_path names %s, outside of the capture %s; copy it there to have it along",
            path,
            capture.root,
        )
        return None
    if not is_colmap(path) and not is_ply(path):
        _logger.warning("left out: ply_file_path names %s, which is no PLY file by its header; restore it", path)
        return None
    return path


def own_pictures(capture: Capture) -> list[int]:
    """The frames whose picture and mask may be copied; one warning tells of all others."""
    files = [[path for path in (frame.image_path, frame.mask_path) if path is not None] for frame in capture.frames]
    strange = {
        index: path for index, paths in enumerate(files) for path in paths if not lies_inside(path, capture.root)
    }
    if strange:
        _logger.warning(
            "left out: %d of %d pictures, since they lie outside of the capture %s, such as %s; copy them there to "
            "have them along",
            *(len(strange), len(files), capture.root, next(iter(strange.values()))),
        )
    return [index for index in range(len(files)) if index not in strange]


def is_ply(path: Path) -> bool:
    """Whether a file begins with the whole header of a PLY file."""
    try:
        with path.open("rb") as file:
            header, end, _ = file.read(_HEADER_BYTES).partition(b"end_header")
    except OSError:
        return False
    lines = [line.strip() for line in header.splitlines()]
    statements = [line for line in lines if line and not line.startswith((b"comment", b"obj_info"))]
    if not end or statements[:1] != [b"ply"] or len(statements) < 2 or statements[1] not in _FORMATS:
        return False
    return all(line.startswith((b"element ", b"property ")) for line in statements[2:])
