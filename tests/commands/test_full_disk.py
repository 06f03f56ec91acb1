"""A disk that is full or cannot be written: one sentence that names the file, an exit code, old files whole, nothing
half written.

On a file system of half a megabyte where this may be mounted (root on Linux), and everywhere with errors put in by
hand.
"""

from __future__ import annotations

import copy
import errno
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from helpers.folders.runs import generated_views, make_run
from helpers.processes.ns_train import run_ns_train, toy_config
from helpers.tiny_models import save_tiny_model
from helpers.tiny_training import TOY
from safetensors.torch import save_file

from fb_core.completion.results.cache import CompletionCache
from fb_core.data import media
from fb_core.data.photos.film import write_film
from fb_core.evaluation.figures.contact_sheet import Strip, write_contact_sheet
from fb_core.evaluation.results import Report
from fb_core.files.faults import CannotWrite, Refused
from fb_core.files.whole import whole_file
from fb_core.training.run.checkpoints import Checkpoints
from fb_core.training.run.progress_log import ProgressLog
from fb_nerfstudio.runs.training_process import TrainingProcess
from fb_nerfstudio.trainer import FillerbusterTrainerConfig
from method_configs.commands import command_line as commands
from method_configs.presets import PRESETS
from method_configs.splats import fillerbuster

KIB, BLOCK = 1024, 4096


