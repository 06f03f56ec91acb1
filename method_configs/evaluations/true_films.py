"""Films that ``fillerbuster eval consistency`` holds runs against: what is true (a procedural room rendered exactly, or
a capture's photos), and the same spoilt, which must do worse.

Walls of procedural rooms are blank, and nothing can be matched on them. What the metric itself is worth shows where the
same room, along the same path, carries paint.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from fb_core.geometry.cameras import Pinholes

TRUE_FILM = "rendered exactly"
"""Row of the procedural room itself along the run's path: what the matcher can reach there."""
PAINTED = "painted, rendered exactly"
"""Row of that room with noise in 3D on all surfaces, which can be matched everywhere."""
PHOTOS = "captured photos"
"""Row of other captures: pairs of their own photos, with the capture's cameras."""
_PAINT = ((0.5, 0.4), (0.15, 0.35), (0.06, 0.25))  # metres of a cell of noise, and its part of the colour
_CELLS = 96  # after which the noise repeats
_MOST_TURN = 25.0  # degrees between two photos of a pair, about what a film turns by in a second
_BLUR = 1 / 27  # standard deviation of the blur over the longer side of a frame
_DISAGREE = 10.0  # degrees that each frame is turned by, another way in every frame
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Film:
    """Frames, the cameras that they are said to be seen by, and which pairs of them are judged."""

    pictures: Callable[[int], Float[Tensor, "3 h w"]]
    """Number of a frame -> RGB in [0, 1]."""
    cameras: Pinholes | Sequence[Pinholes]
    """One of each frame."""
    pairs: list[tuple[int, int]]


def true_films(
    capture: Path, pipeline: Any, captured: list[Pinholes], film: Film, *, seed: int, controls: bool
) -> dict[str, Film]:
    """What is true of a run's capture, by what it is called: the room along the run's own film, else photos.

    Args:
        capture: folder of the capture.
        pipeline: nerfstudio's, of the run.
        captured: cameras of the captured pictures, in the run's world.
        film: the run's.
        seed: draws pairs of photos and what is spoilt.
        controls: also the same spoilt; of a room, painted before.

    Returns:
        Nothing, which the log says, for photos of which no two look about the same way.
    """
    exact = true_pictures(capture, pipeline, captured, film.cameras)
    if exact is not None:
        painted = true_pictures(capture, pipeline, captured, film.cameras, paint=True)
        room, with_paint = dataclasses.replace(film, pictures=exact), dataclasses.replace(film, pictures=painted)
        return {TRUE_FILM: room} | ({PAINTED: with_paint} | spoilt(PAINTED, with_paint, seed) if controls else {})

    def photo(index: int) -> Tensor:
        view = pipeline.datamanager.captured_view(index, captured[index])
        return view.image * view.known

    photos = Film(pictures=photo, cameras=captured, pairs=photo_pairs(captured, len(film.pairs), seed))
    if not photos.pairs:
        _logger.warning(
            "%s: no two photos look the same way within %g degrees, so none are judged", capture, _MOST_TURN
        )
        return {}
    return {PHOTOS: photos} | (spoilt(PHOTOS, photos, seed) if controls else {})


def photo_pairs(cameras: Sequence[Pinholes], count: int, seed: int) -> list[tuple[int, int]]:
    """So many pairs, or as many as there are, of cameras that are turned by at most 25 degrees; sorted."""
    import numpy as np
    import torch

    from fb_core.evaluation.metrics.relative_rotation import rotation_angle_degrees, true_rotation

    every = [
        (first, second)
        for first in range(len(cameras))
        for second in range(first + 1, len(cameras))
        if rotation_angle_degrees(true_rotation(cameras[first], cameras[second]), np.eye(3)) <= _MOST_TURN
    ]
    chosen = torch.randperm(len(every), generator=torch.Generator().manual_seed(seed))[:count]
    return sorted(every[index] for index in chosen.tolist())


