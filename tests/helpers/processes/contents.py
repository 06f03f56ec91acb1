"""What folders hold, to be compared."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

_VARIES = {"seconds", "peak_memory_gib", "output", "source"}  # of a JSON file, between two runs of one command


_NOT_COMPARED = (".png", ".mp4", ".yml")  # curves, sheets, films; not pictures of captures


def content(folder: Path) -> dict[str, str]:
    """A digest of every file by its name, in the state that does not depend on when it was made."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and "tfevents" not in name and not _is_shell(path.parent):
            found[name] = "" if path.suffix in _NOT_COMPARED and "images/" not in name else _digest(path)
        elif path.is_dir() and not _is_shell(path):
            found[f"{name}/"] = ""
    return found


def _is_shell(folder: Path) -> bool:
    """A hidden folder of a writing that was over but for itself: the next writer of that file takes it away."""
    return ".unfinished-" in folder.name and set(os.listdir(folder)) <= {"owner"}


def _digest(path: Path) -> str:
    if path.suffix == ".pt":
        return ""  # holds seconds; the model that is made of it is compared
    if path.suffix == ".json":
        return json.dumps(_steady(json.loads(path.read_text())), sort_keys=True)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _steady(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _steady(one) for key, one in value.items() if key not in _VARIES}
    return [_steady(one) for one in value] if isinstance(value, list) else value
