"""`fillerbuster eval model`: the questions drawn from captures, what is not true does not count, one table of several
models.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from helpers.folders.colmap_files import colmap_capture
from helpers.tiny_models import save_tiny_model, tiny_model

from fb_core.data.capture.captures import read_capture
from fb_core.data.training.capture_sequences import CaptureConfig, Window
from fb_core.evaluation import ablations, conditioning
from fb_core.evaluation.ablations import Asked, conditional_validation_loss, sequence_scores
from fb_core.evaluation.capture_questions import (
    CaptureViews,
    ScaledPictures,
    capture_folders,
    drawn_views,
    readable_captures,
)
from fb_core.inpainter import Fillerbuster, SamplingConfig
from method_configs.evaluations.conditioning import Conditioning
from method_configs.evaluations.model import PAPER, ModelOnCaptures


def views_of(capture: Path, *, views: int = 4, seed: int = 0) -> CaptureViews:
    captures = readable_captures([capture], views=views)
    return drawn_views(captures, views, CaptureConfig(image_size=32), generator=torch.Generator().manual_seed(seed))


def test_questions_are_decided_by_their_seed(tiny_capture: Path):
    one, same, other = (views_of(tiny_capture, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one.images, same.images) and torch.equal(
        one.cameras.camera_to_world, same.cameras.camera_to_world
    )
    assert not torch.equal(one.images, other.images)
    assert one.images.shape == (4, 3, 32, 32) and one.capture == "tiny_capture"
    assert 0 < float(one.truth.mean()) < 1, "every second picture has a mask"
    assert float((one.images * (1 - one.truth)).abs().max()) == 0


def test_pictures_that_sequences_share_are_read_once_while_there_is_room(tiny_capture: Path, monkeypatch):
    captures, config, read = readable_captures([tiny_capture], views=4), CaptureConfig(image_size=32), []
    real = Window.scaled
    monkeypatch.setattr(Window, "scaled", lambda window: read.append(window.frame.image_path) or real(window))

    def drawn(pictures: ScaledPictures | None) -> list[CaptureViews]:
        read.clear()
        draws = [torch.Generator().manual_seed(seed) for seed in range(6)]
        return [drawn_views(captures, 4, config, generator=draw, pictures=pictures) for draw in draws]

    alone = drawn(None)
    assert len(read) == 24
    for most_bytes in (2**30, 0):
        together = drawn(ScaledPictures(most_bytes))
        assert len(read) == (len(set(read)) if most_bytes else 24)
        for one, other in zip(alone, together, strict=True):
            assert torch.equal(one.images, other.images) and torch.equal(one.truth, other.truth)
    pictures = ScaledPictures(2**16)
    drawn(pictures)
    assert 0 < sum(image.nbytes + truth.nbytes for image, truth in pictures._kept.values()) <= 2**16


@pytest.mark.parametrize("layout", ["nerfstudio", "lerf", "scannetpp"])
def test_datasets_as_they_lie_on_disk(layout: str, tiny_capture: Path, tmp_path: Path):
    """A folder of scenes; LERF's lie deeper; ScanNet++ has its pictures and masks in folders beside that of
    transforms.json.
    """
    root = tmp_path / "dataset"
    place = {"nerfstudio": "scene", "lerf": "LERF_Dataset/scene", "scannetpp": "data/scene/dslr/nerfstudio"}[layout]
    shutil.copytree(tiny_capture, root / place)
    if layout == "scannetpp":
        content = json.loads((root / place / "transforms.json").read_text())
        for kind, key, folder in (
            ("images", "file_path", "resized_images"),
            ("masks", "mask_path", "resized_anon_masks"),
        ):
            names = {Path(frame[key]).name for frame in content["frames"] if key in frame}
            assert names
            (root / place / kind).rename((root / place).parent / folder)
            for frame in content["frames"]:
                if key in frame:
                    frame[key] = Path(frame[key]).name
        (root / place / "transforms.json").write_text(json.dumps(content))
    folders = capture_folders(root)
    assert [folder.relative_to(root).as_posix() for folder in folders] == [place]
    views = drawn_views(
        readable_captures(folders, views=4), 4, CaptureConfig(image_size=32), generator=torch.Generator().manual_seed(1)
    )
    assert torch.equal(views.images, views_of(tiny_capture, seed=1).images) and 0 < float(views.truth.mean()) < 1


def test_colmap_captures_are_asked_as_they_lie_on_disk(tiny_capture: Path, tmp_path: Path):
    """Mip-NeRF 360's layout: sparse/0 and images, several scenes in a folder."""
    for scene in ("garden", "kitchen"):
        colmap_capture(tmp_path / "360" / scene, read_capture(tiny_capture))
    folders = capture_folders(tmp_path / "360")
    captures = readable_captures(folders, views=4)
    assert [name for name, _ in captures] == ["garden", "kitchen"]
    views = drawn_views(captures, 4, CaptureConfig(image_size=32), generator=torch.Generator().manual_seed(1))
    assert views.capture in ("garden", "kitchen") and float(views.truth.mean()) == 1
    table = tmp_path / "table.json"
    model = save_tiny_model(tmp_path / "model")
    options = {"lengths": (4,), "sequences": 1, "times": 1, "steps": 1, "json": table}
    ModelOnCaptures(data=tmp_path / "360", models=(model,), **options).run()
    assert json.loads(table.read_text())["rows"][0]["part"] == "360, 32 pixels, 1 sequences"