class Disk:
    """A small file system of its own."""

    def __init__(self, root: Path):
        self.root = root

    def leave(self, room: int) -> None:
        """Fill the disk but for so many bytes."""
        ballast = self.root / ".ballast"
        ballast.unlink(missing_ok=True)
        free = os.statvfs(self.root)
        ballast.write_bytes(bytes(max(0, free.f_bavail * free.f_frsize - room)))

    def freeze(self) -> None:
        """Make it read-only."""
        subprocess.run(["mount", "-o", "remount,ro", str(self.root)], check=True)

    def files(self) -> dict[str, bytes]:
        found = {path.relative_to(self.root).as_posix(): path for path in self.root.rglob("*") if path.is_file()}
        return {name: path.read_bytes() for name, path in found.items() if name != ".ballast"}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    root = tmp_path / "disk"
    root.mkdir()
    mount = shutil.which("mount")
    done = (
        None
        if mount is None
        else subprocess.run([mount, "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(root)], capture_output=True)
    )
    if done is None or done.returncode:
        pytest.skip("a small file system can be mounted by root on Linux alone")
    try:
        yield Disk(root)
    finally:
        subprocess.run(["umount", "-l", str(root)], check=True)


def picture(side: int = 300) -> torch.Tensor:
    return torch.rand(3, side, side, generator=torch.Generator().manual_seed(0))


def _sheet(path: Path) -> None:
    write_contact_sheet(path, [Strip(heading="Noise", pictures=[picture()] * 8)], title="A sheet")


def _saved(path: Path) -> None:
    with whole_file(path) as unfinished:
        torch.save({"values": torch.rand(100_000)}, unfinished)


def _safetensors(path: Path) -> None:
    with whole_file(path) as unfinished:
        save_file({"values": torch.rand(100_000)}, unfinished)


def _report(path: Path) -> None:
    Report(seed=0, rows=[{"value": float(index)} for index in range(10_000)]).write(path, command="bench")


def _checkpoint(path: Path) -> None:
    checkpoints = Checkpoints(path.parent, 2)
    checkpoints.write({"step": 2, "values": torch.rand(100_000)})


def _log(path: Path) -> None:
    ProgressLog(path.parent, "a training", from_step=10**9).add(
        10**9, dict.fromkeys((f"loss {index}" for index in range(5000)), 1.0), {}
    )


WRITERS: dict[str, Callable[[Path], object]] = {
    "sheet.png": _sheet,
    "saved.pt": _saved,
    "weights.safetensors": _safetensors,
    "report.json": _report,
    "checkpoint.pt": _checkpoint,
    "log.jsonl": _log,
}


def _old(path: Path) -> bytes:
    """An earlier file, such as the writer takes for its own."""
    path.parent.mkdir()
    content = b'{"step": 1, "loss": 2.0}\n' if path.suffix == ".jsonl" else b"old"
    path.write_bytes(content)
    return content


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("room", [0, 3 * BLOCK, 8 * BLOCK])
def test_a_file_on_a_full_disk_is_the_old_one(disk: Disk, name: str, room: int):
    path = disk.root / "out" / name
    old = _old(path)
    disk.leave(room)
    with pytest.raises(CannotWrite, match=rf"cannot write {path}: No space left on device; free some room"):
        WRITERS[name](path)
    assert disk.files() == {f"out/{name}": old} and os.listdir(path.parent) == [name]
    disk.leave(4096 * KIB)
    WRITERS[name](path)
    assert path.read_bytes() != old and [one for one in os.listdir(path.parent) if one.startswith(".")] == []


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_on_a_disk_that_cannot_be_written_is_the_old_one(disk: Disk, name: str):
    path = disk.root / "out" / name
    old = _old(path)
    disk.freeze()
    with pytest.raises(
        CannotWrite, match=rf"cannot write {path.parent}.*: Read-only file system; choose a folder on a disk"
    ):
        WRITERS[name](path)
    assert disk.files() == {f"out/{name}": old}


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".exr", ".tif", ".mp4"])
def test_pictures_and_films_are_whole_or_absent_at_any_room(disk: Disk, tmp_path: Path, suffix: str):
    """Their libraries cut files short without a word, or end the process, when room runs out at the wrong place."""
    path, reference = disk.root / f"a{suffix}", tmp_path / f"a{suffix}"

    def write(target: Path) -> None:
        if suffix == ".mp4":
            write_film(target, [picture(64)] * 3)
        else:
            media.write_image(target, picture(100))

    write(reference)
    wanted = reference.stat().st_size
    refused = 0
    for blocks in range(wanted // BLOCK + 2):
        disk.leave(blocks * BLOCK)
        try:
            write(path)
        except CannotWrite as error:
            refused += 1
            assert str(path) in str(error) and "No space left on device" in str(error) and not path.exists()
        else:
            assert abs(path.stat().st_size - wanted) < 64 and blocks * BLOCK >= wanted - 64
            path.unlink()
    assert refused >= wanted // BLOCK


def test_a_model_on_a_full_disk_is_the_old_one(disk: Disk):
    save_tiny_model(disk.root / "model", seed=1)
    before = disk.files()
    disk.leave(64 * KIB)
    with pytest.raises(CannotWrite, match=r"cannot write .*/model.*: No space left on device"):
        save_tiny_model(disk.root / "model", seed=2)
    assert disk.files() == before and sorted(os.listdir(disk.root)) == [".ballast", "model"]


def refusal(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        commands.main([str(argument) for argument in arguments])
    told = capsys.readouterr().err.strip().splitlines()
    assert stopped.value.code == 1 and not any("Traceback" in line for line in told)
    return told[-1]


@pytest.mark.parametrize("state", ["full", "read-only"])
def test_commands_on_such_a_disk(
    disk: Disk, shared_path, tmp_path: Path, tiny_capture: Path, capsys, monkeypatch: pytest.MonkeyPatch, state: str
):
    monkeypatch.setitem(PRESETS, "toy", TOY)
    run = make_run(tmp_path / "run", tiny_capture, generated_views())
    commands.main(["export", str(run), "--format", "nerfstudio", "--output", str(disk.root / "export")])
    (disk.root / "report.json").write_text("old")
    before = disk.files()
    disk.leave(4 * BLOCK)
    if state == "read-only":
        disk.freeze()
    reason = {
        "full": "No space left on device; free some room",
        "read-only": "Read-only file system; choose a folder on a disk",
    }[state]
    for name, arguments in {
        "export": ("export", run, "--format", "nerfstudio", "--overwrite"),
        "model": ("convert", shared_path("golden/reference")),
        "scene": ("complete", tiny_capture, "--poses-only", "--cameras", "features"),
        "room": ("rooms", "--views", 3, "--size", 64, "--held-out", 2),
        "training": ("train", "toy", "--device", "cpu", "--steps", 1),
    }.items():
        told = refusal(capsys, *arguments, "--output", disk.root / name)
        assert f"cannot write {disk.root}" in told and reason in told, told
        assert {path: content for path, content in disk.files().items() if not path.startswith("training")} == before


def test_a_cache_that_is_full_does_not_end_a_run(disk: Disk, caplog):
    disk.leave(2 * BLOCK)
    CompletionCache(disk.root / "cache").keep("ab" * 32, torch.zeros(2, 64, 64, 3, dtype=torch.uint8))
    assert "could not keep a round" in caplog.text and "No space left on device" in caplog.text and disk.files() == {}


# ---- a training in nerfstudio ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture and a model."""
    from fb_core.data.rooms.room_captures import rooms

    folder = tmp_path_factory.mktemp("room")
    rooms(3, folder / "room", family="narrow", views=4, size=32, held_out=2)
    return folder / "room", save_tiny_model(folder / "model", image_size=32)


@pytest.mark.parametrize("kib", [0, 12, 40, 120, 260])
def test_a_training_ends_with_one_sentence_wherever_room_runs_out(disk: Disk, room: tuple[Path, Path], kib: int):
    """From its first file (config.yml) to a checkpoint; TensorBoard's files are among what fills the disk."""
    config = toy_config(room[0], disk.root / "runs", room[1], "run")
    config.steps_per_save = 1
    disk.leave(kib * KIB)
    with pytest.raises(
        Refused,
        match=r"cannot write .*: No space left on device; free some room, or choose another folder; checkpoints",
    ):
        run_ns_train(config)
    run = disk.root / "runs" / "room" / "fillerbuster" / "run"
    assert not list(run.glob(".*unfinished*")) and not list(disk.root.rglob(".config.yml*"))
    for path in run.glob("nerfstudio_models/*"):
        assert "pipeline" in torch.load(path, weights_only=True)
    if (run / "config.yml").exists():
        assert (run / "config.yml").read_text().startswith("!!python/object:fb_nerfstudio.trainer")


def test_an_earlier_checkpoint_of_a_training_stays_whole(
    tmp_path: Path, room: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
):
    config, real, saved = toy_config(room[0], tmp_path, room[1], "run"), torch.save, []
    config.steps_per_save = 1

    def full(state, path, *args, **kwargs):
        saved.append(path)
        if len(saved) < 4:
            return real(state, path, *args, **kwargs)
        Path(path).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(Refused, match=r"nerfstudio_models/step-\d+.ckpt: No space left on device"):
        run_ns_train(config)
    (path,) = (tmp_path / "room" / "fillerbuster" / "run" / "nerfstudio_models").iterdir()
    assert "pipeline" in torch.load(path, weights_only=True)
    assert not list(path.parent.parent.glob(".*unfinished*"))


def test_errors_of_other_kinds_stay_what_they_are(tmp_path: Path):
    from fb_nerfstudio.refusal import refusing_what_cannot_be_written

    with pytest.raises(FileNotFoundError, match="elsewhere"), refusing_what_cannot_be_written(tmp_path / "run"):
        (tmp_path / "elsewhere").read_bytes()
    with (
        pytest.raises(Refused, match=r"cannot write .*run/file: No such file"),
        refusing_what_cannot_be_written(tmp_path / "run"),
    ):
        (tmp_path / "run" / "file").write_bytes(b"")


def test_a_config_on_a_disk_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    config: FillerbusterTrainerConfig = copy.deepcopy(fillerbuster.config)  # type: ignore[assignment]
    config.output_dir, config.experiment_name, config.timestamp = tmp_path / "file", "a", "b"
    (tmp_path / "file").touch()
    with pytest.raises(Refused, match=r"cannot write .*config.yml: .*; check the path, or choose another folder"):
        config.save_config()


# ---- child processes and memory -------------------------------------------------------------------------------------


def test_a_training_process_goes_on_when_its_log_cannot_be_written(
    disk: Disk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its pipe is read on, for else it would wait for ever; the last line is told all the same."""
    talks = tmp_path / "ns-train"
    lines = [f"#!{sys.executable}", *["print('y' * 65536)"] * 20, "print('the last line')", "exit(3)"]
    talks.write_text("\n".join(lines) + "\n")
    talks.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    disk.leave(2 * BLOCK)
    process = TrainingProcess(
        ["fillerbuster"], log=disk.root / "log", iterations=1, rounds=0, threads=1, report=lambda *_: None
    )
    with pytest.raises(ValueError, match=r"code 3: the last line \(cannot write .*/log: No space left on device"):
        process.finish()


def test_pictures_go_straight_to_the_disk_where_there_are_no_files_in_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delattr(os, "memfd_create", raising=False)
    media.write_image(tmp_path / "a.png", picture(20))
    assert torch.equal(media.read_image(tmp_path / "a.png"), (picture(20) * 255).round() / 255)
