"""Ctrl-C and SIGTERM where Python cannot stand them: inside imports, in destructors, twice, and in nerfstudio's
launch.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from fb_core.machine.interruption import signals_given_back, stop_on_signals
from fb_core.training.run.signals import StopSignal

ROOT = Path(__file__).resolve().parents[3]
INTERRUPT = "os.kill(os.getpid(), signal.SIGINT)"


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def ended(program: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A program that stops on signals, and notes where it was when it was told."""
    text = (
        "import os, signal, sys, time\nfrom fb_core.machine.interruption import "
        f"stop_on_signals\nstop_on_signals()\n{program}"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)])}
    return subprocess.run([sys.executable, "-c", text], env=environment, capture_output=True, text=True, check=False)


def test_a_module_that_swallows_every_error_does_not_swallow_ctrl_c(tmp_path: Path):
    """It is imported to its end, and the interruption comes right after it."""
    (tmp_path / "optional.py").write_text(
        f"import os, signal\ntry:\n    {INTERRUPT}\n    sum(range(1000))\nexcept:\n    "
        "print('swallowed')\nprint('whole')\n"
    )
    child = ended(
        "try:\n    import optional\n    time.sleep(20)\nexcept KeyboardInterrupt:\n    print('told', 'optional' in "
        "sys.modules)",
        tmp_path,
    )
    assert child.stdout.split("\n") == ["whole", "told True", ""], child


@pytest.mark.parametrize(
    "program",
    [
        "import optional; print('went on')",
        "def command():\n    import optional\ncommand()\nprint('went on')",
        "import importlib\nimportlib.import_module('optional')\nprint('went on')",
        "try:\n    import broken\nexcept ImportError:\n    print('went on')",
        "try:\n    import optional\n    raise ValueError\nexcept ValueError:\n    print('went on')",
    ],
)
def test_nothing_happens_between_the_end_of_an_import_and_the_interruption(program: str, tmp_path: Path):
    """A command that fails, or ends, at once is no exception."""
    (tmp_path / "optional.py").write_text(f"import os, signal\n{INTERRUPT}\nimport json\n")
    (tmp_path / "broken.py").write_text(f"import os, signal\n{INTERRUPT}\nimport nowhere_at_all\n")
    child = ended(program, tmp_path)
    assert child.stdout == "" and child.stderr.splitlines()[-1] == "KeyboardInterrupt", child


def test_sigterm_waits_for_an_import_too(tmp_path: Path):
    (tmp_path / "optional.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nprint('whole')\n")
    child = ended("import optional\ntime.sleep(20)", tmp_path)
    assert (child.returncode, child.stdout, child.stderr) == (128 + signal.SIGTERM, "whole\n", "")


def test_an_interruption_that_a_destructor_loses_comes_again(tmp_path: Path):
    lost = f"class Lost:\n    def __del__(self):\n        {INTERRUPT}\n        sum(range(1000))\n"
    child = ended(lost + "try:\n    Lost()\n    time.sleep(20)\nexcept KeyboardInterrupt:\n    print('told')", tmp_path)
    assert (child.returncode, child.stdout, child.stderr) == (0, "told\n", "")
    child = ended("class Bad:\n    def __del__(self):\n        raise ValueError('mine')\nBad()", tmp_path)
    assert "Exception ignored" in child.stderr and "mine" in child.stderr, "other errors are printed as ever"


def test_outside_imports_it_comes_at_once():
    stop_on_signals()
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(SystemExit) as stopped:
        os.kill(os.getpid(), signal.SIGTERM)
    assert stopped.value.code == 128 + signal.SIGTERM


def test_a_training_notes_ctrl_c_once_and_obeys_it_twice():
    with StopSignal() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.number == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("saved", [None, "own", "given"])
def test_nerfstudio_ends_with_a_code_and_says_where_to_go_on(tmp_path: Path, capsys, saved: str | None):
    """It turns KeyboardInterrupt into a traceback and success, so what it sees is the end of the program."""
    from nerfstudio.scripts import train as ns_train

    from method_configs.splats import fillerbuster

    config = type(fillerbuster.config)(
        method_name="fillerbuster", experiment_name="a", timestamp="b", output_dir=tmp_path
    )
    own, given = config.get_checkpoint_dir(), tmp_path / "given"
    if saved is not None:
        config.load_dir = given
    if saved == "own":
        own.mkdir(parents=True)
        (own / "step-000000001.ckpt").touch()

    def interrupted(**_: object) -> None:
        stop_on_signals(config._stop)
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(SystemExit) as stopped:
        ns_train.launch(interrupted, 1, config=config)
    assert stopped.value.code == 130 and signal.getsignal(signal.SIGINT) == signal.SIG_DFL, (
        "a second one ends it at once"
    )
    advice = {
        None: "nothing was saved yet",
        "own": f"go on with --load-dir {own}",
        "given": f"go on with --load-dir {given}",
    }[saved]
    assert capsys.readouterr().err == f"\nStopped; {advice}.\n"


def test_signals_go_back_to_whom_they_went_before() -> None:
    """A training inside another command takes Ctrl-C for itself only as long as it lasts."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    hook = sys.unraisablehook
    with pytest.raises(ValueError, match="inside"), signals_given_back():
        stop_on_signals(lambda number: None)
        assert all(signal.getsignal(number) != handler for number, handler in before.items())
        raise ValueError("inside")
    assert all(signal.getsignal(number) == handler for number, handler in before.items())
    assert sys.unraisablehook is hook
