"""A capture as the plugin's dataparser gives it, and all files of a folder."""

from __future__ import annotations

from pathlib import Path

from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

from fb_nerfstudio.capture.dataparser import NerfstudioWithoutOpen3d


def outputs(folder: Path, split: str = "train", **options):
    return NerfstudioWithoutOpen3d(NerfstudioDataParserConfig(data=folder, **options)).get_dataparser_outputs(split)


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
