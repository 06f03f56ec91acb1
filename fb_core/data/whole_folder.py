"""Folders that appear whole or not at all, whatever happens while they are written."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A new folder beside ``folder`` to write into; it takes the latter's name, and its place, when the block ends without an error.

    After an error nothing of it is left, and what was there before stands untouched.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = folder.parent / f".{folder.name}.{secrets.token_hex(4)}"
    unfinished.mkdir()
    try:
        yield unfinished
        _put_in_place(unfinished, folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _put_in_place(finished: Path, folder: Path) -> None:
    """Renames a finished folder to its name; what was there is moved aside first and removed last."""
    if not folder.exists():
        os.replace(finished, folder)
        return
    aside = finished.with_name(f"{finished.name}.old")
    os.replace(folder, aside)
    try:
        os.replace(finished, folder)
    except OSError:
        os.replace(aside, folder)
        raise
    shutil.rmtree(aside, ignore_errors=True)
