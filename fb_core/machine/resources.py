"""What this process may use of its machine: memory that is free within all limits, processors, devices, and its own
largest size so far.

Containers and batch systems limit memory by control groups (cgroups, versions 1 and 2), which the machine's own figure
of free memory knows nothing of; a process that exceeds them is killed without a word.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass

_UNLIMITED = 2**62  # version 1 writes its largest number for "no limit"
_KIB = 1024
_MOST_DIGITS = 40  # of a number of bytes


def free_memory_bytes(root: Path = Path("/")) -> int | None:
    """Main memory that this process can still take: the least of what the machine has and every control group around it
    allows.

    A group allows its limit (also the soft one of version 2, above which processes are slowed down) less what it uses;
    pages of files that nobody has touched lately count as free, since the kernel gives them up first. None where no
    figure can be had. `root` is where `proc` and `sys` lie.
    """
    rooms = [room for group in _groups(root) for room in _rooms(group)]
    free = _machine_free(root)
    known = rooms if free is None else [free, *rooms]
    return max(0, min(known)) if known else None


def usable_cores() -> int:
    """Processors that this process may run on, at least 1; all there are where the system does not tell (macOS,
    Windows).
    """
    affinity = getattr(os, "sched_getaffinity", None)
    return max(1, len(affinity(0)) if affinity is not None else os.cpu_count() or 1)


def busy_seconds() -> float | None:
    """Seconds that the cores which this process may use have worked, for whomever; None where the system does not
    tell.
    """
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
        names = {f"cpu{number}" for number in os.sched_getaffinity(0)}
        rows = [line.split() for line in lines if line.split()[:1] and line.split()[0] in names]
        # user, nice, system, (idle, waiting,) interrupts of both kinds, and what the host gave to others
        ticks = sum(int(row[column]) for row in rows for column in (1, 2, 3, 6, 7, 8))
        return ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, IndexError, ValueError):
        return None


def peak_memory_bytes() -> int:
    """The largest resident size of this process since its start; 0 where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else _KIB * largest  # bytes on macOS, KiB on Linux and the BSDs


def _machine_free(root: Path) -> int | None:
    """Of the whole machine: Linux's own estimate, elsewhere psutil's if it is installed."""
    for line in _text(root / "proc/meminfo").splitlines():
        name, _, amount = line.partition(":")
        available = _whole(amount.split()[0]) if name == "MemAvailable" and amount.split() else None
        if available is not None:
            return _KIB * available
    try:
        import psutil
    except ImportError:
        return None
    return int(psutil.virtual_memory().available) if root == Path("/") else None


def _groups(root: Path) -> Iterator[Path]:
    """Folders of the control groups that limit this process's memory, the innermost first, of each version that is
    mounted.
    """
    paths = dict[str, str]()  # of this process, by the list of controllers; "" is version 2
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, _, hierarchy = line.partition(":")
        controllers, _, path = hierarchy.partition(":")
        paths |= {name: path for name in controllers.split(",")}
    for line in _text(root / "proc/self/mountinfo").splitlines():
        fields, _, rest = line.partition(" - ")
        words, places = rest.split(), fields.split()[3:5]
        if len(words) < 3 or len(places) < 2:
            continue  # not as Linux writes it: a sandbox that only plays its part
        kind, options, (inside, mount) = words[0], words[-1].split(","), places
        if kind == "cgroup2" or (kind == "cgroup" and "memory" in options):
            yield from _upwards(root / mount.lstrip("/"), inside, paths.get("" if kind == "cgroup2" else "memory", "/"))


def _upwards(mount: Path, inside: str, path: str) -> Iterator[Path]:
    """The group's folder and those around it, up to the mount. `inside` is the group that the mount shows (a
    container's own).
    """
    within = path if inside == "/" else path.removeprefix(inside) if path.startswith(inside) else "/"
    folder = mount / within.lstrip("/")
    while folder != mount and mount in folder.parents:
        yield folder
        folder = folder.parent
    yield mount


def _rooms(group: Path) -> Iterator[int]:
    """Bytes that a group's limits leave; nothing where it has none. Asked for each picture that is opened, so that no
    file is read twice or in vain.
    """
    for current, limits, idle in (
        ("memory.current", ("memory.max", "memory.high"), "inactive_file"),
        ("memory.usage_in_bytes", ("memory.limit_in_bytes",), "total_inactive_file"),
    ):
        used = _number(group / current)
        if used is None:
            continue
        statistics = _statistics(group)
        above = statistics.get("hierarchical_memory_limit")  # version 1: the least around it, seen by the mount or not
        for limit in (above, *map(_number, (group / name for name in limits))):
            if limit is not None and limit < _UNLIMITED:
                yield limit - max(0, used - statistics.get(idle, 0))


def _statistics(group: Path) -> dict[str, int]:
    """The group's statistics by their names."""
    lines = (line.split() for line in _text(group / "memory.stat").splitlines())
    pairs = ((words[0], _whole(words[1])) for words in lines if len(words) == 2)
    return {name: value for name, value in pairs if value is not None}


def _number(path: Path) -> int | None:
    """A file's only number; None for "max" and for a file that is not there."""
    return _whole(_text(path).strip())


def _whole(text: str) -> int | None:
    return int(text) if text.isdecimal() and len(text) < _MOST_DIGITS else None


def _text(path: Path) -> str:
    """A file of the kernel, empty where it may not be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
