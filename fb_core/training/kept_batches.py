"""Batches of a training, encoded once and kept in a folder, for all designs that learn from them, now or in a later
run.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from fb_core.conditioning import FACTOR, Conditioning
from fb_core.files.whole import whole_file
from fb_core.training.stages.dit_stage import DiTStage, Encoded


class Kept(NamedTuple):
    """A batch as it comes from the folder."""

    encoded: Encoded
    """Latents (in half precision on the way), what is told, and ray frames whether or not a network reads them."""
    log_distance: Float[Tensor, "b n 1 h w"] | None
    """Mean logarithm of the distances along the rays of a latent's pixels, in units of the raymaps' origins; None if
    unknown.
    """


class KeptBatches:
    """The first batches of a training, which are gone through again and again."""

    def __init__(self, stage: DiTStage, folder: Path, *, count: int, data: str):
        """``stage`` draws and encodes them; its network attends in ray frames. ``count`` is how many differ.

        ``data`` says what decides them beside the stage's seed, batch and task: the source and the autoencoders. Files
        of others in the folder are left alone. Raises ValueError for a stage whose batches would have no ray frames.
        """
        if not stage.network.config.ray_frames:
            raise ValueError(
                "kept batches: expected a stage whose network attends in ray frames, so that they are kept, too"
            )
        self.stage, self.folder, self.count = stage, folder, count
        name = f"{data} {stage.seed} {stage.batch} {stage.config.task} {stage.network.config.patch}"
        self._name = hashlib.sha256(name.encode()).hexdigest()[:16]

    def get(self, step: int) -> Kept:
        """All rows of the batch of a step; made where it is not in the folder."""
        number = step % self.count
        path = self._path(number)
        if not path.exists():
            self._make(number)
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}
        conditioning = Conditioning(channels=tensors["channels"], frames=tensors["frames"])
        return Kept(Encoded(tensors["data"], conditioning, None, None, None), tensors.get("log_distance"))

    def make(self, steps: int) -> None:
        """Encode what so many steps need and what is missing, so that trainings may be timed."""
        for number in range(min(steps, self.count)):
            if not self._path(number).exists():
                self._make(number)

    def _path(self, number: int) -> Path:
        return self.folder / f"{self._name}-{number:05d}.safetensors"

    def _make(self, number: int) -> None:
        rows = range(self.stage.batch)
        sequences = self.stage.sequences(number, rows)
        encoded = self.stage.encode(sequences, number, rows)
        frames = encoded.conditioning.frames
        if (
            encoded.image_weight is not None
            or encoded.rays_weight is not None
            or encoded.captions is not None
            or frames is None
        ):
            raise ValueError(
                "kept batches: expected sequences with ground truth everywhere and without captions, such as rooms"
            )
        tensors = {"data": encoded.data.half(), "channels": encoded.conditioning.channels.half(), "frames": frames}
        if sequences.distance is not None:
            tensors["log_distance"] = log_at_latents(sequences.distance)
        self.folder.mkdir(parents=True, exist_ok=True)
        with whole_file(self._path(number)) as unfinished:
            save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, unfinished)


def log_at_latents(distance: Float[Tensor, "b n 1 hp wp"]) -> Float[Tensor, "b n 1 h w"]:
    """Mean logarithm of the distances of each latent's pixels."""
    logs = distance.clamp(min=1e-6).log().flatten(0, 1)
    return torch.nn.functional.avg_pool2d(logs, FACTOR).unflatten(0, distance.shape[:2])
