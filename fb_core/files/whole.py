"""Files and folders that appear whole or not at all, whatever happens while they are written.

New content grows in a hidden folder beside its place, ``.NAME.unfinished-XXXXXXXX``::

    owner   locked for as long as the writing process lives
    new/    the folder that is being written (or a file by its own name)
    old/    what stood in its place, while both change places
    gone/   what is being removed

Folders change places in one step of the system where it has one (Linux: renameat2). Elsewhere two renames follow each
other; if the second fails the first is undone, and if the process is killed between them, whoever reads or writes there
next puts the old one back.
"""

from __future__ import annotations

import ctypes
import errno
import logging
import os
import re
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # no system with such locks; what killed processes leave then stays
    fcntl = None

from fb_core.files.faults import CannotWrite, all_told, telling
from fb_core.files.ownership import Target, foreign_files, real_place, write_mark

_OWNER, _NEW, _OLD, _GONE = "owner", "new", "old", "gone"
_OWNER_TEXT = "fillerbuster writes here; the folder may be removed once no fillerbuster runs\n"
_AT_THIS_FOLDER, _EXCHANGE = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
_NO_SUCH_STEP = {errno.EINVAL, errno.ENOSYS, errno.ENOTSUP, errno.EXDEV}
_HIDDEN = re.compile(r"\.(.+)\.unfinished-[0-9a-f]{8}")
_PATIENCE_SECONDS = 2.0  # far more than a live process needs between two renames
_logger = logging.getLogger(__name__)


@contextmanager
def whole_folder(target: Target) -> Iterator[Path]:
    """A new folder to write into; it takes the target's place, with a mark, when the block ends without an error.

    After an error nothing of it is left, and what was there before stands untouched. Files in an earlier folder that
    somebody else has put there are kept beside it, with a warning.

    Raises ValueError for a target that must not be written (before the block, and again after it, for a long time may
    have passed), and CannotWrite in one sentence when the disk is full or cannot be written.
    """
    folder = real_place(target.folder)
    swept(settled(folder))
    target.check()
    with unfinished_beside(folder) as work:
        new = work / _NEW
        with all_told(folder):
            new.mkdir()
        with telling(folder, new):
            yield new
            write_mark(new, target.kind)
        target.check()
        with all_told(folder):
            _put_in_place(work, folder)


@contextmanager
def whole_file(path: str | os.PathLike[str], *, durable: bool = False) -> Iterator[Path]:
    """A new file's path to write to; it takes the file's place when the block ends without an error. Missing folders
    are made.

    ``durable``: also when the power fails. Pipes and devices are written as they are. Raises CannotWrite in one
        sentence.
    """
    path = real_place(Path(path))  # "missing/.." leads somewhere though the system does not find it yet
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    if path.is_symlink() or path.is_dir():
        raise CannotWrite(path, OSError(None, "it is a link or a folder, which a file does not replace"))
    with unfinished_beside(path) as work:
        new = work / path.name
        with telling(path, new):
            yield new
            if durable:
                with new.open("rb") as file:
                    os.fsync(file.fileno())
        with all_told(path):
            os.replace(new, path)


@contextmanager
def by_way_of_memory(path: Path) -> Iterator[str]:
    """Where a library that does not tell of a full disk is to write a file: on Linux in memory, from where it then goes
    to its path.

    Raises CannotWrite, and leaves nothing, when the disk takes only a part of it.
    """
    if not hasattr(os, "memfd_create"):
        yield str(path)
        return
    with os.fdopen(os.memfd_create(path.name[:100]), "rb") as memory:
        yield f"/proc/self/fd/{memory.fileno()}"
        try:
            with path.open("wb") as file:
                shutil.copyfileobj(memory, file)
        except OSError as error:
            if path.is_file() and not path.is_symlink():
                with suppress(OSError):
                    path.unlink()
            raise CannotWrite(path, error) from error


