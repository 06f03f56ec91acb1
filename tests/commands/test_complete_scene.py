"""``fillerbuster complete`` as a scene, in miniature: splats of photos, a film of them, what of it was seen; a kill at
any stage.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import av
import pytest
import torch
from helpers.small_figures import draw_small
from helpers.textured_box import cameras_on_an_arc, render
from helpers.tiny_models import save_tiny_model

from fb_core.completion.fly_through import FoundCameras
from fb_core.data.capture.captures import FrameToWrite, validate_capture, write_capture
from fb_core.data.photos.photo import Photo
from fb_core.data.photos.straight_photos import straightened
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.verdict import Arrangement
from fb_core.geometry.similarity import Similarity
from fb_core.registration.choice import Registration
from fb_nerfstudio.splats.backend import BLUR, render_splats
from fb_nerfstudio.splats.splat_file import Splats, read_splats
from method_configs.commands import command_line as commands
from method_configs.commands.complete import command as complete_command
from method_configs.commands.complete.scenes import scene as complete_scene
from method_configs.commands.complete.scenes import scene_work

QUICK = ("--views", 3, "--steps", 1, "--iterations", 4, "--photo-size", 32, "--film-size", 32)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_model(tmp_path_factory.mktemp("tiny") / "model", image_size=16)


@pytest.fixture(autouse=True)
def small_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    draw_small(monkeypatch)


def complete(source: Path, output: Path, model: Path, *options: object) -> dict[str, Any]:
    commands.main(
        ["complete", str(source), "--output", str(output), "--model", str(model), *map(str, (*QUICK, *options))]
    )
    return json.loads((output / "report.json").read_text())


def posed(folder: Path, cameras: Pinholes) -> Path:
    pictures = render(cameras)
    frames = [
        FrameToWrite(name=f"photo_{i:03d}", image=pictures[i], camera=cameras[i].to(torch.float64))
        for i in range(len(cameras))
    ]
    return write_capture(folder, frames).root


def test_the_film_is_the_render_of_the_exported_splats_along_the_path(tmp_path: Path, model: Path, monkeypatch) -> None:
    kept: dict[int, torch.Tensor] = {}
    draw = complete_scene._keep_frame
    monkeypatch.setattr(
        complete_scene, "_keep_frame", lambda film, n, frame: (kept.update({n: frame.image}), draw(film, n, frame))
    )
    source = posed(tmp_path / "capture", cameras_on_an_arc(6, width=40, height=30))
    report = complete(source, tmp_path / "out", model)
    film, splats = report["film"], read_splats(tmp_path / "out" / "splats.ply")
    assert (
        (film["width"], film["height"]) == (32, 24)
        and len(film["frames"]) == 3
        and len(splats) == report["splats"]["gaussians"] > 0
    )
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
    assert (tmp_path / "out" / "sheet.png").is_file() and [
        p.name for p in tmp_path.iterdir() if p.name.startswith(".")
    ] == []


def _picture(splats: Splats, camera: Pinholes) -> torch.Tensor:
    """As any viewer of such files draws it."""
    drawn = render_splats(
        means=splats.means, quats=splats.quats, scales=splats.log_scales.exp(), opacities=splats.logits.sigmoid(),
        colors=splats.harmonics,
        viewmats=camera.world_to_camera, Ks=camera.intrinsics, width=camera.width, height=camera.height, eps2d=BLUR,
        sh_degree=splats.degree,
    )  # fmt: skip
    behind = torch.tensor([0.1490, 0.1647, 0.2157])
    return (drawn.colors[0] + (1 - drawn.alphas[0]) * behind).clamp(0, 1).movedim(-1, 0)


class Killed(BaseException):
    """Stands for SIGKILL: nothing of the command catches it."""


def test_a_kill_at_any_stage_goes_on_to_the_same_bits(tmp_path: Path, model: Path, monkeypatch) -> None:
    """After the cameras, in the middle of the training, in the middle of the film: nothing that is there is done
    again.
    """
    source, out = posed(tmp_path / "capture", cameras_on_an_arc(4, width=40, height=30)), tmp_path / "out"
    complete(source, tmp_path / "whole", model, "--no-generate")
    calls = {"cameras": 0, "training": 0, "steps": [], "frames": 0}
    find, train, draw = complete_command.find_cameras, complete_scene.train_scene, complete_scene.film_frame
    die_in = ["before training", "in training", "in film", ""]

    def finding(*given: Any, **options: Any) -> Any:
        calls["cameras"] += 1
        return find(*given, **options)

    def training(*given: Any, on_progress: Any, **options: Any) -> Any:
        calls["training"] += 1
        if die_in[0] == "before training":
            raise Killed

        def told(what: str, done: int, total: int) -> None:
            calls["steps"].append((what, done))
            if die_in[0] == "in training" and done == 3:
                raise Killed
            on_progress(what, done, total)

        return train(*given, on_progress=told, **options)

    def drawing(*given: Any, **options: Any) -> Any:
        calls["frames"] += 1
        if die_in[0] == "in film" and calls["frames"] == 2:
            raise Killed
        return draw(*given, **options)

    monkeypatch.setattr(complete_command, "find_cameras", finding)
    monkeypatch.setattr(complete_scene, "train_scene", training)
    monkeypatch.setattr(complete_scene, "film_frame", drawing)
    while die_in[0]:
        with pytest.raises(Killed):
            complete(source, out, model, "--no-generate")
        assert not out.exists() and (tmp_path / ".out.in-progress").is_dir()
        die_in.pop(0)
    complete(source, out, model, "--no-generate")
    assert calls["cameras"] == 1 and calls["training"] == 3 and calls["frames"] == 2 + 2
    assert [done for what, done in calls["steps"] if what == "training splats"] == [
        1,
        2,
        3,
        3,
        4,
    ]  # step 3 came after its checkpoint
    assert (out / "splats.ply").read_bytes() == (tmp_path / "whole" / "splats.ply").read_bytes()
    first, second = (json.loads((tmp_path / name / "report.json").read_text())["film"] for name in ("whole", "out"))
    assert first == second and not (tmp_path / ".out.in-progress").exists()


def test_another_question_begins_anew_and_two_at_once_are_refused(tmp_path: Path) -> None:
    with pytest.raises(Killed), scene_work.work_beside(tmp_path / "out", "one") as folder:
        (folder / "cameras.pt").write_bytes(b"kept")
        with (
            pytest.raises(ValueError, match="another fillerbuster complete works"),
            scene_work.work_beside(tmp_path / "out", "one"),
        ):
            pass
        raise Killed
    with pytest.raises(Killed), scene_work.work_beside(tmp_path / "out", "one") as folder:
        assert (folder / "cameras.pt").read_bytes() == b"kept"
        raise Killed
    with scene_work.work_beside(tmp_path / "out", "two") as folder:
        assert not (folder / "cameras.pt").exists()
    assert [path.name for path in tmp_path.iterdir()] == []
    (tmp_path / ".out.in-progress").mkdir()
    (tmp_path / ".out.in-progress" / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match="holds something else"), scene_work.work_beside(tmp_path / "out", "one"):
        pass
    assert (tmp_path / ".out.in-progress" / "thesis.txt").exists()


def test_cameras_are_kept_as_they_were_found(tmp_path: Path) -> None:
    camera = cameras_on_an_arc(1).to(torch.float64)
    pixels = torch.rand(3, camera.height, camera.width), torch.ones(1, camera.height, camera.width)
    photo = Photo(
        name="a", source=tmp_path / "a.png", size=(camera.height, camera.width), focal_prior=None, device="",
        seconds=None, camera=None,
        thumbnail=pixels[0], pixels=lambda: pixels,
    )  # fmt: skip
    straight, camera = straightened(photo, camera, {"k1": -0.1, "k2": 0.01})
    registration = Registration(
        cameras=(camera, None), verdicts=("ok", "no camera"), reasons=("", "too dark"),
        residuals_degrees=(0.1, math.nan),
        raymaps=None, arrangement=Arrangement.ONE_CAMERA, straight={0: straight},
    )  # fmt: skip
    found = FoundCameras(
        registration=registration, method="features", tried={"features": 1}, raymaps=torch.rand(2, 6, 4, 4)
    )
    assert scene_work.kept_cameras(tmp_path, [photo, photo]) is None
    scene_work.keep_cameras(tmp_path, found)
    kept = scene_work.kept_cameras(tmp_path, [photo, photo])
    assert (
        kept is not None
        and kept.trusted == [0]
        and kept.registration.reasons == ("", "too dark")
        and kept.tried == {"features": 1}
    )
    assert torch.equal(kept.camera(0).camera_to_world, camera.camera_to_world) and math.isnan(
        kept.registration.residuals_degrees[1]
    )
    assert (
        kept.raymaps is not None
        and torch.equal(kept.raymaps, found.raymaps)
        and kept.registration.arrangement == "one camera"
    )
    again = kept.as_used([photo, photo])
    assert (
        again[1] is photo
        and torch.equal(again[0].load(), straight.load())
        and not torch.equal(again[0].load(), photo.load())
    )


@pytest.mark.parametrize("kind", ["two photos", "three photos", "a pure rotation"])
def test_few_photos_and_a_turn_on_the_spot_give_a_scene(kind: str, tmp_path: Path, model: Path) -> None:
    cameras = cameras_on_an_arc({"two photos": 2, "three photos": 3}.get(kind, 4), width=40, height=30)
    if kind == "a pure rotation":
        pose = cameras.camera_to_world.clone()
        pose[:, :, 3] = pose[:1, :, 3]
        cameras = dataclasses.replace(cameras, camera_to_world=pose)
    report = complete(posed(tmp_path / "capture", cameras), tmp_path / "out", model)
    film = report["film"]
    assert len(film["frames"]) == 3 and sum(film[name] for name in ("seen", "generated", "empty")) == pytest.approx(
        1, abs=1e-5
    )
    validate_capture(tmp_path / "out", decode=True)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--minutes", 0), "minutes: expected above 0"),
        (("--film-size", 4), "film_size: expected at least 16, got 4"),
        (("--iterations", 0), "iterations: expected at least 1, got 0"),
        (("--prompt", "a sofa"), "this model reads no text"),
        (("--path", "loop"), "expected ellipse, orbit, spiral"),
    ],
)
def test_wishes_that_cannot_be_met_are_refused_before_any_work(
    tmp_path: Path, model: Path, capsys, options, sentence
) -> None:
    source = posed(tmp_path / "capture", cameras_on_an_arc(3, width=20, height=20))
    with pytest.raises(SystemExit) as stopped:
        complete(source, tmp_path / "out", model, *options)
    assert stopped.value.code == 1 and sentence in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["capture"]


def test_what_the_scene_shows_at_other_photos_cameras(tmp_path: Path, model: Path, capsys) -> None:
    """The capture's world is another one; the rows tell what was compared, and a file tells all of it."""
    truth = cameras_on_an_arc(6, width=40, height=30)
    given = posed(tmp_path / "given", truth[[0, 1, 3, 5]])
    for index, number in enumerate((0, 1, 3, 5)):  # the names that the same photos have in the whole capture
        (given / "images" / f"photo_{index:03d}.png").rename(given / "images" / f"new_{number:03d}.png")
    content = (given / "transforms.json").read_text()
    for index, number in enumerate((0, 1, 3, 5)):
        content = content.replace(f"photo_{index:03d}", f"new_{number:03d}")
    (given / "transforms.json").write_text(content)
    complete(given, tmp_path / "out", model, "--no-generate", "--iterations", 30)
    turned = Similarity(
        rotation=torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).double(),
        scale=3.0,
        shift=torch.tensor([1.0, 2, 3]).double(),
    )
    moved, pictures = turned.cameras(truth), render(truth)
    frames = [FrameToWrite(name=f"new_{i:03d}", image=pictures[i], camera=moved[i]) for i in range(6)]
    whole = write_capture(tmp_path / "whole", frames).root
    commands.main(
        [
            "eval",
            "scene",
            "--scene",
            str(tmp_path / "out"),
            "--capture",
            str(whole),
            "--refine",
            "3",
            "--json",
            str(tmp_path / "rows.json"),
        ]
    )
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert [row["photo"] for row in rows] == ["new_002.png", "new_004.png", "all 2"]
    assert all(row["psnr"] > 8 and 0 <= row["seen_share"] <= 1 for row in rows)
    with pytest.raises(SystemExit):
        commands.main(["eval", "scene", "--scene", str(whole), "--capture", str(whole)])
    assert "no splats.ply there" in capsys.readouterr().err
