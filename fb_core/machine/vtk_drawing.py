"""VTK as this project draws with it: off-screen, without a word on the screen that is not there."""

from __future__ import annotations

from contextlib import suppress
from types import ModuleType


def pyvista_off_screen() -> ModuleType:
    """pyvista, loaded so that torch's compiler may be loaded after it has drawn.

    triton's LLVM, loaded after VTK has drawn by Mesa, ends the process (triton 3.9, VTK 9): so it is loaded first,
    where it is installed.
    """
    with suppress(ImportError):
        import triton  # noqa: F401
    import pyvista
    import vtk

    vtk.vtkObject.GlobalWarningDisplayOff()
    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
    return pyvista
