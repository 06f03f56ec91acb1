"""A training that ends itself by SIGKILL at a chosen moment of its generation. A child process of
test_killed_training.py.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from helpers.processes.ns_train import run_ns_train, toy_config

from fb_core.data import media
from fb_core.inpainter import Fillerbuster
from fb_nerfstudio import trainer
from fb_nerfstudio.trainer import FillerbusterTrainerConfig

ROUNDS = 3


def kill_config(data: Path, output: Path, model: Path, timestamp: str) -> FillerbusterTrainerConfig:
    """Anchors and two more rounds, on a capture whose points are not read, so that its photos are triangulated."""
    config = toy_config(data, output, model, timestamp)
    manager: Any = config.pipeline.datamanager
    manager.dataparser.load_3D_points, manager.start_points = False, 200
    manager.completion.densify_rounds, manager.completion.anchor_views = ROUNDS - 1, 2
    config.max_num_iterations = 2
    return config


def at_call(number: int, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which kills this process instead when it is called for this time."""
    calls = 0

    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)

    return call


def inside_the_second_round() -> None:
    """After the first of its denoising steps; before it come the trial on hidden views and the first round."""
    complete, passes = Fillerbuster.complete, 0

    def dying(self: Fillerbuster, views: Any, **options: Any) -> Any:
        nonlocal passes
        passes += 1
        if passes == 3:
            options["on_step"] = at_call(1, lambda *_: None)
        return complete(self, views, **options)

    Fillerbuster.complete = dying  # type: ignore[method-assign]


def while_a_checkpoint_is_written() -> None:
    """That of the second round: its file is there under another name, and torn."""
    replace = os.replace

    def dying(source: Any, target: Any) -> None:
        if str(target).endswith(".ckpt"):
            checkpoints.append(target)
            if len(checkpoints) == 3:  # the first is that of the trial on hidden views
                os.truncate(source, 1000)
                os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)

    checkpoints: list[Any] = []
    trainer.os.replace = dying  # type: ignore[attr-defined]


def while_the_capture_of_the_views_is_written() -> None:
    """After three pictures of the run's folder `completion`."""
    media.write_image = at_call(4, media.write_image)


MOMENTS = {
    one.__name__: one
    for one in (inside_the_second_round, while_a_checkpoint_is_written, while_the_capture_of_the_views_is_written)
}

if __name__ == "__main__":
    torch.set_num_threads(1)
    moment, data, output, model = sys.argv[1:]
    MOMENTS[moment]()
    run_ns_train(kill_config(Path(data), Path(output), Path(model), "killed"))
