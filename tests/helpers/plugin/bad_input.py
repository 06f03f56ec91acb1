"""ns-train started with options that may be bad."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path

from fb_nerfstudio.trainer import FillerbusterTrainerConfig
from method_configs.splats import fillerbuster


class Started(Exception):
    """The training would begin."""


def config_for(data: Path, model: Path | None, output: Path, method=fillerbuster) -> FillerbusterTrainerConfig:
    config = copy.deepcopy(method.config)
    config.data, config.output_dir, config.vis = data, output, "tensorboard"
    config.machine.device_type = "cpu"
    config.pipeline.datamanager.completion.model = model
    return config


def edit(folder: Path, change: Callable[[dict], None]) -> None:
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
