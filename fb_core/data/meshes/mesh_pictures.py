"""Pictures of meshes: their own colours or textures under soft light, drawn by our triangle caster or by pyvista.

A triangle's colour is that of its corners, of its own, or of its material (glTF's baseColorFactor, OBJ's Kd) times its
texture. glTF's factors are linear light (its specification, "Metallic-Roughness Material"), all else is sRGB.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange, reduce
from jaxtyping import Float
from torch import Tensor

from fb_core.data.media import to_linear, to_srgb
from fb_core.data.meshes.triangle_caster import TriangleHits, cast_triangles
from fb_core.geometry.cameras import Pinholes
from fb_core.machine.vtk_drawing import pyvista_off_screen

if TYPE_CHECKING:
    import trimesh

_AMBIENT = 0.4
_Y_UP = (".glb", ".gltf")


@dataclass(frozen=True, kw_only=True)
class Lighting:
    """One lamp far away, and what stands behind the mesh."""

    background: tuple[float, float, float]
    """RGB in [0, 1]."""
    lamp: tuple[float, float, float]
    """Unit vector to the lamp."""


def read_mesh(path: Path) -> list[trimesh.Trimesh]:
    """The parts of a mesh file, moved and scaled into the unit sphere, z up.

    Raises ValueError, with the file's name, for what cannot be read and for what holds no triangles.
    """
    import trimesh

    try:
        scene = cast(Any, trimesh.load_scene(path, process=False))
        for part in scene.geometry.values():
            if isinstance(part, trimesh.Trimesh):
                _colour_every_triangle(part)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        for part in parts:
            _merge_corners(part)
    except Exception as error:  # readers of formats raise whatever their libraries raise
        raise ValueError(
            f"mesh {path}: not readable ({type(error).__name__}: {' '.join(str(error).split())[:200]})"
        ) from error
    if not parts:
        raise ValueError(f"mesh {path}: expected triangles, found none")
    corners = np.concatenate([part.vertices for part in parts])
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    radius = float(np.linalg.norm(corners - middle, axis=1).max())
    if not (math.isfinite(radius) and radius > 0):
        raise ValueError(
            f"mesh {path}: expected finite vertices that are not all in one place, got a radius of {radius}"
        )
    turn = trimesh.transformations.rotation_matrix(math.pi / 2 if path.suffix.lower() in _Y_UP else 0.0, [1, 0, 0])
    for part in parts:
        part.apply_translation(-middle)
        part.apply_scale(1 / radius)
        part.apply_transform(turn)
    return parts


def _colour_every_triangle(part: trimesh.Trimesh) -> None:
    """Colours of a PLY file's polygons for each of the triangles that they are cut into; trimesh 5.2 keeps one for each
    polygon.
    """
    from trimesh.visual import ColorVisuals

    visual = cast(Any, part.visual)
    if getattr(visual, "kind", None) != "face":
        return
    colours = np.asarray(visual._data["face_colors"])  # the property asks for as many as there are triangles
    stored = part.metadata.get("_ply_raw", {}).get("face", {}).get("data", {})
    has = stored.dtype.names or () if isinstance(stored, np.ndarray) else stored
    key = next((name for name in ("vertex_indices", "vertex_index") if name in has), None)
    if len(colours) == len(part.faces) or key is None or len(stored[key]) != len(colours):
        return
    lists = (
        stored[key]["f1"] if getattr(stored[key], "dtype", np.dtype(int)).names else stored[key]
    )  # binary: how many, and which
    polygons = [np.asarray(polygon).reshape(-1) for polygon in lists]
    part.faces = np.array([(one[0], one[k], one[k + 1]) for one in polygons for k in range(1, len(one) - 1)])
    repeated = np.repeat(colours, [max(len(one) - 2, 0) for one in polygons], axis=0)
    part.visual = ColorVisuals(mesh=part, face_colors=repeated)


def _merge_corners(part: trimesh.Trimesh) -> None:
    """Equal corners become one, but not where they have colours of their own, which would run into each other."""
    part.remove_infinite_values()
    if getattr(part.visual, "kind", None) != "vertex":
        part.merge_vertices()


def draw_with_caster(
    parts: list[trimesh.Trimesh], cameras: Pinholes, light: Lighting, *, supersample: int = 2
) -> Float[Tensor, "n 3 h w"]:
    """Exact pictures on the cameras' device, ``supersample`` squared rays per pixel."""
    device = cameras.focal.device
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = torch.from_numpy(np.concatenate([part.vertices for part in parts])).float().to(device)
    faces = (
        torch.from_numpy(np.concatenate([part.faces + first for part, first in zip(parts, offsets, strict=False)]))
        .long()
        .to(device)
    )
    paints = [_paint(part, device) for part in parts]
    shade = _shade(vertices[faces], light)
    fine = cameras.scaled(cameras.width * supersample, cameras.height * supersample)
    pictures = []
    for view in range(len(cameras)):
        hits = cast_triangles(vertices, faces, fine[view])
        colours = _colours(hits, paints, torch.tensor(light.background, device=device), shade)
        pictures.append(reduce(colours, "(h s1) (w s2) c -> c h w", "mean", s1=supersample, s2=supersample))
    return torch.stack(pictures).clamp(0, 1)


