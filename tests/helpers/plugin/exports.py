"""What an export is compared with."""

from __future__ import annotations

from pathlib import Path

import yaml
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio

from fb_core.geometry.similarity import Similarity
from fb_nerfstudio.capture.dataparser import without_open3d


def split_lists(meta: dict) -> dict[str, list[str]]:
    names = [frame["file_path"] for frame in meta["frames"]]
    return {"train_filenames": names[:-1], "val_filenames": names[-1:], "test_filenames": names[-1:]}


def run_world(run: Path) -> tuple[Similarity, Nerfstudio]:
    """From the capture's world to the run's, found from what nerfstudio's reader gives the run."""
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    parser = config.pipeline.datamanager.dataparser
    parser.data = config.data
    reader = without_open3d(parser).setup()
    outputs = reader.get_dataparser_outputs("train")
    matrix = outputs.dataparser_transform.double()
    scale = float(outputs.dataparser_scale)
    return Similarity(rotation=matrix[:, :3], scale=scale, shift=scale * matrix[:, 3]), reader