def test_what_is_not_true_does_not_count(tiny_capture: Path, tmp_path: Path, monkeypatch):
    """An error of 0.1 in true pixels is 20 dB, whatever stands where nobody knows the truth."""
    views = views_of(tiny_capture)
    known = torch.zeros_like(views.truth)
    known[0] = views.truth[0]
    wrong = torch.where(views.truth > 0, views.images + 0.1, 0.7 * torch.ones_like(views.images))
    monkeypatch.setattr(ablations, "conditional_validation_loss", lambda *_, **__: 1.0)
    monkeypatch.setattr(Fillerbuster, "complete", lambda *_, **__: SimpleNamespace(images=wrong))
    scores = sequence_scores(tiny_model(tmp_path), Asked(views, known, 0), SamplingConfig(steps=1), 2, None)
    assert scores["psnr"] == pytest.approx(20.0, abs=1e-3)


def test_validation_loss_of_a_capture(tiny_capture: Path, tmp_path: Path):
    views = views_of(tiny_capture)
    loss = conditional_validation_loss(tiny_model(tmp_path), views, torch.ones_like(views.truth), times=2)
    assert 0 < loss < 100


def test_several_models_in_one_table_and_nothing_twice(tiny_capture: Path, tmp_path: Path, monkeypatch):
    models = tuple(save_tiny_model(tmp_path / name, seed=seed) for seed, name in enumerate(("first", "second")))
    suffixes = {"json": "json", "csv": "csv", "markdown": "md", "figure": "png"}
    files = {name: tmp_path / f"table.{suffix}" for name, suffix in suffixes.items()}
    shutil.copytree(tiny_capture, tmp_path / "captures" / "a" / "b")
    options = {
        "data": tmp_path / "captures",
        "models": models,
        "lengths": (4, 4),
        "sequences": 2,
        "times": 2,
        "steps": 1,
    }
    command = ModelOnCaptures(**options, keep=tmp_path / "kept", **files)
    command.run()
    rows = json.loads(files["json"].read_text())["rows"]
    ours = [row for row in rows if "model" in row]
    assert [row["method"] for row in ours] == ["first", "second"] and all(row["views"] == 4 for row in ours)
    assert ours[0]["model"] != ours[1]["model"] and {"psnr", "psnr_interval", "ssim", "val"} <= set(ours[0])
    assert all(path.stat().st_size > 100 for path in files.values())

    def never(*_):
        raise AssertionError("measured again")

    monkeypatch.setattr(ablations, "sequence_scores", never)
    command.run()
    with pytest.raises(AssertionError):
        ModelOnCaptures(**options | {"seed": 1}, keep=tmp_path / "kept").run()


