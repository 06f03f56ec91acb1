"""Real processes at the price of a fork: a server imports everything once, and each command runs and is killed in a
child.

The child goes the way of the console script from its first line to the interpreter's end. What it does to files is
counted by Python's own audit events (opened for writing, made, renamed, removed), and at the N-th of them it can send
itself a signal: the product has no hook.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[2]
_CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.truncate", "os.symlink"}
_PATIENCE_SECONDS = 240.0
_NO_FAULT = "nanobind:"  # begins what a library says at the end of a process whose objects are frozen
GENERATED = "a round was generated"
"""What a child of `_ns_train` says after each."""


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a command ended."""

    code: int
    """Exit code; minus the signal's number for a process that the signal ended."""
    seconds: float
    """From its start to its end."""
    events: int
    """Changes of files; 0 for a process that was killed."""
    said: str
    """Its stdout and stderr."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """When a signal comes: before the N-th change of a file (from 0), or after so many seconds."""

    signal: int
    event: int | None = None
    after: float | None = None

    def __str__(self) -> str:
        when = f"change {self.event}" if self.after is None else f"{self.after:.2f} s"
        return f"{signal.Signals(self.signal).name} at {when}"


class ForkServer:
    """The server's process, seen from a test."""

    def __init__(self, scratch: Path):
        self._scratch = scratch
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(HERE), str(HERE.parent)]),
            "CUDA_VISIBLE_DEVICES": "",
            "OMP_NUM_THREADS": "1",
            "COLUMNS": "1000",  # so that a line of the log is one
        }
        command = [sys.executable, str(Path(__file__).resolve())]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def run(self, job: dict[str, Any], *, watch: Path, moment: Moment | None = None) -> Ended:
        """Run a command (``argv``, or options of `_ns_train`) in the folder ``watch``, whose changes are counted."""
        assert self._process.stdin is not None and self._process.stdout is not None
        asked = {} if moment is None else {"signal": int(moment.signal), "event": moment.event, "after": moment.after}
        log = self._scratch / "log"
        self._process.stdin.write(
            json.dumps({**job, **asked, "watch": str(watch), "log": str(log)}, default=str) + "\n"
        )
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        assert answer, "the fork server has ended"
        return Ended(**json.loads(answer), said=log.read_text().partition(_NO_FAULT)[0])

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=60)


# ---- in the server --------------------------------------------------------------------------------------------------


def _preload() -> None:
    """Everything that commands import later, so that they need not."""
    import cv2
    import matplotlib.pyplot
    import OpenImageIO
    import pyvista
    import tensorboard.compat
    import torch
    import vtk
    from nerfstudio.scripts import train
    from torch.utils.tensorboard import SummaryWriter

    from fb_nerfstudio.runs import finished_run
    from method_configs import presets as ablations
    from method_configs.benchmarks.sampler import command as bench_sampler
    from method_configs.commands import (
        command_line as commands,
    )
    from method_configs.commands import (
        demo,
        sheet,
    )
    from method_configs.commands import (
        export as export_command,
    )
    from method_configs.commands import (
        training as training_command,
    )
    from method_configs.commands.complete import command as complete_command

    del cv2, matplotlib, OpenImageIO, pyvista, tensorboard, vtk, train, SummaryWriter
    del bench_sampler, commands, complete_command, demo, export_command, finished_run, sheet, training_command
    from helpers.tiny_training import TOY

    torch.set_num_threads(1)
    gc.collect()
    gc.freeze()  # a child then leaves all this alone: half a second for its end instead of three
    ablations.PRESETS["toy"] = TOY


