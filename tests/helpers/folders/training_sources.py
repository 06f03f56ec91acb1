"""Training data in miniature: how rows are drawn and compared."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import torch

from fb_core.data.training.task import TaskConfig
from fb_core.sampling.randomness import generator_of

TASK = TaskConfig(views=3, mixture="quarters")


def draws(step: int = 0, seed: int = 0):
    return partial(generator_of, seed, step)


def assert_same(first, second) -> None:
    for field in dataclasses.fields(first):
        one, other = getattr(first, field.name), getattr(second, field.name)
        assert torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other, field.name


def cube_and_no_mesh(folder: Path) -> Path:
    """A cube of six colours, and a file that is no mesh."""
    import trimesh

    cube = trimesh.creation.box(extents=(2, 2, 2))
    cube.visual.face_colors = np.array([[*(np.abs(n) * 200), 255] for n in cube.face_normals], dtype=np.uint8)
    cube.export(folder / "cube.ply")
    (folder / "broken.obj").write_text("this is no mesh")
    return folder
