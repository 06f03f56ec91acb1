"""Generated rounds kept by what decided them, so that the same inputs, seed and weights never generate twice.

A round's key is a SHA-256 over everything that decides its pictures: the sequence the model was given (known pixels,
masks, rays of the planned cameras among them), what sampling starts from, the seed, the prompt, the sampling options
and the content hash of the weights. The key names one file below the cache folder, which appears whole or not at all;
any number of runs may share the folder.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path

import torch
from jaxtyping import UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from fb_core.files.whole import whole_file
from fb_core.inpainter import SamplingConfig
from fb_core.views import Views

VERSION = 2
"""Of the key and of the files. To be raised whenever the same inputs come to give other pictures."""
_ONLY_HOW = ("memory_budget_bytes", "views_at_once")
"""Sampling options that cut the work without deciding what is generated."""
_IMAGES = "images"
_logger = logging.getLogger(__name__)


def round_key(
    sequence: Views,
    *,
    seed: int,
    sampling: SamplingConfig,
    model_hash: str,
    prompt: str = "",
    current: Views | None = None,
) -> str:
    """64 hexadecimal digits that are the same exactly when all that decides a round's pictures is.

    Args:
        sequence: known and unknown views as the model is given them. What stands in unknown pixels and rays does not
            count.
        seed: of the round.
        sampling: options; how the work is cut into pieces does not count.
        model_hash: content hash of the weights.
        prompt: text of the round.
        current: views that sampling starts from, if it does; what they do not know does not count.
    """
    options = {name: value for name, value in dataclasses.asdict(sampling).items() if name not in _ONLY_HOW}
    question = {
        "version": VERSION,
        "seed": seed,
        "sampling": options,
        "model": model_hash,
        "prompt": prompt,
        "shape": [*sequence.images.shape],
    }
    digest = hashlib.sha256(json.dumps(question, sort_keys=True, allow_nan=False).encode())
    for views in [sequence] if current is None else [sequence, current]:
        for part in _canonical_bytes(views):
            digest.update(part)
    return digest.hexdigest()


class CompletionCache:
    """A folder of generated rounds. Neither a broken file nor a full disk ends a run: both are said, and the round is
    generated.
    """

    def __init__(self, folder: Path):
        """The folder is made when the first round is kept. Raises ValueError when a file stands in its place."""
        if folder.exists() and not folder.is_dir():
            raise ValueError(f"completion.cache_dir: expected a folder, got the file {folder}; choose another path")
        self.folder = folder

    def path(self, key: str) -> Path:
        """The file of a round; 256 subfolders keep listings short."""
        return self.folder / key[:2] / f"{key}.safetensors"

    def find(self, key: str, *, views: int, size: int) -> UInt8[Tensor, "n h w 3"] | None:
        """The pictures that were kept for a key; None where there are none, or none that are whole."""
        path = self.path(key)
        if not path.exists():
            return None
        try:
            with safe_open(path, framework="pt") as file:
                images, metadata = file.get_tensor(_IMAGES), file.metadata() or {}
        except (SafetensorError, OSError, ValueError) as error:
            return _ignored(path, str(error))
        if images.dtype != torch.uint8 or tuple(images.shape) != (views, size, size, 3):
            return _ignored(
                path, f"expected {views} pictures of {size}x{size}, got {images.dtype} of shape {list(images.shape)}"
            )
        if metadata.get("key") != key or metadata.get("sha256") != _digest(images):
            return _ignored(path, "its content is not what its name and checksum say")
        return images

    def keep(self, key: str, images: UInt8[Tensor, "n h w 3"]) -> None:
        """Store a round's pictures, whole or not at all."""
        path, images = self.path(key), images.cpu().contiguous()
        try:
            with whole_file(path) as unfinished:
                save_file({_IMAGES: images}, unfinished, metadata={"key": key, "sha256": _digest(images)})
        except (SafetensorError, OSError) as error:
            _logger.warning(
                "completion.cache_dir: could not keep a round in %s (%s); the run goes on without", self.folder, error
            )


def _canonical_bytes(sequence: Views) -> Iterator[bytes]:
    """Masks, and float32 little-endian values where they are known; zeros elsewhere."""
    pairs = ((sequence.images, sequence.image_known), (sequence.raymaps, sequence.rays_known))
    for values, known in pairs:
        for tensor in (known, torch.where(known > 0, values, torch.zeros_like(values))):
            tensor = tensor.detach().cpu().float() + 0.0  # no negative zeros
            yield tensor.contiguous().numpy().astype("<f4", copy=False).tobytes()


def _digest(images: Tensor) -> str:
    return hashlib.sha256(images.numpy().tobytes()).hexdigest()


def _ignored(path: Path, reason: str) -> None:
    """Says that a file is of no use; it is replaced once the round has been generated."""
    _logger.warning("completion cache: ignoring %s (%s); the round is generated again", path, " ".join(reason.split()))
