"""Which folders and files a command may replace: those that carry its own mark, and that hold nothing it reads.

Every folder that is written here holds a small file, ``.fillerbuster.json``: who made it, of what kind it is, and the
names of all its files. A folder without that mark is somebody else's, whatever it looks like; so is every file in it
that the mark does not name. Single files whose names people type (sheets, figures, tables) say in themselves who made
them.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fb_core.files.limits import require_text_name

MARK_NAME = ".fillerbuster.json"
_MADE_BY, _FORMAT = "fillerbuster", 1
_LOOKED_AT_BYTES = 8192  # of a file's beginning, and of its end
_RESULTS = (  # a file's first bytes, and what else stands near its beginning or its end
    (rb"\x89PNG\r\n", rb"Software\x00fillerbuster"),
    (rb"<\?xml", rb"<dc:title>fillerbuster</dc:title>"),
    (rb"%PDF", rb"/Creator \(fillerbuster\)"),
    (rb"\{\s*\"command\": \"fillerbuster ", rb"\"rows\": "),
    (rb"part,", rb"part,"),
    (rb"\*\*|`", rb"\n?`fillerbuster [^`\n]*`, (?:model [^\n]*, )?commit [^\n]*\n\Z"),
)
"""How results that people name begin: pictures, reports in JSON, tables in CSV and Markdown."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """The folder that a command is to leave, and what it must not touch for that."""

    folder: Path
    """Where; it may be there if it is empty."""
    kind: str
    """Of what it is to hold, such as ``export``; an earlier folder is replaced by one of its own kind only."""
    overwrite: bool = False
    """Replace an earlier one."""
    inputs: tuple[Path, ...] = ()
    """Files and folders that the command reads."""
    earlier: Callable[[Path], bool] | None = None
    """Whether a folder without a mark is beyond doubt one that an older version of this program has made."""

    def check(self) -> None:
        """Raises ValueError in one sentence for a folder that must not be written. Links are neither followed nor
        replaced.
        """
        folder = real_place(
            self.folder
        )  # what is written: "missing/.." leads somewhere though the system does not find it yet
        require_text_name(folder)
        if folder.is_symlink():
            raise ValueError(f"{folder} is a link, which is neither followed nor replaced; choose another folder")
        if not folder.exists():
            return
        if not folder.is_dir():
            raise ValueError(f"{folder} exists already and is not empty, for it is a file; choose another name")
        if os.path.ismount(folder):  # the system lets nothing take its place, and would say so only after all the work
            raise ValueError(f"{folder} is the root of a disk, whose place nothing can take; choose a new folder in it")
        if _is_or_holds(folder, _here()):  # else whoever works in it is left in a folder that is there no more
            raise ValueError(
                f"{folder} is, or holds, the folder that this command was started in; choose a new folder in it"
            )
        for given in self.inputs:
            if _is_or_holds(folder, given):
                raise ValueError(f"{folder} holds the input {given}; choose another folder")
        if not any(folder.iterdir()):
            return
        if not self.overwrite:
            raise ValueError(
                f"{folder} exists already and is not empty; choose another folder, or replace it with --overwrite"
            )
        for given in self.inputs:
            if given.is_dir() and _is_or_holds(given, folder):
                raise ValueError(
                    f"{folder} lies in the input {given}, so that --overwrite does not touch it; choose a folder "
                    "outside"
                )
        if not (
            kind_of(folder) == self.kind
            or (kind_of(folder) is None and self.earlier is not None and self.earlier(folder))
        ):
            raise ValueError(
                f"{folder} holds something else than an earlier {self.kind}, so that --overwrite does not touch it; "
                "choose another folder"
            )


def as_target(folder: Path | Target, kind: str) -> Target:
    """A plain folder as a target that replaces nothing."""
    return folder if isinstance(folder, Target) else Target(folder=folder, kind=kind)


def require_own_or_new(path: Path) -> None:
    """Raises ValueError in one sentence where a file is to be written in whose place stands one that is no earlier
    result.

    Pipes and devices are written as they are.
    """
    path = real_place(path)
    if path.exists() and not path.is_file() and not path.is_dir():
        return
    if path.is_symlink() or path.is_dir():
        raise ValueError(f"{path} is a link or a folder, which a file does not replace; choose another name")
    if not path.exists() or path.stat().st_size == 0:
        return
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            begins = file.read(_LOOKED_AT_BYTES)
            file.seek(max(0, size - _LOOKED_AT_BYTES))
            ends = file.read()
    except OSError:
        begins = ends = b""
    if not any(
        re.match(first, begins) and (re.search(also, begins) or re.search(also, ends)) for first, also in _RESULTS
    ):
        raise ValueError(
            f"{path} exists already and is no earlier result of this program; choose another name, or move it away"
        )


def signature(path: Path) -> dict[str, str]:
    """The metadata by which a figure that matplotlib saves under this name, with this suffix, says who made it."""
    keys = {".png": "Software", ".svg": "Creator", ".pdf": "Creator"}
    suffix = path.suffix.lower()
    return {keys[suffix]: _MADE_BY} if suffix in keys else {}


def write_mark(folder: Path, kind: str) -> None:
    """The mark of a finished folder. It is the same for the same content."""
    (folder / MARK_NAME).write_text(mark_text(kind, _files(folder)), encoding="utf-8")


def mark_text(kind: str, files: list[str]) -> str:
    """What stands in a mark."""
    return json.dumps({"made_by": _MADE_BY, "kind": kind, "format": _FORMAT, "files": sorted(files)}, indent=1) + "\n"


def kind_of(folder: Path) -> str | None:
    """What the folder's mark says that it holds; None without a mark, or with one that does not say all that a mark
    says.
    """
    mark = _mark(folder)
    return None if mark is None else mark["kind"]


def foreign_files(folder: Path) -> list[str]:
    """Files and links, by their names from the folder, that somebody else has put into a marked folder; none where no
    mark tells.
    """
    mark = _mark(folder)
    return (
        [] if mark is None else sorted(set(_files(folder)) - {name for name in mark["files"] if isinstance(name, str)})
    )


def _mark(folder: Path) -> dict | None:
    path = folder / MARK_NAME
    try:
        mark = json.loads(path.read_text(encoding="utf-8")) if path.is_file() and not path.is_symlink() else None
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(mark, dict) or mark.get("made_by") != _MADE_BY or mark.get("format") != _FORMAT:
        return None  # of others, or of a version to come, whose marks may mean something else
    return mark if isinstance(mark.get("kind"), str) and isinstance(mark.get("files"), list) else None


def _here() -> Path:
    """The folder that this process works in; "/" where somebody has removed it."""
    try:
        return Path.cwd()
    except OSError:
        return Path("/")


def _files(folder: Path) -> list[str]:
    """All files and links, at any depth, without the mark."""
    names = []
    for where, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(where, name))]
        names += [Path(where, name).relative_to(folder).as_posix() for name in (*files, *links)]
    return [name for name in names if name != MARK_NAME]


def real_place(folder: Path) -> Path:
    """The folder with the links of all folders above it followed; its own name stays, link or not."""
    return (
        Path(os.path.realpath(folder))
        if folder.name in ("", "..")
        else Path(os.path.realpath(folder.parent)) / folder.name
    )


def _is_or_holds(folder: Path, other: Path) -> bool:
    """Whether ``other`` is the folder or lies in it. Real places are compared, so that links, ``..`` and bind mounts
    deceive nobody.
    """
    real = Path(os.path.realpath(other))
    return any(place.exists() and place.samefile(folder) for place in (real, *real.parents))
