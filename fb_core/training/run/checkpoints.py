"""Checkpoints of a training: written whole or not at all, the last few kept."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from fb_core.files.whole import whole_file

NEWEST = "checkpoint.pt"


def read_state(
    path: Path,
    device: torch.device | str = "cpu",
    *,
    advice: str = "restore it, or delete it to begin anew",
    mapped: bool = False,
) -> dict[str, Any]:
    """A checkpoint's content; ``mapped`` leaves its tensors on disk until they are used. Nothing in the file is
    executed.

    Raises ValueError in one sentence, which ends with the ``advice``, for a file that is damaged or no checkpoint of a
    training.
    """
    try:
        state = torch.load(path, weights_only=True, map_location=device, mmap=mapped or None)
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise ValueError(f"{path} is damaged ({' '.join(str(error).split())[:300]}); {advice}") from error
    if not isinstance(state, dict) or isinstance(state.get("step"), bool) or not isinstance(state.get("step"), int):
        raise ValueError(f"{path} is no checkpoint of a training: it tells no step; {advice}")
    return state


class Checkpoints:
    """``checkpoint.pt`` in a folder is the newest; ``checkpoint-000200.pt`` are those before it, named by their
    steps.
    """

    def __init__(self, folder: Path, keep: int):
        self.folder, self.keep = folder, keep
        self._newest_step: int | None = None

    def find(self) -> Path | None:
        """The newest checkpoint, if there is one."""
        newest = self.folder / NEWEST
        return newest if newest.exists() else next(reversed(self._earlier()), None)

    def read(self, path: Path, device: torch.device) -> dict[str, Any]:
        """A checkpoint's content. Raises ValueError if the file is damaged, naming the one before it."""
        before = [str(other) for other in self._earlier() if other != path]
        state = read_state(
            path, device, advice=f"delete it to go on from {before[-1]}" if before else "delete it to begin anew"
        )
        self._newest_step = state["step"]
        return state

    def write(self, state: dict[str, Any]) -> None:
        """Make ``state`` the newest checkpoint; a kill or a full disk (CannotWrite) while writing leaves the previous
        ones whole.
        """
        newest = self.folder / NEWEST
        with whole_file(
            newest, durable=True
        ) as unfinished:  # else a power cut could leave the new name on an empty file
            with unfinished.open("wb") as file:  # a file of Python's own says itself that a disk is full
                torch.save(state, file)
            if self.keep > 1 and newest.exists() and self._newest_step not in (None, state["step"]):
                newest.rename(self.folder / f"checkpoint-{self._newest_step:06d}.pt")
        self._newest_step = state["step"]
        for old in self._earlier()[: max(0, len(self._earlier()) - (self.keep - 1))]:
            old.unlink()

    def _earlier(self) -> list[Path]:
        """From the oldest to the newest."""
        return sorted(self.folder.glob("checkpoint-*.pt"), key=lambda path: int(path.stem.rpartition("-")[2]))
