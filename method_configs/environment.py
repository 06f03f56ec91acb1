"""What this machine lacks: one sentence for each thing, and the one of them that can be mended from here (OpenCV's
build).
"""

from __future__ import annotations

import ctypes.util
import importlib.metadata
import logging
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

CONTRIB = "opencv-contrib-python-headless"
"""The build of OpenCV that has the modules we use; nerfstudio asks for the plain build, which owns the same folder."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Lack:
    """Something that is missing here."""

    name: str
    """The missing thing."""
    sentence: str
    """What it is needed for, and what to do."""
    mendable: bool = False
    """Whether :func:`mend_opencv` can bring it."""


def lacks() -> list[Lack]:
    """Everything that is missing on this machine; empty when all commands of this project and of nerfstudio can
    work.
    """
    checks = [_opencv(), _ffmpeg(), _libusb(), _compiler(), _cuda_toolkit()]
    return [lack for lack in checks if lack is not None]


def has_contrib() -> bool:
    """Whether ``import cv2`` gives the contrib build, asked in a fresh interpreter because a module is imported only
    once.
    """
    question = "import cv2; cv2.ximgproc.thinning; cv2.xphoto.inpaint"
    return subprocess.run([sys.executable, "-c", question], capture_output=True).returncode == 0


def mend_opencv() -> None:
    """Install the contrib build once more, so that its files win over the plain build's. Raises ValueError when that
    does not help.
    """
    try:
        requirement = f"{CONTRIB}=={importlib.metadata.version(CONTRIB)}"
    except importlib.metadata.PackageNotFoundError as error:
        raise ValueError(f"{CONTRIB} is not installed; run make install.") from error
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--force-reinstall", "--no-deps", requirement]
    _logger.info("OpenCV is not the contrib build; installing %s again", requirement)
    if subprocess.run(command).returncode != 0 or not has_contrib():
        raise ValueError(f"OpenCV could not be mended; run: {' '.join(command)}")


def _opencv() -> Lack | None:
    if has_contrib():
        return None
    command = f"{Path(sys.executable).name} -m pip install --force-reinstall --no-deps {CONTRIB}==4.10.0.84"
    return Lack(
        name="OpenCV's contrib modules",
        sentence="OpenCV's contrib modules are missing because the plain build was installed over them; run: "
        f"{command}",
        mendable=True,
    )


def _ffmpeg() -> Lack | None:
    if shutil.which("ffmpeg"):
        return None
    return Lack(
        name="ffmpeg",
        sentence="ffmpeg was not found, which ns-render needs even for single images; install the system package "
        "ffmpeg.",
    )


def _libusb() -> Lack | None:
    if ctypes.util.find_library("usb-1.0"):
        return None
    needed = "libusb-1.0 was not found, which ns-export needs because open3d loads it"
    return Lack(name="libusb-1.0", sentence=f"{needed}; install the system package libusb-1.0-0 (Fedora: libusb1).")


def _compiler() -> Lack | None:
    if any(shutil.which(name) for name in ("c++", "g++", "clang++")):
        return None
    needed = "A C++ compiler was not found, which gsplat needs on a GPU to build its kernels (a CPU does without)"
    return Lack(name="C++ compiler", sentence=f"{needed}; install the system package g++.")


def _cuda_toolkit() -> Lack | None:
    if not shutil.which("nvidia-smi") or shutil.which("nvcc") or Path("/usr/local/cuda/bin/nvcc").exists():
        return None
    needed = "nvcc was not found beside the NVIDIA driver, and gsplat builds its kernels with it at first use"
    return Lack(name="nvcc", sentence=f"{needed}; install the CUDA toolkit that matches torch.")


def check(*, mend: bool = False) -> list[Lack]:
    """Log one sentence for everything that is missing, after mending what can be mended if ``mend``; returns what is
    left.
    """
    if mend and not has_contrib():
        mend_opencv()
    left = lacks()
    for lack in left:
        _logger.warning("%s", lack.sentence)
    if not left:
        _logger.info("Nothing is missing on this machine.")
    return left


def main() -> None:
    """``python -m method_configs.environment [--mend]``: exits with 1 when something is missing that stops this
    project's own work.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        left = check(mend="--mend" in sys.argv[1:])
    except ValueError as error:
        sys.exit(str(error))
    sys.exit(any(lack.mendable for lack in left))


if __name__ == "__main__":
    main()
