"""Films: which frames are worth looking at, and their pixels, without ever holding the film in memory.

One pass over small grey pictures measures how sharp each frame is and how far the camera has moved; the frames that are
chosen lie evenly along that way, not in time, and each is the sharpest near its place. Their pixels are decoded again
when somebody asks for them.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.data.photos.film_colours import to_rgb
from fb_core.files.limits import MOST_FILM_PIXELS, require_decodable, require_text_name

FILM_SUFFIXES = (
    ".mp4",
    ".mov",
    ".m4v",
    ".avi",
    ".mkv",
    ".webm",
    ".mpg",
    ".mpeg",
    ".mts",
    ".m2ts",
    ".ts",
    ".3gp",
    ".wmv",
    ".ogv",
    ".flv",
)
_SHARPNESS_SIDE = 480  # pixels of the longer side in which sharpness is measured: motion blur must still be seen
_MOTION_SIDE = 120  # and motion
_LEAST_SIDE = 32  # optical flow needs as much
_BLANK = 2.0  # of 255, standard deviation of the brightness: below, a frame shows nothing
_NEW_REFERENCE = 0.04  # once the picture has moved by this share of its longer side, motion is measured from here on
_MOST_STEP = 0.25  # of the longer side: what optical flow says beyond that (a cut) is not believed
_LEAST_COMPLETE = 0.95  # share of the frames announced by the header that must be there
_HELD_CHANNELS = 6  # three of colours and as many of frames that a decoder keeps to predict others from
_HDR = (16, 18)  # transfer curves PQ and HLG
_CACHE_BYTES = 256 * 2**20
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FilmFrame:
    """One frame of a film."""

    number: int
    """Counted from 0 in the order of showing, among the frames that can be decoded."""
    pts: int
    """The film's own time stamp."""
    seconds: float
    """Time since the film's first frame."""
    group: int
    """How many key frames came before it, itself included: decoding can only begin at one."""


@dataclass(frozen=True, kw_only=True)
class Display:
    """How stored frames are to be shown."""

    size: tuple[int, int]
    """(height, width) after the turn, with square pixels."""
    matrix: np.ndarray
    """The 2 x 2 part of the film's display matrix: a stored place (x, y) is shown at (x, y) @ matrix."""

    @staticmethod
    def of(frame: Any, pixel_aspect: float) -> Display:
        """By a frame's side data and the width of a stored pixel for its height."""
        # Asking a frame for its side data ties it into a cycle, which keeps its pixels for a while: one frame of a film
        # tells for all.
        data = frame.side_data.get("DISPLAYMATRIX")
        matrix = np.eye(2) if data is None else np.frombuffer(bytes(data), dtype=np.int32).reshape(3, 3)[:2, :2] / 2**16
        height, width = frame.height, max(1, round(frame.width * pixel_aspect))
        stored = Display(size=(height, width), matrix=matrix)
        return Display(size=(width, height), matrix=matrix) if stored.transposed else stored

    @property
    def transposed(self) -> bool:
        """Whether stored rows are shown as columns."""
        return bool(abs(self.matrix[0, 1]) + abs(self.matrix[1, 0]) > abs(self.matrix[0, 0]) + abs(self.matrix[1, 1]))


