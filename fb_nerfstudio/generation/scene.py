"""The scene before one iteration of a training: its capture, and the splats as far as they are to be believed."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from nerfstudio.engine.optimizers import Optimizers
from torch import Tensor

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import CompletionPlan, plan_completion
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace, cameras_beside
from fb_nerfstudio.capture.splat_renders import TRAINED_STEPS, TrainedSplats, free_space, surface_points

_BESIDE_CAMERAS = 24  # captured places beside which it is looked from, in four directions each
_SURVEYED_CAMERAS = 48  # captured pictures that are rendered to learn where surfaces and free space are
_PLANNED_CAMERAS = 200  # the same, to plan new views: a capture of thousands costs no more than one of hundreds


@dataclass(frozen=True, kw_only=True)
class TrainedScene:
    """Capture and splats before one iteration."""

    splats: TrainedSplats
    """The model that is trained."""
    optimizers: Optimizers | None
    """Its optimizers."""
    cameras: list[Pinholes]
    """The capture's, on the CPU, one each."""
    known: Sequence[Bool[Tensor, "_h _w"] | None]
    """Of each captured picture a small mask of its known part, None for all of it."""
    cloud: Float[Tensor, "m 3"] | None
    """The capture's point cloud, if it has one."""
    step: int
    """Of the training."""

    @property
    def is_trained(self) -> bool:
        """Whether the splats' depth and opacity are to be believed."""
        return self.step >= TRAINED_STEPS

    @property
    def trained_splats(self) -> TrainedSplats | None:
        """The splats, None before they are to be believed."""
        return self.splats if self.is_trained else None

    @property
    def surveyed(self) -> list[Pinholes]:
        """Some of the captured cameras, from all over the capture."""
        return self._spread(_SURVEYED_CAMERAS)

    @property
    def planned_from(self) -> list[Pinholes]:
        """More of them: all of a capture of usual size."""
        return self._spread(_PLANNED_CAMERAS)

    def _spread(self, most: int) -> list[Pinholes]:
        return self.cameras[:: -(-len(self.cameras) // most)]

    def seen_points(self, cameras: Sequence[Pinholes]) -> Float[Tensor, "m 3"] | None:
        """Surface points: from structure from motion if the capture brings them, and once the splats are trained what
        they show in these cameras.
        """
        groups = [] if self.cloud is None else [self.cloud.cpu().float()]
        if self.is_trained:
            groups.append(surface_points(self.splats, cameras))
        return torch.cat(groups) if groups else None

    def free_space(self) -> FreeSpace | None:
        """What is known to be empty; None before the splats are trained."""
        return free_space(self.splats, self.surveyed) if self.is_trained else None

    def space_in_view(self) -> FreeSpace | None:
        """What lies between places beside the captured ones and what the splats show from there; None before they are
        trained.
        """
        return free_space(self.splats, cameras_beside(self._spread(_BESIDE_CAMERAS))) if self.is_trained else None

    def survey(self, config: CompletionConfig, *, size: int) -> CompletionPlan:
        """Shape, shell and context of the capture: a plan without rounds, for views of a size."""
        without = dataclasses.replace(config, anchor_views=0, densify_rounds=0, camera_path=None)
        return plan_completion(self.cameras, self.seen_points(self.surveyed), without, size=size, known=self.known)
