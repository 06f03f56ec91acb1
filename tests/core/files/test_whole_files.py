"""Folders and files are whole or absent: every rename fails once, a process is killed between any two steps, and
readers see old or new.
"""

from __future__ import annotations

import errno
import logging
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from helpers.folders.whole_folders import content, left_behind, names, write

from fb_core.files import whole
from fb_core.files.faults import CannotWrite
from fb_core.files.ownership import MARK_NAME, Target
from fb_core.files.whole import found_below, remove_folder, settled, swept, unfinished_beside, whole_file, whole_folder

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(params=["one step", "two renames"])
def way(request, monkeypatch: pytest.MonkeyPatch) -> str:
    """With the system's exchange of folders, and as on systems without it."""
    if request.param == "two renames":
        monkeypatch.setattr(whole, "exchange", lambda one, other: False)
    return request.param


def test_a_folder_whose_name_is_no_text_is_refused_before_work(tmp_path: Path):
    """Libraries for pictures take no such names; a room ended in a TypeError after all its pictures were drawn."""
    target = Target(folder=tmp_path / os.fsdecode(b"caf\xe9"), kind="room")
    with pytest.raises(ValueError, match=r"caf\\udce9: expected a name in UTF-8, got other bytes; rename it"):
        with whole_folder(target):
            pytest.fail("work was begun")
    assert list(tmp_path.iterdir()) == []


def test_this_system_exchanges_folders_in_one_step(tmp_path: Path):
    if sys.platform != "linux":
        pytest.skip("renameat2 is Linux's")
    (tmp_path / "a").mkdir()
    (tmp_path / "b" / "inside").mkdir(parents=True)
    assert whole.exchange(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "a" / "inside").exists() and not (tmp_path / "b" / "inside").exists()


def test_a_folder_is_replaced_whole_and_nothing_stays_beside_it(tmp_path: Path, way: str):
    for text in ("old", "new"):
        write(tmp_path / "out", text)
        assert content(tmp_path / "out") == text and names(tmp_path) == ["out"]
    remove_folder(Target(folder=tmp_path / "out", kind="test", overwrite=True))
    assert names(tmp_path) == []


@pytest.mark.parametrize("there", [False, True])
def test_every_rename_may_fail(tmp_path: Path, way: str, monkeypatch: pytest.MonkeyPatch, there: bool):
    """With each rename failing once, and with all from it on: old or new is there, or can be had by looking again;
    never neither.
    """
    real, failed = os.rename, 0
    for lasting in (False, True):
        for number in range(8):
            folder = tmp_path / f"{lasting}-{number}" / "out"
            if there:
                write(folder, "old")
            calls = []

            def fails(source, target, number=number, calls=calls, lasting=lasting):
                calls.append(source)
                if len(calls) - 1 == number or (lasting and len(calls) > number):
                    raise OSError(errno.EIO, "Input/output error")
                real(source, target)

            with monkeypatch.context() as patch:
                patch.setattr(os, "rename", fails)
                try:
                    write(folder, "new")
                except CannotWrite as error:
                    failed += 1
                    assert str(error).startswith(f"cannot write {folder}: Input/output error; ")
            assert content(settled(folder)) in ({"old", "new"} if there else {None, "new"})
            write(folder, "newer")
            assert content(folder) == "newer" and names(folder.parent) == ["out"]
            if len(calls) <= number:
                break
    assert failed >= (4 if there and way == "two renames" else 0 if there else 2)


