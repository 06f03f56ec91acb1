"""Sequences of views of captures as a model is asked to complete them (paper, table 2): crops by random draw, with what
of them is true.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.data.capture.layouts import other_tool
from fb_core.data.training.capture_sequences import (
    CaptureConfig,
    TrainingCapture,
    Window,
    find_captures,
    read_training_capture,
    strided,
)
from fb_core.files.whole import found_below
from fb_core.geometry.cameras import Pinholes

_MOST_BYTES = 512 * 1024**2  # of scaled pictures that are kept
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CaptureViews:
    """Square crops of a capture's pictures."""

    images: Float[Tensor, "n 3 h w"]
    """RGB in [0, 1]; black where nothing is true."""
    cameras: Pinholes
    """Of the crops, in a world where the whole capture fits into [-1, 1]^3."""
    truth: Float[Tensor, "n 1 h w"]
    """1 where lens and mask leave true pixels."""
    capture: str
    """Whose views these are."""

    def __getitem__(self, part: slice) -> CaptureViews:
        places = list(range(*part.indices(len(self.images))))
        return CaptureViews(
            images=self.images[part], cameras=self.cameras[places], truth=self.truth[part], capture=self.capture
        )


_PICTURES = {".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".webp"}
_FILMS = {".mp4", ".mov", ".mkv", ".avi", ".webm"}


def capture_folders(data: Path) -> list[Path]:
    """Every folder that holds a capture at or below ``data``. Raises ValueError that says what it looks like
    otherwise.
    """
    if not data.is_dir():
        raise ValueError(f"data: expected a folder of captures, got {data}, which is none; check the path")
    try:
        return find_captures(data)
    except ValueError:
        kind, remedy = looks_like(data)
        raise ValueError(
            f"data: expected captures with a transforms.json at or below {data}, got {kind}; {remedy}"
        ) from None


def looks_like(folder: Path) -> tuple[str, str]:
    """What a folder without captures seems to be, and what turns it into one."""
    if (other := other_tool(folder)) is not None:
        return other
    files = [path for path in found_below(folder, "*")[:10_000] if path.is_file()]
    names, suffixes = {path.name for path in files}, {path.suffix.lower() for path in files}
    if names & {"cameras.bin", "cameras.txt"}:
        return (
            "a part of a COLMAP model",
            "copy its files images and cameras (both .bin, or both .txt) beside one another",
        )
    if any(name.startswith("transforms_") and name.endswith(".json") for name in names):
        return "a Blender scene without a transforms_train.json", "name the file to use transforms.json"
    if any(path.suffix == ".tar" for path in files):
        return "WebDataset shards, which have no cameras", "give captures"
    if suffixes & _FILMS:
        return "a film", "run fillerbuster complete --poses-only or ns-process-data video on it"
    if suffixes & _PICTURES:
        return "photos without cameras", "run fillerbuster complete --poses-only or ns-process-data images on it"
    return "an empty folder" if not files else "files of no kind that is known here", "check the path"


def readable_captures(folders: Sequence[Path], *, views: int) -> list[tuple[str, TrainingCapture]]:
    """The captures that have so many frames; others are left out and named in the log.

    Raises ValueError if none is left.
    """
    captures, reasons = [], []
    for folder in folders:
        try:
            capture = read_training_capture(folder)
        except (ValueError, OSError) as error:
            reasons.append(str(error))
            continue
        if len(capture.frames) < views:
            reasons.append(
                f"capture {folder} has {len(capture.frames)} frames, fewer than the {views} views of a sequence"
            )
        else:
            captures.append((folder.name, capture))
    if not captures:
        raise ValueError(
            f"captures: none can be asked for sequences of {views} views ({reasons[0]}); ask for fewer views, or give "
            "others"
        )
    for reason in reasons:
        _logger.warning("left out: %s", reason)
    return captures


class ScaledPictures:
    """Crops of pictures, whose whole scaled pictures are kept while there is room: sequences of few captures show the
    same ones again and again, and a large photo takes longer to read than its view to complete.
    """

    def __init__(self, most_bytes: int = _MOST_BYTES):
        self._most_bytes, self._bytes = most_bytes, 0
        self._kept: OrderedDict[tuple[Path, Path | None, int, int], tuple[Tensor, Tensor]] = OrderedDict()

    def read(self, window: Window) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]:
        """What ``window.read()`` gives."""
        key = window.frame.image_path, window.frame.mask_path, window.width, window.height
        if key not in self._kept:
            self._kept[key] = window.scaled()
            self._bytes += _bytes(self._kept[key])
        self._kept.move_to_end(key)
        scaled = self._kept[key]
        while self._bytes > self._most_bytes:
            self._bytes -= _bytes(self._kept.popitem(last=False)[1])
        return window.cut_from(*scaled)


def _bytes(pair: tuple[Tensor, Tensor]) -> int:
    return sum(values.numel() * values.element_size() for values in pair)


def drawn_views(
    captures: Sequence[tuple[str, TrainingCapture]],
    views: int,
    config: CaptureConfig,
    *,
    generator: torch.Generator,
    pictures: ScaledPictures | None = None,
) -> CaptureViews:
    """One sequence: a capture, frames at a drawn stride in random order, and the places of their crops, as in
    training. ``pictures`` is for callers that draw several.
    """
    name, capture = captures[int(torch.randint(len(captures), (), generator=generator))]
    stride = config.strides[int(torch.randint(len(config.strides), (), generator=generator))]
    chosen = strided(len(capture.frames), views, stride, generator=generator)
    centered = float(torch.rand((), generator=generator)) < config.centered
    places = torch.full((views, 2), 0.5) if centered else torch.rand(views, 2, generator=generator)
    windows = [
        Window.of(capture.frames[frame], place.tolist(), config) for frame, place in zip(chosen, places, strict=True)
    ]
    read = (pictures or ScaledPictures()).read
    crops = [read(window) for window in windows]
    return CaptureViews(
        images=torch.stack([image for image, _ in crops]),
        cameras=capture.normalized(Pinholes.cat([window.camera for window in windows])).to(torch.float32),
        truth=torch.stack([truth for _, truth in crops]),
        capture=name,
    )
