"""nerfstudio's trainer, careful with files: bad input leaves nothing behind, and a kill leaves whole checkpoints."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NoReturn, Protocol, cast

import numpy as np
import torch
import yaml
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from fb_core.files.faults import Refused, telling
from fb_core.files.whole import swept, unfinished_beside, whole_file
from fb_core.machine.interruption import stop_on_signals
from fb_nerfstudio.checks.going_on import (
    check_capture,
    check_options_beside_a_file,
    check_shapes,
    checkpoint_of,
    parsed,
    read_checkpoint,
)
from fb_nerfstudio.checks.run_folder import claim_for, take_away
from fb_nerfstudio.generation.surroundings import refusing
from fb_nerfstudio.refusal import refuse_bad_capture, refuse_bad_model, refusing_what_cannot_be_written


@dataclass
class FillerbusterTrainerConfig(TrainerConfig):
    """nerfstudio's trainer options; capture and model are looked at before the run has a folder."""

    _target: type = field(default_factory=lambda: FillerbusterTrainer)
    """target class to instantiate"""
    other_capture: bool = False
    """Go on from a checkpoint although the capture is another than the one it was trained on."""

    def set_timestamp(self) -> None:
        """Name the run. This is the first thing ``ns-train`` does with its options, so it is here that bad input is
        refused.
        """
        stop_on_signals(self._stop)
        self.refuse_bad_input()
        with refusing(), refusing_what_cannot_be_written(self.output_dir):
            claim_for(self, checkpoint_of(self))

    def _stop(self, number: int) -> NoReturn:
        """Ends the command with one line. A SystemExit: nerfstudio answers KeyboardInterrupt with a traceback and
        success.

        A second signal ends it at once, whatever is still being cleaned up: files are whole or absent in any case.
        """
        signal.signal(number, signal.SIG_DFL)
        self.logging.profiler = "none"  # nerfstudio would print its table below
        checkpoints = self.get_checkpoint_dir() if any(self.get_checkpoint_dir().glob("step-*.ckpt")) else self.load_dir
        if checkpoints is not None:
            advice = f"go on with --load-dir {checkpoints}"
        else:
            advice = (
                "nothing was saved yet"
                if self.load_checkpoint is None
                else f"go on with --load-checkpoint {self.load_checkpoint}"
            )
        sys.stderr.write(f"\nStopped; {advice}.\n")
        raise SystemExit(128 + number)

    def refuse_bad_input(self) -> None:
        """Raises Refused with one sentence for what cannot be trained on: devices, capture, model folder, checkpoint to
        go on from.

        Where a run goes on from a checkpoint the model may be gone: it is needed only if generated views are still
        missing there.
        """
        datamanager: Any = self.pipeline.datamanager
        processes = self.machine.num_devices * self.machine.num_machines
        if processes != 1:
            raise Refused(f"machine: fillerbuster trains in one process, got {processes}; use --machine.num-devices 1")
        with refusing():
            check_options_beside_a_file(sys.argv)
            refuse_bad_capture(datamanager)
            checkpoint = checkpoint_of(self)
            if checkpoint is None:
                refuse_bad_model(datamanager.completion)
            outputs = parsed(datamanager)
            if checkpoint is not None:
                state = read_checkpoint(checkpoint)
                check_capture(self, checkpoint, state, outputs)
                check_shapes(self, checkpoint, state, len(outputs.image_filenames))

    def save_config(self) -> None:
        """As nerfstudio, whole or not at all. Raises Refused with one sentence when it cannot be written."""
        folder = self.get_base_dir()
        CONSOLE.log(f"Saving config to: {folder / 'config.yml'}")
        with refusing_what_cannot_be_written(folder), whole_file(folder / "config.yml") as unfinished:
            unfinished.write_text(yaml.dump(self), "utf8")


class _Generates(Protocol):
    """What the trainer needs of its datamanager (:mod:`fb_nerfstudio.datamanager`)."""

    at_work: bool
    """Whether views are being generated."""


