"""No command deletes what it did not make: captures, inputs by any way to them, links, other kinds of folders, and
files added later.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers.folders.owned import files, marked, refusal
from helpers.folders.runs import generated_views, make_run
from helpers.tiny_models import save_tiny_model

from fb_core import checkpoint
from fb_core.checkpoint import model_hash
from fb_core.completion.results.completed_views import CompletedViews, views_target
from fb_core.data.capture.captures import read_capture
from fb_core.files.ownership import MARK_NAME, Target, foreign_files, kind_of
from fb_core.files.whole import whole_folder
from fb_nerfstudio.generation.generation import REPORT_NAME, Generation
from fb_nerfstudio.runs.earlier_runs import clear_run
from method_configs.commands import command_line as commands
from method_configs.commands import demo
from method_configs.commands.complete import output as complete_output

WAYS: dict[str, Callable[[Path], Path]] = {
    "itself": lambda place: place,
    "through ..": lambda place: place / "images" / "..",
    "through a link": lambda place: _link(place.parent / "link", place),
    "through a link above": lambda place: _link(place.parent / "above", place.parent) / place.name,
    "a file in it": lambda place: place / "transforms.json",
}
"""Ways to name a capture."""


def _link(path: Path, target: Path) -> Path:
    path.symlink_to(target)
    return path


# ---- the rule -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", WAYS)
def test_an_input_is_known_by_its_real_place(tiny_capture: Path, way: str):
    given = WAYS[way](tiny_capture)
    for output in (tiny_capture, tiny_capture.parent, tiny_capture / "images" / ".."):
        with pytest.raises(ValueError, match="holds the input"):
            Target(folder=output, kind="capture", overwrite=True, inputs=(given,)).check()


def test_a_folder_below_an_input_is_made_but_not_replaced(tiny_capture: Path):
    target = Target(folder=tiny_capture / "out", kind="export", overwrite=True, inputs=(tiny_capture,))
    with whole_folder(target):
        pass
    assert kind_of(tiny_capture / "out") == "export"
    with pytest.raises(ValueError, match="lies in the input"):
        target.check()


@pytest.mark.parametrize("leads_to", ["a folder of ours", "nothing"])
def test_links_are_neither_followed_nor_replaced(tmp_path: Path, leads_to: str):
    place = marked(tmp_path / "ours", "export") if leads_to == "a folder of ours" else tmp_path / "nowhere"
    link = _link(tmp_path / "link", place)
    with pytest.raises(ValueError, match="is a link"), whole_folder(Target(folder=link, kind="export", overwrite=True)):
        pass
    assert link.readlink() == place and place.exists() == (leads_to != "nothing")


def test_only_the_same_kind_with_a_mark_of_ours_is_replaced(tmp_path: Path):
    for name, text in (
        ("none", None),
        ("other", '{"made_by": "others", "kind": "export"}'),
        ("torn", '{"made_by"'),
        ("list", "[1]"),
        ("deep", "[" * 200000),
    ):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "transforms.json").write_text("{}")
        if text is not None:
            (folder / MARK_NAME).write_text(text)
        with pytest.raises(
            ValueError, match="holds something else than an earlier export, so that --overwrite does not touch it"
        ):
            Target(folder=folder, kind="export", overwrite=True).check()
    with pytest.raises(ValueError, match="something else than an earlier export"):
        Target(folder=marked(tmp_path / "room", "capture"), kind="export", overwrite=True).check()
    Target(folder=marked(tmp_path / "ours", "export"), kind="export", overwrite=True).check()
    odd = marked(tmp_path / "odd", "export")
    (odd / MARK_NAME).write_text(
        '{"made_by": "fillerbuster", "kind": "export", "format": 1, "files": [["note.txt"], {}, 3]}'
    )
    assert foreign_files(odd) == ["note.txt"]  # names that are none name nothing
    (tmp_path / "copied mark").mkdir()
    (tmp_path / "copied mark" / MARK_NAME).symlink_to(tmp_path / "ours" / MARK_NAME)
    with pytest.raises(ValueError, match="something else than an earlier export"):
        Target(folder=tmp_path / "copied mark", kind="export", overwrite=True).check()


def test_what_appears_while_a_folder_is_written_is_not_replaced(tmp_path: Path):
    with (
        pytest.raises(ValueError, match="exists already"),
        whole_folder(Target(folder=tmp_path / "out", kind="export")),
    ):
        (tmp_path / "out").mkdir()
        (tmp_path / "out" / "thesis.txt").write_text("years of work")
    assert files(tmp_path) == {"out/thesis.txt": b"years of work"}


# ---- the commands ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "shape", ["capture", "above", "through ..", "link", "run", "models", "completion", "another capture"]
)
def test_export_spares_inputs_and_what_others_made(tiny_capture: Path, tmp_path: Path, capsys, shape: str):
    run = make_run(tmp_path / "runs" / "run", tiny_capture, generated_views())
    generated_views().save_capture(run / "completion")
    shutil.copytree(tiny_capture, tmp_path / "another")
    outputs = {
        "capture": tiny_capture,
        "above": tiny_capture.parent,
        "through ..": tiny_capture / "images" / "..",
        "link": _link(tmp_path / "link", tiny_capture),
        "run": run,
        "models": run / "nerfstudio_models",
        "completion": run / "completion",
        "another capture": tmp_path / "another",
    }
    before = files(tmp_path)
    for format in ("nerfstudio", "colmap"):
        told = refusal(capsys, "export", run, "--format", format, "--output", outputs[shape], "--overwrite")
        assert "choose another folder" in told or "choose a folder outside" in told
    assert files(tmp_path) == before


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("output", ["itself", "through .."])
def test_complete_spares_its_input_by_any_way(tiny_capture: Path, capsys, way: str, output: str):
    """The worst case: the input is an earlier output of this very command."""
    source = marked(tiny_capture.parent / "scene", complete_output.KIND, tiny_capture)
    given, taken = WAYS[way](source), WAYS[output](source)
    before = files(tiny_capture.parent)
    assert "holds the input" in refusal(capsys, "complete", given, "--output", taken, "--overwrite")
    assert files(tiny_capture.parent) == before


def test_complete_spares_its_model_and_known_poses(tiny_capture: Path, tmp_path: Path, capsys):
    scene = marked(tmp_path / "scene", complete_output.KIND, tiny_capture)
    model = save_tiny_model(scene / "model")
    before = files(tmp_path)
    for options in (("--model", model), ("--known-poses", scene), ("--path", scene / "path.json")):
        assert "holds the input" in refusal(
            capsys, "complete", tiny_capture, "--output", scene, "--overwrite", *options
        )
    assert files(tmp_path) == before


def test_an_output_of_complete_without_a_mark_is_known_by_its_report_and_nothing_else_in_it(tmp_path: Path):
    folder = tmp_path / "old"
    (folder / "images").mkdir(parents=True)
    (folder / "report.json").write_text('{"command": "fillerbuster complete"}')
    target = Target(folder=folder, kind=complete_output.KIND, overwrite=True, earlier=complete_output.is_ours)
    target.check()
    (folder / "thesis.txt").touch()
    with pytest.raises(ValueError, match="something else than an earlier completed scene"):
        target.check()


def test_convert_replaces_a_model_only_when_asked_and_never_its_input(shared_path, tmp_path: Path, capsys):
    source = shutil.copytree(shared_path("golden/reference"), tmp_path / "released")
    model = save_tiny_model(tmp_path / "model")
    before = files(tmp_path)
    assert "exists already" in refusal(capsys, "convert", source, "--output", model)
    for place in (source, source / ".", _link(tmp_path / "link", source)):
        assert refusal(capsys, "convert", source, "--output", place, "--overwrite")
    (tmp_path / "link").unlink()
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "config.json").write_text('{"model_type": "clip"}')  # a name that other programs use, too
    assert "something else than an earlier model" in refusal(
        capsys, "convert", source, "--output", tmp_path / "clip", "--overwrite"
    )
    shutil.rmtree(tmp_path / "clip")
    assert files(tmp_path) == before
    old = model_hash(model)
    commands.main(["convert", str(source), "--output", str(model), "--overwrite"])
    assert model_hash(model) != old and kind_of(model) == "model"
    (model / MARK_NAME).unlink()  # as of an older version
    commands.main(["convert", str(source), "--output", str(model), "--overwrite"])


def test_training_refuses_a_taken_place_for_its_model_before_it_begins(tmp_path: Path, capsys):
    (tmp_path / "training" / "model").mkdir(parents=True)
    (tmp_path / "training" / "model" / "thesis.txt").write_text("years of work")
    told = refusal(capsys, "train", "rooms-tiny", "--output", tmp_path / "training", "--device", "cpu")
    assert "'thesis.txt', which is not part of a model" in told
    assert files(tmp_path) == {"training/model/thesis.txt": b"years of work"}


def test_rooms_replaces_nothing(tmp_path: Path, capsys):
    ours = marked(tmp_path / "ours", "capture")
    before = files(tmp_path)
    for place in (ours, _link(tmp_path / "link", tmp_path / "nowhere")):
        assert refusal(capsys, "rooms", "--output", place, "--views", "3", "--size", "16", "--held-out", "2")
    (tmp_path / "link").unlink()
    assert files(tmp_path) == before


def test_a_demo_replaces_an_earlier_demo_and_spares_all_else_in_it(tmp_path: Path, caplog):
    output = tmp_path / "demo"
    demo._clear(output)
    run = demo.run_folder(output, "fillerbuster")
    for name in (
        "config.yml",
        "nerfstudio_models/step-000000001.ckpt",
        "export-colmap/frames.json",
        "events.out.tfevents.1",
    ):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text("of the run")
    (output / "runs" / "mine").mkdir()
    (output / "runs" / "mine" / "thesis.txt").write_text("years of work")
    demo._clear(output)
    assert not run.exists() and (output / "runs" / "mine" / "thesis.txt").exists()
    assert (
        run.with_name("run.replaced-1") / "export-colmap" / "frames.json"
    ).exists() and "export-colmap" in caplog.text
    (output / "capture").mkdir()
    (output / "capture" / "transforms.json").write_text('{"frames": []}')  # somebody's, put there since
    with pytest.raises(ValueError, match="something else than an earlier capture"):
        demo._clear(output)
    assert (output / "capture" / "transforms.json").exists()


def test_a_demo_follows_no_link_and_spares_its_model(tmp_path: Path):
    output, elsewhere = tmp_path / "demo", tmp_path / "elsewhere"
    demo._clear(output)
    (elsewhere / "room" / "fillerbuster" / "run").mkdir(parents=True)
    (output / "runs").symlink_to(elsewhere)
    with pytest.raises(ValueError, match="through a link"):
        demo._clear(output)
    assert (elsewhere / "room" / "fillerbuster" / "run").exists()
    (output / "runs").unlink()
    with pytest.raises(ValueError, match="holds the input"):
        demo.run_demo(output, model=save_tiny_model(output / "my model"))
    assert (output / "my model" / "config.json").exists()


def test_an_earlier_run_is_taken_away_whole(tmp_path: Path):
    run = tmp_path / "runs" / "run"
    for folder in ("nerfstudio_models", "completion"):
        (run / folder).mkdir(parents=True)
    for name in ("config.yml", "dataparser_transforms.json", REPORT_NAME, "events.out.tfevents.1.vm.2.0"):
        (run / name).touch()
    clear_run(run, tmp_path)
    clear_run(run, tmp_path)  # and nothing happens where none is
    assert list((tmp_path / "runs").iterdir()) == []


def test_a_training_replaces_its_own_views_alone(tmp_path: Path, tiny_capture: Path, caplog):
    run = tmp_path / "run"
    generated_views().save_capture(run / "completion")
    generated_views()[[0]].save_capture(run / "completion")
    assert (
        kind_of(run / "completion") == views_target(run).kind
        and len(list((run / "completion" / "images").iterdir())) == 1
    )
    shutil.rmtree(run / "completion")
    shutil.copytree(tiny_capture, run / "completion")
    before = files(tmp_path)

    for views in (generated_views(), None):
        assert saved(views, run, tiny_capture) is None
    assert files(tmp_path) == before and "the generated views are in the checkpoint alone" in caplog.text


def saved(views: CompletedViews | None, run: Path, capture: Path) -> Path | None:
    """Where a training on a capture has saved its views, in the run's folder."""
    captured = SimpleNamespace(
        config=SimpleNamespace(data=capture, dataparser=None), train_dataparser_outputs=_pictures_of(capture)
    )
    state = SimpleNamespace(views=views, trust=None, rounds=SimpleNamespace(record=[]))
    generation: Any = SimpleNamespace(trainer=SimpleNamespace(base_dir=run), captured=captured, state=state)
    return Generation.save_views(generation)


