"""Captures that are changed and read by the plugin's dataparser."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d


def edited(folder: Path, change: Callable[[dict[str, Any]], Any]) -> Path:
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    return folder


def outputs(folder: Path, split: str = "train", reader: type = NerfstudioWithoutOpen3d, **options: Any):
    return reader(NerfstudioDataParserConfig(data=folder, **options)).get_dataparser_outputs(split)


def without(*keys: str) -> Callable[[dict[str, Any]], None]:
    def change(meta: dict[str, Any]) -> None:
        for entry in (meta, *meta["frames"]):
            for key in keys:
                entry.pop(key, None)

    return change