class _AskedToStop(SystemExit):
    """A signal asks the training to end; nothing of its state is half changed."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.number = number


class FillerbusterTrainer(Trainer):
    """Saves checkpoints whole or not at all, so that a run that was killed at any moment can go on, on a CPU to the
    same bits.
    """

    config: FillerbusterTrainerConfig
    when_stopped: Callable[[int], NoReturn] | None = None
    """Called with the signal's number once a stopped training is saved; None: say how to go on, and end the process."""
    _in_step, _asked = False, 0
    _unsaved: int | None = None

    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        """As nerfstudio. A run that goes on takes its Gaussians from the checkpoint: no start is sought for it.

        A run that is refused here leaves no folder.
        """
        datamanager: Any = self.config.pipeline.datamanager
        goes_on = self.config.load_dir is not None or self.config.load_checkpoint is not None
        wanted = datamanager.start_points
        try:
            datamanager.start_points = 0 if goes_on else wanted
            with refusing_what_cannot_be_written(self.base_dir):
                super().setup(test_mode)
        except Refused:
            take_away(self.base_dir)
            raise
        finally:
            datamanager.start_points = wanted

    def train(self) -> None:
        """As nerfstudio. A full disk ends the run with one sentence, whichever of its files could not be written.

        Ctrl-C and SIGTERM end it after the step that is under way, with a checkpoint: no step is lost. While views are
        generated, or before a step was made, they end it at once; what was trained before the generation, and every
        whole round, is saved by then.
        """
        stop_on_signals(self._asked_to_stop)
        before, after = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        self.callbacks = [
            TrainingCallback([before], self._step_begins),
            *self.callbacks,
            TrainingCallback([after], self._step_ends),
        ]
        with refusing_what_cannot_be_written(self.base_dir):
            try:
                super().train()
            except _AskedToStop as asked:
                for number in (signal.SIGINT, signal.SIGTERM):
                    signal.signal(number, signal.SIG_DFL)
                self._keep_what_is_trained()
                self._stop(asked.number)

    def _stop(self, number: int) -> NoReturn:
        if self.when_stopped is not None:
            self.when_stopped(number)
        self.config._stop(number)

    def _asked_to_stop(self, number: int) -> None:
        """Called in the main thread when a signal comes. A second one ends the training at once, whatever it does."""
        if self._asked:
            self._stop(number)
        datamanager = cast(_Generates, self.pipeline.datamanager)
        if self._in_step and self._unsaved is not None and not datamanager.at_work:
            self._asked = number  # the step's tensors do not belong together before its end
        else:
            raise _AskedToStop(number)

    def _step_begins(self, step: int) -> None:
        self._in_step = True

    def _step_ends(self, step: int) -> None:
        self._in_step, self._unsaved = False, step
        if self._asked:
            raise _AskedToStop(self._asked)

    def generation_begins(self) -> None:
        """Called before views are generated, which may take long, or fail: what was trained is saved, or the training
        ends as asked.
        """
        self._keep_what_is_trained()
        if self._asked:
            raise _AskedToStop(self._asked)

    def _keep_what_is_trained(self) -> None:
        """Save the last whole step, if there is one that is not saved. Not to be called within a step that has changed
        anything.
        """
        if self._unsaved is not None:
            self.save_checkpoint(self._unsaved)

    def _load_checkpoint(self) -> None:
        """As nerfstudio, once it is known that the file holds plain values: older versions of torch run code that is in
        it.

        nerfstudio finds the latest by the names of whatever lies beside it, so it is told which file.
        """
        config = self.config
        given, folder = config.load_checkpoint, config.load_dir
        with refusing():
            path = checkpoint_of(config)
            if path is not None:
                swept(path.absolute().parent.parent)  # the run's folder, where a kill may have left half a checkpoint
                read_checkpoint(path)
        try:
            config.load_checkpoint, config.load_dir = path, None
            super()._load_checkpoint()
        except torch.OutOfMemoryError:
            raise
        except (KeyError, RuntimeError) as error:
            message = " ".join(str(error).split())[:200]
            raise Refused(
                f"checkpoint {path}: it does not fit the options ({message}); give those of its run, see its config.yml"
            ) from None
        finally:
            config.load_checkpoint, config.load_dir = given, folder
        if path is not None:
            self._say_if_it_has_too_many()

    def _say_if_it_has_too_many(self) -> None:
        """One sentence where a checkpoint has more Gaussians than the limit."""
        model: Any = self.pipeline.model
        limit = model.config.max_gaussians
        if limit is not None and model.num_points > limit:
            CONSOLE.print(
                f"The checkpoint has {model.num_points} Gaussians, more than --pipeline.model.max-gaussians {limit}: "
                "all of them stay, and "
                "none is added until pruning has left fewer."
            )

    def _train_complete_viewer(self) -> None:
        """As nerfstudio, which shows the finished scene until Ctrl-C; that is then the regular end."""
        stop_on_signals(_end)
        super()._train_complete_viewer()

    def train_iteration(self, step: int) -> Any:
        """As nerfstudio. Backgrounds, splits and noise are drawn from the run's seed and the step alone, so a resumed
        run repeats them.
        """
        seed = np.random.SeedSequence([self.config.machine.seed, step]).generate_state(1, np.uint64)[0]
        torch.manual_seed(int(seed >> np.uint64(1)))
        return super().train_iteration(step)

    def save_checkpoint(self, step: int) -> None:
        """As nerfstudio, but written beside the earlier checkpoints and then renamed; only then are the earlier ones
        removed.
        """
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
        self._unsaved = None


def _end(number: int) -> NoReturn:
    raise SystemExit(0)
