"""Relative rotation accuracy: exact correspondences as the twin, true and spoilt films as laws; `fillerbuster eval
consistency`.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers import textured_box
from torchvision.transforms.functional import gaussian_blur

from fb_core.evaluation.metrics.correspondences import Correspondences, loftr_matcher, sift_matches
from fb_core.evaluation.metrics.relative_rotation import (
    accuracy,
    frame_pairs,
    judge_pairs,
    relative_rotation,
    rotation_angle_degrees,
    true_rotation,
    wilson_interval,
)
from fb_core.evaluation.results import Report, commit, hardware
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.camera_paths import path_cameras
from fb_nerfstudio.bridge import to_nerfstudio, to_pinholes
from fb_nerfstudio.runs import finished_run
from method_configs.benchmarks.command import command_line
from method_configs.benchmarks.figures import new_axes, save_figure
from method_configs.benchmarks.table_files import TableFiles, csv_text, markdown_text, origin_of
from method_configs.evaluations.consistency import Consistency, poses_digest
from method_configs.evaluations.true_films import TRUE_FILM, true_pictures

FRAMES, FPS, SIZE, FOV = 120, 12, 160, 75.0


def captured() -> Pinholes:
    """A ring of cameras that look at the walls of a textured room."""
    angles = torch.arange(12) * math.pi / 6
    centers = torch.stack([1.2 * angles.cos(), 1.2 * angles.sin(), 0.2 * (2 * angles).sin()], dim=1)
    return Pinholes.looking_at(centers, 2 * centers, up=textured_box.UP, fov_degrees=70.0, width=64, height=64)


@pytest.fixture(scope="module")
def film() -> tuple[Pinholes, list[tuple[int, int]], dict[int, torch.Tensor]]:
    """Cameras, pairs, and the exact pictures of the frames that are in a pair."""
    ring = captured()
    cameras = path_cameras("ellipse", [ring[index] for index in range(len(ring))], FRAMES, size=SIZE, fov_degrees=FOV)
    pairs = frame_pairs(FRAMES, most_apart=FPS, seed=0)
    return cameras, pairs, {frame: textured_box.render(cameras[frame])[0] for pair in pairs for frame in pair}


@pytest.fixture(scope="module")
def matches_of_film(film) -> Callable[[torch.Tensor, torch.Tensor], Correspondences]:
    """``sift_matches`` of the film's pictures, each pair once; they do not know the cameras."""
    _, pairs, pictures = film
    kept = {pair: sift_matches(*(pictures[frame] for frame in pair)) for pair in pairs}
    frames = {id(picture): frame for frame, picture in pictures.items()}
    return lambda first, second: kept[frames[id(first)], frames[id(second)]]


def test_true_films_are_right(film, matches_of_film):
    cameras, pairs, pictures = film
    found = accuracy(judge_pairs(pictures.__getitem__, cameras, pairs, matches_of_film))
    assert found["rra_5"] >= 0.95 and found["rra_1"] >= 0.85 and found["failed"] == 0 and found["pairs"] == 20
    assert found["rra_5_low"] < found["rra_5"] <= found["rra_5_high"]


def test_shuffled_cameras_are_near_chance(film, matches_of_film):
    cameras, pairs, pictures = film
    order = torch.randperm(FRAMES, generator=torch.Generator().manual_seed(1)).tolist()
    assert accuracy(judge_pairs(pictures.__getitem__, cameras[order], pairs, matches_of_film))["rra_5"] <= 0.1


def test_blurred_films_and_films_of_views_that_disagree_are_clearly_worse(film):
    cameras, pairs, pictures = film
    blurred = accuracy(
        judge_pairs(lambda frame: gaussian_blur(pictures[frame], [31, 31], 6.0), cameras, pairs, sift_matches)
    )
    assert blurred["rra_5"] <= 0.7

    def elsewhere(frame: int) -> torch.Tensor:
        """The room as a camera sees it that is turned by about ten degrees, another way in every frame."""
        turn = torch.linalg.matrix_exp(0.17 * _cross(torch.randn(3, generator=torch.Generator().manual_seed(frame))))
        pose = torch.cat([cameras[frame].rotations @ turn, cameras[frame].centers[:, :, None]], dim=2)
        return textured_box.render(dataclasses.replace(cameras[frame], camera_to_world=pose))[0]

    assert accuracy(judge_pairs(elsewhere, cameras, pairs, sift_matches))["rra_5"] <= 0.3


