"""`fillerbuster eval masked` and `bench paper --table 1`: what is compared, what is trained, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import tyro
from PIL import Image

from fb_core.completion.results.completed_views import CompletedViews, Origin
from fb_core.data.capture.captures import read_capture
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.runs import finished_run
from method_configs.evaluations import masked as masked_evaluation
from method_configs.evaluations.masked import METHODS, PAPER, Masked, Paper, agreement, require_masks


def bank_of(count: int = 3) -> CompletedViews:
    """Grey pictures of cameras on a ring."""
    angles = torch.arange(count) * 2.0
    centers = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    cameras = Pinholes.looking_at(
        centers, 3 * centers, up=torch.tensor([0.0, 0, 1]), fov_degrees=60.0, width=32, height=32
    )
    origin = Origin(role="anchor", round=0, seed=0, prompt="", model_hash="abcdef0123456789")
    return CompletedViews(
        images=torch.full((count, 32, 32, 3), 51, dtype=torch.uint8),
        masks=torch.ones(count, 32, 32, 1, dtype=torch.bool),
        cameras=cameras,
        origins=(origin,) * count,
    )


def pipeline_of(bank: CompletedViews | None, error: float) -> SimpleNamespace:
    """Stands for nerfstudio's pipeline, as far as renders are asked for."""
    model = SimpleNamespace(get_outputs_for_camera=lambda camera: {"rgb": torch.full((32, 32, 3), 0.2 + error)})
    return SimpleNamespace(datamanager=SimpleNamespace(generated_views=bank), model=model, device="cpu")


def test_an_error_of_a_tenth_is_twenty_decibels():
    bank = bank_of()
    found = agreement(pipeline_of(bank, 0.1), bank, None)
    assert found["psnr"] == pytest.approx(20.0, abs=1e-3) and found["psnr_interval"] == pytest.approx(0, abs=1e-3)
    assert 0 < found["ssim"] < 1 and "lpips" not in found
    assert agreement(pipeline_of(bank, 0.0), bank, None)["ssim"] == pytest.approx(1)


def run_of(
    monkeypatch: pytest.MonkeyPatch, folder: Path, *, step: int, bank: CompletedViews | None, task: str = "inpaint"
) -> Path:
    model = SimpleNamespace(normal_loss_from=100, normal_alignment_weight=0.01, normal_tv_weight=0.0)
    completion = SimpleNamespace(task=task)
    parts = SimpleNamespace(model=model, datamanager=SimpleNamespace(data=Path("scene"), completion=completion))
    monkeypatch.setattr(
        finished_run, "read_run", lambda run: (SimpleNamespace(method_name=METHODS[0], pipeline=parts), {"step": step})
    )
    monkeypatch.setattr(finished_run, "load_run", lambda run: pipeline_of(bank, 0.1))
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "nerfstudio_models" / "step-000000299.ckpt").touch()
    return folder


@pytest.mark.parametrize(("step", "normals"), [(299, "with"), (99, "without")])
def test_the_command_says_whether_normals_were_regularised(step: int, normals: str, tmp_path: Path, monkeypatch):
    run = run_of(monkeypatch, tmp_path / "run", step=step, bank=bank_of())
    suffixes = {"json": "json", "csv": "csv", "markdown": "md", "figure": "png"}
    files = {name: tmp_path / f"table.{suffix}" for name, suffix in suffixes.items()}
    Masked(runs=(run,), **files).run()
    rows = json.loads(files["json"].read_text())["rows"]
    assert (rows[0]["normals"], rows[0]["model"], rows[0]["pictures"]) == (normals, "abcdef01", 3)
    assert {(row["method"], row["normals"] == "with"): row["psnr"] for row in rows[1:]} == {
        key: cell[0] for key, cell in PAPER.items()
    }
    assert all(path.stat().st_size > 100 for path in files.values())


def test_a_run_without_inpainted_pictures_is_refused(tmp_path: Path, monkeypatch):
    run = run_of(monkeypatch, tmp_path / "run", step=5, bank=None)
    with pytest.raises(ValueError, match="no inpainted pictures; give a run of fillerbuster-masked or nerfiller-grid"):
        Masked(runs=(run,)).run()


@pytest.mark.parametrize("method", METHODS)
def test_runs_differ_in_the_normals_weights_alone(method: str, tmp_path: Path):
    """And ns-train knows all of the options."""
    from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion

    command = Paper(
        data=tmp_path,
        output=tmp_path / "out",
        iterations=40,
        normals_from=7,
        completion={"steps": "3"},
        seed=5,
        inpainter_weights=tmp_path,
        scale=0.125,
    )
    both = [tyro.cli(AnnotatedBaseConfigUnion, args=command.arguments(method, normals)) for normals in (True, False)]
    weights = [(one.pipeline.model.normal_alignment_weight, one.pipeline.model.normal_tv_weight) for one in both]
    assert min(weights[0]) > 0 and weights[1] == (0.0, 0.0)
    assert both[0].pipeline.datamanager.completion.inpainter_weights == (
        tmp_path if method == "nerfiller-grid" else None
    )
    assert both[0].experiment_name != both[1].experiment_name and both[0].pipeline.datamanager.completion.steps == 3
    both[1].experiment_name, both[1].pipeline.model = both[0].experiment_name, both[0].pipeline.model
    assert both[0] == both[1] and both[0].machine.seed == 5 and both[0].max_num_iterations == 40
    assert both[0].pipeline.datamanager.camera_res_scale_factor == 0.125