def _pictures_of(capture: Path) -> SimpleNamespace:
    """What nerfstudio knows of a capture's files."""
    return SimpleNamespace(image_filenames=[frame.image_path for frame in read_capture(capture).frames],
                           mask_filenames=None)  # fmt: skip


def test_a_run_within_its_capture_keeps_all_of_its_rounds(tmp_path: Path, tiny_capture: Path, caplog):
    """nerfstudio names runs after the capture, so the quickstart's first command puts the run into outputs/room, which
    it reads; from the second round on generated views, also those asked for in the viewer, were in no folder.
    """
    room = shutil.copytree(tiny_capture, tmp_path / "outputs" / "room")
    run = room / "fillerbuster" / "first"

    captured = files(room)
    for views in (generated_views()[[0]], generated_views()):
        assert saved(views, run, room) == run / "completion"
        assert len(list((run / "completion" / "images").iterdir())) == len(views)
    assert files(room).items() >= captured.items() and not caplog.records
    before = files(room)  # what it reads it does not replace, whatever the mark says
    assert saved(generated_views(), run, run / "completion") is None
    assert files(room) == before and "holds the input" in caplog.text


def test_saving_a_model_survives_that_its_second_rename_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What lost the model before: it was moved aside, and then the new one could not be moved in."""
    import os

    from fb_core.files import whole

    model, real = save_tiny_model(tmp_path / "model", seed=1), os.rename
    before = model_hash(model)
    monkeypatch.setattr(whole, "exchange", lambda one, other: False)

    def fails(source, target):
        if Path(source).name == "new":
            raise OSError(5, "Input/output error")
        real(source, target)

    monkeypatch.setattr(os, "rename", fails)
    with pytest.raises(OSError, match=r"cannot write .*model: Input/output error"):
        save_tiny_model(model, seed=2)
    assert model_hash(model) == before and [path.name for path in tmp_path.iterdir()] == ["model"]
    assert checkpoint.load(model).info["preset"] == "random"


def test_a_place_by_way_of_a_missing_folder_is_the_place_that_is_there(tmp_path: Path):
    there = marked(tmp_path / "capture", "capture")
    before = files(there)
    for overwrite in (False, True):
        target = Target(
            folder=tmp_path / "missing" / ".." / "capture", kind="export", overwrite=overwrite, inputs=(there,)
        )
        with pytest.raises(ValueError, match="capture"), whole_folder(target):
            pass
    assert files(there) == before and [path.name for path in tmp_path.iterdir()] == ["capture"]
