"""What is asked of ``fillerbuster complete``, and the plan that follows from it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fb_core.completion.fly_through import Passes, plan_passes, room_beside
from fb_core.files.limits import (
    MOST_SAMPLING_STEPS,
    MOST_SEED,
    MOST_SIDE,
    MOST_TRAINING_STEPS,
    MOST_VIEWS,
    require_between,
)
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.machine.precision import Precision
from fb_core.registration.by_raymaps import ROUNDS

CHECKED = 8
"""Photos, and new views, that the self-consistency is measured on."""
POSES_AT_ONCE = 16
"""Photos whose raymaps are denoised together; more are registered in windows."""

_MOST_MINUTES = 7 * 24 * 60


@dataclass(frozen=True, kw_only=True)
class CompleteOptions:
    """What is asked of the command."""

    cameras: Literal["auto", "model", "features"] = "auto"
    """What finds the cameras of photos that have none."""
    known_poses: Path | None = None
    """Capture that knows the cameras of some of the photos, by their file names."""
    poses_only: bool = False
    """End when the cameras are found."""
    path: str = "ellipse"
    """ellipse, orbit, spiral or a camera path's JSON file."""
    views: int = 32
    """New views along the path."""
    photos: int = 16
    """Photos that new views are conditioned on."""
    sequence: int = 48
    """Most views, photos and new ones together, that the model sees at once."""
    size: int | None = None
    """Side of new views in pixels; None is the model's."""
    steps: int | None = None
    """Denoising steps; None is the model's recommendation."""
    seed: int = 0
    """Decides all that is drawn."""
    prompt: str | None = None
    """For models that read text."""
    model: Path | None = None
    """Model folder; None is the bundled one."""
    text_encoder: Path | None = None
    """Folder of the CLIP text model, for prompts."""
    device: str | None = None
    """Where to compute; None is a GPU if there is one."""
    precision: Precision = "auto"
    """Of the model's matrix products while views are generated; auto is bfloat16 where the device is faster at it."""
    fps: float = 8.0
    """Pictures per second of the film."""
    check: bool = True
    """Look for the cameras of photos and new views once more, and report how far they are off."""
    frames: Literal["scene", "model"] = "scene"
    """The film shows splats of the photos, completed where no photo shows anything; or the model's own pictures (the
    paper).
    """
    minutes: float = 5.0
    """Time that a scene may take, about; it decides sizes and steps that are not given."""
    film_size: int | None = None
    """Longest side of the scene's film in pixels, at most that of the photos; None is by the time."""
    photo_size: int | None = None
    """Longest side of the photos that splats are trained on; None is by the time."""
    iterations: int | None = None
    """Training steps of the splats; None is by the time."""
    generate: bool = True
    """Let the model make up what no photo shows; without, the scene shows what photos do."""

    def __post_init__(self) -> None:
        for name, least, most in (
            ("views", 1, MOST_VIEWS),
            ("photos", 1, MOST_VIEWS),
            ("sequence", 2, MOST_VIEWS),
            ("size", 16, MOST_SIDE),
            ("steps", 1, MOST_SAMPLING_STEPS),
            ("film_size", 16, MOST_SIDE),
            ("photo_size", 16, MOST_SIDE),
            ("iterations", 1, MOST_TRAINING_STEPS),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name}: expected at least {least}, got {value}")
            require_between(name, value or least, least, most)
        require_between("seed", self.seed, 0, MOST_SEED)
        if not 0 < self.minutes <= _MOST_MINUTES:
            raise ValueError(f"minutes: expected above 0 and at most {_MOST_MINUTES}, got {self.minutes:g}")
        if not 0 < self.fps <= 240:
            raise ValueError(f"fps: expected between 0 and 240 pictures per second, got {self.fps:g}")


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
