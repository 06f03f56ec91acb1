"""Folders of runs as a training leaves them."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from fb_core.completion.results.completed_views import CompletedViews, Origin
from fb_core.geometry.cameras import Pinholes
from method_configs.commands import command_line as commands
from method_configs.splats import fillerbuster

GENERATED = 4


def generated_views(world_masks: bool = True) -> CompletedViews:
    """Four square views on a small ring in a run's world, of two rounds."""
    angles = torch.linspace(0, 4, GENERATED)
    centers = torch.stack([0.3 * angles.cos(), 0.3 * angles.sin(), 0.1 * angles], dim=1)
    cameras = Pinholes.looking_at(
        centers, centers * 5, up=torch.tensor([0.0, 0, 1]), fov_degrees=70.0, width=16, height=16
    )
    images = torch.randint(0, 256, (GENERATED, 16, 16, 3), generator=torch.Generator().manual_seed(0)).to(torch.uint8)
    masks = torch.ones(GENERATED, 16, 16, 1, dtype=torch.bool)
    masks[1, :4] = not world_masks
    origins = [
        Origin(role=role, round=number, seed=2**62 + number, prompt="", model_hash="ab" * 8)
        for role, number in (("anchor", 0), ("anchor", 0), ("densify", 1), ("densify", 1))
    ]
    return CompletedViews(images=images, masks=masks, cameras=cameras, origins=tuple(origins))


def make_run(folder: Path, data: Path, views: CompletedViews | None, *, finished: bool = True) -> Path:
    """A run's folder as ns-train leaves it, as far as exports read it."""
    config = copy.deepcopy(fillerbuster.config)
    config.data = config.pipeline.datamanager.data = data
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "config.yml").write_text(yaml.dump(config))
    generator = torch.Generator().manual_seed(1)
    gaussians = {
        "means": torch.randn(30, 3, generator=generator),
        "opacities": torch.linspace(-6, 3, 30)[:, None],
        "features_dc": torch.randn(30, 3, generator=generator),
    }
    pipeline: dict[str, Any] = {f"_model.gauss_params.{name}": value for name, value in gaussians.items()}
    pipeline["datamanager._extra_state"] = {
        "views": None if views is None else views.state(),
        "finished": finished,
        "captured_draws": 3,
    }
    torch.save({"step": 7, "pipeline": pipeline}, folder / "nerfstudio_models" / "step-000000007.ckpt")
    return folder


def changed(capture: Path, change: Callable[[dict], object]) -> None:
    """Change a capture's transforms.json in place."""
    meta = json.loads((capture / "transforms.json").read_text())
    change(meta)
    (capture / "transforms.json").write_text(json.dumps(meta))


def export(run: Path, format: str, *options: object) -> Path:
    commands.main(["export", str(run), "--format", format, *map(str, options)])
    return run / f"export-{format}"


def refusal(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """The one sentence with which the command refuses."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        commands.main(["export", *map(str, arguments)])
    told = capsys.readouterr().err.strip()
    assert stopped.value.code == 1 and "Traceback" not in told and "\n" not in told
    return told