def _cross(vector: torch.Tensor) -> torch.Tensor:
    """The matrix of a cross product."""
    x, y, z = vector.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def test_frames_without_features_are_wrong_and_told(film):
    cameras, pairs, _ = film
    found = accuracy(judge_pairs(lambda _: torch.full((3, SIZE, SIZE), 0.5), cameras, pairs, sift_matches))
    assert found["failed"] == found["pairs"] == 20 and found["rra_20"] == 0 and found["median_degrees"] == 180


def exact_correspondences(first: Pinholes, second: Pinholes) -> Correspondences:
    """Points of the room's walls that both cameras see."""
    points = (
        torch.rand(3000, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 2 - 1
    ) * textured_box.HALF
    walls = torch.arange(3000) % 3
    points[torch.arange(3000), walls] = points[torch.arange(3000), walls].sign() * textured_box.HALF
    shown, places = torch.ones(3000, dtype=torch.bool), []
    for camera in (first, second):
        pixels, depth = camera.to(torch.float64).project(points)
        shown &= (depth[0] > 0) & (pixels[0] > 0).all(dim=1) & (pixels[0] < SIZE).all(dim=1)
        places.append(pixels[0])
    return Correspondences(first=places[0][shown].float(), second=places[1][shown].float())


def test_twin_from_exact_correspondences(film):
    cameras, pairs, _ = film
    for first, second in pairs:
        found = exact_correspondences(cameras[first], cameras[second])
        turn, inliers = relative_rotation(found, cameras[first], cameras[second])
        assert turn is not None and inliers >= 0.9 * len(found)
        assert rotation_angle_degrees(turn, true_rotation(cameras[first], cameras[second])) < 0.02


@pytest.mark.parametrize("degrees", [0.0, 2.0, 20.0])
def test_a_turn_on_the_spot(degrees: float):
    """The essential matrix is degenerate there."""
    angles = torch.deg2rad(torch.tensor([0.0, degrees]))
    targets = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    both = Pinholes.looking_at(
        torch.zeros(2, 3), targets, up=textured_box.UP, fov_degrees=60.0, width=SIZE, height=SIZE
    )
    found = exact_correspondences(both[0], both[1])
    noise = 0.2 * torch.randn(found.second.shape, generator=torch.Generator().manual_seed(0))
    turn, _ = relative_rotation(Correspondences(first=found.first, second=found.second + noise), both[0], both[1])
    assert turn is not None and rotation_angle_degrees(turn, true_rotation(both[0], both[1])) < 0.5


def test_wrong_matches_among_right_ones(film):
    cameras, pairs, _ = film
    errors = []
    for first, second in pairs:
        found = exact_correspondences(cameras[first], cameras[second])
        generator = torch.Generator().manual_seed(first)
        places = found.second + 0.2 * torch.randn(found.second.shape, generator=generator)
        wrong = torch.rand(len(places), generator=generator) < 0.3
        places[wrong] = SIZE * torch.rand(int(wrong.sum()), 2, generator=generator)
        turn, _ = relative_rotation(Correspondences(first=found.first, second=places), cameras[first], cameras[second])
        assert turn is not None
        errors.append(rotation_angle_degrees(turn, true_rotation(cameras[first], cameras[second])))
    assert (
        sum(error < 5 for error in errors) >= 17 and sorted(errors)[10] < 0.7
    )  # of 20; some pairs see one wall with 24 points


def test_pairs_of_frames():
    pairs = frame_pairs(240, most_apart=24, count=20, seed=3)
    assert len(set(pairs)) == 20 and all(0 < second - first <= 24 and second < 240 for first, second in pairs)
    assert (
        pairs == frame_pairs(240, most_apart=24, count=20, seed=3) != frame_pairs(240, most_apart=24, count=20, seed=4)
    )
    assert frame_pairs(3, most_apart=2, count=3) == [(0, 1), (0, 2), (1, 2)]
    with pytest.raises(ValueError, match=r"pairs: expected between 1 and 3 .* got 4"):
        frame_pairs(3, most_apart=2, count=4)


def test_the_interval_of_a_share():
    assert wilson_interval(10, 20) == pytest.approx(
        (0.2993, 0.7007), abs=1e-4
    )  # a published example of Wilson's interval
    assert wilson_interval(0, 20)[0] == 0 and wilson_interval(20, 20)[1] == pytest.approx(1)


def test_loftr_with_weights_from_a_file(tmp_path: Path):
    import kornia

    with pytest.raises(ValueError, match=r"no file .*loftr_outdoor.ckpt and give its place with --loftr"):
        loftr_matcher(tmp_path / "none.ckpt")
    torch.save({"state_dict": {"a": torch.zeros(1)}}, tmp_path / "other.ckpt")
    with pytest.raises(ValueError, match="belongs to another network"):
        loftr_matcher(tmp_path / "other.ckpt")
    (tmp_path / "broken.ckpt").write_bytes(b"none of ours")
    with pytest.raises(ValueError, match="no weights that can be read"):
        loftr_matcher(tmp_path / "broken.ckpt")
    torch.save({"state_dict": kornia.feature.LoFTR(pretrained=None).state_dict()}, tmp_path / "loftr.ckpt")
    found = loftr_matcher(tmp_path / "loftr.ckpt")(torch.rand(3, 30, 50), torch.rand(3, 40, 32))
    assert found.first.shape == found.second.shape and found.first.shape[1] == 2


def run_of_the_room(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Path:
    """A run whose splats show the textured room exactly; a stand-in for nerfstudio's pipeline, as far as a film needs
    one.
    """
    ring = captured()

    def outputs(camera):
        return {"rgb": textured_box.render(to_pinholes(camera))[0].movedim(0, -1)}

    dataset = SimpleNamespace(cameras=to_nerfstudio(ring), image_filenames=[])
    manager = SimpleNamespace(cached_train=[], train_dataset=dataset, generated_views=None, data=folder / "capture")
    pipeline = SimpleNamespace(datamanager=manager, device="cpu", model=SimpleNamespace(get_outputs_for_camera=outputs))
    config = SimpleNamespace(method_name="fillerbuster", pipeline=pipeline, data=None)
    monkeypatch.setattr(finished_run, "read_run", lambda run: (config, {"step": 7}))
    monkeypatch.setattr(finished_run, "load_run", lambda run: pipeline)
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "nerfstudio_models" / "step-000000007.ckpt").touch()
    return folder


def test_the_command_judges_a_run_writes_all_files_and_goes_on(monkeypatch, tmp_path: Path):
    run = run_of_the_room(monkeypatch, tmp_path / "run")
    suffixes = {"json": "json", "csv": "csv", "markdown": "md", "figure": "png"}
    files = {name: tmp_path / f"table.{suffix}" for name, suffix in suffixes.items()}
    command = Consistency(
        runs=(run,), size=SIZE, fov=FOV, fps=6, pairs=6, true_film=False, keep=tmp_path / "kept", **files
    )
    command.run()
    content = json.loads(files["json"].read_text())
    assert {"command", "commit", "hardware", "seed"} <= set(content)
    row = content["rows"][0]
    assert row["method"] == "fillerbuster" and row["rra_5"] >= 0.8 and "SIFT" in row["part"]
    line = next(csv.DictReader(files["csv"].open()))
    assert line["method"] == "fillerbuster"
    assert {name: line[name] for name in ("command", "commit", "hardware")} == {
        name: content[name] for name in ("command", "commit", "hardware")
    }
    assert line["seed"] == "0" == str(content["seed"])
    assert "| fillerbuster |" in files["markdown"].read_text() and files["figure"].stat().st_size > 1000

    def never(run):
        raise AssertionError("measured again")

    monkeypatch.setattr(finished_run, "load_run", never)
    files["json"].unlink()
    command.run()
    assert json.loads(files["json"].read_text())["rows"] == content["rows"]


def test_a_procedural_room_is_also_judged_as_it_is(tmp_path: Path):
    """The true film is seen from the film's cameras, in a world that is turned, scaled and moved against the
    capture's.
    """
    from fb_core.data.capture.captures import read_capture
    from fb_core.data.rooms.room_captures import rooms
    from fb_core.geometry.similarity import Similarity

    rooms(0, tmp_path / "room", views=4, size=64, held_out=2)
    frames = read_capture(tmp_path / "room").frames[:4]
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    world = Similarity(rotation=turn, scale=0.3, shift=torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
    theirs = [world.cameras(frame.camera) for frame in frames]
    names = [frame.image_path for frame in frames]
    pipeline = SimpleNamespace(datamanager=SimpleNamespace(train_dataset=SimpleNamespace(image_filenames=names)))
    pictures = true_pictures(tmp_path / "room", pipeline, theirs, Pinholes.cat(theirs))
    assert pictures is not None
    for number, frame in enumerate(frames):
        assert float((pictures(number) - frame.load_image()).abs().mean()) < 0.01


def test_a_masked_copy_is_no_further_capture(monkeypatch, tmp_path: Path):
    """Runs on room 0, on a copy of it with a block cut out, and on room 1, which lies in a folder of the same name:
    means are over two captures, of which the first weighs no more for its two runs; each room's true film comes once.
    """
    from fb_core.data.rooms.room_captures import rooms
    from method_configs.benchmarks.methods import cut_blocks

    places = {"plain": "a/room", "cut": "a/room-masked", "other": "b/room"}
    captures = {name: tmp_path / place for name, place in places.items()}
    for seed, name in ((0, "plain"), (1, "other")):
        rooms(seed, captures[name], views=3, size=32, held_out=2)
    cut_blocks(captures["plain"], captures["cut"], share=0.35)
    assert poses_digest(captures["plain"]) == poses_digest(captures["cut"]) != poses_digest(captures["other"])
    errors = {"plain": 1.5, "cut": 7.0, "other": 0.5}
    brought = []

    def config_of(run: Path):
        manager = SimpleNamespace(data=captures[run.name])
        return SimpleNamespace(method_name="m", pipeline=SimpleNamespace(datamanager=manager), data=None), {"step": 7}

    def measured(self, run, method, capture, matcher, with_truth):
        brought.extend([run.name] if with_truth else [])
        pair = {"first": 0, "second": 1, "true_degrees": 9.0, "error_degrees": errors[run.name]}
        pair |= {"matches": 9, "inliers": 9}
        films = {method: [pair]} | ({TRUE_FILM: [pair | {"error_degrees": 0.1}]} if with_truth else {})
        return {"pairs": films, "model": "-"}

    monkeypatch.setattr(finished_run, "read_run", config_of)
    monkeypatch.setattr(finished_run, "identity_of", lambda run, state: {"run": run.name})
    monkeypatch.setattr(Consistency, "_measured", measured)
    Consistency(runs=tuple(Path(name) for name in places), json=tmp_path / "table.json").run()
    rows = json.loads((tmp_path / "table.json").read_text())["rows"]
    assert brought == ["plain", "other"]
    assert len({row["capture"] for row in rows if row.get("method") == "m" and "capture" in row}) == 3
    mean = {row["method"]: row for row in rows if "captures" in row}
    assert {name: row["captures"] for name, row in mean.items()} == {"m": 2, TRUE_FILM: 2}
    assert mean["m"]["rra_2"] == pytest.approx((0.5 + 1.0) / 2)
    assert mean["m"]["median_degrees"] == pytest.approx(((1.5 + 7.0) / 2 + 0.5) / 2)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"runs": ()}, "expected one or more folders of runs"),
        ({"size": 8}, "got seconds 10, fps 24, size 8"),
        ({"fps": 0.0}, "fps 0,"),
        ({"fps": math.inf}, "frames of the film, seconds times fps: expected 1 to 10000, got inf"),
        ({"seconds": 1e9}, "frames of the film, seconds times fps: expected 1 to 10000, got 2.4e"),
        ({"size": 10**6}, "size: expected 32 to 8192, got 1000000"),
        ({"fov": 0.0}, "fov: expected 1 to 179, got 0"),
        ({"fov": math.nan}, "fov: expected 1 to 179, got nan"),
    ],
)
def test_bad_options_are_told(options, said, tmp_path: Path):
    with pytest.raises(ValueError, match=said):
        Consistency(**{"runs": (tmp_path,)} | options).run()
    with pytest.raises(ValueError, match=r"no config.yml there"):
        Consistency(runs=(tmp_path,)).run()


