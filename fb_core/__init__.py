"""Fillerbuster's diffusion model: views of a scene, of which some are known, completed. Knows torch, never nerfstudio.

    from fb_core import Fillerbuster, Views, Pinholes

The names below are imported when they are first asked for, so that ``import fb_core`` itself costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fb_core.geometry.cameras import Pinholes
    from fb_core.inpainter import Fillerbuster
    from fb_core.sampling.options import SamplingConfig
    from fb_core.views import Views

__all__ = ["Fillerbuster", "Pinholes", "SamplingConfig", "Views"]
_HOMES = {
    "Fillerbuster": "fb_core.inpainter",
    "Pinholes": "fb_core.geometry.cameras",
    "SamplingConfig": "fb_core.sampling.options",
    "Views": "fb_core.views",
}


def __getattr__(name: str) -> Any:
    """A public name. Raises AttributeError for others."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