KILLED = """
import os, shutil, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from fb_core.files import whole
from helpers.folders.whole_folders import content, ends_at_step, names, write
root, exchanges, there = Path(sys.argv[2]), sys.argv[3] == "one step", sys.argv[4] == "True"
if not exchanges:
    whole.exchange = lambda one, other: False
ends, killed = set(), 0
for moment in range(200):
    folder = root / str(moment) / "out"
    folder.parent.mkdir()
    if there:
        write(folder, "old")
    child = os.fork()
    if child == 0:
        whole.exchange = ends_at_step(moment)(whole.exchange)
        write(folder, "new")
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 9), code
    seen = content(whole.settled(folder))
    assert seen in (("old", "new") if there else (None, "new")), (moment, seen)
    ends.add(seen)
    write(folder, "newer")
    assert content(folder) == "newer" and names(folder.parent) == ["out"], (moment, names(folder.parent))
    killed += code == 9
    if code == 0:
        break
else:
    raise AssertionError("never came to the end")
print(killed, sorted(str(one) for one in ends))
"""


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("exchange", ["one step", "two renames"])
def test_a_kill_between_any_two_steps_loses_nothing(tmp_path: Path, exchange: str, there: bool):
    """A child is killed before its first step, its second, and so on; a reader, then a writer, look at what it has left
    each time.
    """
    arguments = [str(ROOT / "tests"), str(tmp_path), exchange, str(there)]
    done = subprocess.run(
        [sys.executable, "-c", KILLED, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    killed, _, ends = done.stdout.partition(" ")
    assert int(killed) >= 9 and "new" in ends and ("old" if there else "None") in ends


def test_what_a_live_process_writes_is_left_alone_and_what_is_not_ours(tmp_path: Path):
    stranger = tmp_path / ".out.unfinished-0badcafe"
    stranger.mkdir()
    (stranger / "thesis.txt").write_text("years of work")
    with unfinished_beside(tmp_path / "out") as work:
        (work / "half").touch()
        write(tmp_path / "out", "new")
        assert (work / "half").exists() and content(tmp_path / "out") == "new"
    assert names(tmp_path) == [stranger.name, "out"] and (stranger / "thesis.txt").read_text() == "years of work"


def test_a_reader_waits_for_a_live_swap(tmp_path: Path):
    folder = tmp_path / "out"
    write(folder, "old")
    with unfinished_beside(folder) as work:
        os.rename(folder, work / "old")
        later = threading.Thread(target=lambda: (time.sleep(0.1), os.rename(work / "old", folder)))
        later.start()
        assert content(settled(folder)) == "old"
        later.join()


def test_a_folder_is_never_absent_while_it_is_replaced_again_and_again(tmp_path: Path):
    """On Linux; nor does a reader that opened a file of it ever find half of one."""
    if sys.platform != "linux":
        pytest.skip("other systems have no single step, but settled() for readers")
    folder, stop, absent, looks = tmp_path / "out", threading.Event(), [], []
    write(folder, "0")

    def look() -> None:
        while not stop.is_set():
            looks.append(1)
            if not (folder / "below" / "two").exists():
                absent.append(1)

    reader = threading.Thread(target=look)
    reader.start()
    for number in range(50):
        write(folder, str(number))
    stop.set()
    reader.join()
    assert len(looks) > 50 and absent == []


def test_files_of_somebody_else_in_a_replaced_folder_are_kept(tmp_path: Path, way: str, caplog):
    folder = tmp_path / "out"
    write(folder, "old")
    (folder / "below" / "mine.txt").write_text("mine")
    (folder / "link").symlink_to(tmp_path)
    with caplog.at_level(logging.WARNING):
        write(folder, "new")
    assert content(folder) == "new" and names(tmp_path) == ["out", "out.replaced-1"]
    assert (
        tmp_path / "out.replaced-1" / "below" / "mine.txt"
    ).read_text() == "mine" and "such as below/mine.txt" in caplog.text


@pytest.mark.parametrize("stands", ["nothing", "an empty folder", "another folder"])
def test_an_interrupted_swap_never_costs_the_old_folder(tmp_path: Path, stands: str):
    """A kill between the two renames, after which somebody makes the folder anew: the old one is the last of its
    kind.
    """
    folder, work = tmp_path / "out", tmp_path / ".out.unfinished-0badcafe"
    write(folder, "old")
    write(tmp_path / "new", "new")
    work.mkdir()
    (work / "owner").touch()
    os.rename(folder, work / "old")
    os.rename(tmp_path / "new", work / "new")
    if stands == "an empty folder":
        folder.mkdir()
    elif stands == "another folder":
        write(tmp_path / "third", "third")
        os.rename(tmp_path / "third", folder)
    with unfinished_beside(folder):
        pass
    assert content(folder) == ("third" if stands == "another folder" else "old")
    assert names(tmp_path) == (["out", "out.replaced-1"] if stands == "another folder" else ["out"])
    assert stands != "another folder" or content(tmp_path / "out.replaced-1") == "old"


def test_files_of_somebody_else_survive_a_kill_after_the_swap(tmp_path: Path):
    write(tmp_path / "out", "new")
    work = tmp_path / ".out.unfinished-0badcafe"
    write(work / "new", "old")
    (work / "owner").touch()
    (work / "new" / "mine.txt").write_text("mine")
    write(tmp_path / "out", "newer")
    assert content(tmp_path / "out") == "newer" and names(tmp_path) == ["out", "out.replaced-1"]
    assert (tmp_path / "out.replaced-1" / "mine.txt").read_text() == "mine"


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "new folder" / "report.json"
    for text in ("old", "new"):
        with whole_file(path) as unfinished:
            unfinished.write_text(text)
            assert not path.exists() or path.read_text() == "old"
    for end in (KeyboardInterrupt, ValueError):
        with pytest.raises(end), whole_file(path) as unfinished:
            unfinished.write_text("half")
            raise end
    assert path.read_text() == "new" and names(path.parent) == ["report.json"]
    (tmp_path / "link").symlink_to(path)
    with pytest.raises(CannotWrite, match="it is a link"), whole_file(tmp_path / "link"):
        pass
    with whole_file("/dev/null") as unfinished:
        assert unfinished == Path("/dev/null")


def test_an_error_of_another_kind_passes_unchanged(tmp_path: Path):
    with pytest.raises(FileNotFoundError, match="elsewhere"), whole_file(tmp_path / "a") as unfinished:
        unfinished.write_bytes((tmp_path / "elsewhere").read_bytes())
    with (
        pytest.raises(CannotWrite, match=r"cannot write .*/a: No space left on device; free some room"),
        whole_file(tmp_path / "a"),
    ):
        raise RuntimeError("a library's own words") from OSError(errno.ENOSPC, "No space left on device")
    assert names(tmp_path) == []


def test_a_file_by_way_of_a_missing_folder_is_the_file_that_is_there(tmp_path: Path):
    """A link stays and nothing is made on the way."""
    precious, link = tmp_path / "precious.png", tmp_path / "sheet.png"
    precious.write_text("precious")
    link.symlink_to(precious)
    with (
        pytest.raises(CannotWrite, match="a link or a folder"),
        whole_file(tmp_path / "missing" / ".." / "sheet.png") as unfinished,
    ):
        unfinished.write_text("new")
    assert link.is_symlink() and precious.read_text() == "precious"
    with whole_file(tmp_path / "missing" / ".." / "precious.png") as unfinished:
        unfinished.write_text("new")
    assert precious.read_text() == "new" and sorted(path.name for path in tmp_path.iterdir()) == [
        "precious.png",
        "sheet.png",
    ]


def test_a_folder_with_nothing_but_what_kills_left_is_free(tmp_path: Path):
    """The failing case: a folder that looked empty to people was refused as somebody else's."""
    folder = tmp_path / "out"
    left_behind(folder / "a.json")
    left_behind(folder / "model", new="half")
    with whole_folder(Target(folder=folder, kind="test")):
        pass
    assert names(folder) == [MARK_NAME] and names(tmp_path) == ["out"]
    left_behind(folder / "sheet.png")  # is no file of somebody else either
    write(folder, "newer")
    assert content(folder) == "newer" and names(tmp_path) == ["out"]


def test_sweeping_puts_right_what_kills_left_and_spares_all_else(tmp_path: Path):
    left_behind(tmp_path / "model", old="old", new="new")
    left_behind(tmp_path / "gone", new="half")
    stranger = tmp_path / ".notes.unfinished-0badcafe"
    stranger.mkdir()
    (stranger / "thesis.txt").write_text("years of work")
    (tmp_path / ".link.unfinished-0badcafe").symlink_to(stranger)
    with unfinished_beside(tmp_path / "live") as work:
        (work / "half").touch()
        assert swept(tmp_path) == tmp_path
        assert (work / "half").exists()
    assert (
        names(tmp_path) == [".link.unfinished-0badcafe", stranger.name, "model"]
        and content(tmp_path / "model") == "old"
    )
    assert (stranger / "thesis.txt").exists() and swept(tmp_path / "missing") == tmp_path / "missing"


def test_searches_find_nothing_that_is_unfinished(tmp_path: Path):
    """Neither captures nor meshes nor shards: half a capture would be trained on, or the same one twice."""
    write(tmp_path / "deep" / "scene", "whole")
    left_behind(tmp_path / "deep" / "scene", old="old", new="half")
    left_behind(tmp_path / "other", new="half")
    for folder in (tmp_path, tmp_path / "deep", tmp_path / "deep" / "scene"):
        (found,) = found_below(folder, "two")
        assert found == tmp_path / "deep" / "scene" / "below" / "two"
    inside = tmp_path / ".odd.unfinished-0badcafe" / "scene"  # who names such a folder means it
    write(inside, "whole")
    assert found_below(inside, "two") == [inside / "below" / "two"]


KILLED_REPAIR = """
import os, shutil, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from fb_core.files import whole
from helpers.folders.whole_folders import content, ends_at_step, left_behind, names, write
root, stands, ends = Path(sys.argv[2]), sys.argv[3], set()
for moment in range(200):
    place = root / str(moment) / "out"
    left_behind(place, old="old", new="new")
    (place.parent / ".out.unfinished-0badcafe" / "old" / "mine.txt").write_text("mine")
    if stands == "another folder":
        write(place.parent / "third", "third")
        os.rename(place.parent / "third", place)
    child = os.fork()
    if child == 0:
        ends_at_step(moment)
        whole.swept(place.parent)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 9), code
    ends.add(code)
    whole.swept(place.parent)
    expected = ["out", "out.replaced-1"] if stands == "another folder" else ["out"]
    assert names(place.parent) == expected, (moment, names(place.parent))
    (place.parent / expected[-1] / "mine.txt").unlink()  # which must be there
    assert content(place) == ("third" if stands == "another folder" else "old"), moment
    assert content(place.parent / expected[-1]) == "old", moment
    if code == 0:
        break
assert ends == {0, 9} and moment >= 4, (ends, moment)
"""


@pytest.mark.parametrize("stands", ["nothing", "another folder"])
def test_a_kill_during_the_repair_is_repaired(tmp_path: Path, stands: str):
    """A swap was interrupted, and then, at each of its steps, the repair: the old folder comes back with all that was
    put into it.
    """
    done = subprocess.run([sys.executable, "-c", KILLED_REPAIR, str(ROOT / "tests"), str(tmp_path), stands], cwd=ROOT,
                          capture_output=True, text=True, timeout=300)  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