@dataclass(frozen=True, kw_only=True)
class _Paint:
    """Colours of one part's triangles: at their corners, times a texture where there is one."""

    corners: Float[Tensor, "f 3 3"]
    places: Float[Tensor, "f 3 2"] | None = None
    """Of the corners in the texture, in [-1, 1], y down."""
    texture: Float[Tensor, "1 3 th tw"] | None = None
    """Colours, times that of the material."""


def _paint(part: trimesh.Trimesh, device: torch.device) -> _Paint:
    faces = torch.from_numpy(np.asarray(part.faces)).long()
    textured = _texture(part)
    if textured is not None:
        uv, pixels = (torch.from_numpy(array) for array in textured)
        places = 2 * torch.stack([uv[:, 0], 1 - uv[:, 1]], dim=-1) - 1
        texture = rearrange(pixels.float() / 255, "h w c -> 1 c h w").to(device)
        return _Paint(
            corners=torch.ones(len(faces), 3, 3, device=device), places=places[faces].to(device), texture=texture
        )
    colours, of_faces = _plain_colours(part)
    values = torch.from_numpy(colours).float().to(device) / 255
    return _Paint(corners=values[:, None].expand(-1, 3, -1) if of_faces else values[faces.to(device)])


def _texture(part: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray] | None:
    """(places of the vertices in the picture, from its lower left, in [0, 1]; its pixels [h, w, 3]) of a textured
    mesh.
    """
    uv, material = getattr(part.visual, "uv", None), getattr(part.visual, "material", None)
    pictures = (getattr(material, name, None) for name in ("baseColorTexture", "image"))
    picture = next((image for image in pictures if image is not None), None)
    if uv is None or picture is None:
        return None
    uv = np.asarray(uv, dtype=np.float32)
    if uv.min() < -1e-6 or uv.max() > 1 + 1e-6:  # a repeated texture
        uv = uv % 1
    factor, linear = _factor(material)
    pixels = torch.from_numpy(np.array(picture.convert("RGB"))).float() / 255
    if bool((factor < 1).any()):
        pixels = to_srgb(to_linear(pixels) * factor) if linear else pixels * factor
    return uv, (pixels * 255).round().byte().numpy()


def _factor(material: Any) -> tuple[Float[Tensor, "3"], bool]:
    """(colour of a material, 1 where it has none, whether it is linear light)."""
    linear = hasattr(material, "baseColorFactor")
    value = material.baseColorFactor if linear else getattr(material, "diffuse", None)
    if value is None:
        return torch.ones(3), linear
    values = np.asarray(value).reshape(-1)[:3]
    top = 255.0 if values.dtype.kind in "iu" else 1.0
    return torch.from_numpy(values.astype(np.float32) / top).clamp(0, 1), linear


