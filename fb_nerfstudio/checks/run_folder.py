"""A run's folder belongs to one run: claimed before anything is written there, and taken away again where the run is
refused.
"""

from __future__ import annotations

import os
import shutil
import time
from datetime import datetime
from pathlib import Path
from typing import Any

_AUTOMATIC = "{timestamp}"  # nerfstudio's word for "now"
_claimed: dict[Path, int] = {}  # of this process: descriptors whose locks end with it, however it ends
_made: set[Path] = set()  # of this process: folders that were not there before


def claim(folder: Path, *, goes_on_from: Path | None, ours: bool) -> None:
    """Make the folder, or take it over, for this process until it ends.

    Args:
        folder: the run's.
        goes_on_from: the checkpoint that the run goes on from.
        ours: whether the name is nobody's choice, so that a folder that is there is another run's.

    Raises FileExistsError where ``ours`` and the folder is there, and ValueError in one sentence where another run
    trains there, or has left checkpoints that this one does not go on from.
    """
    place = folder.absolute()
    is_new = not place.exists()
    place.mkdir(parents=True, exist_ok=not ours)
    descriptor = _claimed[place] if place in _claimed else _locked(place)
    if descriptor is None:
        raise ValueError(f"run folder {folder}: another run trains there right now; give this one another --timestamp")
    mine = goes_on_from is not None and goes_on_from.absolute().is_relative_to(place)
    if not mine and any(place.glob("*/step-*.ckpt")):
        if place not in _claimed:
            os.close(descriptor)
        raise ValueError(
            f"run folder {folder}: it holds another run, which is never overwritten; give another --timestamp, or go "
            "on with --load-dir "
            "and its folder nerfstudio_models (--load-config takes the timestamp from its file: change it there)"
        )
    _claimed[place] = descriptor
    if is_new:
        _made.add(place)


def claim_for(config: Any, goes_on_from: Path | None) -> None:
    """Claim the folder of a trainer's options. Where these leave its name to the clock, runs that start in one second
    get one each.

    Raises ValueError as :func:`claim`.
    """
    if config.timestamp != _AUTOMATIC:
        claim(config.get_base_dir(), goes_on_from=goes_on_from, ours=False)
        return
    while True:
        config.timestamp = datetime.now().strftime("%Y-%m-%d_%H%M%S")
        try:
            claim(config.get_base_dir(), goes_on_from=goes_on_from, ours=True)
            return
        except FileExistsError:
            time.sleep(0.1)


def release(folder: Path) -> None:
    """The folder may be claimed by another run from now on; it stays."""
    descriptor = _claimed.pop(folder.absolute(), None)
    _made.discard(folder.absolute())
    if descriptor is not None:
        os.close(descriptor)


def take_away(folder: Path) -> None:
    """Remove the folder of a run that was refused, if this process has made it and it holds no checkpoint; and what was
    made around it.
    """
    place = folder.absolute()
    if place not in _made or any(place.glob("*/step-*.ckpt")):
        return
    release(place)
    shutil.rmtree(place, ignore_errors=True)
    for above in list(place.parents)[:2]:  # of method and experiment
        try:
            above.rmdir()  # only if nothing else is in it
        except OSError:
            return


def _locked(folder: Path) -> int | None:
    """A descriptor that holds the folder's lock until it is closed or its process ends; None where another process
    holds it.

    Where a system or a network drive has no locks, everybody gets one.
    """
    descriptor = os.open(folder, os.O_RDONLY) if os.name == "posix" else os.open(os.devnull, os.O_RDONLY)
    try:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    except (ImportError, OSError):
        pass
    return descriptor
