"""Training sequences from captures on disk: any folders with a transforms.json (paper, appendix "Multi-view data
sampling").

Pictures are read when a sequence needs them, undistorted, scaled, cut to squares. There is no truth where lens or mask
leave out pixels.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.capture.captures import read_capture
from fb_core.data.capture.frames import Frame
from fb_core.data.capture.layouts import layouts_below
from fb_core.data.capture.transforms_json import JSON_NAME
from fb_core.data.capture.undistort import straight_camera
from fb_core.data.training.task import Draw, Sequences, TaskConfig, draw_task, stacked, task_order, training_frame
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import raymaps_of
from fb_core.masks import wholly_known

_logger = logging.getLogger(__name__)
_CAPTURES_IN_MEMORY = 64  # parsed JSON files
_READERS = 8  # pictures decoded at a time


@dataclass(frozen=True, kw_only=True)
class CaptureConfig:
    """How captures become sequences; the defaults are the paper's where it says."""

    image_size: int = 256
    """Side of the square crops in pixels."""
    strides: tuple[int, ...] = (1, 2, 4, 8, 0)
    """Steps between the frames of a sequence, one of which is drawn; 0 = frames at random (paper)."""
    centered: float = 0.1
    """Odds that all crops of a sequence are centred; else each has a random place (paper)."""
    zoom: float = 1.15
    """A picture's shorter side over the crop's (ScanNet++ in the released code)."""
    retries: int = 8
    """Sequences tried, one after the other, before a row with unreadable pictures ends the training."""

    def __post_init__(self) -> None:
        if self.zoom < 1 or self.image_size < 16 or not self.strides or self.retries < 1:
            raise ValueError(
                f"captures: expected zoom >= 1, image_size >= 16, some strides and retries >= 1, got {self}"
            )


def find_captures(folder: Path) -> list[Path]:
    """Every folder at or below ``folder`` that holds a capture in a layout of :mod:`fb_core.data.capture.layouts`,
    sorted.

    Raises ValueError if there is none.
    """
    captures = layouts_below(Path(folder)) if Path(folder).is_dir() else []
    if not captures:
        raise ValueError(
            f"captures: expected folders with a {JSON_NAME}, a transforms_train.json or a COLMAP model at or below "
            f"{folder}, found none; "
            "check the path"
        )
    return captures


class CaptureSource:
    """Sequences of views of captures. Nothing is kept between steps but parsed JSON."""

    def __init__(self, folders: Sequence[Path], config: CaptureConfig, *, device: torch.device | str = "cpu"):
        if not folders:
            raise ValueError("captures: expected at least one capture's folder, got none")
        self.folders, self.config, self.device = tuple(folders), config, torch.device(device)
        self._capture = lru_cache(_CAPTURES_IN_MEMORY)(read_training_capture)
        self._readers = ThreadPoolExecutor(_READERS, thread_name_prefix="pictures")

    @property
    def views(self) -> int:
        """Any number: small captures show pictures twice, with other crops."""
        return 1_000_000

    def advance(self, step: int, rows: range | None = None) -> None:
        """Nothing to prepare."""

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """One crop for each row, black where there is no ground truth."""
        return torch.stack([self._row(TaskConfig(views=1), draw(row))["images"][0] for row in rows])

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """One raymap for each row, in the frame of its sequence; no picture is read."""
        return torch.stack([self._row(task, draw(row), cameras_only=True)["raymaps"][row % task.views] for row in rows])

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """One sequence for each row."""
        return stacked([self._row(task, draw(row)) for row in rows])

    def _row(self, task: TaskConfig, generator: torch.Generator, cameras_only: bool = False) -> dict[str, Tensor]:
        """A sequence of a random capture; one that cannot be read is told in the log and another is drawn."""
        error: Exception | None = None
        for _ in range(self.config.retries):
            folder = self.folders[int(torch.randint(len(self.folders), (), generator=generator))]
            try:
                return self._sequence(self._capture(folder), task, generator, cameras_only)
            except (ValueError, OSError) as fault:
                _logger.warning("left out a sequence: %s", fault)
                error = fault
        raise ValueError(
            f"captures: {self.config.retries} sequences in a row could not be read, the last because: {error}"
        ) from error

    def _sequence(
        self, capture: TrainingCapture, task: TaskConfig, generator: torch.Generator, cameras_only: bool
    ) -> dict[str, Tensor]:
        config = self.config
        stride = config.strides[int(torch.randint(len(config.strides), (), generator=generator))]
        chosen = strided(len(capture.frames), task.views, stride, generator=generator)
        centered = float(torch.rand((), generator=generator)) < config.centered
        places = torch.full((task.views, 2), 0.5) if centered else torch.rand(task.views, 2, generator=generator)
        windows = [
            Window.of(capture.frames[number], place.tolist(), config)
            for number, place in zip(chosen, places, strict=True)
        ]
        cameras = capture.normalized(Pinholes.cat([window.camera for window in windows]))
        order = task_order(cameras, task, generator=generator)
        windows, cameras = [windows[number] for number in order.tolist()], cameras[order]
        frame = training_frame(cameras, task, generator=generator)
        raymaps = (
            frame.apply(raymaps_of(cameras)).float().to(self.device)
        )  # float32 only here: worlds may have large coordinates
        if cameras_only:
            return {"raymaps": raymaps}
        image_known, rays_known = draw_task(task.views, config.image_size, task, generator=generator)
        images, truths = (torch.stack(parts) for parts in zip(*self._readers.map(Window.read, windows), strict=True))
        fields = {
            "images": images,
            "image_known": image_known * truths,
            "rays_known": rays_known,
            "image_truth": truths,
        }
        return {"raymaps": raymaps, **{name: value.to(self.device) for name, value in fields.items()}}


