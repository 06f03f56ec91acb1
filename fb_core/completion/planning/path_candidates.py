"""Views along a film's path among those that a need-driven plan chooses from: what the film will show is where a gap is
noticed.
"""

from __future__ import annotations

import dataclasses

import torch.nn.functional as F

from fb_core.completion.planning.candidate_views import SIDE_SEEN, Candidates
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.paths import CaptureShape


def with_path(candidates: Candidates, path: Pinholes, shape: CaptureShape) -> Candidates:
    """The candidates and, before them, the views of a path in the same world; of equals the path's are taken."""
    path = path.to(shape.center)
    looks = F.normalize(path.camera_to_world[:, :, 2], dim=1)
    sides = candidates.sides
    if sides is not None:  # of an object: the sides that lie towards the camera
        around = F.normalize(candidates.coverage.surface - shape.focus, dim=1)
        sides = F.normalize(path.centers - shape.focus, dim=1) @ around.T > SIDE_SEEN
    return candidates.and_before(
        dataclasses.replace(candidates, centers=path.centers, looks=looks, sides=sides, wider=None)
    )