class Film:
    """The chosen frames of a film, decoded on demand; pixels of at most ``_CACHE_BYTES`` are kept."""

    def __init__(self, path: Path, frames: list[FilmFrame], display: Display):
        self.path, self.frames, self._display = path, frames, display
        self._kept: dict[int, np.ndarray] = {}
        self._lock = threading.Lock()

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels, upright."""
        return self._display.size

    def load(self, frame: FilmFrame) -> Float[Tensor, "3 h w"]:
        """The frame upright at full size, RGB in [0, 1]. Raises ValueError when the film has become unreadable."""
        with self._lock:
            if frame.pts not in self._kept:
                self._decode_from(frame)
            array = self._kept[frame.pts]
        return rearrange(torch.from_numpy(array), "h w c -> c h w").float() / 255

    def _decode_from(self, frame: FilmFrame) -> None:
        """Keeps this frame and the chosen ones that follow before the next key frame, as far as there is room.

        So frames asked for in order of time are decoded once, and any other order costs at most the way from a key
        frame each.
        """
        room = max(1, _CACHE_BYTES // (3 * math.prod(self.size)))
        wanted = [one.pts for one in self.frames if one.group == frame.group and one.pts >= frame.pts][:room]
        self._kept.clear()
        for begin in (frame.pts, None):  # from the start, should a container lead to a wrong place
            for decoded in _frames(self.path, [], from_pts=begin):
                if decoded.pts in wanted:
                    self._kept[decoded.pts] = _pixels(decoded, self._display)
                if len(self._kept) == len(wanted) or (decoded.pts or 0) > wanted[-1]:
                    break
            if frame.pts in self._kept:
                return
        raise ValueError(
            f"film {self.path}: the frame at {frame.seconds:.2f} s can no longer be decoded; was the file changed?"
        )


def read_film(path: Path, most: int) -> Film:
    """A film with at most ``most`` chosen frames (see :func:`choose_frames`).

    What can be decoded of a damaged film is used, with a warning.

    Raises:
        ValueError: one sentence, for a file that is no film and for a film of which fewer than two frames can be
            decoded.
    """
    faults: list[str] = []
    frames, sharpness, travelled, blank, display = _survey(path, faults)
    fault = f" ({faults[0]})" if faults else ""
    if len(frames) < 2 or display is None:
        what = "copy it again from its source" if faults else "give a longer film or a folder of photos"
        raise ValueError(
            f"film {path}: expected at least 2 frames, got {len(frames)} that can be decoded{fault}; {what}"
        )
    if faults:
        _logger.warning("film %s is damaged or truncated%s: its %d good frames are used", path, fault, len(frames))
    shown = (
        np.flatnonzero(~blank) if int((~blank).sum()) >= 2 else np.arange(len(frames))
    )  # fades and black leaders show nothing
    chosen = [int(shown[index]) for index in choose_frames(sharpness[shown], travelled[shown], most)]
    _logger.info("film %s: %d of %d frames chosen", path, len(chosen), len(frames))
    return Film(path, [frames[index] for index in chosen], display)


def choose_frames(sharpness: np.ndarray, travelled: np.ndarray, most: int) -> list[int]:
    """Indices of at most ``most`` frames: evenly along the way that the camera went, each the sharpest near its place.

    The way is cut into as many equal parts as frames are wanted. In the middle half of each part the sharpest frame is
    taken, so that two neighbours are apart by half a part to one and a half. Sharpness counts relative to the frames
    around, because a bare wall is not blurred. Where the film jumps over a part, none is taken, so that no two show the
    same.

    Args:
        sharpness: of each frame, at least 0.
        travelled: how far the camera has moved until each frame; never decreasing.
        most: how many frames are wanted.
    """
    count = len(travelled)
    if count <= most:
        return list(range(count))
    way = travelled - travelled[0]
    if way[-1] <= 0:  # nothing moves: evenly in time
        way = np.arange(count, dtype=float)
    part = way[-1] / most
    part_of = np.minimum((way / part).astype(int), most - 1)
    relative = sharpness / np.maximum(_local_median(sharpness), 1e-9)
    chosen: list[int] = []
    for index in range(most):
        here = np.flatnonzero(part_of == index)
        middle = here[np.abs(way[here] / part - index - 0.5) <= 0.25]
        if len(here):  # a part may be jumped over
            candidates = middle if len(middle) else here
            chosen.append(int(candidates[np.argmax(relative[candidates])]))
    return chosen


def _local_median(values: np.ndarray, reach: int = 15) -> np.ndarray:
    """The median of each value's neighbours up to ``reach`` places away."""
    padded = np.pad(values, reach, mode="reflect" if len(values) > reach else "edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1), axis=-1)


# ---- the first pass -------------------------------------------------------------------------------------------------


def _survey(
    path: Path, faults: list[str]
) -> tuple[list[FilmFrame], np.ndarray, np.ndarray, np.ndarray, Display | None]:
    """All frames that can be decoded, their sharpness, how far the camera has moved until each, which show nothing, and
    their display.
    """
    frames: list[FilmFrame] = []
    sharpness: list[float] = []
    way: list[float] = []
    blank: list[bool] = []
    display, start, group, odometer = None, 0.0, 0, _Odometer()
    announced, pixel_aspect = _header(path)  # refuses what is too large before anything is decoded
    for frame in _frames(path, faults):
        if frame.pts is None or frame.time is None or (frames and frame.pts <= frames[-1].pts):
            faults.append("some frames have no time; ffmpeg -i FILM film.mp4 writes it anew")
            continue
        if display is None:
            display, start = Display.of(frame, pixel_aspect), frame.time
            if getattr(frame, "color_trc", None) in _HDR:  # older releases of PyAV do not tell
                _logger.warning(
                    "film %s has HDR colours, which are used as they are: pale; export it as SDR for better ones", path
                )
        group += frame.key_frame
        frames.append(FilmFrame(number=len(frames), pts=frame.pts, seconds=frame.time - start, group=group))
        grey = _small_grey(frame)
        sharpness.append(_sharpness(grey))
        way.append(odometer.moved(grey))
        blank.append(float(grey.std()) < _BLANK)
    if frames and frames[-1].seconds < _LEAST_COMPLETE * announced - 1:
        faults.append(f"it ends after {frames[-1].seconds:.1f} of {announced:.1f} seconds")
    return frames, np.array(sharpness), np.array(way), np.array(blank, dtype=bool), display


class _Odometer:
    """Adds up how far the picture moves, in units of its longer side.

    Optical flow is measured from a reference frame that stays until the picture has moved clearly, so that noise of a
    camera at rest does not add up.
    """

    def __init__(self) -> None:
        import cv2

        self._flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._reference: np.ndarray | None = None
        self._until_reference = self._total = 0.0

    def moved(self, grey: np.ndarray) -> float:
        """The way until this frame, the next one of the film."""
        import cv2

        scale = _MOTION_SIDE / max(grey.shape)
        small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
        if self._reference is None:
            self._reference = small
            return 0.0
        flow = self._flow.calc(self._reference, small, None)
        step = min(float(np.linalg.norm(flow, axis=-1).mean()) / max(small.shape), _MOST_STEP)
        self._total = max(self._total, self._until_reference + step)
        if step > _NEW_REFERENCE:
            self._reference, self._until_reference = small, self._total
        return self._total


def _sharpness(grey: np.ndarray) -> float:
    """Variance of the Laplacian: how much fine detail there is."""
    import cv2

    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


# ---- decoding -------------------------------------------------------------------------------------------------------


def _frames(path: Path, faults: list[str], *, from_pts: int | None = None) -> Iterator[Any]:
    """PyAV's intact frames in order of time, one at a time. What goes wrong after the opening is told in ``faults``.

    Args:
        path: the film.
        faults: sentences are appended.
        from_pts: begin at the last key frame before this time stamp.
    """
    from av.error import FFmpegError

    with _opened(path) as container:
        stream = _pictures(container)
        stream.thread_type = "AUTO"
        if from_pts is not None:
            container.seek(from_pts, stream=stream, backward=True)
        packets = container.demux(stream)
        intact = True
        while True:
            try:
                packet = next(packets, None)
                decoded = [] if packet is None else packet.decode()
            except FFmpegError as error:
                faults.append(str(error))
                intact = False
                continue  # after an error of the container itself there is no next packet
            for frame in decoded:
                intact = not frame.is_corrupt and (
                    intact or frame.key_frame
                )  # what follows a damaged frame inherits the damage
                if intact:
                    yield frame
                else:
                    faults.append("some frames are damaged")
            if packet is None:
                return


def _opened(path: Path) -> Any:
    """PyAV's container of a file with at least one video track."""
    import av
    from av.error import FFmpegError

    require_text_name(path)
    try:
        container = av.open(str(path))
    except PermissionError:
        raise
    except (FFmpegError, OSError) as error:
        raise ValueError(
            f"film {path}: not readable as a film ({error.strerror}), expected MP4, MOV, MKV, WebM or AVI; was it "
            "copied completely?"
        ) from error
    if not container.streams.video:
        container.close()
        raise ValueError(f"film {path}: expected a film, got a file without pictures; choose another one")
    return container


def _pictures(container: Any) -> Any:
    """The video stream with the most pixels: films of some cameras begin with a small preview, and may carry a cover
    picture.
    """
    films = [
        stream
        for stream in container.streams.video
        if "attached_pic" not in str(getattr(stream, "disposition", "")).lower()
    ]
    return max(films or container.streams.video, key=lambda stream: (stream.width or 0) * (stream.height or 0))


def _header(path: Path) -> tuple[float, float]:
    """How many seconds the film lasts (0 = not told), and how wide a stored pixel is for its height.

    Raises ValueError for frames that are too large to be decoded here.
    """
    with _opened(path) as container:
        stream = _pictures(container)
        seconds = float(stream.duration * stream.time_base) if stream.duration else (container.duration or 0) / 1e6
        pixel_aspect = float(stream.sample_aspect_ratio or 1)
        require_decodable(
            f"film {path}", stream.height, stream.width * pixel_aspect, _HELD_CHANNELS, most=MOST_FILM_PIXELS
        )
        return seconds, pixel_aspect


def _small_grey(frame: Any) -> np.ndarray:
    """Brightness as stored (not turned), small enough to be cheap: uint8 [h, w]."""
    scale = min(1.0, _SHARPNESS_SIDE / max(frame.width, frame.height))
    width, height = (max(_LEAST_SIDE, round(side * scale)) for side in (frame.width, frame.height))
    grey = frame.reformat(width=width, height=height, format="gray8", interpolation="AREA").to_ndarray()
    return np.ascontiguousarray(grey)  # optical flow takes no rows with gaps, which some widths leave


def _pixels(frame: Any, display: Display) -> np.ndarray:
    """RGB as shown: uint8 [h, w, 3]."""
    height, width = display.size[::-1] if display.transposed else display.size
    array = to_rgb(frame, height, width)
    array = array.swapaxes(0, 1) if display.transposed else array
    right, down = display.matrix.sum(axis=0)  # of each column one number counts for turns by quarters
    return np.ascontiguousarray(array[:: 1 if down >= 0 else -1, :: 1 if right >= 0 else -1])
