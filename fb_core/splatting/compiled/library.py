"""The compiled drawing of splats (the C files here): made once by `fillerbuster compile`, then found and loaded.

Nothing is compiled unasked. The library lies in the user's own cache folder, under a name that says from what it was
made (source, options, processor), so that another version of this package or another processor never loads it.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import platform
import shutil
import stat
import subprocess
from functools import cache
from pathlib import Path

import torch

from fb_core.files.whole import whole_file

SOURCES = tuple(sorted(Path(__file__).parent.glob("*.[ch]")))
"""What the library is made from: sources, and the headers that they share."""
CACHE_VARIABLE = "FILLERBUSTER_CACHE"
"""Environment variable: folder of compiled libraries, instead of the system's usual place."""
_OPTIONS = ("-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
_DEFINES = {torch.float32: (), torch.float64: ("-DDOUBLE",)}
_FUNCTIONS = (
    "fb_project", "fb_project_backward", "fb_spans", "fb_count_items", "fb_place_items", "fb_forward", "fb_backward",
    "fb_gather",
)  # fmt: skip
_COMPILERS = ("cc", "gcc", "clang")
_logger = logging.getLogger(__name__)


class NoCompiler(ValueError):
    """In one sentence why nothing could be compiled."""


def library_path(dtype: torch.dtype) -> Path:
    """Where the library for tensors of this dtype lies, or would lie once it is made."""
    sources = [part for source in SOURCES for part in (source.name.encode(), source.read_bytes())]
    made_from = (*sources, " ".join((*_OPTIONS, *_DEFINES[dtype])).encode(), _processor().encode())
    return cache_folder() / f"compositing-{hashlib.sha256(b'|'.join(made_from)).hexdigest()[:16]}.so"


def cache_folder() -> Path:
    """The folder that compiled libraries are kept in."""
    named = os.environ.get(CACHE_VARIABLE)
    if named:
        return Path(named).expanduser().resolve()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "fillerbuster"


def compiler_here() -> str | None:
    """The program that the environment variable CC names, or the first usual one that is installed; None without."""
    return os.environ.get("CC") or next(filter(shutil.which, _COMPILERS), None)


def compile_libraries() -> list[Path]:
    """Compile for single and double precision, which takes some seconds each; what is there already is made anew.

    Raises NoCompiler where there is no compiler or it fails, and CannotWrite where the folder cannot be written.
    """
    program = compiler_here()
    if program is None or shutil.which(program) is None:
        raise NoCompiler(
            f"compile: expected a C compiler, one of {', '.join(_COMPILERS)} or the one that CC names, found "
            f"{'none' if program is None else f'no program {program}'}: install gcc or clang, or go on without (splats "
            "are then drawn by torch alone)."
        )
    folder = cache_folder()
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    made = []
    for dtype, defines in _DEFINES.items():
        with whole_file(library_path(dtype)) as unfinished:
            sources = [str(source) for source in SOURCES if source.suffix == ".c"]
            command = [program, *_OPTIONS, *defines, *sources, "-o", str(unfinished), "-lm"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                reason = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr.strip()[:200])
                raise NoCompiler(
                    f"compile: {program} ended with code {done.returncode} ({reason}): name another compiler by CC, "
                    "or go on without (splats are then drawn by torch alone)."
                )
            unfinished.chmod(0o700)
        made.append(library_path(dtype))
    loaded.cache_clear()
    return made


@cache
def loaded(dtype: torch.dtype) -> ctypes.CDLL | None:
    """The library for tensors of this dtype; None where it has not been made, where it cannot be loaded (said once), or
    where others may write to it.
    """
    if dtype not in _DEFINES:
        return None
    path = library_path(dtype)
    if not path.is_file() or not (_private(path.parent) and _private(path)):
        return None
    try:
        library = ctypes.CDLL(str(path))
        for name in _FUNCTIONS:
            getattr(library, name).restype = None
    except (OSError, AttributeError):
        _logger.warning("%s cannot be loaded; torch draws. `fillerbuster compile` makes it anew.", path)
        return None
    return library


def library_for(dtype: torch.dtype) -> ctypes.CDLL:
    """`loaded`, for who cannot do without. Raises ValueError where there is none."""
    library = loaded(dtype)
    if library is None:
        raise ValueError(f"no compiled library for {dtype}: run `fillerbuster compile`, or draw with torch.")
    return library


def _private(path: Path) -> bool:
    """Whether nobody but this user can write there: a library is code."""
    if not hasattr(os, "getuid"):
        return True  # systems without owners by number: the folder is the user's own
    status = path.stat()
    return status.st_uid in (os.getuid(), 0) and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


@cache
def _processor() -> str:
    """What decides which instructions there are."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    features = {
        line for line in lines if line.partition("\t")[0].strip() in ("model name", "flags", "Features", "CPU part")
    }
    return "|".join([platform.system(), platform.machine(), platform.processor(), *sorted(features)])
