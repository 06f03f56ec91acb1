"""Single pictures with captions as sequences of one view without a camera (paper, appendix "Single-view data
sampling").
"""

from __future__ import annotations

import io
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from fb_core.data import media
from fb_core.data.training.shard_stream import ShardStream, find_shards
from fb_core.data.training.task import Draw, Sequences, TaskConfig
from fb_core.files.json_files import parse_json
from fb_core.files.limits import require_decodable
from fb_core.masks import drop_conditioning, partly_known, wholly_known

_logger = logging.getLogger(__name__)
_READERS = 8  # rows read at a time
_PICTURES = ("jpg", "jpeg", "png", "webp")
_MAY_BE_TRANSPARENT = ("png", "webp")
_CAPTIONS = ("txt", "caption", "text")


@dataclass(frozen=True, kw_only=True)
class CaptionedConfig:
    """How captioned pictures become training data."""

    image_size: int = 256
    """Side of the square crops in pixels; the shorter side of a picture is scaled to it."""
    per_row: int = 13
    """Pictures in a row of the batch: as much work as a row's sequence of views (paper: 52 pictures for 4 sequences at
    256 pixels).
    """
    centered: float = 0.1
    """Odds that a crop is centred."""
    unknown: float = 0.5
    """Odds that the picture is wholly unknown, so that the caption alone decides; else it is partly known."""

    def __post_init__(self) -> None:
        if self.per_row < 1 or self.image_size < 16:
            raise ValueError(f"captioned images: expected per_row >= 1 and image_size >= 16, got {self}")


class CaptionedImages:
    """Pictures of WebDataset shards, each a sequence of its own. ``advance`` counts batches: batch k is read where
    batch k - 1 ended.
    """

    def __init__(self, shards: str, config: CaptionedConfig, *, seed: int, device: torch.device | str = "cpu"):
        """``shards`` is a folder or a pattern (see :func:`fb_core.data.training.shard_stream.find_shards`)."""
        self.shards, self.config, self.seed, self.device = find_shards(shards), config, seed, torch.device(device)
        self._streams: dict[tuple[int, int], ShardStream] = {}
        self._number = 0
        self._readers = ThreadPoolExecutor(_READERS, thread_name_prefix="shards")

    @property
    def views(self) -> int:
        """One."""
        return 1

    def advance(self, step: int, rows: range | None = None) -> None:
        """Go to batch number ``step``."""
        self._number = step

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """The crops of these rows."""
        return self.sequences(rows, TaskConfig(views=1), draw).images[:, 0]

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """There are none: raises ValueError."""
        raise ValueError(
            "images: single pictures have no cameras to learn raymaps from; give captures or meshes, or train on rooms"
        )

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """``per_row`` sequences of one view for each row; rays are neither known nor true."""
        parts = [
            part
            for row in self._readers.map(lambda row: self._row(row, rows.stop, task, draw(row)), rows)
            for part in row
        ]
        images, truth, known = (
            torch.stack([part[n] for part in parts])[:, None].to(self.device) for n in ("image", "truth", "known")
        )
        nothing = torch.zeros_like(known)
        return Sequences(
            images=images,
            raymaps=nothing.expand(-1, -1, 6, -1, -1),
            image_known=known * truth,
            rays_known=nothing,
            image_truth=None if bool((truth == 1).all()) else truth,
            rays_truth=nothing,
            captions=tuple(part["caption"] for part in parts),
        )

    def _row(self, row: int, rows: int, task: TaskConfig, generator: torch.Generator) -> list[dict[str, Any]]:
        count = self.config.per_row
        stream = self._streams.setdefault((row, rows), ShardStream(self.shards, row, rows, self.seed))
        read = [self._decoded(sample, generator) for sample in stream.take(self._number * count, count)]
        good = [one for one in read if one is not None]
        if not good:
            raise ValueError(f"images: none of {count} samples in a row could be read; see the log for their names")
        return [one | {"known": self._known(task, generator)} for one in (good * count)[:count]]

    def _decoded(self, sample: dict[str, Any], generator: torch.Generator) -> dict[str, Any] | None:
        """Picture and caption; a broken sample is told in the log, and others of its row take its place, so that
        positions stay.
        """
        place = torch.rand(3, generator=generator).tolist()
        try:
            image, truth = self._crop(*picture_of(sample), place)
            return {"image": image, "truth": truth, "caption": caption_of(sample)}
        except ValueError as error:
            _logger.warning("left out sample %s of shard %s: %s", sample.get("__key__"), sample.get("__url__"), error)
            return None

    def _crop(
        self, image: Float[Tensor, "3 h w"], truth: Float[Tensor, "1 h w"], place: list[float]
    ) -> tuple[Float[Tensor, "3 size size"], Float[Tensor, "1 size size"]]:
        size = self.config.image_size
        height, width = image.shape[1:]
        height, width = (max(size, round(side * size / min(height, width))) for side in (height, width))
        shares = (0.5, 0.5) if place[0] < self.config.centered else place[1:]
        top, left = (int(share * (side - size) + 0.5) for share, side in zip(shares, (height, width), strict=True))
        image, truth = wholly_known(image, truth, lambda channels: media.resize(channels, height, width))
        cut = (slice(None), slice(top, top + size), slice(left, left + size))
        return image[cut].clamp(0, 1), truth[cut]

    def _known(self, task: TaskConfig, generator: torch.Generator) -> Float[Tensor, "1 h w"]:
        size = self.config.image_size
        unknown = float(torch.rand((), generator=generator)) < self.config.unknown
        known = partly_known(size, size, generator=generator)
        dropped, _ = drop_conditioning(generator, share=task.dropout)
        return known * (not unknown) * (not dropped)