@dataclass(frozen=True, kw_only=True)
class TrainingCapture:
    """The usable frames of a capture, and where its cameras are."""

    frames: tuple[Frame, ...]
    center: Float[Tensor, "3"]
    """Mean of the cameras' centres."""
    extent: float
    """Largest distance of a camera from there, along an axis."""

    def normalized(self, cameras: Pinholes) -> Pinholes:
        """Cameras in a world where the whole capture just fits into [-1, 1]^3, so that a sequence's own extent tells
        something.
        """
        centers = (cameras.centers - self.center) / self.extent
        return dataclasses.replace(cameras, camera_to_world=torch.cat([cameras.rotations, centers[:, :, None]], dim=2))


def read_training_capture(folder: Path) -> TrainingCapture:
    """A capture without the frames that it calls bad, and without ScanNet++'s test frames.

    Raises ValueError for what cannot be read, and for a capture without usable frames.
    """
    capture = read_capture(folder)
    frames = tuple(frame for frame in capture.frames if not frame.is_bad and not frame.extra.get("held_out"))
    if not frames:
        raise ValueError(f"capture {folder}: every frame is marked is_bad or held_out; leave this folder out")
    centers = torch.cat([frame.camera.centers for frame in frames])
    center = centers.mean(dim=0)
    extent = float((centers - center).abs().max())
    return TrainingCapture(frames=frames, center=center, extent=extent if extent > 1e-9 else 1.0)


def strided(frames: int, views: int, stride: int, *, generator: torch.Generator) -> list[int]:
    """Numbers of the frames of a sequence, in random order: ``stride`` apart, or anywhere for 0.

    A stride that does not fit is halved until it does. Fewer frames than views: frames are drawn with replacement.
    """
    if frames < views:
        return torch.randint(frames, (views,), generator=generator).tolist()
    while stride and stride * (views - 1) >= frames:
        stride //= 2
    if not stride:
        return torch.randperm(frames, generator=generator)[:views].tolist()
    first = int(torch.randint(frames - stride * (views - 1), (), generator=generator))
    return (first + stride * torch.randperm(views, generator=generator)).tolist()


@dataclass(frozen=True, kw_only=True)
class Window:
    """A square part of a picture that is undistorted and scaled."""

    frame: Frame
    width: int
    """Of the whole scaled picture."""
    height: int
    left: int
    top: int
    size: int
    """Side of the square."""

    @staticmethod
    def of(frame: Frame, place: Sequence[float], config: CaptureConfig) -> Window:
        """``place`` in [0, 1]^2 (x, y) says where the square lies in the scaled picture."""
        size, old = config.image_size, frame.camera
        scale = config.zoom * size / min(old.width, old.height)
        width, height = (max(size, round(side * scale)) for side in (old.width, old.height))
        left, top = (int(share * (side - size) + 0.5) for share, side in zip(place, (width, height), strict=True))
        return Window(frame=frame, width=width, height=height, left=left, top=top, size=size)

    @property
    def camera(self) -> Pinholes:
        """The pinhole camera of the square."""
        frame = self.frame
        straight = straight_camera(frame.camera, frame.camera_model, frame.distortion)
        return straight.scaled(self.width, self.height).cropped(self.left, self.top, self.size, self.size)

    def read(self) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]:
        """(picture, truth) of the square; the picture is black where there is no truth."""
        return self.cut_from(*self.scaled())

    def scaled(self) -> tuple[Float[Tensor, "3 h2 w2"], Float[Tensor, "1 h2 w2"]]:
        """(picture, truth) of the whole scaled picture."""
        image, mask, _ = self.frame.load_undistorted()
        image, mask = wholly_known(image, mask, lambda channels: media.resize(channels, self.height, self.width))
        return image.clamp(0, 1), mask

    def cut_from(
        self, image: Float[Tensor, "3 h2 w2"], truth: Float[Tensor, "1 h2 w2"]
    ) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]:
        """The square of what `scaled` gives."""
        square = (slice(None), slice(self.top, self.top + self.size), slice(self.left, self.left + self.size))
        return image[square], truth[square]