def test_rooms_where_there_is_no_data(tmp_path: Path):
    folder = save_tiny_model(tmp_path / "model")
    command = ModelOnCaptures(
        models=(folder,), lengths=(8,), sequences=1, times=1, steps=1, json=tmp_path / "table.json"
    )
    command.run()
    rows = json.loads((tmp_path / "table.json").read_text())["rows"]
    assert rows[0]["views"] == 8 and "narrow rooms" in rows[0]["part"]
    said = {row["method"]: row["psnr"] for row in rows[1:]}
    assert said == {name: cells[8][0] for name, cells in PAPER.items()}, "beside it, what the paper has"


def test_bad_data_is_told(tiny_capture: Path, tmp_path: Path):
    with pytest.raises(ValueError, match=r"has 6 frames, fewer than the 8 views of a sequence\); ask for fewer views"):
        ModelOnCaptures(data=tiny_capture, lengths=(8,)).run()
    with pytest.raises(ValueError, match="lengths of 4 or more views"):
        ModelOnCaptures(lengths=(3,)).run()
    with pytest.raises(ValueError, match="lengths: expected 4 to 10000, got 100000"):
        ModelOnCaptures(lengths=(8, 10**5)).run()
    with pytest.raises(ValueError, match="size: expected 16 to 8192, got -64"):
        ModelOnCaptures(size=-64).run()
    with pytest.raises(ValueError, match="known and hidden views together: expected 2 to 10000, got 100008"):
        Conditioning(data=tiny_capture, known=(10**5,)).run()
    with pytest.raises(ValueError, match="which is none; check the path"):
        capture_folders(tmp_path / "nowhere")


def test_the_same_hidden_views_from_more_and_more_known_ones(tiny_capture: Path, tmp_path: Path, monkeypatch):
    asked, real = [], conditioning.generated_from

    def recorded(model, views, *, hidden, known, sampling, seed):
        asked.append((known, seed, views.images[:hidden]))
        return real(model, views, hidden=hidden, known=known, sampling=sampling, seed=seed)

    monkeypatch.setattr(conditioning, "generated_from", recorded)
    suffixes = {"json": "json", "csv": "csv", "markdown": "md", "figure": "png", "sheet": "sheet.png"}
    files = {name: tmp_path / f"table.{suffix}" for name, suffix in suffixes.items()}
    folder = save_tiny_model(tmp_path / "model")
    options = {
        "data": tiny_capture,
        "model": folder,
        "known": (1, 4, 4),
        "hidden": 2,
        "sequences": 2,
        "steps": 1,
        "keep": tmp_path / "kept",
    }
    Conditioning(**options, **files).run()
    assert [(known, seed) for known, seed, _ in asked[:4]] == [(1, 0), (1, 1), (4, 0), (4, 1)]
    assert torch.equal(asked[0][2], asked[2][2]) and torch.equal(asked[1][2], asked[3][2])
    rows = json.loads(files["json"].read_text())["rows"]
    assert [row["known"] for row in rows] == [1, 4] and all(path.stat().st_size > 100 for path in files.values())
    Conditioning(**options).run()
    assert len(asked) == 6, "four scores and two rows of the sheet"
    with pytest.raises(ValueError, match="fewer than the 8 views"):
        Conditioning(**options | {"known": (6,)}).run()
    with pytest.raises(ValueError, match="got known none, hidden 2, sequences 2"):
        Conditioning(**options | {"known": ()}).run()


def test_scores_of_hidden_views(tiny_capture: Path):
    views = views_of(tiny_capture)
    garbage = torch.where(views.truth > 0, views.images + 0.1, 0.3 * torch.ones_like(views.images))
    assert conditioning.scores_of(garbage, views)["psnr"] == pytest.approx(20.0, abs=1e-3)
    assert conditioning.scores_of(views.images, views)["ssim"] == pytest.approx(1)


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("sparse/0/cameras.bin", "a part of a COLMAP model; copy its files images and cameras"),
        ("transforms_spheric.json", "a Blender scene without a transforms_train.json"),
        ("a/film.MP4", "a film; run fillerbuster complete"),
        ("images/1.JPG", "photos without cameras"),
        ("00000.tar", "WebDataset shards"),
        ("notes.txt", "files of no kind"),
        (None, "an empty folder"),
    ],
)
def test_folders_of_another_kind_are_named(file: str | None, said: str, tmp_path: Path):
    if file is not None:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    with pytest.raises(ValueError, match=said):
        capture_folders(tmp_path)
