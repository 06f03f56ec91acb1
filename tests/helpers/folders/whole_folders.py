"""A folder of two files, written whole and looked at."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fb_core.files.ownership import Target, foreign_files, kind_of
from fb_core.files.whole import whole_folder


def write(folder: Path, text: str) -> None:
    with whole_folder(Target(folder=folder, kind="test", overwrite=True)) as unfinished:
        (unfinished / "below").mkdir()
        for name in ("one", "below/two"):
            (unfinished / name).write_text(text)


def content(folder: Path) -> str | None:
    """The text that both files of a whole folder hold; None where there is no folder."""
    if not folder.exists():
        return None
    texts = {(folder / name).read_text() for name in ("one", "below/two")}
    assert len(texts) == 1 and kind_of(folder) == "test" and foreign_files(folder) == []
    return texts.pop()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def left_behind(place: Path, *, old: str | None = None, new: str | None = None) -> Path:
    """What a killed process leaves of a writing to a place."""
    work = place.parent / f".{place.name}.unfinished-0badcafe"
    work.mkdir(parents=True)
    (work / "owner").touch()
    for name, text in (("old", old), ("new", new)):
        if text is not None:
            write(work / name, text)
    return work


def ends_at_step(moment: int) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Have this process end, as if killed, instead of its next step in the file system once it has made so many.

    Returns what makes a step of another function.
    """
    steps: list[Callable[..., Any]] = []

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def step(*args: Any, **kwargs: Any) -> Any:
            if len(steps) == moment:
                os._exit(9)
            steps.append(function)
            return function(*args, **kwargs)

        return step

    for name in ("rename", "replace", "mkdir", "unlink", "rmdir", "open", "close"):
        setattr(os, name, counted(getattr(os, name)))
    return counted
