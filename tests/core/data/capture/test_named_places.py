"""Names that people type for results: no command destroys what stands there, whatever is named, before it has worked
for hours.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from helpers.folders.owned import files, marked, refusal
from helpers.folders.runs import generated_views, make_run
from helpers.folders.whole_folders import left_behind
from helpers.tiny_models import save_tiny_model
from PIL import Image

from fb_core.data.rooms.room_captures import rooms
from fb_core.evaluation.figures.contact_sheet import Strip, write_contact_sheet
from fb_core.evaluation.results import Report
from fb_core.files.ownership import MARK_NAME, Target, foreign_files, kind_of, require_own_or_new, signature
from fb_core.files.whole import whole_folder
from fb_nerfstudio.runs.finished_run import read_run
from method_configs.benchmarks.table_files import csv_text, markdown_text
from method_configs.commands import command_line as commands
from method_configs.commands import demo
from method_configs.commands.complete import output as complete_output

# ---- single files ---------------------------------------------------------------------------------------------------


def _figure(path: Path) -> None:
    from matplotlib.figure import Figure

    Figure().savefig(path, metadata=signature(path))


def _report(path: Path) -> None:
    Report(seed=0, rows=[{"part": "a", "error": 1.0}]).write(path, command="fillerbuster bench sampler")


def _rows(path: Path) -> None:
    path.write_text(csv_text([{"part": "a", "error": 1.0}]))


def _table(path: Path) -> None:
    path.write_text(markdown_text(Report(seed=0, rows=[{"part": "a", "error": 1.0}]), "fillerbuster eval rooms"))


OURS: dict[str, Callable[[Path], None]] = {
    "sheet.png": lambda path: write_contact_sheet(
        path, [Strip(heading="a", pictures=[torch.zeros(3, 8, 8)])], title="b", subtitle="c"
    ),
    "figure.png": _figure,
    "figure.svg": _figure,
    "figure.pdf": _figure,
    "report.json": _report,
    "rows.csv": _rows,
    "table.md": _table,
    "empty": lambda path: path.touch(),
    "missing/new.png": lambda path: None,
}
"""What this program writes under a name of the user's."""

THEIRS: dict[str, bytes] = {
    "config.yml": b"!!python/object:fb_nerfstudio.trainer.FillerbusterTrainerConfig\nmethod_name: fillerbuster\n",
    "config.json": b'{"format_version": 1, "info": {"command": "fillerbuster train"}, "rows": 1}',
    "transforms.json": b'{"frames": [], "made by": "fillerbuster"}',
    "report.json": b'{"command": "fillerbuster complete", "photos": 3}',
    "notes.md": b"# My notes\n\nI ran\n`fillerbuster demo`, and it was fine\n",
    "table.csv": b"name,score\nfillerbuster,3\n",
    "photo.jpg": b"\xff\xd8\xff\xe0 fillerbuster",
    "thesis.tex": b"\\documentclass{book} fillerbuster",
}
"""What it does not, however much it looks like it."""


@pytest.mark.parametrize("name", OURS)
def test_an_earlier_result_may_be_replaced(tmp_path: Path, name: str):
    OURS[name](tmp_path / name)
    require_own_or_new(tmp_path / name)


@pytest.mark.parametrize("name", THEIRS)
def test_another_file_may_not(tmp_path: Path, name: str):
    (tmp_path / name).write_bytes(THEIRS[name])
    with pytest.raises(ValueError, match="is no earlier result of this program; choose another name"):
        require_own_or_new(tmp_path / name)


def test_nor_a_picture_of_others_a_folder_or_a_link(tmp_path: Path):
    Image.new("RGB", (8, 8)).save(tmp_path / "photo.png")
    with pytest.raises(ValueError, match="no earlier result"):
        require_own_or_new(tmp_path / "photo.png")
    OURS["sheet.png"](tmp_path / "sheet.png")
    (tmp_path / "link.png").symlink_to("sheet.png")
    (tmp_path / "dangling.png").symlink_to("nowhere.png")
    for name in ("link.png", "dangling.png", "."):
        with pytest.raises(ValueError, match="is a link or a folder"):
            require_own_or_new(tmp_path / name)
    require_own_or_new(Path(os.devnull))


