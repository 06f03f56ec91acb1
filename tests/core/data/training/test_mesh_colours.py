"""Colours of meshes as other tools write them: of materials, of textures and their factors, of corners and of
polygons.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from fb_core.data.media import to_linear, to_srgb
from fb_core.data.meshes.mesh_pictures import Lighting, draw_with_caster, draw_with_pyvista, read_mesh
from fb_core.geometry.cameras import Pinholes

FRONT = Pinholes.looking_at(
    torch.tensor([[0.0, -3.0, 0.0]]),
    torch.zeros(1, 3),
    up=torch.tensor([0.0, 0, 1]),
    fov_degrees=45,
    width=64,
    height=64,
)
LIGHT = Lighting(background=(0.0, 0.0, 0.0), lamp=(0.0, -1.0, 0.0))  # full light on what faces the camera


def seen(path: Path) -> torch.Tensor:
    """Colour in the middle of the picture."""
    return draw_with_caster(read_mesh(path), FRONT, LIGHT)[0, :, 32, 32]


def box_as_obj(folder: Path, materials: str, *, coordinates: bool, split: bool = False) -> Path:
    box = trimesh.creation.box()
    (folder / "box.mtl").write_text(materials)
    names = [line.split()[1] for line in materials.splitlines() if line.startswith("newmtl")]
    lines = [
        "mtllib box.mtl",
        *(f"v {x:g} {y:g} {z:g}" for x, y, z in box.vertices),
        *(["vt 0 0", "vt 1 0", "vt 0 1"] if coordinates else []),
    ]
    for number, face in enumerate(box.faces + 1):
        if number in (0, *([6] if split else [])):
            lines.append(f"usemtl {names[number // 6]}")
        corners = [f"{corner}/{place}" if coordinates else str(corner) for place, corner in enumerate(face, start=1)]
        lines.append("f " + " ".join(corners))
    (folder / "box.obj").write_text("\n".join(lines) + "\n")
    return folder / "box.obj"


def test_gltf_factors_are_linear_light(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    box.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[0.5, 0.25, 1.0, 1.0]))
    box.export(tmp_path / "a.glb")
    assert torch.allclose(seen(tmp_path / "a.glb"), to_srgb(torch.tensor([0.5, 0.25, 1.0])), atol=2 / 255)


@pytest.mark.parametrize("coordinates", [True, False])
def test_colours_of_obj_materials(tmp_path: Path, coordinates: bool) -> None:
    path = box_as_obj(tmp_path, "newmtl a\nKd 0.8 0.2 0.4\n", coordinates=coordinates)
    assert torch.allclose(seen(path), torch.tensor([0.8, 0.2, 0.4]), atol=2 / 255)


def test_each_part_has_its_own_material(tmp_path: Path) -> None:
    path = box_as_obj(tmp_path, "newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 1 0\n", coordinates=False, split=True)
    parts = read_mesh(path)
    assert len(parts) == 2
    pictures = draw_with_caster(parts, FRONT, LIGHT)[0]
    colours = {tuple((pictures[:, y, x] > 0.3).int().tolist()) for y in range(64) for x in range(64)}
    assert colours <= {(0, 0, 0), (1, 0, 0), (0, 1, 0)} and len(colours) > 1


def test_a_texture_is_multiplied_by_its_factor(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    picture = Image.new("RGB", (4, 4), (200, 100, 50))
    material = PBRMaterial(baseColorTexture=picture, baseColorFactor=[0.5, 1.0, 0.25, 1.0])
    box.visual = TextureVisuals(uv=np.full((len(box.vertices), 2), 0.5), material=material)
    box.export(tmp_path / "a.glb")
    expected = to_srgb(to_linear(torch.tensor([200.0, 100.0, 50.0]) / 255) * torch.tensor([0.5, 1.0, 0.25]))
    assert torch.allclose(seen(tmp_path / "a.glb"), expected, atol=3 / 255)
    picture.save(tmp_path / "t.png")
    path = box_as_obj(tmp_path, "newmtl a\nKd 0.5 1 0.25\nmap_Kd t.png\n", coordinates=True)
    expected = torch.tensor([200.0, 100.0, 50.0]) / 255 * torch.tensor([0.5, 1.0, 0.25])
    assert torch.allclose(seen(path), expected, atol=3 / 255)


def test_light_there_and_back() -> None:
    values = torch.linspace(0, 1, 1001)
    assert torch.allclose(to_linear(to_srgb(values)), values, atol=1e-6)


def test_colours_of_corners_that_touch_do_not_run_into_each_other(tmp_path: Path) -> None:
    """Two cubes, red and blue, side by side, as voxel editors write them."""
    corners, faces, colours = [], [], []
    for shift, colour in ((0, (255, 0, 0)), (1, (0, 0, 255))):
        box = trimesh.creation.box(extents=(1, 1, 1))
        box.apply_translation((shift, 0, 0))
        for triangle in box.faces:
            faces.append([len(corners) + k for k in range(3)])
            corners += box.vertices[triangle].tolist()
            colours += [colour] * 3
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(corners)}",
        *(f"property float {axis}" for axis in "xyz"),
    ]
    header += [*(f"property uchar {name}" for name in ("red", "green", "blue")), f"element face {len(faces)}"]
    header += ["property list uchar int vertex_indices", "end_header"]
    rows = [f"{x:g} {y:g} {z:g} {r} {g} {b}" for (x, y, z), (r, g, b) in zip(corners, colours, strict=True)]
    (tmp_path / "a.ply").write_text("\n".join([*header, *rows, *(f"3 {a} {b} {c}" for a, b, c in faces)]) + "\n")
    row = draw_with_caster(read_mesh(tmp_path / "a.ply"), FRONT, LIGHT, supersample=1)[0][:, 32]
    assert set(map(tuple, (row * 255).round().int().T.tolist())) == {(0, 0, 0), (255, 0, 0), (0, 0, 255)}


def test_colours_of_polygons_are_those_of_their_triangles(tmp_path: Path) -> None:
    """A quadrangle and a pentagon side by side, facing the camera, each of one colour."""
    text = (
        "ply\nformat ascii 1.0\nelement vertex 7\nproperty float x\nproperty float y\nproperty float z\nelement face "
        "2\n"
        "property list uchar int vertex_indices\nproperty uchar red\nproperty uchar green\nproperty uchar "
        "blue\nend_header\n"
        "-1 0 -1\n0 0 -1\n0 0 1\n-1 0 1\n1 0 -1\n1 0 1\n0.5 0 1\n"
    )
    for faces in ("4 0 1 2 3 255 0 0\n4 1 4 5 2 0 255 0\n", "4 0 1 2 3 255 0 0\n5 1 4 5 6 2 0 255 0\n"):
        (tmp_path / "a.ply").write_text(text + faces)
        same_two_colours(tmp_path / "a.ply")
    corners = [(-1, 0, -1), (0, 0, -1), (0, 0, 1), (-1, 0, 1), (1, 0, -1), (1, 0, 1)]
    header = text.replace("ascii", "binary_little_endian").replace("vertex 7", "vertex 6")
    data = struct.pack("<18f", *(value for corner in corners for value in corner))
    data += struct.pack("<B4i3B", 4, 0, 1, 2, 3, 255, 0, 0) + struct.pack("<B4i3B", 4, 1, 4, 5, 2, 0, 255, 0)
    (tmp_path / "b.ply").write_bytes(header[: header.index("end_header\n") + 11].encode() + data)
    same_two_colours(tmp_path / "b.ply")


def same_two_colours(path: Path) -> None:
    row = draw_with_caster(read_mesh(path), FRONT, LIGHT, supersample=1)[0][:, 32]
    assert (row[0, 20] > 0.9 and row[1, 20] == 0) and (row[1, 44] > 0.9 and row[0, 44] == 0)


@pytest.mark.slow
def test_pyvista_draws_the_same_colours(tmp_path: Path) -> None:
    path = box_as_obj(tmp_path, "newmtl a\nKd 0.8 0.2 0.4\n", coordinates=False)
    ours, theirs = (draw(read_mesh(path), FRONT, LIGHT)[0, :, 32, 32] for draw in (draw_with_caster, draw_with_pyvista))
    assert torch.allclose(ours, theirs, atol=0.03)
