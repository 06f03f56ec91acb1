"""Casual captures of procedural rooms: a person's sweep over part of a room, held-out ground truth, sparse points, and
the writer.

A held-out view is *covered* when most of its surface was seen by the capture, *uncovered* when most of it was not.
"""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.captures import FrameToWrite, write_capture
from fb_core.data.capture.point_cloud import Points
from fb_core.data.rooms.ray_caster import RoomImages, cast, render
from fb_core.data.rooms.room import FAMILIES, Room, make_room
from fb_core.data.rooms.room_cameras import CAMERA_CLEARANCE_METRES, cameras_by_angles, free_positions
from fb_core.files.limits import MOST_SEED, require_between
from fb_core.files.ownership import Target
from fb_core.files.whole import whole_folder
from fb_core.geometry.cameras import Pinholes

COVERED_SHARE, UNCOVERED_SHARE = 0.8, 0.4
"""A view is covered from the first share upwards, uncovered up to the second; views between them are not held out."""

_log = logging.getLogger(__name__)
_GRID = 32  # covered shares are measured on at most this many pixels squared
_POINTS_PER_CAPTURE = 6000  # pixels tried; those seen by two views become points
_POINT_NOISE_METRES = 0.005
_MOST_PIXELS = 2**26  # of all views, which are drawn together


@dataclass(frozen=True, kw_only=True)
class RoomCapture:
    """What a person's camera saw of a room, and what it should have seen elsewhere."""

    room: Room = field(repr=False)
    cameras: Pinholes
    """The captured views, in the order of the walk."""
    images: RoomImages = field(repr=False)
    """Of the captured views."""
    held_out_cameras: Pinholes
    held_out_images: RoomImages = field(repr=False)
    covered_share: Float[Tensor, "m"]
    """Share of each held-out view's pixels whose surface point is visible in at least one captured view."""
    points: Points = field(repr=False)
    """Sparse surface points seen by at least two captured views, slightly noisy, as structure from motion gives
    them.
    """

    @property
    def covered(self) -> Bool[Tensor, "m"]:
        """True for covered held-out views, False for uncovered ones."""
        return self.covered_share >= COVERED_SHARE


def casual_capture(
    seed: int, *, family: str = "narrow", views: int = 24, size: int = 128, held_out: int = 16
) -> RoomCapture:
    """The capture of a seed: ``views`` square pictures of ``size`` pixels over 150 to 200 degrees of heading, and
    held-out views.

    Half of the held-out views are covered and half uncovered. Raises ValueError for an unknown family, fewer than 2
    views or held-out views, or a size below 16.
    """
    if family not in FAMILIES:
        raise ValueError(f"family must be one of {', '.join(FAMILIES)}, got {family!r}")
    for name, value, least in (("seed", seed, 0), ("views", views, 2), ("size", size, 16), ("held_out", held_out, 2)):
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")
    require_between("seed", seed, 0, MOST_SEED)
    pixels = (views + held_out) * size * size  # all views are drawn at once, four rays a pixel
    if pixels > _MOST_PIXELS:
        raise ValueError(
            f"views, held_out and size: expected at most {_MOST_PIXELS / 1e6:.0f} million pixels in all views "
            "together, "
            f"got {pixels / 1e6:,.0f} million; ask for fewer or smaller views"
        )
    room = make_room(seed, FAMILIES[family])
    generator = torch.Generator().manual_seed(seed)
    low, high = room.family.fov_degrees
    fov_degrees = float(_uniform(1, (low + high) / 2, high, generator))  # phones hold wide lenses
    cameras, first_heading, sweep = _walk(room, views, size, fov_degrees, generator)
    images = render(room, cameras, supersample=2)
    others, shares = _held_out(room, cameras, held_out, (first_heading, sweep), fov_degrees, generator)
    return RoomCapture(
        room=room,
        cameras=cameras,
        images=images,
        held_out_cameras=others,
        held_out_images=render(room, others, supersample=2),
        covered_share=shares,
        points=_sparse_points(room, cameras, images, generator),
    )


def _uniform(count: int, low: float, high: float, generator: torch.Generator) -> Float[Tensor, "n"]:
    return low + (high - low) * torch.rand(count, generator=generator)


def _walk(
    room: Room, views: int, size: int, fov_degrees: float, generator: torch.Generator
) -> tuple[Pinholes, float, float]:
    """A slow turn with a few steps: cameras, first heading and swept angle in radians."""
    first = float(_uniform(1, 0.0, 2 * math.pi, generator))
    sweep = math.radians(float(_uniform(1, 150.0, 200.0, generator)))
    progress = torch.linspace(0, 1, views)
    heading = first + sweep * progress + _uniform(views, -0.06, 0.06, generator)
    pitch = 0.2 * torch.sin(2 * math.pi * (1.5 * progress + torch.rand(1, generator=generator))) + _uniform(
        views, -0.05, 0.05, generator
    )
    reach = float(_uniform(1, 0.2, 0.35, generator))  # a body turning: the phone moves on an arc in front of the person
    bob = 0.06 * torch.sin(2 * math.pi * (2 * progress + torch.rand(1, generator=generator)))
    for _ in range(200):
        person = free_positions(room, 1, generator=generator, reach=min(room.family.camera_reach, 0.4))
        steps = torch.stack([heading.cos() * reach, heading.sin() * reach, bob], dim=-1)
        centers = person + steps + 0.02 * torch.randn(views, 3, generator=generator)
        if bool((room.clearance(centers) >= CAMERA_CLEARANCE_METRES).all()):
            fov = torch.full((views,), fov_degrees)
            return cameras_by_angles(centers, heading, pitch, fov, size=size), first, sweep
        reach *= 0.97  # tight rooms leave less of an arc
    raise ValueError(f"room {room.seed} of family {room.family.name} has no free place for a walk; take another seed")