def test_results_spare_runs_captures_and_models(tiny_capture: Path, tmp_path: Path, capsys):
    """Before anything is measured: none of these commands would end here within the test's time."""
    run = make_run(tmp_path / "run", tiny_capture, None)
    model = save_tiny_model(tmp_path / "model")
    photo = next((tiny_capture / "images").iterdir())
    before = files(tmp_path)
    for place in (
        run / "config.yml",
        next((run / "nerfstudio_models").iterdir()),
        photo,
        tiny_capture / "transforms.json",
    ):
        assert "no earlier result" in refusal(capsys, "sheet", run, "--output", place)
        for option in ("--json", "--figure"):
            assert "no earlier result" in refusal(capsys, "bench", "networks", option, place)
    assert "no earlier result" in refusal(capsys, "eval", "rooms", "--json", model / "config.json")
    assert "no earlier result" in refusal(capsys, "eval", "rooms", "--sheet", photo)
    assert "no earlier result" in refusal(capsys, "bench", "inference", "--markdown", photo)
    assert "no earlier result" in refusal(capsys, "bench", "inference", "--csv", photo)
    assert files(tmp_path) == before


def test_results_that_could_not_be_written_are_refused_before_anything_is_measured(tmp_path: Path, capsys):
    (tmp_path / "note.txt").write_text("mine")
    below, one = tmp_path / "note.txt" / "table.json", tmp_path / "one.png"
    for option in ("--json", "--csv", "--markdown", "--figure"):
        assert "note.txt is a file; choose another place" in refusal(capsys, "bench", "inference", option, below)
    assert "note.txt is a file; choose another place" in refusal(
        capsys, "eval", "consistency", tmp_path, "--keep", tmp_path / "note.txt"
    )
    assert "note.txt is a file; choose another place" in refusal(
        capsys, "bench", "paper", "--data", tmp_path, "--output", tmp_path / "note.txt"
    )
    for name in ("figure", "figure.xyz", "figure.json"):
        said = refusal(capsys, "bench", "inference", "--figure", tmp_path / name)
        assert f"figure: expected a name that ends with .png, .svg, .pdf, got {name}; rename it" in said
    said = refusal(capsys, "eval", "conditioning", "--data", tmp_path, "--sheet", tmp_path / "sheet.pdf")
    assert "sheet: expected a name that ends with .png, got sheet.pdf" in said
    said = refusal(capsys, "bench", "inference", "--json", one, "--figure", one)
    assert "figure: " in said and "is the place of --json already; choose another name" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["note.txt"]


# ---- folders --------------------------------------------------------------------------------------------------------


def test_a_damaged_mark_makes_no_folder_ours(tmp_path: Path):
    """Without its list of files nothing would be known as somebody else's, and all would be removed."""
    whole = json.loads((marked(tmp_path / "whole", "export") / MARK_NAME).read_text())
    assert whole == {"made_by": "fillerbuster", "kind": "export", "format": 1, "files": ["note.txt"]}
    damages = [{key: value for key, value in whole.items() if key != gone} for gone in whole]
    damages += [whole | {"files": value} for value in (None, "note.txt", {"note.txt": 1}, 3)]
    damages += [whole | {"format": value} for value in (2, "1", None)] + [
        whole | {"kind": value} for value in (None, 3, ["export"])
    ]
    for number, damaged in enumerate(damages):
        folder = marked(tmp_path / str(number), "export")
        (folder / "thesis.txt").write_text("years of work")
        (folder / MARK_NAME).write_text(json.dumps(damaged))
        with pytest.raises(ValueError, match="something else than an earlier export"):
            Target(folder=folder, kind="export", overwrite=True).check()
        assert kind_of(folder) is None and foreign_files(folder) == []


@pytest.mark.parametrize("there", ["empty", "ours"])
@pytest.mark.parametrize("place", [".", "..", "../here", "a link"])
def test_the_folder_that_a_command_is_started_in_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: str, place: str
):
    """Its shell would be left in a folder that is there no more."""
    here = tmp_path / "above" / "here"
    here.mkdir(parents=True) if there == "empty" else marked(here, "export")
    if place == "..":
        marked(tmp_path / "other", "export")
        shutil.move(tmp_path / "other" / MARK_NAME, here.parent / MARK_NAME)
    (tmp_path / "link").symlink_to("above")
    monkeypatch.chdir(here)
    folder = tmp_path / "link" / "here" if place == "a link" else Path(place)
    before = here.stat().st_ino
    with pytest.raises(ValueError, match="the folder that this command was started in; choose a new folder in it"):
        with whole_folder(Target(folder=folder, kind="export", overwrite=True)):
            pass
    assert here.stat().st_ino == before
    with whole_folder(Target(folder=Path("new"), kind="export")):
        pass
    assert kind_of(here / "new") == "export"


