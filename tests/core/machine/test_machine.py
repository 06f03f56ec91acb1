"""What a process may use: control groups of both versions, and systems that tell less than Linux or in other units."""

from __future__ import annotations

import os
import random
import resource
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from fb_core.machine import resources as machine
from fb_core.memory import budget as memory

GIB = 2**30
UNLIMITED_V1 = 9223372036854771712


class Linux:
    """The files of a machine with 64 GiB, 40 of them free."""

    def __init__(self, root: Path, *, group: str, mounts: str):
        self.root = root
        self.write("proc/meminfo", f"MemTotal: {64 * 2**20} kB\nMemFree: 1024 kB\nMemAvailable:   {40 * 2**20} kB\n")
        self.write("proc/self/cgroup", group)
        self.write("proc/self/mountinfo", "22 1 0:20 / /proc rw,nosuid - proc proc rw\n" + mounts)

    def write(self, name: str, text: str) -> None:
        (self.root / name).parent.mkdir(parents=True, exist_ok=True)
        (self.root / name).write_text(text)

    def v2(
        self, folder: str, *, used: float, top: float | None = None, high: float | None = None, idle: float = 0.0
    ) -> None:
        self.write(f"{folder}/memory.max", "max\n" if top is None else f"{int(top * GIB)}\n")
        self.write(f"{folder}/memory.high", "max\n" if high is None else f"{int(high * GIB)}\n")
        self.write(f"{folder}/memory.current", f"{int(used * GIB)}\n")
        self.write(f"{folder}/memory.stat", f"anon 1\nfile 2\nactive_file 7\ninactive_file {int(idle * GIB)}\n")

    def v1(self, folder: str, *, used: float, top: float | None = None, idle: float = 0.0) -> None:
        self.write(f"{folder}/memory.limit_in_bytes", f"{UNLIMITED_V1 if top is None else int(top * GIB)}\n")
        self.write(f"{folder}/memory.usage_in_bytes", f"{int(used * GIB)}\n")
        self.write(
            f"{folder}/memory.stat", f"inactive_file 5\ntotal_active_file 9\ntotal_inactive_file {int(idle * GIB)}\n"
        )

    @property
    def free_gib(self) -> float:
        free = machine.free_memory_bytes(self.root)
        assert free is not None
        return free / GIB


V2 = "30 22 0:26 / /sys/fs/cgroup rw,nosuid shared:9 - cgroup2 cgroup2 rw,nsdelegate\n"


def test_a_container_s_limit_counts_not_the_machine_s_memory(tmp_path: Path):
    """A namespace of its own: the container sees its group as the root."""
    linux = Linux(tmp_path, group="0::/\n", mounts=V2)
    linux.v2("sys/fs/cgroup", top=8, used=3)
    assert linux.free_gib == 5
    linux.v2("sys/fs/cgroup", top=8, used=3, idle=2)  # files that were read once are given up first
    assert linux.free_gib == 7
    linux.v2("sys/fs/cgroup", top=8, high=6, used=3)
    assert linux.free_gib == 3
    linux.v2("sys/fs/cgroup", high=2, used=3)
    assert linux.free_gib == 0, "never less than nothing"
    linux.v2("sys/fs/cgroup", top=200, used=3)
    assert linux.free_gib == 40, "a limit beyond the machine's memory is none"
    linux.v2("sys/fs/cgroup", used=3)
    assert linux.free_gib == 40


def test_every_group_around_a_process_counts(tmp_path: Path):
    linux = Linux(tmp_path, group="0::/user.slice/job_17.scope/step_0\n", mounts=V2)
    linux.v2("sys/fs/cgroup/user.slice/job_17.scope/step_0", used=1)
    linux.v2("sys/fs/cgroup/user.slice/job_17.scope", top=10, used=4)
    linux.v2("sys/fs/cgroup/user.slice", top=30, used=28)
    assert linux.free_gib == 2


def test_version_1_in_a_container(tmp_path: Path):
    """The mount shows the container's own group, though the process knows the path on the host."""
    mounts = "41 31 0:32 /docker/3a5f /sys/fs/cgroup/memory ro,nosuid master:16 - cgroup cgroup rw,memory\n"
    mounts += "42 31 0:33 /docker/3a5f /sys/fs/cgroup/cpu,cpuacct ro - cgroup cgroup rw,cpu,cpuacct\n"
    linux = Linux(tmp_path, group="12:cpu,cpuacct:/docker/3a5f\n4:memory:/docker/3a5f\n0::/\n", mounts=mounts)
    linux.v1("sys/fs/cgroup/memory", top=6, used=5, idle=3)
    assert linux.free_gib == 4
    linux.v1("sys/fs/cgroup/memory", used=5)
    assert linux.free_gib == 40


def test_version_1_of_a_batch_job(tmp_path: Path):
    mounts = (
        "35 31 0:32 / /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n41 31 0:38 / /sys/fs/cgroup/unified "
        "rw - cgroup2 cgroup2 rw\n"
    )
    linux = Linux(tmp_path, group="4:memory:/slurm/uid_7/job_9/step_0\n0::/\n", mounts=mounts)
    linux.v1("sys/fs/cgroup/memory/slurm/uid_7/job_9/step_0", used=1)
    linux.v1("sys/fs/cgroup/memory/slurm/uid_7/job_9", top=4, used=1)
    linux.v1("sys/fs/cgroup/memory", used=60)
    assert linux.free_gib == 3


