"""Coloured points and the PLY file that nerfstudio seeds its splats from."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.capture.point_cloud import Points

_HEADER_BYTES = 2**16


def is_colmap(path: str | Path) -> bool:
    """Whether a file is named as COLMAP names its points."""
    return Path(path).name in ("points3D.bin", "points3D.txt")


def read_points(path: str | Path) -> Points:
    """Finite points of a PLY file (or the corners of its mesh), grey where it has no colours, or of COLMAP's points3D.

    Raises ValueError for other files.
    """
    if is_colmap(path):
        from fb_core.data.capture.colmap.reader import read_colmap_points  # which reads into our points

        return read_colmap_points(Path(path))
    require_points(path)
    import trimesh

    try:
        cloud: Any = trimesh.load(str(path), process=False)
        positions = torch.from_numpy(np.array(cloud.vertices, dtype=np.float64))
    except (OSError, ValueError, AttributeError, IndexError, KeyError) as error:
        raise ValueError(f"points {path}: not readable as a PLY file ({error}); restore it") from error
    finite = torch.isfinite(positions).all(dim=1)
    colors = _stored_colors(cloud)
    if colors is None or len(colors) != len(positions):
        return Points(positions=positions[finite], colors=torch.full_like(positions[finite], 0.5))
    return Points(positions=positions[finite], colors=colors[finite])


def _stored_colors(cloud: Any) -> Float[Tensor, "m 3"] | None:
    """Colours in [0, 1] as the file's types mean them: 8 and 16 bits of their range, others up to 1, or up to 255 if
    any is larger.
    """
    stored = cloud.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = ("red", "green", "blue")
    has = [] if stored is None else list(stored.dtype.names or ()) if isinstance(stored, np.ndarray) else list(stored)
    if stored is not None and set(names) <= set(has):
        values = np.stack([np.asarray(stored[name]).reshape(-1) for name in names], axis=1)
        tops = {"uint8": 255.0, "uint16": 65535.0}
        colors = torch.from_numpy(values.astype(np.float64))
        finite = colors[torch.isfinite(colors).all(dim=1)]
        top = tops.get(values.dtype.name, 255.0 if len(finite) and float(finite.max()) > 1 else 1.0)
        return (colors / top).nan_to_num(0.5).clamp(0, 1)
    colors = getattr(cloud, "colors", None)
    if colors is None and getattr(getattr(cloud, "visual", None), "kind", None) == "vertex":
        colors = cloud.visual.vertex_colors
    values = np.asarray(
        [] if colors is None else colors, dtype=np.float64
    )  # trimesh gives an empty row where there are none
    return torch.from_numpy(values[:, :3]) / 255 if values.ndim == 2 and values.shape[1] >= 3 else None


def require_points(path: str | Path) -> None:
    """Raises ValueError for a file that does not begin as a PLY file does, such as the pointer that Git LFS leaves in
    its place, and for one whose header promises more than the file holds. Only the header is read. COLMAP's files are
    left to their reader.
    """
    if is_colmap(path):
        return
    with Path(path).open("rb") as file:
        start = file.read(_HEADER_BYTES)
    if not start.startswith(b"ply"):
        lfs = (
            ", but the pointer of a file that Git LFS keeps: git lfs pull"
            if start.startswith(b"version https://git-lfs")
            else ""
        )
        raise ValueError(
            f"points {path}: expected a PLY file, which this is not{lfs}; restore it, or remove ply_file_path"
        )
    size = Path(path).stat().st_size
    for kind, count in re.findall(rb"^element\s+(\S+)\s+(\d+)", start.partition(b"end_header")[0], flags=re.MULTILINE):
        if int(count[:20]) > size:  # each takes a byte at least
            what = kind.decode(errors="replace")[:20]
            raise ValueError(
                f"points {path}: its header promises {int(count[:20]):,} of {what}, more than its {size:,} bytes "
                "hold; copy it again"
            )


def copy_points(source: Path, target: Path) -> None:
    """The same points as a PLY file: byte for byte where they are one already."""
    if is_colmap(source):
        write_points(target, read_points(source))
    else:
        shutil.copyfile(source, target)


def write_points(path: str | Path, points: Points) -> None:
    """Writes a binary PLY file: float32 positions and 8-bit colours (red, green, blue)."""
    vertices = np.empty(len(points), dtype=[("position", "<f4", 3), ("color", "u1", 3)])
    vertices["position"] = points.positions.detach().cpu().float().numpy()
    vertices["color"] = (points.colors.detach().cpu().double().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    properties = [f"property float {axis}" for axis in "xyz"] + [
        f"property uchar {color}" for color in ("red", "green", "blue")
    ]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    Path(path).write_bytes("\n".join(lines).encode("ascii") + vertices.tobytes())
