"""Refusals of a training that would go on."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from helpers.plugin.bad_input import config_for
from helpers.processes.ns_train import ns_train

from fb_core.files.faults import Refused
from fb_nerfstudio.trainer import FillerbusterTrainerConfig

STEP = 7


def options(data: Path, model: Path, output: Path, timestamp: str) -> FillerbusterTrainerConfig:
    config = config_for(data, model, output)
    config.timestamp = timestamp
    splats: Any = config.pipeline.model
    splats.sh_degree, splats.num_random, splats.max_gaussians, splats.random_init = 1, 60, 60, True
    splats.camera_optimizer.mode, splats.use_bilateral_grid, splats.grid_shape = "SO3xR3", True, (4, 4, 2)
    return config


def refusal(config: FillerbusterTrainerConfig) -> str:
    """One sentence, and no folder."""
    before = copy.deepcopy(config)
    with pytest.raises(Refused) as refused:
        ns_train.main(config)
    sentence = refused.value.code
    assert isinstance(sentence, str) and "\n" not in sentence and len(sentence) < 600
    assert not before.get_base_dir().exists()
    return sentence