def test_scenes_without_masks_are_refused(tiny_capture: Path, tmp_path: Path):
    require_masks(tiny_capture)
    content = json.loads((tiny_capture / "transforms.json").read_text())
    for frame in content["frames"]:
        frame.pop("mask_path", None)
    content.pop("mask_path", None)
    (tiny_capture / "transforms.json").write_text(json.dumps(content))
    assert all(frame.mask_path is None for frame in read_capture(tiny_capture).frames)
    with pytest.raises(
        ValueError, match=r"table 1 needs pictures with masks .* this capture has none; add a mask_path"
    ):
        Paper(data=tiny_capture, output=tmp_path / "out").run()
    assert not (tmp_path / "out").exists()


def test_masks_in_alpha_are_masks_as_in_nerfillers_scenes(tiny_capture: Path):
    for frame in read_capture(tiny_capture).frames:
        with Image.open(frame.image_path) as picture:
            pixels = picture.convert("RGBA")
        pixels.putalpha(Image.new("L", pixels.size, 255))
        pixels.paste((0, 0, 0, 0), (4, 4, 12, 12))
        pixels.save(frame.image_path)
    content = json.loads((tiny_capture / "transforms.json").read_text())
    for frame in content["frames"]:
        frame.pop("mask_path", None)
    (tiny_capture / "transforms.json").write_text(json.dumps(content))
    assert all(frame.mask_path is None for frame in read_capture(tiny_capture).frames)
    require_masks(tiny_capture)


def test_other_methods_are_refused(tiny_capture: Path):
    with pytest.raises(ValueError, match="expected some of fillerbuster-masked, nerfiller-grid, got splatfacto"):
        Paper(data=tiny_capture, methods=("splatfacto",)).run()
    with pytest.raises(ValueError, match="expected one or more folders of runs"):
        Masked(runs=()).run()


def test_a_run_that_inpaints_nothing_is_refused(tmp_path: Path, monkeypatch):
    """Its generated views are new ones, which table 1 is not about."""
    run = run_of(monkeypatch, tmp_path / "run", step=5, bank=bank_of(), task="new-views")
    with pytest.raises(ValueError, match=r"expected a run of fillerbuster-masked or nerfiller-grid, got one of"):
        Masked(runs=(run,)).run()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"iterations": 0}, "iterations: expected 1 to 1e"),
        ({"normals_from": -1}, "normals-from: expected 0 to 1e"),
        ({"inpainter_weights": Path("nowhere")}, "inpainter-weights: no folder nowhere; give the diffusers folder"),
        ({"lpips": Path("nowhere.pth")}, "SqueezeNet 1.1 in the file nowhere.pth, which is missing"),
        ({"model": Path("nowhere")}, "nowhere"),
    ],
)
def test_what_would_end_after_the_trainings_is_told_before_them(options, said, tiny_capture: Path, tmp_path: Path):
    with pytest.raises(ValueError, match=said):
        Paper(data=tiny_capture, output=tmp_path / "out", **options).run()
    assert not (tmp_path / "out").exists()


def test_scales_beyond_the_photos_are_refused(tiny_capture: Path):
    for scale in (0.0, 2.0, float("nan")):
        with pytest.raises(ValueError, match="scale: expected a part of the photos' sides above 0 and up to 1, got"):
            Paper(data=tiny_capture, scale=scale).run()


def test_a_run_that_is_there_is_not_trained_again(tiny_capture: Path, tmp_path: Path, monkeypatch):
    command = Paper(data=tiny_capture, output=tmp_path / "out", iterations=8, methods=METHODS[:1])
    judged = []
    monkeypatch.setattr(
        masked_evaluation, "masked_row", lambda run, files: judged.append(run) or {"part": "p", "psnr": 1.0}
    )
    monkeypatch.setattr(masked_evaluation, "publish", lambda files, rows, seed: None)
    for normals in ("with", "without"):
        folder = tmp_path / "out" / f"tiny_capture-{normals}-normals" / METHODS[0] / "run" / "nerfstudio_models"
        folder.mkdir(parents=True)
        (folder / "step-000000007.ckpt").touch()
    command.run()
    assert [run.parent.parent.name for run in judged] == ["tiny_capture-with-normals", "tiny_capture-without-normals"]