def spoilt(name: str, film: Film, seed: int) -> dict[str, Film]:
    """The same film with its cameras shuffled, blurred, and with frames that disagree about where they look."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(film.cameras), generator=generator).tolist()
    turns = torch.randn(len(film.cameras), 3, generator=generator)
    shuffled = [film.cameras[place] for place in order]

    def blurry(frame: int) -> Tensor:
        return blurred(film.pictures(frame))

    def elsewhere(frame: int) -> Tensor:
        return turned(film.pictures(frame), film.cameras[frame], _DISAGREE * turns[frame] / turns[frame].norm())

    return {
        f"{name}, cameras shuffled": Film(pictures=film.pictures, cameras=shuffled, pairs=film.pairs),
        f"{name}, blurred": Film(pictures=blurry, cameras=film.cameras, pairs=film.pairs),
        f"{name}, frames that disagree": Film(pictures=elsewhere, cameras=film.cameras, pairs=film.pairs),
    }


def blurred(picture: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
    """With a Gaussian of a twenty-seventh of the longer side."""
    from torchvision.transforms.functional import gaussian_blur

    sigma = _BLUR * max(picture.shape[1:])
    reach = min(int(2.5 * sigma), min(picture.shape[1:]) - 1)
    return gaussian_blur(picture, [2 * reach + 1, 2 * reach + 1], [sigma, sigma])


def turned(picture: Float[Tensor, "3 h w"], camera: Pinholes, degrees: Float[Tensor, "3"]) -> Float[Tensor, "3 h w"]:
    """What the camera would see if it were turned on the spot; its border is drawn out where it looks past the picture.

    Args:
        picture: RGB.
        camera: of the picture.
        degrees: axis times angle, in the camera's axes.
    """
    import torch
    import torch.nn.functional as F

    x, y, z = torch.deg2rad(degrees.double()).tolist()
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64))
    height, width = picture.shape[1:]
    rows, columns = (torch.arange(side, dtype=torch.float64) + 0.5 for side in (height, width))
    places = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)
    focal, principal = camera.focal[0].double(), camera.principal[0].double()
    rays = F.pad((places - principal) / focal, (0, 1), value=1.0) @ turn.T
    seen = rays[..., :2] / rays[..., 2:] * focal + principal
    grid = (2 * seen / torch.tensor([width, height]) - 1).to(picture.dtype)
    return F.grid_sample(picture[None], grid[None], padding_mode="border", align_corners=False)[0]


def true_pictures(
    capture: Path, pipeline: Any, captured: Sequence[Pinholes], cameras: Any, *, paint: bool = False
) -> Callable[[int], Tensor] | None:
    """Frames of the film as the procedural room shows them, perhaps painted; None for other captures."""
    import torch

    from fb_core.data.capture.captures import read_capture
    from fb_core.data.rooms.ray_caster import render
    from fb_core.data.rooms.room import FAMILIES, make_room
    from fb_core.geometry.similarity import Similarity

    content = read_capture(capture)
    record = content.extra.get("room")
    if not isinstance(record, dict) or record.get("family") not in FAMILIES or not isinstance(record.get("seed"), int):
        return None
    places = {frame.image_path.name: frame.camera for frame in content.frames}
    names = [Path(name).name for name in pipeline.datamanager.train_dataset.image_filenames]
    if any(name not in places for name in names):
        return None
    theirs = [(torch.cat([one.rotations for one in side]), torch.cat([one.centers for one in side])) for side in
              (captured, [places[name] for name in names])]  # fmt: skip
    to_capture, room = Similarity.between(*theirs), make_room(record["seed"], FAMILIES[record["family"]])

    def picture(frame: int) -> Tensor:
        camera = to_capture.cameras(cameras[frame]).to(torch.float32)
        seen = render(room, camera, supersample=2)
        colours = seen.rgb[0].clamp(0, 1)
        if not paint:
            return colours
        directions = camera.directions()[0]
        along = directions @ camera.rotations[0][:, 2]  # how far a unit of a ray goes into the picture
        points = camera.centers[0] + seen.depth[0, ..., None] / along[..., None] * directions
        return 0.4 * colours + 0.6 * noise(points)

    return picture


def noise(points: Float[Tensor, "h w 3"]) -> Float[Tensor, "1 h w"]:
    """Grey in [0, 1] of places in a solid of noise, metres."""
    import torch
    import torch.nn.functional as F

    generator = torch.Generator().manual_seed(0)
    grey = points.new_zeros(1, *points.shape[:2])
    for cell, part in _PAINT:
        solid = torch.rand(1, 1, _CELLS, _CELLS, _CELLS, generator=generator)
        places = 2 * (points / (cell * _CELLS)).remainder(1.0) - 1
        grey = grey + part * F.grid_sample(solid, places[None, None], align_corners=True)[0, 0]
    return grey
