"""ns-train in this process, at toy size."""

from __future__ import annotations

import copy
import dataclasses
import importlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from fb_core.machine.interruption import signals_given_back
from fb_nerfstudio.trainer import FillerbusterTrainerConfig
from method_configs.splats import fillerbuster

# nerfstudio asks for the whole call stack once for each external method that it knows. Each frame of pytest's deep
# stack then costs a walk over all modules, 10 s together; a thread has a stack of its own, without these frames.
with ThreadPoolExecutor(1) as _thread:
    ns_train = _thread.submit(importlib.import_module, "nerfstudio.scripts.train").result()
writer = importlib.import_module("nerfstudio.utils.writer")  # which needs the other one first

ANCHORS, DENSIFIED = 3, 2


STEPS_AFTER_RESUME = 4


def toy_config(data: Path, output: Path, model: Path, timestamp: str) -> FillerbusterTrainerConfig:
    """The method as registered, with numbers that make it quick."""
    config = copy.deepcopy(fillerbuster.config)
    config.data, config.output_dir, config.timestamp, config.vis = data, output, timestamp, "tensorboard"
    config.machine.device_type = "cpu"
    config.max_num_iterations, config.steps_per_eval_image = STEPS_AFTER_RESUME, 2
    config.logging.local_writer.max_log_size, config.logging.steps_per_log = 0, 1
    config.pipeline.model.num_random = config.pipeline.model.max_gaussians = 600
    manager = config.pipeline.datamanager
    manager.completion = dataclasses.replace(
        manager.completion,
        model=model,
        at_step=0,
        anchor_views=ANCHORS,
        densify_rounds=1,
        densify_views=DENSIFIED,
        steps=2,
        max_seed_gaussians=50,
    )
    return config


def run_ns_train(config: FillerbusterTrainerConfig) -> None:
    """``ns-train``, whose log writers are global and would pile up, and which takes the signals for its own."""
    for everything in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
        everything.clear()
    with signals_given_back():
        ns_train.main(config)
