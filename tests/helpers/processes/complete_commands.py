"""``fillerbuster complete`` in this process."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from helpers.textured_box import render

from fb_core.data.capture.captures import FrameToWrite, write_capture
from fb_core.data.capture.point_cloud import Points
from fb_core.geometry.cameras import Pinholes
from method_configs.commands import command_line as commands

QUICK = ("--frames", "model", "--views", 5, "--steps", 1, "--no-check")


def complete(source: Path, output: Path, model: Path, *options: object) -> dict:
    commands.main(
        ["complete", str(source), "--output", str(output), "--model", str(model), *map(str, (*QUICK, *options))]
    )
    return json.loads((output / "report.json").read_text())


def refusal(capsys: pytest.CaptureFixture, source: Path, output: Path, model: Path, *options: object) -> str:
    """The one sentence on stderr with which the command refuses."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        complete(source, output, model, *options)
    told = capsys.readouterr().err.strip().splitlines()
    assert stopped.value.code == 1 and not any("Traceback" in line for line in told)
    assert told[-1].startswith("Error: ") and len(told[-1]) < 600
    return told[-1]


def posed(folder: Path, cameras: Pinholes, *, points: bool = False, name: str = "photo") -> Path:
    pictures = render(cameras)
    frames = [
        FrameToWrite(name=f"{name}_{i:03d}", image=pictures[i], camera=cameras[i].to(torch.float64))
        for i in range(len(cameras))
    ]
    cloud = Points(positions=torch.rand(20, 3), colors=torch.rand(20, 3)) if points else None
    return write_capture(folder, frames, points=cloud, extra={"applied_scale": 2.0}).root


def _folder(path: Path) -> Path:
    path.mkdir(exist_ok=True)
    return path
