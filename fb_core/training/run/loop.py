"""The training loop: optimiser, an average of the weights, exact resume; on one process or many, which then share each
step's batch.

Every random draw of a row of a batch comes from generators derived from (seed, step, row). So a run that was killed
continues as if it had not been, and so does one that is resumed by another number of processes, or in more or fewer
parts per step.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from fb_core.machine.precision import precision_in_words, resolved
from fb_core.networks.transformer.blocks import Block
from fb_core.networks.transformer.dit import DiT
from fb_core.networks.vae import Resnet
from fb_core.training.run.averaged import Averaged
from fb_core.training.run.checkpoints import Checkpoints
from fb_core.training.run.distributed import ALONE, Group, averaged_if, averaging, shard, sharded_like, whole
from fb_core.training.run.optimizers import clip_gradients, load_optimizer, make_optimizers
from fb_core.training.run.options import EngineConfig, LoopConfig
from fb_core.training.run.progress_log import ProgressLog
from fb_core.training.run.signals import StopSignal
from fb_core.training.run.stage import Stage

_logger = logging.getLogger(__name__)
OnProgress = Callable[[int, int, dict[str, float]], None]
"""(steps done, steps in all, latest smoothed losses)."""
OnSheet = Callable[[Path, dict[str, Tensor]], dict[str, float]]
"""Draws a sample sheet (a file to write) of the averaged weights, and says how good they are on unseen data."""


class _Step(nn.Module):
    """A stage's losses as a module's forward pass, which is what DistributedDataParallel wraps."""

    def __init__(self, stage: Stage):
        super().__init__()
        self.network, self.critic = stage.network, stage.critic
        self._losses = stage.losses

    def forward(self, drawn: Any) -> dict[str, Tensor]:
        return self._losses(drawn)


class Run:
    """A training run in a folder: ``checkpoint.pt`` and those before it, ``log.jsonl`` (losses), ``loss.png`` (curve),
    ``sheets``.
    """

    def __init__(
        self,
        stage: Stage,
        config: LoopConfig,
        folder: Path | None,
        *,
        preset: str = "",
        engine: EngineConfig = EngineConfig(),
        group: Group = ALONE,
        on_sheet: OnSheet | None = None,
    ):
        """Resumes what is in ``folder``; without one nothing is written.

        Raises ValueError for a batch that the processes cannot share equally, and for a checkpoint of another stage,
        preset or batch.
        """
        self.stage, self.config, self.folder, self.preset = stage, config, folder, preset
        self.engine, self.group, self._on_sheet = engine, group, on_sheet
        parts = group.size * engine.accumulate
        if stage.batch % parts:
            raise ValueError(
                f"{stage.name}: expected a batch that {group.size} processes can share equally in {engine.accumulate} "
                "parts each, "
                f"got {stage.batch}"
            )
        self.parts = [
            range(number * group.size + group.rank, stage.batch, parts) for number in range(engine.accumulate)
        ]
        """Rows that this process does, part by part."""
        sharded = engine.shard and group.size > 1 and isinstance(stage.network, DiT)
        if sharded and config.optimizer == "muon":
            raise ValueError("training: muon needs whole matrices; choose adamw for a sharded transformer")
        if engine.recompute:
            _recompute_blocks(stage.network)
        if sharded:
            shard(stage.network)  # type: ignore[arg-type]
        device = next(stage.network.parameters()).device
        self.dtype = resolved(engine.precision, device)
        """Precision of matrix products."""
        if engine.precision == "auto" and group.is_main:
            _logger.info("%s: matrix products in %s", stage.name, precision_in_words("auto", device))
        self.optimizers = self._optimizers()
        self._module = averaging(_Step(stage), group, sharded=sharded)
        self.average = Averaged(stage.network, config.average)
        self.step = 0
        self.seconds = 0.0
        self.waited = 0.0
        """Seconds of these in which data were made or waited for."""
        self.smoothed: dict[str, float] = {}
        self.signal = 0
        """The signal that ended the training early, if any."""
        self._ahead: tuple[int, Future] | None = None
        self._checkpoints: Checkpoints | None = None
        self._log: ProgressLog | None = None
        if folder is not None:
            self._open(folder)

    def _optimizers(self) -> list[torch.optim.Optimizer]:
        """Of the network, then of the critic, if there is one."""
        stage, config = self.stage, self.config
        each = {"learning_rate": config.learning_rate, "weight_decay": config.weight_decay, "betas": config.betas}
        optimizers = make_optimizers(stage.network, name=config.optimizer, iteration=self.dtype, **each)
        if stage.critic is not None:
            optimizers += make_optimizers(stage.critic, name="adamw", **each)
        return optimizers

    def _open(self, folder: Path) -> None:
        """Go on with what is in the folder, and write there from now on."""
        folder.mkdir(parents=True, exist_ok=True)
        self._checkpoints = Checkpoints(folder, self.engine.keep)
        if (path := self._checkpoints.find()) is not None:
            self._resume(path)
        self.group.wait()
        if self.group.is_main:
            tensorboard = self.engine.tensorboard
            self._log = ProgressLog(folder, self.stage.name, from_step=self.step, tensorboard=tensorboard)

    def train(
        self, *, on_progress: OnProgress | None = None, minutes: float = math.inf, at_most: int | None = None
    ) -> None:
        """Go on to the last step, or for ``at_most`` steps, or until the time is up or a signal comes; saves now and
        then and at the end.

        Raises FloatingPointError when a loss or gradient is not finite; the last checkpoint then still holds the last
        good state.
        """
        until = time.monotonic() + 60 * minutes
        last = self.config.steps if at_most is None else min(self.config.steps, self.step + at_most)
        self.stage.network.train()
        with StopSignal() as stop, ThreadPoolExecutor(1) as ahead:
            while self.step < last and not self.group.any(bool(stop.number) or time.monotonic() >= until):
                started = time.monotonic()
                losses = self._one_step(ahead)
                self.seconds += time.monotonic() - started
                self._tell(losses, time.monotonic() - started, on_progress)
                if self.step % self.config.save_every == 0:
                    self.save()
                if self.engine.sheet_every and self.step % self.engine.sheet_every == 0:
                    self._draw_sheet()
            self._ahead = None
            self.signal = int(max(self.group.gather(stop.number)))
        self.save()
        if self._log is not None:
            self._log.close()

    def averaged_state(self) -> dict[str, Tensor]:
        """The state to export: the average, or the last weights when averaging is off. All processes must ask."""
        return whole(self.average.values if self.config.average > 0 else self.stage.network.state_dict())

    def record(self) -> dict:
        """What is worth keeping about this run, for the exported model's ``info``."""
        return {"stage": self.stage.name, "steps": self.step, "seconds": round(self.seconds), "losses": self.smoothed}

    def _one_step(self, ahead: ThreadPoolExecutor) -> dict[str, float]:
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
            for parameters in optimizer.param_groups:
                parameters["lr"] = self.config.rate(self.step)
        parts_losses: list[dict[str, Tensor]] = []
        for number, rows in enumerate(self.parts):
            drawn = self._drawn(number, ahead)
            with averaged_if(self._module, self.stage.network, last=rows is self.parts[-1]):
                with self._autocast():
                    losses = self._module(drawn)
                (losses["loss"] / len(self.parts)).backward()
            parts_losses.append({name: value.detach() for name, value in losses.items()})
        means = {name: float(torch.stack([losses[name] for losses in parts_losses]).mean()) for name in parts_losses[0]}
        means = dict(zip(means, self.group.mean(list(means.values())), strict=True))
        self._require_finite("loss", means["loss"])
        self._require_finite("gradient's norm", clip_gradients(self.stage.network, self.config.clip))
        if self.stage.critic is not None:
            self._require_finite("critic's gradient's norm", clip_gradients(self.stage.critic, self.config.clip))
        for optimizer in self.optimizers:
            optimizer.step()
        self.average.update(self.stage.network)
        self.step += 1
        return means

    def _drawn(self, number: int, ahead: ThreadPoolExecutor) -> Any:
        """The data of a part of this step; with ``draw_ahead`` they are there already, and the next part's are
        begun.
        """
        began = time.monotonic()
        place = self.step * len(self.parts) + number
        if self._ahead is not None and self._ahead[0] == place:
            drawn = self._ahead[1].result()
        else:
            drawn = self._draw_place(place)
            if torch.cuda.is_initialized():
                torch.cuda.synchronize()  # so that rendering on the GPU counts as data's time, not as the network's
        if self.engine.draw_ahead and place + 1 < self.config.steps * len(self.parts):
            self._ahead = place + 1, ahead.submit(self._draw_place, place + 1)
        self.waited += time.monotonic() - began
        return drawn

    def _draw_place(self, place: int) -> Any:
        step, number = divmod(place, len(self.parts))
        return self.stage.draw(step, self.parts[number])

    def _autocast(self) -> torch.autocast:
        device = next(self.stage.network.parameters()).device.type
        return torch.autocast(device, torch.bfloat16, enabled=self.dtype == torch.bfloat16)

    def _tell(self, losses: dict[str, float], seconds: float, on_progress: OnProgress | None) -> None:
        keep = min(0.98, 1 - 1 / self.step)
        self.smoothed = {
            name: keep * self.smoothed.get(name, value) + (1 - keep) * value for name, value in losses.items()
        }
        if self._log is not None:
            speed = {"steps per second": 1 / max(seconds, 1e-9), "data share": self.waited / max(self.seconds, 1e-9)}
            self._log.add(self.step, losses, speed)
        if on_progress is not None:
            on_progress(self.step, self.config.steps, self.smoothed)

    def _require_finite(self, what: str, value: float) -> None:
        if math.isfinite(value):
            return
        where = self._checkpoints.find() if self._checkpoints is not None else None
        last_state = f"the last good state is {where}" if where else "there is no checkpoint yet"
        rows = ", ".join(map(str, sorted(row for rows in self.group.gather(self._bad_rows()) for row in rows)))
        blamed = f" (rows {rows} of the batch)" if rows else ""
        raise FloatingPointError(
            f"{self.stage.name}: the {what} became {value} at step {self.step}{blamed}; {last_state}"
        )

    @torch.no_grad()
    def _bad_rows(self) -> list[int]:
        """Which of this process's rows have a loss that is not finite, each by itself."""
        bad = []
        for row in (row for rows in self.parts for row in rows):
            with self._autocast():
                loss = self.stage.losses(self.stage.draw(self.step, range(row, self.stage.batch, self.stage.batch)))[
                    "loss"
                ]
            if not bool(torch.isfinite(loss)):
                bad.append(row)
        return bad

    def _draw_sheet(self) -> None:
        """All processes come here, as the average may be spread over them; one draws."""
        state = self.averaged_state()
        if self.group.is_main and self._on_sheet is not None and self.folder is not None:
            path = self.folder / "sheets" / f"{self.step:06d}.png"
            path.parent.mkdir(exist_ok=True)
            measured = self._on_sheet(path, state)
            if self._log is not None:
                self._log.add_validation(self.step, measured)
        self.group.wait()

    def save(self) -> None:
        """Write the checkpoint; all processes come here, one writes. A kill or a full disk meanwhile leaves the
        previous one whole.
        """
        if self._checkpoints is None:
            return
        parts = {
            "network": self.stage.network.state_dict(),
            "optimizer": [optimizer.state_dict() for optimizer in self.optimizers],
            "average": self.average.values,
        } | ({} if self.stage.critic is None else {"critic": self.stage.critic.state_dict()})
        state = {
            "stage": self.stage.name,
            "preset": self.preset,
            "batch": self.stage.batch,
            "step": self.step,
            "seconds": self.seconds,
            "waited": self.waited,
            "smoothed": self.smoothed,
            "average_updates": self.average.updates,
        } | whole(parts, keep=self.group.is_main)
        if self.group.is_main:
            self._checkpoints.write(state)
        self.group.wait()

    def _resume(self, path: Path) -> None:
        assert self._checkpoints is not None
        network, critic = self.stage.network, self.stage.critic
        state = self._checkpoints.read(path, next(network.parameters()).device)
        expected = {"stage": self.stage.name, "preset": self.preset, "batch": self.stage.batch}
        for what, mine in expected.items():
            theirs = state.get(what, mine)  # earlier checkpoints name their stage only
            if theirs != mine and theirs and mine:
                raise ValueError(f"{path} holds {what} {theirs!r}, expected {mine!r}; choose another output folder")
        try:
            _load(network, state["network"])
            if critic is not None:
                _load(critic, state["critic"])
        except (RuntimeError, KeyError) as error:
            raise ValueError(
                f"{path} was made by another preset than this one; choose another output folder ({error})"
            ) from error
        saved = state["optimizer"] if isinstance(state["optimizer"], list) else [state["optimizer"]]
        if len(saved) != len(self.optimizers):
            raise ValueError(
                f"{path} was made with another optimizer than {self.config.optimizer!r}; choose another output folder"
            )
        for optimizer, values in zip(self.optimizers, saved, strict=True):
            load_optimizer(optimizer, values)
        like = network.state_dict()
        self.average.values = {name: sharded_like(value, like[name]) for name, value in state["average"].items()}
        self.average.updates = state["average_updates"]
        self.step, self.seconds, self.waited = state["step"], state["seconds"], state.get("waited", 0.0)
        self.smoothed = state["smoothed"]
        _logger.info("%s: resumed at step %d from %s", self.stage.name, self.step, path)


def _load(network: nn.Module, state: dict[str, Tensor]) -> None:
    """Load whole weights into a network that may be spread over processes."""
    like = network.state_dict()
    network.load_state_dict(
        {name: sharded_like(value, like[name]) if name in like else value for name, value in state.items()}
    )


def _recompute_blocks(network: nn.Module) -> None:
    """Let every block forget its activations until the backward pass, which computes them again."""
    for block in network.modules():
        if isinstance(block, Block | Resnet):
            forward = block.forward

            def forgetting(*inputs: Any, _forward: Callable = forward) -> Any:
                return checkpoint(_forward, *inputs, use_reentrant=False)

            block.forward = forgetting  # type: ignore[method-assign]