def test_what_was_kept_answers_the_same_question_only(tmp_path: Path):
    files, asked = TableFiles(keep=tmp_path / "kept"), []

    def measure() -> list[int]:
        asked.append(1)
        return [len(asked)]

    assert [files.kept("cell", {"seed": seed}, measure) for seed in (0, 0, 1, 1)] == [[1], [1], [2], [2]]
    assert files.kept("cell", {"seed": 0}, measure) == [1], "another question does not take its place"
    kept = list((tmp_path / "kept").iterdir())
    assert len(kept) == 2 and all(path.name.startswith("cell-") for path in kept)
    for path in kept:
        path.write_text("{")
    assert files.kept("cell", {"seed": 1}, measure) == [3], "what cannot be read is measured again"


def test_tables_as_text():
    rows = [{"part": "a", "name": "x|y", "value": 0.12345}, {"part": "a", "name": "z", "value": math.nan, "more": 3}]
    assert csv_text(rows).splitlines() == ["part,name,value,more", "a,x|y,0.12345,", "a,z,,3"]
    lines = markdown_text(Report(seed=5, rows=rows), "fillerbuster eval").splitlines()
    assert lines[2:6] == ["| name | value | more |", "| --- | --- | --- |", "| x\\|y | 0.123 | - |", "| z | - | 3 |"]
    assert "seed 5" in lines[-1] and "fillerbuster eval" in lines[-1]


