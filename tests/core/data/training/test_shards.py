"""WebDataset shards with all the names that tar files have: entering a stream anywhere is reading it from its start."""

from __future__ import annotations

import io
import random
import tarfile
from pathlib import Path

import pytest

from fb_core.data.training.shard_stream import ShardStream, samples_of, shard_length

pytest.importorskip("webdataset", reason="needs the extra `train`")


def shard(path: Path, names: list[str]) -> str:
    with tarfile.open(path, "w") as tar:
        for name in names:
            info = tarfile.TarInfo(name)
            if name.endswith("/"):
                info.type = tarfile.DIRTYPE
                tar.addfile(info)
            else:
                info.size = 1
                tar.addfile(info, io.BytesIO(b"x"))
    return str(path)


def plain(count: int, before: str = "", prefix: str = "s") -> list[str]:
    return [f"{before}{prefix}{number}.{suffix}" for number in range(count) for suffix in ("jpg", "txt")]


NAMES: dict[str, list[str]] = {
    "plain": plain(4),
    "of a Mac": [name for one in plain(4) for name in (f"./._{one}", f"./{one}")],
    "with a README": ["README", *plain(2), "LICENSE", "s2.jpg", "NOTES", "s2.txt"],
    "with folders": ["./", "data/", *plain(3, "data/"), "more.data/", *plain(2, "more.data/")],
    "with what WebDataset keeps": ["__info__/x.json", *plain(2), "__index__", "__meta__.json", *plain(2, prefix="t")],
    "with many suffixes": ["a.seg.png", "a.JPG", "a.txt", "b.jpg", "b.x.y", ".hidden", "c.jpg"],
    "in one folder twice": ["a/x.jpg", "b/x.jpg", "a/x.txt"],
    "a name twice": [*plain(2), "s9.jpg", "s9.jpg", *plain(1, prefix="t")],
    "nothing but notes": ["README", "._x"],
    "empty": [],
}


def counted(path: str) -> int:
    count = 0
    try:
        for _ in samples_of(path):
            count += 1
    except ValueError:
        pass
    return count


@pytest.mark.parametrize("kind", NAMES)
def test_a_shard_has_as_many_samples_as_the_library_reads(tmp_path: Path, kind: str) -> None:
    path = shard(tmp_path / "a.tar", NAMES[kind])
    assert shard_length(path) == counted(path)


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_entering_anywhere_is_reading_through(tmp_path: Path, rows: int) -> None:
    generator = random.Random(rows)
    kinds = list(NAMES)
    shards = [shard(tmp_path / f"{number}.tar", NAMES[kind]) for number, kind in enumerate(kinds)]
    for row in range(min(rows, 2)):
        whole = [sample["__key__"] for sample in ShardStream(shards, row, rows, 0).take(0, 60)]
        for position in generator.sample(range(1, 57), 12):
            found = [sample["__key__"] for sample in ShardStream(shards, row, rows, 0).take(position, 3)]
            assert found == whole[position : position + 3], (row, position)


def test_a_shard_cut_short_has_what_can_be_read(tmp_path: Path) -> None:
    path = Path(shard(tmp_path / "a.tar", plain(6)))
    content = path.read_bytes()
    for size in (512 * 9, 512 * 10 + 100, 300, 0):
        cut = tmp_path / f"{size}.tar"
        cut.write_bytes(content[:size])
        count = 0
        try:
            for _ in samples_of(str(cut)):
                count += 1
        except (tarfile.TarError, OSError, EOFError, ValueError):
            pass
        assert shard_length(str(cut)) == count
