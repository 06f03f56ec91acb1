"""Screenshot of nerfstudio's viewer with the generated frustums of a finished run, by a headless Chromium.

    python docs/make_viewer_screenshot.py --load-config outputs/demo/runs/room/fillerbuster/run/config.yml python
    docs/make_viewer_screenshot.py --load-config outputs/demo/runs/room/fillerbuster/run/config.yml --complete 3 \\
        --output docs/images/viewer_complete.png

The second line lets the run train on, presses "Complete from here" as a person would, and shows what came of it.

Needs the extra ``dev`` (playwright's Python package) and a Chromium of the system on PATH; nothing is downloaded.
"""

from __future__ import annotations

import logging
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import tyro
from playwright.sync_api import Page, sync_playwright

from fb_nerfstudio.runs.run_config import read_run_config

BROWSERS = ("chromium", "chromium-headless-shell", "chromium-browser", "google-chrome")
# WebGL in software, so that it also works where there is no graphics card.
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_logger = logging.getLogger("make_viewer_screenshot")


def main(
    load_config: Path,
    output: Path = Path("docs/images/viewer.png"),
    *,
    size: tuple[int, int] = (1440, 900),
    zoom_out: int = 3,
    settle_seconds: float = 25.0,
    start_seconds: float = 240.0,
    complete: int = 0,
    complete_seconds: float = 900.0,
) -> None:
    """Start ns-viewer on a run, look at it from outside, and save what a browser shows.

    Args:
        load_config: config.yml of the run.
        output: the picture.
        size: width and height of the browser's window in pixels.
        zoom_out: turns of the mouse wheel; the camera starts among the frustums.
        settle_seconds: time for the splats to be rendered and the pictures of the frustums to arrive.
        start_seconds: longest wait for the viewer to answer.
        complete: go on with the training, and ask for so many views from where the camera starts.
        complete_seconds: longest wait for these.
    """
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        sys.exit(f"no browser found on PATH (one of {', '.join(BROWSERS)}); install the system package chromium")
    output.parent.mkdir(parents=True, exist_ok=True)
    port = _free_port()
    with tempfile.TemporaryDirectory() as unwanted, sync_playwright() as playwright, ExitStack() as running:
        command = _training(load_config, Path(unwanted)) if complete else _looking(load_config)
        running.enter_context(_viewer(command, port, start_seconds))
        chromium = playwright.chromium.launch(executable_path=browser, args=FLAGS)
        page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        page.set_default_timeout(300_000)  # frustums in software take their time on a busy machine
        page.goto(f"http://127.0.0.1:{port}", wait_until="load", timeout=120_000)
        page.add_style_tag(content="img[alt='NerfStudio Logo'] { visibility: hidden; }")  # comes from the internet
        if complete:
            _complete(page, complete, complete_seconds)
        _step_back(page, size, zoom_out)
        page.wait_for_timeout(1000 * settle_seconds)
        page.screenshot(path=output, timeout=120_000)
        chromium.close()
    _logger.info("wrote %s", output)


def _step_back(page: Page, size: tuple[int, int], turns: int) -> None:
    """Leave the middle of the scene, so that the frustums are seen from outside."""
    page.wait_for_selector("canvas", timeout=120_000)
    page.wait_for_timeout(8000)  # the first render decides where the camera stands
    page.mouse.move(size[0] * 0.4, size[1] * 0.5)
    for _ in range(turns):
        page.mouse.wheel(0, 240)
        page.wait_for_timeout(150)


def _complete(page: Page, views: int, seconds: float) -> None:
    """Ask for a fan of views and wait until it is there."""
    page.wait_for_selector("canvas", timeout=120_000)
    page.wait_for_timeout(8000)  # the first render decides where the camera stands
    page.locator("xpath=//*[normalize-space(text())='Views']/following::input[1]").fill(str(views))
    page.keyboard.press("Tab")
    page.get_by_role("button", name="Complete from here").click()
    page.get_by_text("Gaussians placed in holes").wait_for(timeout=1000 * seconds)


def _looking(config: Path) -> list[Path | str]:
    """The command that shows a run."""
    return [Path(sys.executable).with_name("ns-viewer"), "--load-config", config]


def _training(config: Path, output: Path) -> list[Path | str]:
    """The command that goes on with a run, into another folder."""
    told = read_run_config(config)
    checkpoints = config.parent / "nerfstudio_models"
    command = [
        Path(sys.executable).with_name("ns-train"),
        told.method_name,
        "--data",
        told.data,
        "--load-dir",
        checkpoints,
    ]
    return [*command, "--output-dir", output, "--vis", "viewer", "--max-num-iterations", "1000000"]


@contextmanager
def _viewer(command: list[Path | str], port: int, start_seconds: float) -> Iterator[None]:
    """A running ns-viewer or ns-train on 127.0.0.1 that answers."""
    options = ["--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", str(port)]
    options += ["--viewer.default-composite-depth", "False"]  # or splats in front would hide the frustums
    process = subprocess.Popen([*map(str, command), *options], stdin=subprocess.DEVNULL)
    try:
        until = time.monotonic() + start_seconds
        while not _answers(port):
            if process.poll() is not None or time.monotonic() > until:
                sys.exit(f"the viewer did not start within {start_seconds:.0f} seconds; its output above says why")
            time.sleep(0.5)
        yield
    finally:
        process.terminate()
        try:
            process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            process.kill()


def _answers(port: int) -> bool:
    with socket.socket() as client:
        client.settimeout(1)
        return client.connect_ex(("127.0.0.1", port)) == 0


def _free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    tyro.cli(main)