def _plain_colours(part: trimesh.Trimesh) -> tuple[np.ndarray, bool]:
    """(8-bit RGB of the triangles or of the vertices, whether of the triangles)."""
    visual = cast(Any, part.visual)
    if getattr(visual, "kind", None) == "face":
        return np.array(visual.face_colors)[:, :3], True
    if (
        getattr(visual, "kind", None) == "texture"
    ):  # by name, yet without a picture: the material's colour is all there is
        factor, linear = _factor(visual.material)
        colour = ((to_srgb(factor) if linear else factor) * 255).round().byte().numpy()
        return np.tile(colour, (len(part.vertices), 1)), False
    plain = visual if hasattr(visual, "vertex_colors") else visual.to_color()
    return np.array(plain.vertex_colors)[:, :3], False


def _shade(corners: Float[Tensor, "f 3 3"], light: Lighting) -> Float[Tensor, "f"]:
    """Light on each triangle: the same from everywhere, so that the views agree."""
    normals = F.normalize(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dim=-1)
    return _AMBIENT + (1 - _AMBIENT) * (0.5 + 0.5 * normals @ corners.new_tensor(light.lamp))


def _colours(
    hits: TriangleHits, paints: list[_Paint], background: Float[Tensor, "3"], shade: Float[Tensor, "f"]
) -> Float[Tensor, "h w 3"]:
    colours = background.expand(*hits.face.shape, 3).clone()
    first = 0
    for paint in paints:
        inside = (hits.face >= first) & (hits.face < first + len(paint.corners))
        face, weights = hits.face[inside] - first, hits.weights[inside]
        surface_colours = torch.einsum("nk,nkc->nc", weights, paint.corners[face])
        if paint.texture is not None and paint.places is not None:
            places = torch.einsum("nk,nkc->nc", weights, paint.places[face])
            looked_up = F.grid_sample(paint.texture, places[None, :, None], padding_mode="border", align_corners=False)
            surface_colours = surface_colours * rearrange(looked_up, "1 c n 1 -> n c")
        colours[inside] = surface_colours * shade[hits.face[inside]][:, None]
        first += len(paint.corners)
    return colours


def draw_with_pyvista(
    parts: list[trimesh.Trimesh], cameras: Pinholes, light: Lighting, *, supersample: int = 2
) -> Float[Tensor, "n 3 h w"]:
    """The same by VTK, off-screen, with smooth shading. Principal points must be central and pixels square."""
    pyvista = pyvista_off_screen()
    plotter = pyvista.Plotter(
        off_screen=True, window_size=[cameras.width * supersample, cameras.height * supersample], lighting="none"
    )
    plotter.renderer.set_background(light.background)
    plotter.add_light(pyvista.Light(position=light.lamp, focal_point=(0, 0, 0), light_type="scene light"))
    for part in parts:
        surface = pyvista.PolyData.from_regular_faces(np.asarray(part.vertices), np.asarray(part.faces))
        look: dict[str, Any] = {
            "ambient": _AMBIENT,
            "diffuse": 1 - _AMBIENT,
            "smooth_shading": True,
            "split_sharp_edges": True,
        }
        textured = _texture(part)
        if textured is not None:
            surface.active_texture_coordinates = textured[0]
            look["texture"] = pyvista.Texture(textured[1])
        else:
            colours, of_faces = _plain_colours(part)
            (surface.cell_data if of_faces else surface.point_data)["colours"] = colours
            look |= {"scalars": "colours", "rgb": True}
        plotter.add_mesh(surface, **look)
    pictures = []
    for center, rotation, focal in zip(
        *(values.cpu().double() for values in (cameras.centers, cameras.rotations, cameras.focal)), strict=True
    ):
        view = plotter.camera
        view.position, view.focal_point, view.up = (
            center.tolist(),
            (center + rotation[:, 2]).tolist(),
            (-rotation[:, 1]).tolist(),
        )
        view.view_angle = math.degrees(2 * math.atan(cameras.height / 2 / float(focal[1])))
        plotter.reset_camera_clipping_range()
        plotter.render()
        pixels = torch.from_numpy(np.array(plotter.screenshot(return_img=True))[:, :, :3]).float() / 255
        pictures.append(reduce(pixels, "(h s1) (w s2) c -> c h w", "mean", s1=supersample, s2=supersample))
    plotter.close()
    return torch.stack(pictures).to(cameras.focal.device)