def test_version_1_tells_of_groups_that_the_mount_does_not_show(tmp_path: Path):
    """A pod's limit: the container's own group has none, and its mount shows no other."""
    mounts = "31 22 0:27 /kubepods/pod7/abc /sys/fs/cgroup/memory rw - cgroup cgroup rw,memory\n"
    linux = Linux(tmp_path, group="5:memory:/kubepods/pod7/abc\n", mounts=mounts)
    linux.v1("sys/fs/cgroup/memory", used=1)
    assert linux.free_gib == 40
    stat = tmp_path / "sys/fs/cgroup/memory/memory.stat"
    stat.write_text(
        stat.read_text() + f"hierarchical_memory_limit {6 * GIB}\nhierarchical_memsw_limit {UNLIMITED_V1}\n"
    )
    assert linux.free_gib == 5
    stat.write_text(stat.read_text().replace(str(6 * GIB), str(UNLIMITED_V1)))
    assert linux.free_gib == 40


def test_whatever_stands_in_the_files_is_no_error(tmp_path: Path):
    """Sandboxes that only play Linux write what they like; what cannot be understood limits nothing, and nothing is
    ever below 0.
    """
    draws = random.Random(0)
    words = [
        "0::/",
        "5:memory:/a",
        "::",
        ":",
        "",
        "x",
        "max",
        "-1",
        "٣",
        "9" * 30,
        "9" * 5000,
        "0",
        "7",
        "MemAvailable:",
        " - ",
        "\x00",
    ]
    words += [
        "22 1 0:2 / /sys/fs/cgroup rw - cgroup2 c rw",
        "3 2 0:2 /a /sys/fs/cgroup rw - cgroup c rw,memory",
        "/..",
        "inactive_file",
    ]
    groups = ("memory.max", "memory.current", "memory.stat", "memory.limit_in_bytes", "memory.usage_in_bytes")
    names = ["proc/meminfo", "proc/self/cgroup", "proc/self/mountinfo", *(f"sys/fs/cgroup/{name}" for name in groups)]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    for _ in range(100):
        for name in names:
            lines = [
                "".join(draws.choice(words) + draws.choice(("", " ", ":")) for _ in range(draws.randint(0, 4)))
                for _ in range(3)
            ]
            (tmp_path / name).write_text("\n".join(lines))
        free = machine.free_memory_bytes(tmp_path)
        assert free is None or free >= 0


def test_groups_that_cannot_be_read_and_none_at_all(tmp_path: Path):
    assert Linux(tmp_path / "a", group="0::/gone\n", mounts=V2).free_gib == 40
    assert Linux(tmp_path / "b", group="", mounts="").free_gib == 40
    assert machine.free_memory_bytes(tmp_path / "nothing") is None


def test_estimates_use_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(memory, "free_memory_bytes", lambda: 123)
    assert memory.available_bytes(torch.device("cpu")) == 123
    assert memory.available_bytes(torch.device("meta")) is None
    free = machine.free_memory_bytes()
    assert free is None or 2**20 < free < 2**50


def test_without_proc_psutil_tells(monkeypatch: pytest.MonkeyPatch):
    """macOS and Windows."""
    import psutil

    monkeypatch.setattr(machine, "_text", lambda path: "")
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=5 * GIB))
    assert machine.free_memory_bytes() == 5 * GIB
    monkeypatch.setitem(sys.modules, "psutil", None)
    assert machine.free_memory_bytes() is None


def test_cores_where_no_affinity_is_told(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1, 5, 6}, raising=False)
    assert machine.usable_cores() == 3
    monkeypatch.delattr(os, "sched_getaffinity")  # macOS and Windows have none
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    assert machine.usable_cores() == 8
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert machine.usable_cores() == 1


def test_the_largest_size_is_in_bytes_on_every_system(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(resource, "getrusage", lambda who: SimpleNamespace(ru_maxrss=3 * 2**20))
    monkeypatch.setattr(sys, "platform", "linux")
    assert machine.peak_memory_bytes() == 3 * GIB
    monkeypatch.setattr(sys, "platform", "darwin")
    assert machine.peak_memory_bytes() == 3 * 2**20
    monkeypatch.setitem(sys.modules, "resource", None)
    assert machine.peak_memory_bytes() == 0


def test_this_process_has_a_size():
    assert 2**20 < machine.peak_memory_bytes() < 2**45 and machine.usable_cores() >= 1


def test_nobody_else_asks_the_system():
    """One place each: memory, cores, the process's own size."""
    root = Path(__file__).resolve().parents[3]
    asked = (
        "sched_getaffinity",
        "cpu_count(",
        "ru_maxrss",
        "virtual_memory",
        "meminfo",
        "import resource",
        "SC_PHYS_PAGES",
    )
    for path in (
        path for package in ("fb_core", "fb_nerfstudio", "method_configs") for path in (root / package).rglob("*.py")
    ):
        if path.name != "resources.py":
            assert not [word for word in asked if word in path.read_text()], path
