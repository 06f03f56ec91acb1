"""Surface points from photos whose cameras are known: matched features, joined into tracks, triangulated.

Many captures come with poses but without points (phone AR, instant-ngp's data sets). The known cameras make this a
small problem: only features near each other's epipolar lines can match, and a track is one 3x3 linear system.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.geometry.viewpoints.paths import distances

_NEIGHBOURS = 6  # photos that each photo is matched with
_EPIPOLAR_DEGREES = 0.25  # a match lies this near the plane through both centres and the other ray
_RATIO = 0.85  # Lowe's ratio, looser than usual because few candidates lie near an epipolar line
_LEAST_SIMILARITY = 0.75  # cosine of two descriptors
_LEAST_ANGLE_DEGREES = 3.0  # between the rays of a track; below, its distance means nothing
_MOST_ERROR_DEGREES = 0.3  # between any ray of a track and its point


@dataclass(frozen=True, kw_only=True)
class Features:
    """Distinctive places of one photo."""

    center: Float[Tensor, "3"]
    """The camera's centre, world."""
    directions: Float[Tensor, "k 3"]
    """Unit viewing directions in world axes."""
    descriptors: Float[Tensor, "k d"]
    """Unit vectors; similar places have a large dot product."""
    colors: Float[Tensor, "k 3"]
    """RGB in [0, 1]."""

    def __len__(self) -> int:
        return len(self.directions)


def detect(image: Float[Tensor, "3 h w"], known: Float[Tensor, "1 h w"] | None = None, *, limit: int = 1500):
    """SIFT key points of a photo (Lowe 2004; descriptors after Arandjelovic 2012): places, descriptors, colours.

    Args:
        image: RGB in [0, 1].
        known: 1 where the pixel may be used.
        limit: at most this many, the strongest.

    Returns:
        Places in pixels ([k, 2], the first pixel's centre is 0.5, 0.5), unit descriptors ([k, 128]), RGB in [0, 1] ([k,
        3]).
    """
    import cv2

    pixels = np.ascontiguousarray((image.clamp(0, 1) * 255).round().to(torch.uint8).movedim(0, -1).numpy())
    mask = None if known is None else np.ascontiguousarray((known[0] > 0).to(torch.uint8).numpy() * 255)
    places, descriptors = _detector(limit).detectAndCompute(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), mask)
    if not places:
        return torch.zeros(0, 2), torch.zeros(0, 128), torch.zeros(0, 3)
    at = torch.tensor([place.pt for place in places])
    column, row = (at[:, axis].round().long().clamp(0, image.shape[2 - axis] - 1) for axis in (0, 1))
    return (
        at + 0.5,
        F.normalize(F.normalize(torch.from_numpy(descriptors), p=1, dim=-1).sqrt(), dim=-1),
        image[:, row, column].T,
    )


def _detector(limit: int) -> Any:
    """The only maker of detectors. Without the precise upscale, OpenCV's doubled picture puts every place .25 pixel
    right and down.
    """
    import cv2

    return cv2.SIFT.create(nfeatures=limit, contrastThreshold=0.01, enable_precise_upscale=True)


