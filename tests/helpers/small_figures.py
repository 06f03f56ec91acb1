"""Figures of ``fillerbuster complete`` at a size that takes no time, for tests that do not look at them."""

import functools

import pytest

from fb_core.evaluation.figures.camera_figure import draw_cameras
from fb_core.evaluation.figures.contact_sheet import write_contact_sheet
from method_configs.commands import command_line as commands
from method_configs.commands.complete import output as complete_output


def draw_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small cameras and sheets, and sentences instead of tracebacks, until the test ends."""
    monkeypatch.setattr(complete_output, "draw_cameras", functools.partial(draw_cameras, size=(120, 80)))
    monkeypatch.setattr(complete_output, "write_contact_sheet", functools.partial(write_contact_sheet, dpi=20))
    monkeypatch.delenv(commands.DEBUG_VARIABLE, raising=False)
