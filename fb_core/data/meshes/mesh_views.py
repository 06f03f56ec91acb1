"""Training sequences from meshes: views on a sphere around any file that trimesh reads (paper, appendix
"Shutterstock3D").

Our triangle caster draws them, on the training's device, with the mesh's own colours or texture under soft light.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F

from fb_core.data.meshes.mesh_pictures import Lighting, draw_with_caster, read_mesh
from fb_core.data.training.sequences import Encode, PoolSize, RenderedScene, ViewPool
from fb_core.files.whole import found_below
from fb_core.geometry.cameras import Pinholes
from fb_core.sampling.randomness import generator_of

_logger = logging.getLogger(__name__)
_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off", ".3mf", ".dae", ".zae")
_FOV_DEGREES = 50.0
_DISTANCE = 2.6, 3.4  # range of the cameras' distance from the middle, in radii of the mesh
_TRIES = 8  # files, one after the other, before an unreadable mesh ends the training


@dataclass(frozen=True, kw_only=True)
class MeshConfig:
    """How meshes become sequences."""

    image_size: int = 256
    """Side of the square views in pixels."""
    views: int = 24
    """Views per mesh, all over a sphere (paper: 24)."""
    meshes: int = 64
    """Rendered meshes at hand."""
    renewed_per_step: float = 0.25
    """Meshes replaced per training step."""
    supersample: int = 2
    """Rays per pixel side."""

    def __post_init__(self) -> None:
        if self.image_size % 16 or min(self.views, self.meshes, self.supersample) < 1:
            raise ValueError(f"meshes: expected an image size divisible by 16 and counts of at least 1, got {self}")


class MeshPool(ViewPool):
    """Meshes seen from all over a sphere, renewed step by step."""

    def __init__(
        self,
        files: Sequence[Path],
        config: MeshConfig,
        *,
        seed: int,
        device: torch.device | str = "cpu",
        encode: Encode | None = None,
        with_images: bool = True,
    ):
        size = PoolSize(
            scenes=config.meshes,
            views=config.views,
            image_size=config.image_size,
            renewed_per_step=config.renewed_per_step,
        )
        super().__init__(size, device=device, encode=encode, with_images=with_images)
        self.files, self.config, self.seed = tuple(files), config, seed
        if not files:
            raise ValueError("meshes: expected at least one file, got none")

    def render(self, numbers: list[int]) -> list[RenderedScene]:
        """A random file for each number; one that cannot be read is told in the log and another is drawn."""
        return [self._render(number) for number in numbers]

    def _render(self, number: int) -> RenderedScene:
        generator = generator_of(self.seed, number)
        cameras = sphere_cameras(self.config, generator)
        if not self.with_images:
            return RenderedScene(cameras)
        background, lamp = torch.rand(3, generator=generator), F.normalize(torch.randn(3, generator=generator), dim=0)
        light = Lighting(background=tuple(background.tolist()), lamp=tuple(lamp.tolist()))
        error: Exception | None = None
        for _ in range(_TRIES):
            path = self.files[int(torch.randint(len(self.files), (), generator=generator))]
            try:
                there, supersample = cameras.to(self.device), self.config.supersample
                return RenderedScene(cameras, draw_with_caster(read_mesh(path), there, light, supersample=supersample))
            except (
                Exception
            ) as fault:  # of trimesh and of what its materials hold: whatever it is, another file is drawn
                message = fault if isinstance(fault, ValueError) else f"{path}: {type(fault).__name__}: {fault}"
                _logger.warning("left out a mesh: %s", message)
                error = fault
        raise ValueError(f"meshes: {_TRIES} files in a row could not be drawn, the last because: {error}") from error


def find_meshes(folder: Path) -> list[Path]:
    """Every mesh file at or below a folder, sorted. Raises ValueError if there is none."""
    meshes = (
        [path for path in found_below(folder, "*") if path.suffix.lower() in _SUFFIXES] if Path(folder).is_dir() else []
    )
    if not meshes:
        raise ValueError(
            f"meshes: expected files of {', '.join(_SUFFIXES)} at or below {folder}, found none; check the path"
        )
    return meshes


def sphere_cameras(config: MeshConfig, generator: torch.Generator) -> Pinholes:
    """Upright cameras all over a sphere that look at its middle, where the mesh has radius 1."""
    ways = F.normalize(torch.randn(config.views, 3, generator=generator), dim=-1)
    near, far = _DISTANCE
    distances = near + (far - near) * torch.rand(config.views, 1, generator=generator)
    up = torch.tensor([0.0, 0.0, 1.0])
    size, middle = config.image_size, torch.zeros(config.views, 3)
    return Pinholes.looking_at(ways * distances, middle, up=up, fov_degrees=_FOV_DEGREES, width=size, height=size)