@pytest.mark.parametrize("hashed", ["f9b4db88", "-"])
def test_the_same_command_replaces_its_own_files(hashed: str, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["fillerbuster", "eval", "model"])
    suffixes = {"json": "json", "csv": "csv", "markdown": "md", "figure": "png"}
    files = TableFiles(**{name: tmp_path / f"table.{suffix}" for name, suffix in suffixes.items()})

    def draw(report: Report, path: Path) -> None:
        save_figure(new_axes("dB")[0], path, origin_of(report))

    for value in (1.0, 2.0):
        files.publish(Report(seed=5, rows=[{"part": "a", "model": hashed, "value": value}]), draw)
    assert "| 2 |" in (tmp_path / "table.md").read_text()


def test_a_figure_says_what_it_takes_to_make_it_again(tmp_path: Path):
    rows = [{"part": "a", "model": hashed} for hashed in ("f9b4db88", "-", "0123abcd")]
    figure, _ = new_axes("dB")
    save_figure(figure, tmp_path / "figure.png", origin_of(Report(seed=5, rows=rows)))
    told = figure.get_suptitle().replace("\n", " ")
    assert told.startswith(command_line().split()[0]) and "model 0123abcd, f9b4db88," in told
    assert f"commit {commit()}" in told and "seed 5" in told and hardware() in told
    assert (tmp_path / "figure.png").stat().st_size > 1000
