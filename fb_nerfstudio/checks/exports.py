"""What nerfstudio's exporter says about our runs: one sentence where its box holds nothing."""

from __future__ import annotations

import sys
from typing import Any

from fb_core.files.faults import Refused

_CAREFUL = "_refuses_an_empty_box"


def refuse_empty_exports() -> None:
    """Let ``ns-export gaussian-splat`` end with one sentence where no Gaussian is left to write; nerfstudio checks
    types and gives up.

    Does nothing where another program reads the run. It is called when a run is opened for rendering or export.
    """
    exporter: Any = getattr(sys.modules.get("nerfstudio.scripts.exporter"), "ExportGaussianSplat", None)
    if exporter is None or hasattr(exporter, _CAREFUL):
        return
    write = exporter.write_ply

    def write_ply(filename: str, count: int, map_to_tensors: Any) -> None:
        if count == 0:
            raise Refused(
                f"{filename}: no Gaussian is left to write; choose a larger box (--obb-center, --obb-rotation, "
                "--obb-scale, in the run's "
                "world, as the viewer's Export tab tells), or leave it out"
            )
        write(filename, count, map_to_tensors)

    exporter.write_ply = staticmethod(write_ply)
    setattr(exporter, _CAREFUL, True)
