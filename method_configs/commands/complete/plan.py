"""The plan of new views that follows from what is asked of ``fillerbuster complete``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from fb_core.completion.fly_through import Passes, plan_passes, room_beside
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.registration.by_raymaps import ROUNDS
from method_configs.commands.complete.options import CompleteOptions


@dataclass(frozen=True, kw_only=True)
class Plan:
    """How new views will be generated."""

    photos: int
    """Photos that they are conditioned on."""
    side: int
    """Of the views in pixels."""
    sampling: SamplingConfig
    """Of each pass."""
    passes: Passes
    """Which views are generated together."""

    @property
    def longest(self) -> int:
        """Views of the longest sequence."""
        later = [len(chosen) + self.passes.anchors for chosen in self.passes.views[1:]]
        return self.photos + max([len(self.passes.views[0]), *later])

    @staticmethod
    def of(photos: int, views: int, model: Fillerbuster, options: CompleteOptions) -> Plan:
        """For so many photos with a camera and views along the path. Raises ValueError when memory does not suffice for
        one view.
        """
        photos, side = min(photos, options.photos), options.size or model.size
        sampling = dataclasses.replace(model.recommended_sampling, precision=options.precision)
        sampling = sampling if options.steps is None else dataclasses.replace(sampling, steps=options.steps)
        room = room_beside(
            photos, model, sequence=options.sequence, views=views, side=side, sampling=sampling, prompt=options.prompt
        )
        return Plan(photos=photos, side=side, sampling=sampling, passes=plan_passes(views, room=room))


def pose_sampling(model: Fillerbuster, options: CompleteOptions) -> SamplingConfig:
    """The paper's budget for raymaps, with no more steps than were asked for."""
    sampling = dataclasses.replace(model.recommended_sampling.for_poses(), rounds=ROUNDS)
    return (
        sampling if options.steps is None else dataclasses.replace(sampling, steps=min(options.steps, sampling.steps))
    )
