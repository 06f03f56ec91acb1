"""Screenshot of nerfstudio's viewer with the generated frustums of a finished run, by a headless Chromium.

    python docs/make_viewer_screenshot.py --load-config outputs/demo/runs/room/fillerbuster/run/config.yml

Needs the extra ``dev`` (playwright's Python package) and a Chromium of the system on PATH; nothing is downloaded.
"""

from __future__ import annotations

import logging
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import tyro
from playwright.sync_api import Page, sync_playwright

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
) -> None:
    """Start ns-viewer on a run, look at it from outside, and save what a browser shows.

    Args:
        load_config: config.yml of the run.
        output: the picture.
        size: width and height of the browser's window in pixels.
        zoom_out: turns of the mouse wheel; the camera starts among the frustums.
        settle_seconds: time for the splats to be rendered and the pictures of the frustums to arrive.
        start_seconds: longest wait for the viewer to answer.
    """
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        sys.exit(f"no browser found on PATH (one of {', '.join(BROWSERS)}); install the system package chromium")
    output.parent.mkdir(parents=True, exist_ok=True)
    port = _free_port()
    with _viewer(load_config, port, start_seconds), sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=FLAGS)
        page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(f"http://127.0.0.1:{port}", wait_until="load", timeout=120_000)
        page.add_style_tag(content="img[alt='NerfStudio Logo'] { visibility: hidden; }")  # comes from the internet
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


@contextmanager
def _viewer(config: Path, port: int, start_seconds: float) -> Iterator[None]:
    """A running ns-viewer on 127.0.0.1 that answers."""
    command = [Path(sys.executable).with_name("ns-viewer"), "--load-config", config]
    options = ["--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", str(port)]
    options += ["--viewer.default-composite-depth", "False"]  # or splats in front would hide the frustums
    process = subprocess.Popen([*map(str, command), *options], stdin=subprocess.DEVNULL)
    try:
        until = time.monotonic() + start_seconds
        while not _answers(port):
            if process.poll() is not None or time.monotonic() > until:
                sys.exit(f"ns-viewer did not start within {start_seconds:.0f} seconds; its output above says why")
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
