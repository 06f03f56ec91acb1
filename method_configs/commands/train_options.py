"""What is asked of ``fillerbuster train``: one class for the command, for the worker, and for torchrun's entrance.

Plain values, so that reading a command line needs no torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from fb_core.data.training.named_data import TrainingData
from fb_core.files.limits import MOST_TRAINING_STEPS, require_between


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """What is asked of the command beside the preset and the folder; None and False leave what the preset says."""

    stage: Literal["all", "image-vae", "raymap-vae", "dit"] = "all"
    """One stage, or all three in turn."""
    steps: int | None = None
    """Steps per stage instead of the preset's."""
    minutes: float | None = None
    """Stop after so many minutes; a transformer that is not done by then is exported as it is."""
    device: str | None = None
    """Where to compute, e.g. cpu or cuda:1; by default a GPU if there is one."""
    half: bool = True
    """Store the model in half precision (the raymap autoencoder never is)."""
    precision: Literal["auto", "float32", "bfloat16"] | None = None
    """Of matrix products and convolutions instead of the preset's (auto: bfloat16 where it is faster); weights stay
    float32.
    """
    accumulate: int | None = None
    """Parts that each process does its share of a batch in, one after the other, to save memory."""
    recompute: bool = False
    """Keep no activations inside blocks, to save memory for a third more time."""
    shard: bool = False
    """Spread the transformer's weights over the processes (FSDP)."""
    sheet_every: int | None = None
    """Steps between sample sheets of an unseen room."""
    keep: int | None = None
    """Checkpoints kept."""
    tensorboard: bool = False
    """Also write TensorBoard's files."""
    dry_run: bool = False
    """Only say sizes, memory and speed of the stages here, measured in a few steps; nothing is written."""
    data: TrainingData = TrainingData()
    """Where the data lie."""
    start_from: Path | None = None
    """Model folder whose weights the training begins with; its autoencoders are kept as they are."""

    def __post_init__(self) -> None:
        for name in ("steps", "minutes", "accumulate", "keep"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected a positive number, got {value}")
        require_between("steps", self.steps or 1, 1, MOST_TRAINING_STEPS)

    @property
    def engine_changes(self) -> dict[str, Any]:
        """What is asked for instead of the preset's engine."""
        chosen = {name: getattr(self, name) for name in ("precision", "accumulate", "keep", "sheet_every")}
        flags = {name: getattr(self, name) for name in ("recompute", "shard", "tensorboard")}
        return {name: value for name, value in chosen.items() if value is not None} | {
            name: True for name, value in flags.items() if value
        }
