"""A person in a browser: open the viewer of a running training, press "Complete from here", see the bank grow.

A toy training with a tiny random model runs in a thread, a headless Chromium of the system opens its viewer.
"""

from __future__ import annotations

import copy
import dataclasses
import io
import re
import shutil
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.tiny_models import save_tiny_model
from PIL import Image

from fb_core.data.rooms.room_captures import rooms

BROWSER = shutil.which("chromium") or shutil.which("chromium-headless-shell")
# WebGL in software, so that it also works where there is no graphics card.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
ANCHORS, VIEWS, SIDE = 3, 6, 32
SLOW = 120_000  # milliseconds; a loaded machine
GREEN = (90, 210, 120)  # the lines of round 2, which is the first that is asked for

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium on PATH: apt-get install chromium")
playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed: pip install 'fillerbuster[dev]'"
)


@dataclass
class Training:
    """A training that runs until it is told to stop."""

    trainer: object
    address: str
    folder: Path

    @property
    def manager(self):
        return self.trainer.pipeline.datamanager

    @property
    def count(self) -> int:
        return len(self.manager.generated_views or ())

    def until(self, true, what: str, seconds: float = 120.0) -> None:
        end = time.monotonic() + seconds
        while not true():
            assert time.monotonic() < end, f"waited {seconds:.0f} s for {what}"
            time.sleep(0.1)


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Training]:
    from nerfstudio.scripts import train as ns_train
    from nerfstudio.utils import writer

    from fb_nerfstudio.trainer import FillerbusterTrainer
    from method_configs.splats import fillerbuster

    folder = tmp_path_factory.mktemp("browser")
    rooms(3, folder / "room", family="narrow", views=VIEWS, size=SIDE, held_out=2, ground_truth=False)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = copy.deepcopy(fillerbuster.config)
    config.data, config.output_dir, config.timestamp, config.vis = folder / "room", folder / "out", "run", "viewer"
    config.machine.device_type, config.max_num_iterations, config.steps_per_save = "cpu", 10**6, 10**6
    config.viewer.websocket_host, config.viewer.websocket_port, config.viewer.quit_on_train_completion = (
        "127.0.0.1",
        port,
        True,
    )
    config.pipeline.model.num_random = config.pipeline.model.max_gaussians = 300
    manager = config.pipeline.datamanager
    model = save_tiny_model(folder / "model", image_size=SIDE)
    toy = {"model": model, "at_step": 0, "anchor_views": ANCHORS, "densify_rounds": 1, "densify_views": 0, "steps": 2}
    manager.completion = dataclasses.replace(manager.completion, **toy, max_seed_gaussians=20)
    trainers: list[FillerbusterTrainer] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)
        setup, train_iteration = FillerbusterTrainer.setup, FillerbusterTrainer.train_iteration

        def unhurried(self, step):  # leaves the processor to the browser
            time.sleep(0.05)
            return train_iteration(self, step)

        patch.setattr(FillerbusterTrainer, "setup", lambda self, *args: (trainers.append(self), setup(self, *args))[1])
        patch.setattr(FillerbusterTrainer, "train_iteration", unhurried)
        for everything in (writer.EVENT_WRITERS, writer.EVENT_STORAGE, writer.GLOBAL_BUFFER):
            everything.clear()
        thread = threading.Thread(target=ns_train.main, args=(config,), daemon=True)
        thread.start()
        running = Training(
            trainer=None, address=f"http://127.0.0.1:{port}", folder=folder / "out" / "room" / "fillerbuster" / "run"
        )
        running.until(lambda: trainers or not thread.is_alive(), "the training to begin")
        running.trainer = trainers[0]
        running.until(lambda: getattr(running.trainer, "step", 0) > 1, "the first steps")
        yield running
        running.trainer.shutdown()
        thread.join(timeout=60)


@pytest.fixture(scope="module")
def browser() -> Iterator:
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=BROWSER, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def page(training: Training, browser) -> Iterator:
    """A window of its own for each test."""
    page = browser.new_page(viewport={"width": 1000, "height": 1000})
    page.set_default_timeout(SLOW)
    page.received = []
    page.on("websocket", lambda socket: socket.on("framereceived", lambda frame: page.received.append(frame)))
    page.goto(training.address, wait_until="load")
    page.get_by_text("Complete from here").wait_for()
    yield page
    page.close()


def received(page, name: str) -> bool:
    """Whether the browser was sent something with this name."""
    return any(name.encode() in (frame.encode() if isinstance(frame, str) else frame) for frame in page.received)


def field(page, label: str):
    """The input beside a label of the panel."""
    return page.locator(f"xpath=//*[normalize-space(text())='{label}']/following::input[1]")


def pixels(page, color: tuple[int, int, int]) -> np.ndarray:
    """Rows and columns [2, n] of the window's pixels that have nearly this colour."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=SLOW))).convert("RGB")).astype(int)
    return np.array(np.nonzero(np.abs(picture - np.array(color)).max(axis=-1) < 25))


def test_complete_from_here_and_remove_it_again(training: Training, page):
    with urllib.request.urlopen(training.address, timeout=20) as answer:
        assert answer.status == 200
    assert training.count == ANCHORS
    page.get_by_text(f"{ANCHORS} generated views").wait_for()
    page.wait_for_timeout(1000)
    step, asked_from = (
        training.trainer.step,
        next(iter(training.trainer.viewer_state.viser_server.get_clients().values())),
    )
    place, green = np.array(asked_from.camera.position) / 10, pixels(page, GREEN).shape[1]

    page.get_by_role("button", name="Complete from here").click()
    page.get_by_text(f"{ANCHORS + 1} generated views").wait_for()  # what the person sees
    page.get_by_text("Requested 2 (1)").first.wait_for()
    assert training.count == ANCHORS + 1 and received(page, "/completion/round_02/view_000")
    view = training.manager.generated_views[[ANCHORS]]
    assert view.origins[0].role == "requested" and np.allclose(view.cameras.centers[0].numpy(), place, atol=1e-4)
    training.until(lambda: training.trainer.step > step + 1, "the training to go on")
    assert (training.folder / "completion" / "transforms.json").read_text().count('"generated"') == ANCHORS + 1

    # The person steps back and sees the frustum.
    page.mouse.move(300, 500)
    for _ in range(3):
        page.mouse.wheel(0, 200)
        page.wait_for_timeout(300)
    page.wait_for_timeout(2000)
    seen = pixels(page, GREEN)
    assert seen.shape[1] > green + 50

    # A click selects it, and the button removes it.
    row, column = (seen.min(axis=1) + seen.max(axis=1)) / 2
    page.mouse.click(column, row)
    page.get_by_text("Selected: Requested 2, seed 1").wait_for()
    page.get_by_role("button", name="Remove this view").click()
    page.get_by_text(f"{ANCHORS} generated views").wait_for()
    assert training.count == ANCHORS and training.manager.generated_views.rounds == [0]


def test_a_fan_with_another_seed_and_a_prompt_that_cannot_be_read(training: Training, page):
    before = training.count
    field(page, "Prompt").fill("a red door")
    page.get_by_role("button", name="Complete from here").click()
    page.get_by_text(re.compile("Not done: prompt: this model reads no text")).wait_for()
    assert training.count == before
    field(page, "Prompt").fill("")
    field(page, "Views").fill("3")
    page.keyboard.press("Tab")
    page.get_by_role("button", name="Complete from here").click()
    page.get_by_text("Requested 2 (3)").first.wait_for()
    assert training.count == before + 3 and {
        origin.seed for origin in training.manager.generated_views.origins[before:]
    } != {1}
