"""What is refused, and what cannot be written, told in one sentence: which file, why, and what to do."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_OF_THE_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}  # whoever raises these was writing
_ADVICE = {
    errno.ENOSPC: "free some room, or choose another folder",
    errno.EDQUOT: "free some room, or choose another folder",
    errno.EROFS: "choose a folder on a disk that can be written",
    errno.EACCES: "choose a folder where you may write, or change its permissions",
    errno.EPERM: "choose a folder where you may write, or change its permissions",
}
_PROBE_BYTES = 1 << 20


class Refused(SystemExit, ValueError):
    """Input that a person has to mend.

    It is a ValueError for programs. Uncaught it ends a command as SystemExit does: the sentence alone on stderr, exit
    code 1, and no traceback, which nerfstudio's commands would print for any other error.
    """


class CannotWrite(OSError):
    """A file or folder that could not be written. Its text is one sentence; what stood there before still does."""

    def __init__(self, path: Path, error: OSError):
        advice = _ADVICE.get(error.errno or 0, "check the path, or choose another folder")
        self.path, self.reason = path, error.strerror or " ".join(str(error).split())
        super().__init__(f"cannot write {path}: {self.reason}; {advice}")
        self.errno = error.errno


@contextmanager
def telling(target: Path, unfinished: Path) -> Iterator[None]:
    """Errors of writing below ``unfinished``, which becomes ``target``, become :class:`CannotWrite`; all others pass
    unchanged.

    Libraries in C++ and Rust say with errors of their own, or with none of the system's numbers, that a disk is full.
    Where one of these arrives, a probe of 1 MiB tells whether the disk takes anything at all.
    """
    try:
        yield
    except CannotWrite as error:
        if not _inside(error.path, unfinished):
            raise
        cause = OSError(error.errno, error.reason, str(error.path))
        raise CannotWrite(_named(cause, target, unfinished), cause) from error
    except Exception as error:
        cause = _of_writing(error, unfinished) or _of_probing(unfinished)
        if cause is None:
            raise
        raise CannotWrite(_named(cause, target, unfinished), cause) from error


@contextmanager
def all_told(path: Path) -> Iterator[None]:
    """Every error of the system, which must come from writing ``path``, becomes :class:`CannotWrite`."""
    try:
        yield
    except CannotWrite:
        raise
    except OSError as error:
        raise CannotWrite(path, error) from error


def is_of_the_disk(error: BaseException) -> bool:
    """Whether an error says that a disk is full or cannot be written, whatever file it names."""
    return isinstance(error, OSError) and error.errno in _OF_THE_DISK


def sentence_of(error: BaseException) -> str:
    """An error's own text, or what to do where it says that a disk is full or cannot be written."""
    if (
        isinstance(error, OSError)
        and not isinstance(error, CannotWrite)
        and is_of_the_disk(error)
        and error.filename is not None
    ):
        return str(CannotWrite(Path(os.fsdecode(error.filename)), error))
    return str(error)


def _of_writing(error: BaseException | None, unfinished: Path) -> OSError | None:
    """The error among this one and its causes that the system raised for writing."""
    while error is not None:
        if isinstance(error, OSError) and (is_of_the_disk(error) or _inside(error.filename, unfinished)):
            return error
        error = error.__cause__ or error.__context__
    return None


def _of_probing(unfinished: Path) -> OSError | None:
    """The system's error when another file is written beside; None when it can be."""
    probe = unfinished.with_name(f"{unfinished.name}.probe")
    try:
        with probe.open("wb") as file:
            file.write(bytes(_PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        return error if is_of_the_disk(error) else None
    finally:
        with suppress(OSError):
            probe.unlink()
    return None


def _inside(name: object, unfinished: Path) -> bool:
    return isinstance(name, str | os.PathLike) and Path(name).absolute().is_relative_to(unfinished.absolute())


def _named(error: OSError, target: Path, unfinished: Path) -> Path:
    """The file by the name that it would have had."""
    for name in (error.filename2, error.filename):
        if _inside(name, unfinished):
            return target / Path(name).absolute().relative_to(unfinished.absolute())
    return target
