"""Photos of points in space, as features would tell of them."""

import dataclasses
import math

import numpy as np
import torch
import torch.nn.functional as F

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.features.bundle_adjustment import Bundle, Lenses
from fb_core.geometry.features.pairs import PhotoFeatures
from fb_core.geometry.pose_solver.refine import rotation_of

SIZE = (480, 640)


def around(count: int, *, focal: float = 500.0, arc_degrees: float = 70.0, size: tuple[int, int] = SIZE) -> Pinholes:
    """Cameras on an arc, at varying heights, that look at the origin."""
    angles = torch.deg2rad(torch.linspace(0, arc_degrees, count, dtype=torch.float64))
    centers = torch.stack([4 * angles.cos(), 4 * angles.sin(), 0.8 * (3 * angles).sin()], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    looking = Pinholes.looking_at(
        centers, 0.1 * centers.flip(1), up=up, fov_degrees=60.0, width=size[1], height=size[0]
    )
    return dataclasses.replace(looking, focal=torch.full((count, 2), focal, dtype=torch.float64))


def cloud(count: int, *, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2.4 - 1.2


def seen(
    cameras: Pinholes,
    points: torch.Tensor,
    *,
    told: float | None = None,
    lens: str = "one",
    noise: float = 0.0,
    wrong: float = 0.0,
    seed: int = 0,
    alphabet: int = 0,
) -> list[PhotoFeatures]:
    """What the cameras see of points, each of which has a descriptor of its own; some are given those of others."""
    generator = torch.Generator().manual_seed(seed)
    descriptors = F.normalize(
        torch.randn(len(points), 128, generator=torch.Generator().manual_seed(100 + alphabet)), dim=1
    )
    pixels, depth = cameras.project(points)
    photos = []
    for index in range(len(cameras)):
        inside = ((pixels[index] > 0) & (pixels[index] < torch.tensor([cameras.width, cameras.height]))).all(dim=1) & (
            depth[index] > 0
        )
        which = inside.nonzero()[:, 0]
        strayed = torch.rand(len(which), generator=generator) < wrong
        names = torch.where(strayed, which[torch.randperm(len(which), generator=generator)], which)
        places = pixels[index, which] + noise * torch.randn(len(which), 2, generator=generator, dtype=torch.float64)
        photos.append(
            PhotoFeatures(
                places=places.float(),
                descriptors=descriptors[names],
                coarse=descriptors[names][:200],
                size=(cameras.height, cameras.width),
                focal=told,
                lens=lens,
            )
        )
    return photos


def rotations_of(vectors: np.ndarray) -> np.ndarray:
    return rotation_of(torch.from_numpy(vectors)).numpy()


def bundle(*, cameras: int = 4, points: int = 30, seed: int = 0) -> Bundle:
    truth, places = around(cameras), cloud(points, seed=seed)
    pixels, _ = truth.project(places)
    camera_of, point_of = (axis.ravel() for axis in np.meshgrid(np.arange(cameras), np.arange(points), indexing="ij"))
    world_to_camera = truth.world_to_camera.numpy()
    return Bundle(
        rotations=world_to_camera[:, :3, :3],
        shifts=world_to_camera[:, :3, 3],
        focal=np.array([500.0, 500.0]),
        bend=np.zeros((2, 2)),
        lens=np.arange(cameras) % 2,
        points=places.numpy(),
        camera_of=camera_of,
        point_of=point_of,
        offsets=(pixels - truth.principal[:, None]).numpy().reshape(-1, 2),
        tolerance=np.ones(len(camera_of)),
    )


def lenses(*, told: float = math.nan, deviation: float = 1.0, bends: int = 0) -> Lenses:
    """Of the bundle's two lenses."""
    free = np.ones(2, bool)
    bend_free = np.tile(np.arange(2) < bends, (2, 1))
    return Lenses(told=np.full(2, told), deviation=np.full(2, deviation), focal_free=free, bend_free=bend_free)


def perturbed(exact: Bundle, amount: float) -> Bundle:
    generator = np.random.default_rng(0)
    return dataclasses.replace(
        exact,
        rotations=rotations_of(amount * generator.standard_normal((len(exact.rotations), 3))) @ exact.rotations,
        shifts=exact.shifts + amount * generator.standard_normal(exact.shifts.shape),
        focal=exact.focal * (1 + amount),
        points=exact.points + amount * generator.standard_normal(exact.points.shape),
    )