@contextmanager
def unfinished_beside(path: Path) -> Iterator[Path]:
    """The hidden folder beside a place that is to be written, locked by this process; gone with all in it when the
    block ends.

    What killed processes have left of theirs for the same place is cleaned up first.
    """
    with ExitStack() as stack:
        with all_told(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            for work in _unfinished(path):
                _clean_up(work, path)
            work, lock = _claimed(path)
        stack.callback(os.close, lock)
        stack.callback(_mend, work, path)
        yield work


def remove_folder(target: Target) -> None:
    """Take away an earlier folder of the target's kind, if there is one, in one step. Raises as
    :func:`whole_folder`.
    """
    folder = real_place(target.folder)
    swept(settled(folder))
    target.check()
    if folder.exists():
        discard(folder, foreign=foreign_files(folder))


def discard(folder: Path, *, foreign: list[str]) -> None:
    """Take away a folder in one step; if it holds files of somebody else, it stays beside its place with a warning."""
    with unfinished_beside(folder) as work, all_told(folder):
        if foreign:
            _keep(folder, folder, f"held files that are not ours, such as {foreign[0]}")
        else:
            os.rename(folder, work / _GONE)


def settled(path: Path) -> Path:
    """The path itself, for reading: what a kill between two renames took away is put back first, and a live swap is
    waited for.
    """
    until = time.monotonic() + _PATIENCE_SECONDS
    while not os.path.lexists(path):
        swaps = [work for work in _unfinished(path) if (work / _OLD).exists()]
        for work in swaps:
            with _taken_over(work) as stale, suppress(OSError):
                if stale:
                    os.rename(work / _OLD, path)
        if not swaps or time.monotonic() > until:
            break
        time.sleep(0.01)
    return path


def swept(folder: Path) -> Path:
    """The folder itself, without what killed processes have left of writings to places in it: that is put right and
    removed.
    """
    try:
        with os.scandir(folder) as entries:
            works = [
                (one.name, match[1])
                for one in entries
                if (match := _HIDDEN.fullmatch(one.name)) and one.is_dir(follow_symlinks=False)
            ]
    except OSError:
        return folder
    for name, place in sorted(works):
        _clean_up(folder / name, folder / place)
    return folder


def found_below(folder: Path, pattern: str) -> list[Path]:
    """Files and folders at or below a folder, sorted, but none that is still being written, or was when a process was
    killed.
    """
    paths = sorted(Path(folder).rglob(pattern))
    return [path for path in paths if not any(_HIDDEN.fullmatch(part) for part in path.relative_to(folder).parts)]


# ---- changing places ------------------------------------------------------------------------------------------------


def _put_in_place(work: Path, folder: Path) -> None:
    """What stood there before is left in the hidden folder, whose end decides about it."""
    new, old = work / _NEW, work / _OLD
    if not folder.exists() or not any(folder.iterdir()):
        os.rename(new, folder)  # which replaces an empty folder in one step
    elif not exchange(new, folder):
        os.rename(folder, old)
        try:
            os.rename(new, folder)
        except OSError:
            os.rename(old, folder)
            raise


def exchange(one: Path, other: Path) -> bool:
    """Let two folders change places in one step; False where the system, or this disk, has no such step."""
    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is None:
        return False
    function.argtypes = (ctypes.c_int, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_uint)
    if function(_AT_THIS_FOLDER, os.fsencode(one), _AT_THIS_FOLDER, os.fsencode(other), _EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in _NO_SUCH_STEP:
        return False
    raise OSError(number, os.strerror(number), str(other))


def _keep(previous: Path, folder: Path, why: str) -> None:
    """Put what stood at a place beside it, by a name of its own."""
    number = 1
    while os.path.lexists(backup := folder.with_name(f"{folder.name}.replaced-{number}")):
        number += 1
    os.rename(previous, backup)
    _logger.warning("%s %s; what was replaced is kept as %s", folder, why, backup)


# ---- the hidden folders ---------------------------------------------------------------------------------------------


def _unfinished(path: Path) -> list[Path]:
    """Hidden folders of writings to a place."""
    prefix = f".{path.name}.unfinished-"
    try:
        with os.scandir(path.parent) as entries:
            names = [one.name for one in entries if one.name.startswith(prefix) and one.is_dir(follow_symlinks=False)]
    except OSError:
        return []
    return [path.parent / name for name in sorted(names) if len(name) == len(prefix) + 8]


def _claimed(path: Path) -> tuple[Path, int]:
    """A new hidden folder, and the descriptor that holds its lock."""
    while True:
        work = path.parent / f".{path.name}.unfinished-{secrets.token_hex(4)}"
        work.mkdir()
        try:
            lock = os.open(work / _OWNER, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        except FileNotFoundError:
            continue  # somebody who cleans up has taken it for one that a killed process has left
        except OSError:
            work.rmdir()
            raise
        if _locked(lock) is not False and (work / _OWNER).exists():
            with suppress(OSError):  # on a full disk: the text is for people
                os.write(lock, _OWNER_TEXT.encode())
            return work, lock
        os.close(lock)


def _locked(descriptor: int) -> bool | None:
    """Whether the lock could be had; None on a disk that has no locks."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


@contextmanager
def _taken_over(work: Path) -> Iterator[bool]:
    """Whether no live process owns a hidden folder, which for the block is this process's own."""
    try:
        lock = os.open(work / _OWNER, os.O_RDWR)
    except OSError:
        yield False
        return
    try:
        yield _locked(lock) is True
    finally:
        os.close(lock)


def _clean_up(work: Path, path: Path) -> None:
    """Put right and remove what a killed process has left; what a live one owns, and what is not ours, stays."""
    with _taken_over(work) as stale:
        if stale:
            _mend(work, path)
    with suppress(OSError):
        work.rmdir()  # killed before or after all else: empty


def _mend(work: Path, path: Path) -> None:
    """Remove a hidden folder, but nothing in it that is the last of its kind. If that fails, all stays for the next
    try.

    Where ``old`` and ``new`` are both there, their swap has not come to its end: the old one goes back, or beside what
    stands there by now. Files that somebody else has put into what was replaced are kept with it.
    """
    try:
        if (work / _OLD).exists() and (work / _NEW).exists():
            if os.path.lexists(path) and not (path.is_dir() and not any(path.iterdir())):
                _keep(work / _OLD, path, "was written anew after its replacement had been interrupted")
            else:
                os.rename(work / _OLD, path)
        for name in (_NEW, _OLD, _GONE):
            if foreign := foreign_files(work / name):
                _keep(work / name, path, f"held files that are not ours, such as {foreign[0]}")
    except OSError as error:
        _logger.warning("%s is kept in %s, for it could not be put back (%s)", path, work, error)
        return
    with suppress(OSError):
        for entry in sorted(work.iterdir()):
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            elif entry.name != _OWNER:
                entry.unlink()
        (work / _OWNER).unlink()  # last: without it nobody would know whose the rest is
        work.rmdir()