def picture_of(sample: dict[str, Any]) -> tuple[Float[Tensor, "3 h w"], Float[Tensor, "1 h w"]]:
    """A sample's picture, RGB in [0, 1], and 1 where it is opaque by half or more. Raises ValueError without one, or
    for a damaged one.
    """
    suffix = next((suffix for suffix in _PICTURES if suffix in sample), None)
    if suffix is None:
        raise ValueError(
            f"expected a picture ({', '.join(_PICTURES)}), got {sorted(key for key in sample if key[0] != '_')}"
        )
    import cv2

    _require_decodable(suffix, sample[suffix])
    data = np.frombuffer(sample[suffix], dtype=np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError(f"its {suffix} is damaged")
    stored = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if suffix in _MAY_BE_TRANSPARENT else pixels
    opaque = np.ones(pixels.shape[:2], dtype=np.float32)
    if stored is not None and stored.ndim == 3 and stored.shape[2] == 4:
        stored = stored.astype(np.float32) / (257 if stored.dtype == np.uint16 else 1)
        opaque = (stored[:, :, 3] >= 127.5).astype(np.float32)
        pixels = stored[
            :, :, :3
        ]  # both from the same reading: OpenCV turns opaque pictures alone as their EXIF tags say
    image = rearrange(torch.from_numpy(np.ascontiguousarray(pixels[:, :, ::-1])), "h w c -> c h w").float() / 255
    return image, torch.from_numpy(opaque)[None]


def _require_decodable(suffix: str, data: bytes) -> None:
    """Raises ValueError for a picture that is too large, by its header. What is no picture at all is left to the
    decoder.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data)) as image:
            width, height = image.size
    except Image.DecompressionBombError as error:  # Pillow's own bound is lower than ours
        raise ValueError(f"its {suffix} has too many pixels ({error}); make it smaller") from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
        return
    require_decodable(f"its {suffix}", height, width, 4)


def caption_of(sample: dict[str, Any]) -> str:
    """A sample's text: a text file, or "caption" or "text" of a JSON file; empty without any. Raises ValueError for bad
    JSON.
    """
    for suffix in _CAPTIONS:
        if suffix in sample:
            return sample[suffix].decode("utf-8", errors="replace").strip()
    if "json" not in sample:
        return ""
    try:
        entry = parse_json(sample["json"])
    except ValueError as error:
        raise ValueError(f"its json is damaged ({error})") from error
    return str(entry.get("caption") or entry.get("text") or "") if isinstance(entry, dict) else ""
