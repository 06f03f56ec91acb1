"""nerfstudio's trainer, careful with files: bad input leaves nothing behind, and a kill leaves whole checkpoints."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
import torch
import yaml
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from fb_core.files.faults import telling
from fb_core.files.whole import swept, unfinished_beside, whole_file
from fb_core.interruption import stop_on_signals
from fb_nerfstudio.refusal import Refused, refuse_bad_capture, refuse_bad_model, refusing_what_cannot_be_written


@dataclass
class FillerbusterTrainerConfig(TrainerConfig):
    """nerfstudio's trainer options; capture and model are looked at before the run has a folder."""

    _target: type = field(default_factory=lambda: FillerbusterTrainer)
    """target class to instantiate"""

    def set_timestamp(self) -> None:
        """Name the run. This is the first thing ``ns-train`` does with its options, so it is here that bad input is refused."""
        stop_on_signals(self._stop)
        self.refuse_bad_input()
        super().set_timestamp()

    def _stop(self, number: int) -> NoReturn:
        """Ends the command with one line. A SystemExit: nerfstudio answers KeyboardInterrupt with a traceback and success.

        A second signal ends it at once, whatever is still being cleaned up: files are whole or absent in any case.
        """
        signal.signal(number, signal.SIG_DFL)
        self.logging.profiler = "none"  # nerfstudio would print its table below
        checkpoints = self.get_checkpoint_dir() if any(self.get_checkpoint_dir().glob("step-*.ckpt")) else self.load_dir
        advice = "nothing was saved yet" if checkpoints is None else f"go on with --load-dir {checkpoints}"
        sys.stderr.write(f"\nStopped; {advice}.\n")
        raise SystemExit(128 + number)

    def refuse_bad_input(self) -> None:
        """Raises Refused with one sentence for what cannot be trained on: devices, capture, model folder, checkpoint to go on from.

        Where a run goes on from a checkpoint the model may be gone: it is needed only if generated views are still missing there.
        """
        datamanager: Any = self.pipeline.datamanager
        processes = self.machine.num_devices * self.machine.num_machines
        if processes != 1:
            raise Refused(f"machine: fillerbuster trains in one process, got {processes}; use --machine.num-devices 1")
        refuse_bad_capture(datamanager)
        if self.load_dir is None and self.load_checkpoint is None:
            refuse_bad_model(datamanager.completion)
        elif self.load_dir is not None and not any(self.load_dir.glob("step-*.ckpt")):
            raise Refused(f"load_dir {self.load_dir}: no checkpoint (step-*.ckpt) there; give a run's folder nerfstudio_models")
        elif self.load_checkpoint is not None and not self.load_checkpoint.is_file():
            raise Refused(f"load_checkpoint {self.load_checkpoint}: no such file; check the path")

    def save_config(self) -> None:
        """As nerfstudio, whole or not at all. Raises Refused with one sentence when it cannot be written."""
        folder = self.get_base_dir()
        CONSOLE.log(f"Saving config to: {folder / 'config.yml'}")
        with refusing_what_cannot_be_written(folder), whole_file(folder / "config.yml") as unfinished:
            unfinished.write_text(yaml.dump(self), "utf8")


class FillerbusterTrainer(Trainer):
    """Saves checkpoints whole or not at all, so that a run that was killed at any moment can go on, on a CPU to the same bits."""

    config: FillerbusterTrainerConfig

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """As nerfstudio. A run that goes on takes its Gaussians from the checkpoint: no start is sought for it."""
        datamanager: Any = self.config.pipeline.datamanager
        goes_on = self.config.load_dir is not None or self.config.load_checkpoint is not None
        wanted = datamanager.start_points
        try:
            datamanager.start_points = 0 if goes_on else wanted
            with refusing_what_cannot_be_written(self.base_dir):
                super().setup(test_mode)
        finally:
            datamanager.start_points = wanted

    def train(self) -> None:
        """As nerfstudio. A full disk ends the run with one sentence, whichever of its files could not be written."""
        with refusing_what_cannot_be_written(self.base_dir):
            super().train()

    def _load_checkpoint(self) -> None:
        """As nerfstudio, once it is known that the file holds plain values: older versions of torch run code that is in it."""
        given, folder, step = self.config.load_checkpoint, self.config.load_dir, self.config.load_step
        if folder is not None:
            given = max(folder.glob("step-*.ckpt")) if step is None else folder / f"step-{step:09d}.ckpt"
        if given is not None:
            swept(given.absolute().parent.parent)  # the run's folder, where a kill may have left half a checkpoint
            try:
                torch.load(given, map_location="cpu", weights_only=True, mmap=True)
            except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
                told = " ".join(str(error).split())[:200]
                raise Refused(f"checkpoint {given}: not readable as plain values ({told}); give one that ns-train has saved") from None
        super()._load_checkpoint()

    def _train_complete_viewer(self) -> None:
        """As nerfstudio, which shows the finished scene until Ctrl-C; that is then the regular end."""
        stop_on_signals(_end)
        super()._train_complete_viewer()

    def train_iteration(self, step: int) -> Any:
        """As nerfstudio. Backgrounds, splits and noise are drawn from the run's seed and the step alone, so a resumed run repeats them."""
        seed = np.random.SeedSequence([self.config.machine.seed, step]).generate_state(1, np.uint64)[0]
        torch.manual_seed(int(seed >> np.uint64(1)))
        return super().train_iteration(step)

    def save_checkpoint(self, step: int) -> None:
        """As nerfstudio, but written beside the earlier checkpoints and then renamed; only then are the earlier ones removed."""
        folder = Path(self.checkpoint_dir)
        with refusing_what_cannot_be_written(self.base_dir), unfinished_beside(folder) as work:
            self.checkpoint_dir = work / "new"
            try:
                with telling(folder / f"step-{step:09d}.ckpt", work / "new"):
                    super().save_checkpoint(step)
            finally:
                self.checkpoint_dir = folder
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted((work / "new").glob("*.ckpt")):
                os.replace(path, folder / path.name)
                for old in folder.glob("*.ckpt") if self.config.save_only_latest_checkpoint else ():
                    if old.name != path.name:
                        old.unlink()


def _end(number: int) -> NoReturn:
    raise SystemExit(0)
