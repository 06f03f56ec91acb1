"""Two processes train what one trains: the same losses, the same weights; they stop together, and one process can go on
for them.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.tiny_training import LOOP, TinyStage, losses_of, run_in

from fb_core.data.training.sequences import PoolConfig, RoomPool, TaskConfig
from fb_core.training.run.distributed import ALONE, Group
from fb_core.training.run.loop import Run
from fb_core.training.run.options import EngineConfig
from fb_core.training.run.stage import row_generator

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """What two processes left behind, as torchrun would start them, and one process's run ("one")."""
    folder = tmp_path_factory.mktemp("processes")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    shared = {
        "WORLD_SIZE": "2",
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "PYTHONPATH": path,
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, str(ROOT / "tests" / "helpers" / "tiny_training.py"), str(folder)]
    children = [
        subprocess.Popen(
            command,
            env={**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    run = run_in(folder / "one", ALONE)
    run.train()
    torch.save((run.stage.network.state_dict(), run.averaged_state()), folder / "one" / "weights.pt")
    try:
        for child in children:
            _, errors = child.communicate(timeout=300)
            assert child.returncode == 0, errors[-3000:]
    finally:
        for child in children:
            child.kill()
    return folder


@pytest.mark.parametrize("name", ["two", "parts", "sharded"])
def test_processes_parts_and_shards_learn_what_one_process_learns(folder, name):
    """Stopped after 9 of 20 steps and resumed, too."""
    one, other = losses_of(folder / "one"), losses_of(folder / name)
    assert len(one) == len(other) == LOOP.steps
    assert max(abs(a - b) for a, b in zip(one, other, strict=True)) <= 1e-6 + 1e-9  # both are rounded to six digits
    for mine, theirs in zip(
        *(torch.load(folder / kind / "weights.pt", weights_only=True) for kind in ("one", name)), strict=True
    ):
        for key, value in mine.items():
            assert torch.allclose(theirs[key], value, rtol=0, atol=1e-5), key


def test_losses_fall_so_that_equality_says_something(folder):
    losses = losses_of(folder / "one")
    assert sum(losses[-4:]) < 0.9 * sum(losses[:4])


def test_one_process_goes_on_where_two_stopped(folder):
    run = run_in(folder / "handed over", ALONE)
    assert run.step == 9
    run.train()
    assert losses_of(folder / "handed over") == pytest.approx(losses_of(folder / "one"), abs=2e-6)


def test_only_the_first_process_writes_and_the_files_are_those_of_one(folder):
    assert {path.name for path in (folder / "two").iterdir()} | {"loss.png"} == {
        path.name for path in (folder / "one").iterdir()
    }
    one, two = (torch.load(folder / name / "checkpoint.pt", weights_only=True) for name in ("one", "sharded"))
    assert one.keys() == two.keys() and one["network"].keys() == two["network"].keys()
    assert all(type(value) is torch.Tensor for value in two["network"].values())


def test_sheets_of_sharded_weights_get_whole_ones(folder):
    sheets = {path.name: path.read_text() for path in (folder / "sharded" / "sheets").iterdir()}
    assert sheets == dict.fromkeys(("000005.png", "000010.png", "000015.png", "000020.png"), "torch.Size([128, 16])")


def test_a_signal_to_one_process_stops_both_with_a_checkpoint(folder):
    told = [json.loads((folder / f"told-{rank}.json").read_text()) for rank in range(2)]
    assert [one["step"] for one in told] == [3, 3] and [one["signal"] for one in told] == [15, 15]
    assert torch.load(folder / "stopped" / "checkpoint.pt", weights_only=True)["step"] == 3


def test_a_row_that_is_not_finite_stops_both_and_is_named(folder):
    told = [json.loads((folder / f"told-{rank}.json").read_text())["message"] for rank in range(2)]
    assert told[0] == told[1] and "at step 5 (rows 3 of the batch); there is no checkpoint yet" in told[0]


def test_a_batch_that_processes_cannot_share_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a batch that 3 processes can share equally in 1 parts each, got 4"):
        Run(TinyStage(), LOOP, None, group=Group(rank=0, size=3))


def test_processes_that_share_a_pool_render_their_rooms_only_and_draw_what_one_draws():
    config, task = PoolConfig(rooms=6, views=3, image_size=16, renewed_per_step=1.0, supersample=1), TaskConfig(views=2)
    rendered = []

    class Counting(RoomPool):
        def render(self, numbers):
            rendered.extend(numbers)
            return super().render(numbers)

    whole, shared = RoomPool(config, seed=5), [Counting(config, seed=5) for _ in range(2)]
    for step in range(3):
        whole.advance(step)
        both = whole.sequences(range(4), task, lambda row, step=step: row_generator(0, step, row))
        for rank, pool in enumerate(shared):
            rows = range(rank, 4, 2)
            pool.advance(step, rows)
            mine = pool.sequences(rows, task, lambda row, step=step: row_generator(0, step, row))
            assert torch.equal(mine.images, both.images[rank::2]) and torch.equal(mine.raymaps, both.raymaps[rank::2])
            assert torch.equal(mine.image_known, both.image_known[rank::2])
    assert sorted(rendered) == list(range(8))  # six rooms at first, then one a step: each is made by one process


@pytest.mark.parametrize("nonsense", [{"accumulate": 0}, {"keep": 0}, {"sheet_every": -1}, {"precision": "float8"}])
def test_nonsense_engines_are_refused(nonsense, shapes_unchecked):
    with pytest.raises(ValueError, match="training:"):
        EngineConfig(**nonsense)


ENDINGS = {
    "pass": (0, ""),
    "sys.exit(143)": (143, ""),
    "sys.exit('Error: no data.')": (1, "Error: no data."),
    "1 / 0": (1, "ZeroDivisionError"),
}
ENDS = """
import atexit
atexit.register(print, "taken apart")
with left_at_once():
    print("worked")
    {ending}
"""
EACH_IN_A_PROCESS = """
import json, os, sys
from fb_core.training.run.distributed import left_at_once
for number, (program, size) in enumerate(json.loads(sys.argv[1])):
    if os.fork() == 0:
        os.environ["WORLD_SIZE"] = str(size)
        for stream in (1, 2):
            os.dup2(os.open(f"{sys.argv[2]}/{number}.{stream}", os.O_CREAT | os.O_WRONLY), stream)
        break
    with open(f"{sys.argv[2]}/{number}.code", "w") as file:
        file.write(str(os.waitstatus_to_exitcode(os.wait()[1])))
else:
    sys.exit()
exec(program)
"""
"""Forks of one process that has imported torch; each runs its program as its outermost block."""


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, int], tuple[int, str, str]]:
    """Code, output and errors of processes by how their work ends and how many processes there are."""
    folder = tmp_path_factory.mktemp("ended")
    cases = [(ending, size) for ending in ENDINGS for size in (1, 2)]
    programs = json.dumps([(ENDS.format(ending=ending), size) for ending, size in cases])
    command = [sys.executable, "-c", EACH_IN_A_PROCESS, programs, str(folder)]
    subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, timeout=120)
    return {
        case: (int((folder / f"{number}.code").read_text()), *((folder / f"{number}.{n}").read_text() for n in (1, 2)))
        for number, case in enumerate(cases)
    }


@pytest.mark.parametrize(("ending", "code", "said"), [(ending, *told) for ending, told in ENDINGS.items()])
@pytest.mark.parametrize("size", [1, 2])
def test_a_process_of_a_group_ends_with_the_code_of_its_work(ended, ending, code, said, size):
    """Of several processes one ends without taking the interpreter apart (``atexit`` is not reached), one alone as
    always.
    """
    returned, output, errors = ended[ending, size]
    assert returned == code and said in errors
    assert output.split("\n")[:-1] == ["worked", "taken apart"][: 2 if size == 1 else 1]
