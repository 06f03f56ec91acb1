"""What every test shares: run-time shape checks, seeds, few threads, the shared data folder, one tiny capture."""

from __future__ import annotations

import gc
import os
import random
import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
import shape_checks
import torch
from hypothesis import settings
from torch.overrides import _get_current_function_mode_stack

# Installed before any test imports fb_core: every annotated function and dataclass checks its shapes. The parts of
# the rasterizer run thousands of times for each picture, so their shapes are tested where they meet, not at each call.
_CORE = Path(__file__).resolve().parents[1] / "fb_core"
_CHECKED = sorted(path.stem for path in _CORE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists())
shape_checks.install([f"fb_core.{name}" for name in _CHECKED if name not in ("__init__", "splatting")])

torch.set_num_threads(1)  # what is tested is small: a second thread costs more than it brings
settings.register_profile("fillerbuster", deadline=None, derandomize=True, max_examples=25)
settings.load_profile("fillerbuster")


STOPPING = (signal.SIGINT, signal.SIGTERM)

# What a user has compiled on this machine takes no part, here and in the processes that tests start: an empty folder.
_NO_LIBRARIES = tempfile.TemporaryDirectory(prefix="fillerbuster-no-libraries-")
os.environ["FILLERBUSTER_CACHE"] = _NO_LIBRARIES.name


def pytest_configure(config: pytest.Config) -> None:
    """Markers live here so that a lone test file runs without warnings."""
    config.addinivalue_line("markers", "slow: takes more than a few seconds; deselect with -m 'not slow'")


gc.disable()  # until all modules are there: what they hold stays, and looking for rubbish in it costs seconds


def pytest_collection_finish(session: pytest.Session) -> None:
    """From here on rubbish is collected, among what came into being since."""
    gc.enable()
    gc.freeze()


def pytest_unconfigure(config: pytest.Config) -> None:
    """At the end everything is looked at, lest libraries that count their own objects report what stays."""
    gc.unfreeze()


def shared_path(relative: str) -> Path:
    """A file or folder of the shared data (goldens, sample captures), or a skip that names what is absent.

    The folder is the environment variable FILLERBUSTER_SHARED, or ``shared`` beside the repository.
    """
    root = Path(os.environ.get("FILLERBUSTER_SHARED") or Path(__file__).resolve().parents[2] / "shared")
    path = root / relative
    if not path.exists():
        pytest.skip(f"shared data {relative!r} not found (set FILLERBUSTER_SHARED to the folder that holds it)")
    return path


def state_of_process() -> dict[str, Any]:
    """What one test could change for all that follow it."""
    return {number.name: signal.getsignal(number) for number in STOPPING} | {
        "default dtype": torch.get_default_dtype(),
        "default device": torch.get_default_device(),
        "gradients": torch.is_grad_enabled(),
        "function modes": len(_get_current_function_mode_stack()),
    }


@pytest.fixture(name="shared_path", scope="session")
def _shared_path_fixture():
    """The function :func:`shared_path`, for tests that take it as an argument instead of importing it."""
    return shared_path


@pytest.fixture
def shapes_unchecked():
    """Turns the shape checks off, to reach the sentences that a user sees for wrong shapes."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True)
def _as_before(request: pytest.FixtureRequest) -> Iterator[None]:
    """Every test starts from the same global seeds, alone or in the suite, and leaves this process as it found it.

    Tests of the plugin run parts of ``ns-train``, a program that takes the signals for its own until it ends.
    """
    from fb_core.machine.interruption import signals_given_back

    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)
    before = state_of_process()
    with signals_given_back() if "plugin" in request.path.parts else nullcontext():
        yield
    left = {name: value for name, value in state_of_process().items() if value != before[name]}
    if left:
        for number in STOPPING:  # so that the tests that follow are judged by what they leave themselves
            signal.signal(number, before[number.name])
        torch.set_default_dtype(before["default dtype"])
        torch.set_grad_enabled(before["gradients"])
        if "default device" in left:
            torch.set_default_device(None)
        pytest.fail(f"the test leaves {left} behind, and found { {name: before[name] for name in left} }")


@pytest.fixture(scope="session")
def _tiny_capture_original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six 48x32 views on a ring of radius 2 that look at a smooth pattern, every second one with a mask, and 50
    points.
    """
    from fb_core.data.capture.captures import FrameToWrite, Points, write_capture
    from fb_core.geometry.cameras import Pinholes

    angles = torch.arange(6, dtype=torch.float64) * torch.pi / 3
    centers = torch.stack([2 * angles.cos(), 2 * angles.sin(), 0.3 * angles.sin()], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    cameras = Pinholes.looking_at(centers, torch.zeros_like(centers), up=up, fov_degrees=60.0, width=48, height=32)
    frames = []
    for index in range(6):
        directions = cameras[index].directions()[0].permute(2, 0, 1)
        image = (0.5 + 0.5 * torch.sin(3 * directions + torch.arange(3)[:, None, None])).float()
        mask = torch.ones(1, 32, 48)
        mask[:, 8:16, 10:30] = 0.0
        frames.append(
            FrameToWrite(name=f"view_{index:03d}", image=image, mask=mask if index % 2 else None, camera=cameras[index])
        )
    generator = torch.Generator().manual_seed(0)
    points = Points(positions=torch.randn(50, 3, generator=generator), colors=torch.rand(50, 3, generator=generator))
    return write_capture(tmp_path_factory.mktemp("tiny") / "capture", frames, points=points).root


@pytest.fixture
def tiny_capture(_tiny_capture_original: Path, tmp_path: Path) -> Path:
    """A fresh folder with a small valid capture (transforms.json, images, masks, points); a test may damage it."""
    return Path(shutil.copytree(_tiny_capture_original, tmp_path / "tiny_capture"))


@pytest.fixture(scope="session")
def _libraries(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the compiled splat library, made once for each run of the tests that ask for it."""
    from fb_core.splatting.compiled import library

    folder = tmp_path_factory.mktemp("libraries")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(library.CACHE_VARIABLE, str(folder))
        try:
            library.compile_libraries()
        except library.NoCompiler as error:
            pytest.skip(str(error))
    return folder


@pytest.fixture
def compiled_library(_libraries: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a library for both precisions, which is found inside the test."""
    from fb_core.splatting.compiled import library

    monkeypatch.setenv(library.CACHE_VARIABLE, str(_libraries))
    library.loaded.cache_clear()
    yield _libraries
    library.loaded.cache_clear()
