"""Which photos to look at: those that show nothing or the same as another one, and a few that cover the scene."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.photos.photo import Photo
from fb_core.geometry.viewpoints.paths import spread_subset

_FLAT = 0.01  # standard deviation of brightness: below, a picture shows nothing
_BLACK = 0.04  # mean brightness
_SAME = 0.004  # mean absolute difference of two pictures: one grey level of 255
_SAME_SIDE = 32  # pixels, at which traces of compression are averaged away
_TIME_WEIGHT = 0.5  # distance of the first from the last photo beside that of their appearance


def doubtful(photos: list[Photo]) -> dict[str, str]:
    """Names of photos that cannot help, with the reason: black, of one colour, or the same as an earlier photo. Cheap
    (thumbnails).
    """
    reasons: dict[str, str] = {}
    useful: dict[str, Tensor] = {}
    for photo in photos:
        small = media.shrink(photo.thumbnail, _SAME_SIDE)
        twin = next((name for name, other in useful.items() if _same(small, other)), None)
        if float(small.mean(dim=0).std(correction=0)) < _FLAT:
            reasons[photo.name] = "black" if float(small.mean()) < _BLACK else "of one colour"
        elif twin is not None:
            reasons[photo.name] = f"the same picture as {twin}"
        else:
            useful[photo.name] = small
    return reasons


def require_two_views(photos: list[Photo]) -> None:
    """Raises ValueError unless at least two photos show something and differ: cameras cannot be found otherwise."""
    reasons = doubtful(photos)
    if len(photos) - len(reasons) >= 2:
        return
    kinds = sorted(set(reasons.values()))
    raise ValueError(
        f"photos: expected at least 2 different pictures that show something, got {len(photos) - len(reasons)} of "
        f"{len(photos)} "
        f"({', '.join(kinds[:2])}); walk around the scene while taking photos"
    )


def choose_by_coverage(photos: list[Photo], count: int) -> list[int]:
    """Indices, ascending, of ``count`` photos that together show as much as possible; all when there are fewer.

    With known poses they differ most in place and direction (:func:`fb_core.geometry.viewpoints.paths.spread_subset`).
    Without, they are picked farthest first, by what they look like and by their place in the sequence; photos that are
    :func:`doubtful` come last.
    """
    if count >= len(photos):
        return list(range(len(photos)))
    cameras = [photo.camera for photo in photos if photo.camera is not None]
    if len(cameras) == len(photos):
        return sorted(spread_subset(cameras, count))
    doubts = doubtful(photos)
    order = [index for index, photo in enumerate(photos) if photo.name not in doubts]
    spares = [index for index, photo in enumerate(photos) if photo.name in doubts]
    picked = _farthest_first(_features([photos[index] for index in order]), count) if order else []
    return sorted(([order[index] for index in picked] + spares)[:count])


def _features(photos: list[Photo]) -> Float[Tensor, "n d"]:
    """Appearance (8 x 8 colours as a unit vector without exposure; unlike pictures are 1.4 apart) beside the place in
    the sequence.
    """
    small = torch.stack([F.adaptive_avg_pool2d(photo.thumbnail, (8, 8)).flatten() for photo in photos])
    appearance = F.normalize(small - small.mean(dim=1, keepdim=True), dim=1)
    return torch.cat([appearance, torch.linspace(0, _TIME_WEIGHT, len(photos))[:, None]], dim=1)


def _farthest_first(features: Float[Tensor, "n d"], count: int) -> list[int]:
    """Greedy farthest points, beginning with the most typical one."""
    apart = torch.cdist(features, features)
    chosen = [int(apart.sum(dim=1).argmin())]
    while len(chosen) < min(count, len(features)):
        nearest = apart[:, chosen].min(dim=1).values
        nearest[chosen] = -1.0
        chosen.append(int(nearest.argmax()))
    return chosen


def _same(first: Tensor, second: Tensor) -> bool:
    """Whether two small pictures differ by no more than another compression would."""
    return first.shape == second.shape and float((first - second).abs().mean()) < _SAME
