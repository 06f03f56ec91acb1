"""What ``fillerbuster complete`` keeps while it works, so that the same command after a kill goes on where it was.

The folder stands hidden beside the output, ``.NAME.in-progress``, and goes when the output is there: cameras, the
capture that splats are trained on, the run with its checkpoints, finished frames of the film. Another question to the
command finds none of it and begins anew.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from fb_core.completion.fly_through import FoundCameras
from fb_core.data.photos.photo import Photo
from fb_core.data.photos.straight_photos import straightened
from fb_core.files.json_files import read_json
from fb_core.files.ownership import MARK_NAME, Target, mark_text, real_place, write_mark
from fb_core.files.whole import discard, whole_file
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.pose_solver.verdict import Arrangement
from fb_core.registration.choice import Registration

try:
    import fcntl
except ImportError:  # no system with such locks
    fcntl = None

_logger = logging.getLogger(__name__)
KIND = "scene in progress"
_FORMAT = 1  # of what is kept
_JOB, _CAMERAS, _LOCK = "job.json", "cameras.pt", "lock"
_OURS = {
    _JOB,
    _CAMERAS,
    _LOCK,
    "capture",
    "runs",
    "film",
    "path.json",
    "splats.ply",
    "scene.json",
    "generated.pt",
    MARK_NAME,
}


def question_of(photos: Sequence[Photo], options: Any, model_hash: str | None) -> str:
    """A text that is the same for the same photos, options and weights, and for nothing else."""
    files = []
    for photo in photos:
        file, pose = (
            photo.source.stat(),
            None if photo.camera is None else photo.camera.camera_to_world.flatten().tolist(),
        )
        files.append((photo.name, str(photo.source), photo.seconds, file.st_size, file.st_mtime_ns, pose))
    question = {
        "format": _FORMAT,
        "photos": files,
        "options": {key: str(value) for key, value in dataclasses.asdict(options).items()},
    }
    return hashlib.sha256(json.dumps(question | {"model": model_hash}, sort_keys=True).encode()).hexdigest()


def folder_beside(output: Path) -> Path:
    """Where the work for an output lies."""
    place = real_place(output)
    return place.with_name(f".{place.name}.in-progress")


@contextmanager
def work_beside(output: Path, question: str) -> Iterator[Path]:
    """The folder of the work, this process's own for the block; it stays after an error and goes after success.

    Raises ValueError where another process is at the same work, and where something else stands in its place.
    """
    folder = folder_beside(output)
    Target(folder=folder, kind=KIND, overwrite=True).check()
    if folder.is_dir() and any(folder.iterdir()) and _question_in(folder) != question:
        with _alone(folder):
            _remove(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with _alone(folder):
        if _question_in(folder) is None:
            with whole_file(folder / MARK_NAME) as unfinished:
                unfinished.write_text(mark_text(KIND, []), encoding="utf-8")
            with whole_file(folder / _JOB) as unfinished:
                unfinished.write_text(json.dumps({"question": question}), encoding="utf-8")
        try:
            yield folder
        except (KeyboardInterrupt, SystemExit) as error:
            if not isinstance(error, ValueError):
                _logger.info("What is done is kept; the same command goes on from there.")
            raise
        _remove(folder)


def keep_cameras(folder: Path, found: FoundCameras) -> None:
    """Write what was found, so that nobody looks for it again."""
    registration = found.registration
    state = {
        "cameras": [None if one is None else dataclasses.asdict(one) for one in registration.cameras],
        "verdicts": list(registration.verdicts),
        "reasons": list(registration.reasons),
        "residuals": list(registration.residuals_degrees),
        "own_raymaps": registration.raymaps,
        "arrangement": registration.arrangement.name,
        "bent": {
            index: {"camera": dataclasses.asdict(photo.bent[0]), "distortion": photo.bent[1]}
            for index, photo in registration.straight.items()
            if photo.bent is not None
        },
        "method": found.method,
        "tried": dict(found.tried),
        "raymaps": found.raymaps,
    }
    with whole_file(folder / _CAMERAS) as unfinished:
        torch.save(state, unfinished)


def kept_cameras(folder: Path, photos: Sequence[Photo]) -> FoundCameras | None:
    """What :func:`keep_cameras` wrote of these photos, those of bent lenses straightened again; None where there is
    nothing yet.
    """
    if not (folder / _CAMERAS).is_file():
        return None
    state = torch.load(folder / _CAMERAS, map_location="cpu", weights_only=True)
    return FoundCameras(
        registration=Registration(
            cameras=tuple(None if one is None else Pinholes(**one) for one in state["cameras"]),
            verdicts=tuple(state["verdicts"]),
            reasons=tuple(state["reasons"]),
            residuals_degrees=tuple(state["residuals"]),
            raymaps=state["own_raymaps"],
            arrangement=Arrangement[state["arrangement"]],
            straight={
                index: straightened(photos[index], Pinholes(**lens["camera"]), lens["distortion"])[0]
                for index, lens in state.get("bent", {}).items()
            },
        ),
        method=state["method"],
        tried=state["tried"],
        raymaps=state["raymaps"],
    )


def _question_in(folder: Path) -> str | None:
    try:
        state = read_json(folder / _JOB)
    except (OSError, ValueError):
        return None
    return str(state.get("question")) if isinstance(state, dict) else None


def _remove(folder: Path) -> None:
    """Takes the folder away; where somebody else has put something into it, it stays beside its place with a
    warning.
    """
    foreign = sorted({entry.name for entry in folder.iterdir()} - _OURS)
    if not foreign:
        write_mark(folder, KIND)  # so that all that lies in our own subfolders counts as ours
    discard(folder, foreign=foreign)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Raises ValueError where another process holds the folder."""
    if fcntl is None:
        yield
        return
    lock = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"{folder}: another fillerbuster complete works on the same output; wait for it, or choose another"
            ) from None
        except OSError:
            pass  # a disk without locks
        yield
    finally:
        os.close(lock)
