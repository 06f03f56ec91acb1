"""Colours of point clouds mean the same whatever type the file keeps them in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fb_core.data.capture.point_cloud import Points
from fb_core.data.capture.points import read_points, write_points

COLOURS = torch.tensor([[1.0, 0.5, 0.0], [0.25, 0.75, 1.0]], dtype=torch.float64)
KINDS = {"uchar": ("u1", 255), "ushort": ("<u2", 65535), "float": ("<f4", 1), "double": ("<f8", 1), "int": ("<i4", 255)}


def write(path: Path, kind: str, *, binary: bool, top: float | None = None) -> Path:
    dtype, most = KINDS[kind]
    values = (COLOURS * (top or most)).round() if kind not in ("float", "double") else COLOURS * (top or most)
    header = f"ply\nformat {'binary_little_endian' if binary else 'ascii'} 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "".join(
        f"property {kind} {name}\n" for name in ("red", "green", "blue")
    )
    header += "end_header\n"
    if binary:
        table = np.zeros(2, dtype=[("place", "<f4", 3), ("colour", dtype, 3)])
        table["colour"] = values.numpy()
        path.write_bytes(header.encode() + table.tobytes())
    else:
        rows = [" ".join(["0 0 0", *(f"{float(value):g}" for value in row)]) for row in values]
        path.write_text(header + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("binary", [True, False])
def test_colours_of_every_type(tmp_path: Path, kind: str, binary: bool) -> None:
    """trimesh keeps the low byte of 16-bit colours."""
    points = read_points(write(tmp_path / "p.ply", kind, binary=binary))
    assert torch.allclose(points.colors, COLOURS, atol=0.51 / 255)


def test_floats_up_to_255_are_scaled_down(tmp_path: Path) -> None:
    points = read_points(write(tmp_path / "p.ply", "float", binary=True, top=255.0))
    assert torch.allclose(points.colors, COLOURS, atol=1e-6)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    points = Points(positions=torch.randn(5, 3).double(), colors=torch.rand(5, 3).double())
    write_points(tmp_path / "p.ply", points)
    again = read_points(tmp_path / "p.ply")
    assert torch.allclose(again.positions, points.positions, atol=1e-6) and torch.allclose(
        again.colors, points.colors, atol=0.51 / 255
    )


def test_a_header_that_promises_more_than_the_file_holds_is_refused_before_anything_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "p.ply", "uchar", binary=True)
    for count in (10**6, 10**12, 10**30):
        path.write_bytes(path.read_bytes().replace(b"element vertex 2", b"element vertex %d" % count))
        with pytest.raises(ValueError, match=r"its header promises .* of vertex, more than its"):
            read_points(path)
        path.write_bytes(path.read_bytes().replace(b"element vertex %d" % count, b"element vertex 2"))
    assert len(read_points(path)) == 2


def test_points_without_colours_are_grey(tmp_path: Path) -> None:
    path = tmp_path / "p.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float "
        "z\nend_header\n0 1 2\n"
    )
    points = read_points(path)
    assert points.positions.tolist() == [[0.0, 1.0, 2.0]] and points.colors.tolist() == [[0.5, 0.5, 0.5]]
