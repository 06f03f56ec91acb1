"""The training loop: AdamW, an average of the weights, exact resume, atomic checkpoints, a JSON log and a loss curve.

Every random draw of a step comes from generators derived from (seed, step), so a run that was killed continues as if it had not been.
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor, nn

_logger = logging.getLogger(__name__)
OnProgress = Callable[[int, int, dict[str, float]], None]
"""(steps done, steps in all, latest smoothed losses)."""


@runtime_checkable
class Stage(Protocol):
    """One thing that is trained: a network and the loss of a step."""

    @property
    def name(self) -> str: ...

    @property
    def network(self) -> nn.Module: ...

    def losses(self, step: int) -> dict[str, Tensor]:
        """Losses of step ``step``; the entry ``loss`` is what is minimised. Deterministic in the step."""
        ...


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """How a stage is optimised."""

    steps: int = 1000
    """Optimiser steps in all."""
    learning_rate: float = 6e-4
    """Peak learning rate of AdamW."""
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

    def __post_init__(self) -> None:
        if self.steps < 1 or self.save_every < 1:
            raise ValueError(f"training: steps and save_every must be at least 1, got {self.steps} and {self.save_every}")
        if not 0 <= self.cooldown <= 1 or not 0 <= self.average < 1:
            raise ValueError(f"training: cooldown must lie in [0, 1] and average in [0, 1), got {self.cooldown} and {self.average}")

    def rate(self, step: int) -> float:
        """Learning rate of step ``step`` (0-based)."""
        warm = min(1.0, (step + 1) / max(1, self.warmup_steps))
        left = (self.steps - step) / max(1.0, self.cooldown * self.steps)
        return self.learning_rate * min(warm, 1.0, max(0.0, left))


class Averaged:
    """Exponential average of a network's floating-point state, with the usual correction for the first steps."""

    def __init__(self, network: nn.Module, decay: float):
        self.decay, self.updates = decay, 0
        self.values = {name: value.detach().clone() for name, value in network.state_dict().items()}

    def update(self, network: nn.Module) -> None:
        """Take the network's present state in."""
        self.updates += 1
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        for name, value in network.state_dict().items():
            self.values[name].lerp_(value.detach(), 1 - decay)