def _serve() -> dict[str, Any] | None:
    """Answers requests; returns in a child with its job, and in the server with None when there are no more."""
    answers = os.fdopen(os.dup(1), "w")
    while line := sys.stdin.readline():
        job = json.loads(line)
        reader, writer = os.pipe()
        began = time.monotonic()
        child = os.fork()
        if child == 0:
            os.close(reader)
            _become(job, writer)
            return job
        os.close(writer)
        code = _waited(child, job, began)
        with os.fdopen(reader) as told:
            events = int(told.read() or 0)
        answers.write(json.dumps({"code": code, "seconds": time.monotonic() - began, "events": events}) + "\n")
        answers.flush()
    return None


def _waited(child: int, job: dict[str, Any], began: float) -> int:
    """The child's exit code, after its signal has been sent when its time comes."""
    due = job.get("after")
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        passed = time.monotonic() - began
        if due is not None and passed >= due:
            os.kill(child, job["signal"])
            due = None
        if passed > _PATIENCE_SECONDS:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.003)


def _become(job: dict[str, Any], writer: int) -> None:
    """Turn a fork of the server into a process that has just begun, with files and signals of its own; count its
    changes.
    """
    log = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for descriptor, target in ((nothing, 0), (log, 1), (log, 2)):
        os.dup2(descriptor, target)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os.chdir(job["watch"])
    _renew_threads()
    changes, main = 0, threading.get_ident()

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal changes
        if threading.get_ident() != main or not _is_change(event, arguments, job["watch"]):
            return
        if changes == job.get("event"):
            changes += 1
            os.kill(os.getpid(), job["signal"])
            return
        changes += 1

    sys.addaudithook(hook)
    atexit.register(lambda: os.write(writer, str(changes).encode()))


def _renew_threads() -> None:
    """torch makes its pool of threads anew at its first use after a fork, and two threads that come first at once meet
    none ("pool INTERNAL ASSERT FAILED"). A process that has just begun has no such moment.
    """
    import torch

    torch.set_num_threads(1)


def _is_change(event: str, arguments: tuple[Any, ...], folder: str) -> bool:
    """Whether an audit event is a change of a file below the folder (so are files named relative to a descriptor)."""
    if event == "ctypes.dlsym":
        return arguments[1] == "renameat2"
    if event == "open":
        path, mode, flags = arguments
        known = isinstance(flags, int)
        if not (flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) if known else set(mode or "") & set("wax+")):
            return False
    elif event in _CHANGES:
        path = arguments[0]
    else:
        return False
    if not isinstance(path, str | bytes | os.PathLike):
        return False
    path = os.fsdecode(path)
    return not os.path.isabs(path) or path.startswith(folder)


def _ns_train(options: dict[str, Any]) -> None:
    """What ``ns-train`` does once its command line is read: anchors and two more rounds amid a few steps."""
    from helpers.processes.killed_training import kill_config
    from helpers.processes.ns_train import run_ns_train

    from fb_core.inpainter import Fillerbuster

    config = kill_config(Path(options["data"]), Path(options["output"]), Path(options["model"]), options["timestamp"])
    complete = Fillerbuster.complete

    def told(*arguments: Any, **keywords: Any) -> Any:
        done = complete(*arguments, **keywords)
        print(GENERATED, flush=True)
        return done

    Fillerbuster.complete = told  # type: ignore[method-assign]
    config.max_num_iterations, config.steps_per_save, config.steps_per_eval_image = options["iterations"], 3, 10**6
    manager: Any = config.pipeline.datamanager
    manager.completion.at_step = options["at_step"]
    manager.completion.trust = "full"  # the trial on hidden views calls the model too, and is no round
    if options.get("cache"):
        manager.completion.cache_dir = Path(options["cache"])
    if options.get("load_dir"):
        config.load_dir = Path(options["load_dir"])
    run_ns_train(config)


def _work(job: dict[str, Any]) -> None:
    if "ns_train" in job:
        _ns_train(job["ns_train"])
        return
    from method_configs.entrance import main

    sys.argv = ["fillerbuster", *job["argv"]]
    main()


if __name__ == "__main__":
    _preload()
    mine = _serve()
    if mine is not None:
        _work(mine)