def triangulate(photos: Sequence[Features]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """World points and colours (RGB in [0, 1]) of everything that at least two photos agree on.

    Deterministic. Photos without features, and cameras that all stand in one place, give no points.
    """
    if not photos or not sum(len(photo) for photo in photos):
        return torch.zeros(0, 3), torch.zeros(0, 3)
    starts = np.cumsum([0, *(len(photo) for photo in photos)])
    links = [
        torch.stack([first + int(starts[i]), second + int(starts[j])], dim=1)
        for i, j in _pairs(photos)
        for first, second in [matches(photos[i], photos[j])]
    ]
    if not links:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    track = tracks_of(torch.cat(links), int(starts[-1]))
    owner = torch.repeat_interleave(torch.arange(len(photos)), torch.tensor([len(photo) for photo in photos]))
    members = track >= 0
    track, owner = track[members], owner[members]
    places = torch.stack([photo.center for photo in photos]).double()
    middle = places.mean(dim=0)
    centers = (places - middle)[owner]
    directions = torch.cat([photo.directions for photo in photos]).double()[members]
    points, good = nearest_points(centers, directions, track)
    points = points + middle
    colors = _mean_over(torch.cat([photo.colors for photo in photos])[members].double(), track, len(points))
    return points[good].to(photos[0].center), colors[good].float()


def matches(first: Features, second: Features) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Indices of features that are each other's best match near their epipolar planes, and clearly better than the next
    one.
    """
    nothing = torch.zeros(0, dtype=torch.long)
    baseline = (second.center - first.center).to(first.directions)
    if len(first) < 2 or len(second) < 2 or float(baseline.norm()) == 0:
        return nothing, nothing
    # The angle between a ray and the plane through the baseline and the other photo's ray.
    normals = F.normalize(torch.linalg.cross(baseline.expand_as(first.directions), first.directions), dim=-1, eps=1e-12)
    near = (normals @ second.directions.T).abs() < np.sin(np.radians(_EPIPOLAR_DEGREES))
    return mutual_matches(torch.where(near, first.descriptors @ second.descriptors.T, -1.0), ratio=_RATIO)


def mutual_matches(similar: Float[Tensor, "k l"], *, ratio: float) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
    """Rows and columns that are each other's best match, the next best farther off by Lowe's ratio (cosines of unit
    descriptors).
    """
    best, partner = similar.topk(2, dim=1)
    distance = (2 - 2 * best).clamp(min=0).sqrt()
    clear = (best[:, 0] > _LEAST_SIMILARITY) & (distance[:, 0] < ratio * distance[:, 1])
    rows, columns = clear.nonzero()[:, 0], partner[clear, 0]
    mutual = similar[:, columns].argmax(dim=0) == rows  # of these columns alone: a column is far apart in memory
    return rows[mutual], columns[mutual]


def nearest_points(
    centers: Float[Tensor, "k 3"],
    directions: Float[Tensor, "k 3"],
    track: Int[Tensor, " k"],
    *,
    least_angle_degrees: float = _LEAST_ANGLE_DEGREES,
    most_error_degrees: float = _MOST_ERROR_DEGREES,
) -> tuple[Float[Tensor, "m 3"], Tensor]:
    """The point nearest to the rays of each track (least squares of the distances), and whether it can be trusted.

    Trusted: in front of every camera, seen within a small angle of every ray, and from directions far enough apart.

    Args:
        centers: ray origins, world.
        directions: unit ray directions, world.
        track: which track a ray belongs to, 0 to m - 1, each with at least one ray.
        least_angle_degrees: between the rays of a trusted track.
        most_error_degrees: between any ray of a trusted track and its point.
    """
    count = int(track.max()) + 1 if len(track) else 0
    across = torch.eye(3).to(directions) - directions[:, :, None] * directions[:, None, :]
    matrix = directions.new_zeros(count, 3, 3).index_add_(0, track, across)
    right = directions.new_zeros(count, 3).index_add_(0, track, (across @ centers[:, :, None])[..., 0])
    solvable = torch.linalg.det(matrix) > 1e-12
    points = torch.linalg.solve(torch.where(solvable[:, None, None], matrix, torch.eye(3).to(matrix)), right)
    offset = points[track] - centers
    looks = F.normalize(offset, dim=-1, eps=1e-30)
    error = torch.linalg.cross(looks, directions).norm(dim=-1)
    bad = ((looks * directions).sum(dim=-1) <= 0) | (error > np.sin(np.radians(most_error_degrees)))
    worst = torch.zeros(count, dtype=torch.long).index_add_(0, track, bad.long())
    # |mean direction| = cos of half the angle for two rays; for more it falls with their spread.
    spread = _mean_over(directions, track, count).norm(dim=-1)
    wide = spread < np.cos(np.radians(least_angle_degrees) / 2)
    return points, solvable & wide & (worst == 0)


def _pairs(photos: Sequence[Features]) -> list[tuple[int, int]]:
    """Each photo with those that look most the same way from another place."""
    centers = torch.stack([photo.center for photo in photos])
    looks = torch.stack(
        [F.normalize(photo.directions.sum(dim=0), dim=0) for photo in photos]
    )  # zero where a photo has none
    apart = distances(centers, centers)
    typical = apart[apart > 0].median() if bool((apart > 0).any()) else torch.ones(())
    closeness = (looks @ looks.T).double() - 0.2 * apart / typical
    closeness[apart <= 1e-9 * typical] = -torch.inf
    pairs: set[tuple[int, int]] = set()
    for index, row in enumerate(closeness):
        for other in row.topk(min(_NEIGHBOURS, len(photos))).indices.tolist():
            if bool(row[other] > 0.3):
                pairs.add((min(index, other), max(index, other)))
    return sorted(pairs)


def tracks_of(links: Int[Tensor, "l 2"], count: int) -> Int[Tensor, " count"]:
    """Connected components of the links, numbered from 0; -1 for features without a link."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(links), dtype=bool), links.T.numpy()), shape=(count, count))
    label = torch.from_numpy(connected_components(graph, directed=False)[1].astype(np.int64))
    linked = torch.zeros(count, dtype=torch.bool)
    linked[links.reshape(-1)] = True
    result = torch.full((count,), -1)
    result[linked] = torch.unique(label[linked], return_inverse=True)[1]
    return result


def _mean_over(values: Float[Tensor, "k c"], track: Int[Tensor, " k"], count: int) -> Float[Tensor, "m c"]:
    """Mean of the rows of each track."""
    sums = values.new_zeros(count, values.shape[1]).index_add_(0, track, values)
    return sums / torch.bincount(track, minlength=count).clamp(min=1)[:, None]