class Run:
    """A training run in a folder: ``checkpoint.pt`` (resume), ``log.jsonl`` (losses), ``loss.png`` (curve)."""

    def __init__(self, stage: Stage, config: LoopConfig, folder: Path):
        self.stage, self.config, self.folder = stage, config, folder
        folder.mkdir(parents=True, exist_ok=True)
        matrices = [p for p in stage.network.parameters() if p.requires_grad and p.ndim >= 2]
        vectors = [p for p in stage.network.parameters() if p.requires_grad and p.ndim < 2]
        groups = [{"params": matrices, "weight_decay": config.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
        self.optimizer = torch.optim.AdamW(groups, lr=config.learning_rate, betas=config.betas, foreach=True)
        self.average = Averaged(stage.network, config.average)
        self.step = 0
        self.seconds = 0.0
        self.smoothed: dict[str, float] = {}
        if (folder / "checkpoint.pt").exists():
            self._resume()

    def train(self, *, on_progress: OnProgress | None = None, minutes: float = math.inf) -> None:
        """Go on to the last step (or until the time is up), saving now and then and at the end.

        Raises FloatingPointError when a loss is not finite; the last checkpoint then still holds the last good state.
        """
        begun = time.monotonic()
        self.stage.network.train()
        while self.step < self.config.steps and time.monotonic() - begun < 60 * minutes:
            started = time.monotonic()
            self._one_step()
            self.seconds += time.monotonic() - started
            if on_progress is not None:
                on_progress(self.step, self.config.steps, self.smoothed)
            if self.step % self.config.save_every == 0:
                self.save()
        self.save()
        self._draw_curve()

    def averaged_state(self) -> dict[str, Tensor]:
        """The state to export: the average, or the last weights when averaging is off."""
        return self.average.values if self.config.average > 0 else self.stage.network.state_dict()

    def record(self) -> dict:
        """What is worth keeping about this run, for the exported model's ``info``."""
        return {"stage": self.stage.name, "steps": self.step, "seconds": round(self.seconds), "losses": self.smoothed}

    def _one_step(self) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.rate(self.step)
        losses = self.stage.losses(self.step)
        loss = losses["loss"]
        if not bool(torch.isfinite(loss)):
            raise FloatingPointError(
                f"{self.stage.name}: the loss became {float(loss.detach())} at step {self.step}; "
                f"the last good state is {self.folder / 'checkpoint.pt'}"
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.stage.network.parameters(), self.config.clip)
        self.optimizer.step()
        self.average.update(self.stage.network)
        self.step += 1
        values = {name: float(value.detach()) for name, value in losses.items()}
        keep = min(0.98, 1 - 1 / self.step)
        self.smoothed = {name: keep * self.smoothed.get(name, value) + (1 - keep) * value for name, value in values.items()}
        with (self.folder / "log.jsonl").open("a") as log:
            log.write(json.dumps({"step": self.step, **{name: round(value, 6) for name, value in values.items()}}) + "\n")

    def save(self) -> None:
        """Write the checkpoint; a kill or a full disk while writing leaves the previous one whole."""
        state = {
            "stage": self.stage.name,
            "step": self.step,
            "seconds": self.seconds,
            "smoothed": self.smoothed,
            "network": self.stage.network.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "average": self.average.values,
            "average_updates": self.average.updates,
        }
        temporary = self.folder / f"checkpoint.pt.{os.getpid()}"
        try:
            torch.save(state, temporary)
            temporary.replace(self.folder / "checkpoint.pt")
        finally:
            temporary.unlink(missing_ok=True)

    def _resume(self) -> None:
        path = self.folder / "checkpoint.pt"
        state = torch.load(path, weights_only=True, map_location=next(self.stage.network.parameters()).device)
        if state["stage"] != self.stage.name:
            raise ValueError(f"{path} holds stage {state['stage']!r}, expected {self.stage.name!r}; choose another output folder")
        try:
            self.stage.network.load_state_dict(state["network"])
        except RuntimeError as error:
            raise ValueError(f"{path} was made by another preset than this one; choose another output folder ({error})") from error
        self.optimizer.load_state_dict(state["optimizer"])
        self.average.values, self.average.updates = state["average"], state["average_updates"]
        self.step, self.seconds, self.smoothed = state["step"], state["seconds"], state["smoothed"]
        self._forget_after(self.step)
        _logger.info("%s: resumed at step %d from %s", self.stage.name, self.step, path)

    def _forget_after(self, step: int) -> None:
        """Drop the log's lines of steps that will be done again."""
        log = self.folder / "log.jsonl"
        if log.exists():
            kept = [line for line in log.read_text().splitlines() if line.endswith("}") and json.loads(line)["step"] <= step]
            log.write_text("".join(line + "\n" for line in kept))

    def _draw_curve(self) -> None:
        if not self.step:
            return
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot

        rows = [json.loads(line) for line in (self.folder / "log.jsonl").read_text().splitlines()]
        if len(rows) < 2:
            return
        figure, axes = pyplot.subplots(figsize=(6, 3.5), layout="constrained")
        width = max(1, len(rows) // 100)
        for name in rows[0]:
            if name != "step":
                values = [row[name] for row in rows]
                means = [sum(values[k : k + width]) / len(values[k : k + width]) for k in range(0, len(values), width)]
                axes.plot([rows[k]["step"] for k in range(0, len(rows), width)], means, label=name)
        axes.set(xlabel="step", ylabel="loss", yscale="log", title=self.stage.name)
        axes.legend()
        figure.savefig(self.folder / "loss.png", dpi=120)
        pyplot.close(figure)


def step_generator(seed: int, step: int, stream: int = 0, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator for one purpose (``stream``) of one step."""
    return torch.Generator(device=device).manual_seed((seed * 1_000_003 + step) * 101 + stream)
