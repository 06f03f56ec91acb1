"""Learning rates as plain Python floats, so that checkpoints load with ``weights_only=True``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from nerfstudio.engine.schedulers import ExponentialDecayScheduler, ExponentialDecaySchedulerConfig
from torch.optim.lr_scheduler import LambdaLR


@dataclass
class FloatExponentialDecaySchedulerConfig(ExponentialDecaySchedulerConfig):
    """nerfstudio's exponential decay with warm-up; its values are Python floats instead of numpy's."""

    _target: type = field(default_factory=lambda: FloatExponentialDecayScheduler)
    """target class to instantiate"""


class FloatExponentialDecayScheduler(ExponentialDecayScheduler):
    """The same curve as nerfstudio's scheduler.

    nerfstudio 1.1.5 computes rates with numpy; the numpy scalars end up in the optimizer and scheduler states, and
    ``torch.load`` then refuses the checkpoint (nerfstudio issue 3683). Floats need no exception from that safety.
    """

    config: FloatExponentialDecaySchedulerConfig

    def learning_rate(self, step: int, lr_init: float) -> float:
        """Learning rate at ``step``: a ramp from ``lr_pre_warmup`` to ``lr_init``, then exponential decay to
        ``lr_final``.
        """
        config = self.config
        if step < config.warmup_steps:
            progress = min(max(step / config.warmup_steps, 0.0), 1.0)
            ramp = math.sin(0.5 * math.pi * progress) if config.ramp == "cosine" else progress
            return config.lr_pre_warmup + (lr_init - config.lr_pre_warmup) * ramp
        lr_final = lr_init if config.lr_final is None else config.lr_final
        progress = min(max((step - config.warmup_steps) / (config.max_steps - config.warmup_steps), 0.0), 1.0)
        return math.exp(math.log(lr_init) * (1.0 - progress) + math.log(lr_final) * progress)

    def get_scheduler(self, optimizer: torch.optim.Optimizer, lr_init: float) -> LambdaLR:
        """A scheduler whose multiplier reproduces :meth:`learning_rate`."""
        return LambdaLR(optimizer, lr_lambda=lambda step: self.learning_rate(step, lr_init) / lr_init)
