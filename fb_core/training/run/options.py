"""How a stage is optimised, and how the machine does it."""

from __future__ import annotations

from dataclasses import dataclass

from fb_core.files.limits import MOST_TRAINING_STEPS, require_between
from fb_core.machine.precision import PRECISIONS, Precision
from fb_core.training.run.optimizers import OPTIMIZERS, OptimizerName


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """How a stage is optimised."""

    steps: int = 1000
    """Optimiser steps in all."""
    learning_rate: float = 6e-4
    """Peak learning rate."""
    warmup_steps: int = 50
    """Steps over which the rate rises linearly from 0."""
    cooldown: float = 0.2
    """Share of the steps, at the end, over which the rate falls linearly to 0."""
    weight_decay: float = 1e-2
    """Decoupled weight decay of matrices (never of norms and biases)."""
    betas: tuple[float, float] = (0.9, 0.98)
    """Decay rates of AdamW's moments."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    average: float = 0.998
    """Decay per step of the exponential average of the weights that is exported; 0 exports the last weights."""
    save_every: int = 200
    """Steps between checkpoints."""
    optimizer: OptimizerName = "adamw"
    """adamw, or muon for the matrices of the transformer's blocks."""

    def __post_init__(self) -> None:
        if self.steps < 1 or self.save_every < 1:
            raise ValueError(
                f"training: steps and save_every must be at least 1, got {self.steps} and {self.save_every}"
            )
        require_between("training: steps", self.steps, 1, MOST_TRAINING_STEPS)
        if not 0 <= self.cooldown <= 1 or not 0 <= self.average < 1:
            raise ValueError(
                f"training: cooldown must lie in [0, 1] and average in [0, 1), got {self.cooldown} and {self.average}"
            )
        if self.optimizer not in OPTIMIZERS:
            raise ValueError(f"training: expected an optimizer out of {list(OPTIMIZERS)}, got {self.optimizer!r}")

    def rate(self, step: int) -> float:
        """Learning rate of step ``step`` (0-based)."""
        warm = min(1.0, (step + 1) / max(1, self.warmup_steps))
        left = (self.steps - step) / max(1.0, self.cooldown * self.steps)
        return self.learning_rate * min(warm, 1.0, max(0.0, left))


@dataclass(frozen=True, kw_only=True)
class EngineConfig:
    """How the machine does it; but for rounding, none of this changes what is learned."""

    precision: Precision = "float32"
    """Of matrix products and convolutions (autocast), of the frozen autoencoders' too, and of Muon's iteration;
    weights, their average, norms and losses stay in float32. 'auto' is bfloat16 where the device is faster at it.
    """
    accumulate: int = 1
    """Parts that a process does its rows of a batch in, one after the other."""
    recompute: bool = False
    """Keep no activations inside blocks; compute them again in the backward pass."""
    shard: bool = False
    """Spread the transformer over the processes (FSDP) instead of holding it whole on each."""
    draw_ahead: bool = False
    """Prepare the next step's data in another thread; pays where data are made on the CPU for a GPU."""
    keep: int = 2
    """Checkpoints kept, the newest included."""
    sheet_every: int = 0
    """Steps between sample sheets; 0 for none."""
    tensorboard: bool = False
    """Write TensorBoard's files beside log.jsonl."""

    def __post_init__(self) -> None:
        if self.accumulate < 1 or self.keep < 1 or self.sheet_every < 0:
            raise ValueError(f"training: accumulate and keep must be at least 1 and sheet_every at least 0, got {self}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"training: expected a precision out of {', '.join(PRECISIONS)}, got {self.precision!r}")
