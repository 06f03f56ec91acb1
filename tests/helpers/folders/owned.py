"""Folders with and without marks."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fb_core.files.ownership import Target
from fb_core.files.whole import whole_folder
from method_configs.commands import command_line as commands


def files(folder: Path) -> dict[str, bytes | str]:
    """Everything in a folder, links by where they lead."""
    found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    return {
        name: str(path.readlink()) if path.is_symlink() else path.read_bytes()
        for name, path in found.items()
        if not path.is_dir()
    }


def refusal(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """The one sentence with which a command refuses."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        commands.main([str(argument) for argument in arguments])
    told = capsys.readouterr().err.strip()
    assert stopped.value.code == 1 and "Traceback" not in told and told.splitlines()[-1].startswith("Error: ")
    return told.splitlines()[-1]


def marked(folder: Path, kind: str, source: Path | None = None) -> Path:
    """A folder with our mark, with the content of another one."""
    with whole_folder(Target(folder=folder, kind=kind)) as unfinished:
        if source is not None:
            shutil.copytree(source, unfinished, dirs_exist_ok=True)
        (unfinished / "note.txt").write_text("there before")
    return folder
