"""``fillerbuster complete`` as a scene, in miniature: splats of photos, a film of them, what of it was seen; a kill at any stage."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import av
import pytest
import torch
from textured_box import cameras_on_an_arc, render, save_photos
from tiny_models import save_tiny_model

from fb_core.data import media
from fb_core.data.captures import FrameToWrite, read_capture, validate_capture, write_capture
from fb_core.evaluation.camera_figure import draw_cameras
from fb_core.evaluation.contact_sheet import write_contact_sheet
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.splat_backend import BLUR, render_splats
from fb_nerfstudio.splat_file import Splats, read_splats
from method_configs import commands, complete_output, complete_scene

QUICK = ("--views", 3, "--steps", 1, "--iterations", 4, "--photo-size", 32, "--film-size", 32)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_model(tmp_path_factory.mktemp("tiny") / "model", image_size=16)


@pytest.fixture(autouse=True)
def small_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(complete_output, "draw_cameras", functools.partial(draw_cameras, size=(120, 80)))
    monkeypatch.setattr(complete_output, "write_contact_sheet", functools.partial(write_contact_sheet, dpi=20))
    monkeypatch.delenv(commands.DEBUG_VARIABLE, raising=False)


def complete(source: Path, output: Path, model: Path, *options: object) -> dict[str, Any]:
    commands.main(["complete", str(source), "--output", str(output), "--model", str(model), *map(str, (*QUICK, *options))])
    return json.loads((output / "report.json").read_text())


def posed(folder: Path, cameras: Pinholes) -> Path:
    pictures = render(cameras)
    frames = [FrameToWrite(name=f"photo_{i:03d}", image=pictures[i], camera=cameras[i].to(torch.float64)) for i in range(len(cameras))]
    return write_capture(folder, frames).root


def test_the_film_is_the_render_of_the_exported_splats_along_the_path(tmp_path: Path, model: Path, monkeypatch) -> None:
    kept: dict[int, torch.Tensor] = {}
    draw = complete_scene._keep_frame
    monkeypatch.setattr(complete_scene, "_keep_frame", lambda film, n, frame: (kept.update({n: frame.image}), draw(film, n, frame)))
    source = posed(tmp_path / "capture", cameras_on_an_arc(6, width=40, height=30))
    report = complete(source, tmp_path / "out", model)
    film, splats = report["film"], read_splats(tmp_path / "out" / "splats.ply")
    assert (film["width"], film["height"]) == (32, 24) and len(film["frames"]) == 3 and len(splats) == report["splats"]["gaussians"] > 0
    for number, told in enumerate(film["frames"]):
        camera = Pinholes(
            camera_to_world=torch.tensor([told["camera_to_world"]]), focal=torch.tensor([told["focal"]]),
            principal=torch.tensor([[16.0, 12.0]]), width=32, height=24,
        )  # fmt: skip
        picture = _picture(splats, camera)
        assert torch.allclose(kept[number], picture, atol=2e-5)
        assert told["seen"] + told["generated"] + told["empty"] == pytest.approx(1, abs=1e-5)
        assert min(told["seen"], told["generated"], told["empty"]) >= 0
    assert sum(film[name] for name in ("seen", "generated", "empty")) == pytest.approx(1, abs=1e-5)
    after = validate_capture(tmp_path / "out", decode=True)
    assert sum(not frame.generated for frame in after.frames) == 6
    for name in ("fly-through.mp4", "trust.mp4"):
        with av.open(str(tmp_path / "out" / name)) as file:
            assert len(list(file.decode(video=0))) == 3
    assert (tmp_path / "out" / "sheet.png").is_file() and [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def _picture(splats: Splats, camera: Pinholes) -> torch.Tensor:
    """As any viewer of such files draws it."""
    drawn = render_splats(
        means=splats.means, quats=splats.quats, scales=splats.log_scales.exp(), opacities=splats.logits.sigmoid(), colors=splats.harmonics,
        viewmats=camera.world_to_camera, Ks=camera.intrinsics, width=camera.width, height=camera.height, sh_degree=splats.degree, eps2d=BLUR,
    )  # fmt: skip
    behind = torch.tensor([0.1490, 0.1647, 0.2157])
    return (drawn.colors[0] + (1 - drawn.alphas[0]) * behind).clamp(0, 1).movedim(-1, 0)