def _held_out(
    room: Room,
    captured: Pinholes,
    count: int,
    walk: tuple[float, float],
    fov_degrees: float,
    generator: torch.Generator,
) -> tuple[Pinholes, Float[Tensor, "m"]]:
    """Covered and uncovered views in turns (covered first), drawn until there are enough of both."""
    wanted = {True: (count + 1) // 2, False: count // 2}
    chosen: dict[bool, list[tuple[Pinholes, Tensor]]] = {True: [], False: []}
    for _ in range(60):
        candidates = _candidates(room, captured, walk, fov_degrees, generator)
        shares = covered_share(room, candidates, captured)
        for index, share in enumerate(shares.tolist()):
            covered = share >= COVERED_SHARE
            if (covered or share <= UNCOVERED_SHARE) and len(chosen[covered]) < wanted[covered]:
                chosen[covered].append((candidates[index], shares[index]))
        if all(len(chosen[covered]) == wanted[covered] for covered in wanted):
            ordered = [chosen[index % 2 == 0][index // 2] for index in range(count)]
            return Pinholes.cat([camera for camera, _ in ordered]), torch.stack([share for _, share in ordered])
    raise ValueError(
        f"room {room.seed} of family {room.family.name}: found only {len(chosen[True])} covered and "
        f"{len(chosen[False])} uncovered of "
        f"{count} held-out views; take another seed or fewer held-out views"
    )


def _candidates(
    room: Room, captured: Pinholes, walk: tuple[float, float], fov_degrees: float, generator: torch.Generator
) -> Pinholes:
    """16 views near the walk: along it, away from it, steeply up and down, and anywhere."""
    first, sweep = walk
    inside = first + sweep * torch.rand(8, generator=generator)
    opposite = first + sweep / 2 + math.pi + _uniform(4, -0.5, 0.5, generator)
    heading = torch.cat([inside, opposite, _uniform(4, 0.0, 2 * math.pi, generator)])
    level = _uniform(12, -0.15, 0.15, generator)
    steep = _uniform(4, 0.6, 1.2, generator) * torch.tensor([1.0, -1.0, 1.0, -1.0])
    pitch = torch.cat([level, steep])
    order = torch.randperm(16, generator=generator)
    anchors = captured.centers[torch.randint(len(captured), (16,), generator=generator)]
    shift = torch.randn(16, 3, generator=generator) * torch.tensor([0.15, 0.15, 0.08])
    centers = anchors + shift
    centers = torch.where((room.clearance(centers) >= CAMERA_CLEARANCE_METRES)[:, None], centers, anchors)
    return cameras_by_angles(centers, heading, pitch, torch.full((16,), fov_degrees), size=captured.width)[order]


def visible(
    room: Room, points: Float[Tensor, "m 3"], cameras: Pinholes, *, tolerance: float = 0.005
) -> Bool[Tensor, "n m"]:
    """Whether each camera sees each surface point: in frame, and nothing in between (``tolerance`` in metres along the
    ray).
    """
    pixels, depth = cameras.project(points)
    inside = (pixels >= 0).all(-1) & (pixels[..., 0] <= cameras.width) & (pixels[..., 1] <= cameras.height)
    seen = inside & (depth > 1e-3)
    view, point = seen.nonzero(as_tuple=True)
    offset = points[point] - cameras.centers[view]
    distance = offset.norm(dim=-1)
    hits = cast(room, cameras.centers[view], offset / distance[:, None])
    seen[view, point] = hits.distance >= distance - tolerance
    return seen


def covered_share(room: Room, cameras: Pinholes, captured: Pinholes) -> Float[Tensor, "m"]:
    """Share of each camera's pixels (0 to 1, on a coarse grid) whose surface point at least one captured camera
    sees.
    """
    coarse = cameras.scaled(min(_GRID, cameras.width), min(_GRID, cameras.height))
    directions = coarse.directions().flatten(1, 2)
    shares = []
    for center, rays in zip(coarse.centers, directions, strict=True):
        hits = cast(room, center.expand_as(rays), rays)
        shares.append(visible(room, hits.points, captured).any(dim=0).float().mean())
    return torch.stack(shares)


def _sparse_points(room: Room, cameras: Pinholes, images: RoomImages, generator: torch.Generator) -> Points:
    """Pixels drawn where the picture has detail (and a few elsewhere), lifted, and kept if two views see the place."""
    detail = F.pad((images.rgb[..., :, 1:] - images.rgb[..., :, :-1]).abs().mean(1), (0, 1))
    detail = detail + F.pad((images.rgb[..., 1:, :] - images.rgb[..., :-1, :]).abs().mean(1), (0, 0, 0, 1))
    weights = (0.3 * detail.mean() + 1e-4 + detail).flatten()
    chosen = torch.multinomial(weights, min(_POINTS_PER_CAPTURE, len(weights)), generator=generator)
    places = cameras.unproject(images.depth).flatten(0, 2)[chosen]
    colors = images.rgb.permute(0, 2, 3, 1).flatten(0, 2)[chosen]
    seen_twice = visible(room, places, cameras).sum(dim=0) >= 2
    noise = _POINT_NOISE_METRES * torch.randn(len(places), 3, generator=generator)
    return Points(positions=(places + noise)[seen_twice], colors=colors[seen_twice])


def write_room_capture(capture: RoomCapture, output: Path, *, ground_truth: bool = False) -> None:
    """Writes the capture as a folder for nerfstudio: captured views as its train split, held-out views as val and test.

    Held-out frames carry ``covered`` and ``covered_share``. With ``ground_truth``, z-depth (metres) and world normals
    of all views follow as float EXR files, named by ``depth_exr_path`` and ``normals_exr_path`` of the frames. The
    folder appears whole or not at all. Raises ValueError when ``output`` exists and is not empty.
    """
    output = Path(output)
    _refuse_taken(output)
    taken = _frames("captured", capture.cameras, capture.images, [{}] * len(capture.cameras), ground_truth)
    verdicts = [
        {"covered": covered, "covered_share": round(share, 4)}
        for covered, share in zip(capture.covered.tolist(), capture.covered_share.tolist(), strict=True)
    ]
    others = _frames("held_out", capture.held_out_cameras, capture.held_out_images, verdicts, ground_truth)
    held_out_names = [f"images/{frame.name}.png" for frame in others]
    extra = {
        "room": {"seed": capture.room.seed, "family": capture.room.family.name},
        "orientation_override": "none",  # the world is upright already: z is up
        "train_filenames": [f"images/{frame.name}.png" for frame in taken],
        "val_filenames": held_out_names,
        "test_filenames": held_out_names,
    }
    with whole_folder(Target(folder=output, kind="capture")) as unfinished:
        write_capture(unfinished, [*taken, *others], points=capture.points, extra=extra)
        if ground_truth:
            write_ground_truth(unfinished, "captured", capture.images)
            write_ground_truth(unfinished, "held_out", capture.held_out_images)


def _refuse_taken(output: Path) -> None:
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise ValueError(f"output {output} exists and is not empty; name a new folder or remove that one")


def _frames(
    prefix: str, cameras: Pinholes, images: RoomImages, extras: list[dict[str, Any]], ground_truth: bool
) -> list[FrameToWrite]:
    """Frames of one group with their JSON keys."""
    frames = []
    for index, extra in enumerate(extras):
        name = f"{prefix}_{index:03d}"
        files = (
            {f"{kind}_exr_path": f"ground_truth/{name}_{kind}.exr" for kind in ("depth", "normals")}
            if ground_truth
            else {}
        )
        frames.append(FrameToWrite(name=name, image=images.rgb[index], camera=cameras[index], extra={**extra, **files}))
    return frames


def write_ground_truth(folder: Path, prefix: str, images: RoomImages) -> None:
    """Depth and normals of one group as EXR files."""
    (folder / "ground_truth").mkdir(exist_ok=True)
    for index in range(len(images.rgb)):
        stem = folder / "ground_truth" / f"{prefix}_{index:03d}"
        media.write_exr(stem.with_name(f"{stem.name}_depth.exr"), {"Z": images.depth[index]})
        media.write_exr(
            stem.with_name(f"{stem.name}_normals.exr"), dict(zip("XYZ", images.normals[index], strict=True))
        )


def rooms(
    seed: int,
    output: Path,
    family: str = "narrow",
    views: int = 24,
    size: int = 128,
    held_out: int = 16,
    ground_truth: bool = False,
) -> None:
    """Makes the casual capture of one procedural room and writes it as a nerfstudio folder.

    Args:
        seed: Which room (0 or more); the same seed gives the same files.
        output: New folder for the capture.
        family: narrow, medium or wide: how varied room and cameras are.
        views: Captured pictures.
        size: Width and height of the pictures in pixels.
        held_out: Further ground-truth pictures, half of them covered by the capture and half not.
        ground_truth: Also write depth and normals as EXR files.
    """
    _refuse_taken(Path(output))  # before the work, not after it
    start = time.perf_counter()
    capture = casual_capture(seed, family=family, views=views, size=size, held_out=held_out)
    write_room_capture(capture, Path(output), ground_truth=ground_truth)
    covered = int(capture.covered.sum())
    held_out_counts = (covered, len(capture.covered) - covered)
    _log.info(
        "room %d (%s): %d captured views, %d covered and %d uncovered held-out views, %d points",
        *(seed, family, views, *held_out_counts, len(capture.points)),
    )
    _log.info("written to %s in %.1f s", output, time.perf_counter() - start)
