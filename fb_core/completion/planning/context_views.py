"""Which captured views should condition given new views: those that show most of what the new ones will. Geometry
alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.shell import Shell, intersect
from fb_core.geometry.viewpoints.paths import distances, seen_by, up_of

_RAYS_ACROSS = 12  # rays per side of a new view that its overlap with captured pictures is judged by
_SHOWN_AGAIN = 0.35  # a surface point is worth this much less each time another context view shows it
_NEARNESS = 1e-3  # decides between captured views that show equally much


def nearest_context(
    cameras: Sequence[Pinholes],
    targets: Pinholes,
    shell: Shell,
    count: int,
    known: Sequence[Bool[Tensor, "_h _w"] | None] | None = None,
) -> list[int]:
    """The captured views that together show most of what ``targets`` will show, the most level one first.

    What the targets show is guessed by rays to the shell. Views are chosen one by one; a surface point that is shown
    already counts less. Between views that show equally much (nothing, say) the nearest in place and direction is
    taken.

    Args:
        cameras: the capture's, one camera each.
        targets: the new views.
        shell: the guessed surface.
        count: how many to choose; all when there are fewer.
        known: of each captured picture its known part, None for all of it; without, all of them are known.
    """
    cameras = [camera.to("cpu", torch.float64) for camera in cameras]
    small = targets.to("cpu", torch.float64).scaled(_RAYS_ACROSS, _RAYS_ACROSS)
    directions = small.directions().reshape(-1, 3)
    origins = small.centers.repeat_interleave(_RAYS_ACROSS**2, dim=0)
    distance = intersect(shell, origins, directions)
    met = torch.isfinite(distance)
    points = origins[met] + distance[met, None] * directions[met]
    masks = [None] * len(cameras) if known is None else known
    shown = torch.stack(
        [seen_by([camera], points, [mask]) for camera, mask in zip(cameras, masks, strict=True)]
    ).double()
    nearness = _nearness(cameras, small)
    worth, chosen = torch.full((len(points),), 1 / max(len(points), 1), dtype=torch.float64), []
    while len(chosen) < min(count, len(cameras)):
        gain = shown @ worth + _NEARNESS * nearness
        gain[chosen] = -1.0
        best = int(gain.argmax())
        chosen.append(best)
        worth = torch.where(shown[best] > 0, worth * _SHOWN_AGAIN, worth)
    up = up_of(cameras)
    level = max(chosen, key=lambda index: float(-cameras[index].camera_to_world[0, :, 1] @ up))
    return [level, *(index for index in chosen if index != level)]


def _nearness(cameras: Sequence[Pinholes], targets: Pinholes) -> Float[Tensor, "n"]:
    """From 1 for a captured camera in the place and direction of a target towards 0 far away."""
    poses = torch.cat([camera.camera_to_world for camera in cameras])
    extent = float((poses[:, :, 3] - poses[:, :, 3].mean(dim=0)).norm(dim=1).max())
    away = distances(poses[:, :, 3], targets.centers) / max(extent, 1e-9) + distances(
        poses[:, :, 2], targets.camera_to_world[:, :, 2]
    )
    return 1 / (1 + away.min(dim=1).values)