def test_the_root_of_a_disk_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Such as a container's volume: nothing can take its place."""
    (tmp_path / "volume").mkdir()
    real = os.path.ismount
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path) == tmp_path / "volume" or real(path))
    with pytest.raises(ValueError, match="root of a disk"):
        Target(folder=tmp_path / "volume", kind="export").check()
    Target(folder=tmp_path / "volume" / "new", kind="export").check()


def test_complete_spares_the_files_that_its_photos_are_links_to(tmp_path: Path, capsys):
    """The folder of photos holds links into an earlier output, which the new one would replace."""
    rooms(3, tmp_path / "room", family="narrow", views=4, size=32, held_out=2)
    earlier = marked(tmp_path / "earlier", complete_output.KIND, tmp_path / "room")
    (tmp_path / "photos").mkdir()
    for path in (earlier / "images").iterdir():
        (tmp_path / "photos" / path.name).symlink_to(path)
    options = (
        "--model",
        save_tiny_model(tmp_path / "model"),
        "--views",
        2,
        "--steps",
        1,
        "--no-check",
        "--device",
        "cpu",
    )
    before = files(tmp_path)
    told = refusal(capsys, "complete", tmp_path / "photos", "--output", earlier, "--overwrite", *options)
    assert "holds the input" in told and files(tmp_path) == before


def test_export_spares_masks_and_points_that_its_capture_names_elsewhere(tiny_capture: Path, tmp_path: Path, capsys):
    elsewhere = marked(tmp_path / "earlier", "export", tiny_capture)
    content = json.loads((tiny_capture / "transforms.json").read_text())
    told = json.dumps(content | {"ply_file_path": "../earlier/points3D.ply"})
    (tiny_capture / "transforms.json").write_text(told)
    (elsewhere / "points3D.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    before = files(tmp_path)
    told = refusal(
        capsys, "export", run, "--format", "nerfstudio", "--output", os.path.relpath(elsewhere), "--overwrite"
    )
    assert "holds the input" in told and files(tmp_path) == before


def test_a_training_replaces_no_model_but_its_own(tmp_path: Path, capsys):
    save_tiny_model(tmp_path / "training" / "model")
    before = files(tmp_path)
    command = ("train", "rooms-tiny", "--output", tmp_path / "training", "--device", "cpu")
    assert "no training that made it" in refusal(capsys, *command)
    (tmp_path / "training" / "dit").mkdir()
    (tmp_path / "training" / "dit" / "checkpoint.pt").touch()
    assert "holds the input" in refusal(capsys, *command, "--start-from", tmp_path / "training" / "model")
    (tmp_path / "training" / "dit" / "checkpoint.pt").unlink()
    assert files(tmp_path) == before


def test_commands_write_two_results_to_one_place_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
):
    """The second one to end finds the first one's, and says so; with --overwrite it replaces it."""
    command = ["rooms", "--output", str(tmp_path / "out"), "--views", "3", "--size", "16", "--held-out", "2"]
    from fb_core.data.rooms import room_captures

    real, nested = room_captures.whole_folder, []

    def meanwhile(target: Target):
        if not nested:
            nested.append(target)
            commands.main([*command, "--seed", "5"])
        return real(target)

    monkeypatch.setattr(room_captures, "whole_folder", meanwhile)
    assert "exists already" in refusal(capsys, *command)
    assert [path.name for path in tmp_path.iterdir()] == ["out"] and kind_of(tmp_path / "out") == "capture"


def test_what_a_kill_left_confuses_neither_a_demo_nor_whoever_reads_a_run(tiny_capture: Path, tmp_path: Path):
    """A demo that was killed at its very first file begins anew; half a checkpoint is gone once its run is looked
    at.
    """
    left_behind(tmp_path / "demo" / MARK_NAME)
    demo._clear(tmp_path / "demo")
    assert kind_of(tmp_path / "demo") == "demo" and [path.name for path in (tmp_path / "demo").iterdir()] == [MARK_NAME]
    run = make_run(tmp_path / "run", tiny_capture, None)
    before = files(run)
    left_behind(run / "nerfstudio_models", new="half")
    read_run(run)
    assert files(run) == before
