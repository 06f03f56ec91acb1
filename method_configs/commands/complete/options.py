"""What is asked of ``fillerbuster complete``: plain values, so that reading a command line needs no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from fb_core.files.limits import (
    MOST_SAMPLING_STEPS,
    MOST_SEED,
    MOST_SIDE,
    MOST_TRAINING_STEPS,
    MOST_VIEWS,
    require_between,
)

CHECKED = 8
"""Photos, and new views, that the self-consistency is measured on."""
POSES_AT_ONCE = 16
"""Photos whose raymaps are denoised together; more are registered in windows."""

_MOST_MINUTES = 7 * 24 * 60


@dataclass(frozen=True, kw_only=True)
class CompleteOptions:
    """What is asked of the command, beside where photos lie and where the output goes."""

    cameras: Literal["auto", "model", "features"] = "auto"
    """What finds the cameras of photos that have none: the model's raymaps, features, or the model and, where it is not
    sure, features.
    """
    known_poses: Path | None = None
    """Capture that knows the cameras of some of the photos, by their file names."""
    poses_only: bool = False
    """Find cameras and generate nothing."""
    path: str = "ellipse"
    """ellipse (fitted to the cameras), orbit, spiral, or a camera path's JSON file in the world of the capture."""
    views: int = 32
    """Pictures of the film along the path."""
    photos: int = 16
    """Photos that new views are conditioned on, chosen by coverage; all photos get cameras."""
    sequence: int = 48
    """With --frames model, most views, photos and new ones together, that the model sees at once; more come in further
    passes.
    """
    size: int | None = None
    """Side of new views in pixels; by default the model's."""
    steps: int | None = None
    """Denoising steps; by default the model's recommendation."""
    seed: int = 0
    """Decides all that is drawn."""
    prompt: str | None = None
    """What is to be seen, for models that read text."""
    model: Path | None = None
    """Model folder; by default the bundled one."""
    text_encoder: Path | None = None
    """Folder with the CLIP text model, which prompts need."""
    device: str | None = None
    """Where to compute, e.g. cpu or cuda:1; by default a GPU if there is one."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the model's matrix products (auto: bfloat16 where the machine is faster at it)."""
    fps: float = 8.0
    """Pictures per second of the film."""
    check: bool = True
    """With --frames model, look for the cameras of photos and new views once more, and report how far they are off."""
    frames: Literal["scene", "model"] = "scene"
    """scene: the film shows splats of the photos, with new views where no photo shows anything; model: the model's own
    pictures of the path (the paper).
    """
    minutes: float = 5.0
    """Time that a scene may take, about; it decides the sizes and steps that are not given."""
    film_size: int | None = None
    """Longest side of the scene's film in pixels, at most that of the photos."""
    photo_size: int | None = None
    """Longest side of the photos that splats are trained on."""
    iterations: int | None = None
    """Training steps of the splats."""
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
