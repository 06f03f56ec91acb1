"""Names that modules had in earlier versions, as they stand in the config.yml of runs made then.

nerfstudio's own commands (``ns-eval``, ``ns-viewer``) import whatever a config.yml names. A finder at the end of
Python's list leads the earlier names to the modules of today; it is asked only for names that nothing else answers to.
"""

from __future__ import annotations

import importlib
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

EARLIER_NAMES = {
    f"fb_nerfstudio.{name}": today
    for name, today in {
        "completion_config": "fb_core.completion.options",
        "splat_model": "fb_nerfstudio.splats.splat_model",
        "fused_adam": "fb_nerfstudio.splats.fused_adam",
        "schedulers": "fb_nerfstudio.splats.schedulers",
        "dataparser": "fb_nerfstudio.capture.dataparser",
    }.items()
}
"""Every module that a config.yml of an earlier version can name and that has moved since."""


class _Finder:
    """Finds and loads nothing but the names of the table: the module of today takes the place of the asked one."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        return ModuleSpec(name, self) if name in EARLIER_NAMES else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        sys.modules[module.__name__] = importlib.import_module(EARLIER_NAMES[module.__name__])


def lead_earlier_names() -> None:
    """From now on the earlier names can be imported; once is enough."""
    if not any(isinstance(one, _Finder) for one in sys.meta_path):
        sys.meta_path.append(_Finder())  # type: ignore[arg-type]
