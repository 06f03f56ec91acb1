"""Runs of ns-train that a command has started, and that it takes away before it starts them anew."""

from __future__ import annotations

from pathlib import Path

from fb_core.files.whole import discard

_LEFT_BY_TRAINING = {
    "config.yml",
    "dataparser_transforms.json",
    "nerfstudio_models",
    "completion",
    "completion.json",
    "viewer_log_filename.txt",
}
_EVENTS = "events.out.tfevents."


def clear_run(run: Path, output: Path) -> None:
    """Take away an earlier run below ``output``. One that holds more than a training leaves is kept beside its place.

    Raises ValueError for a run that lies elsewhere through a link.
    """
    if run.is_symlink() or not run.resolve() == output.resolve() / run.relative_to(output):
        raise ValueError(
            f"{run} leads out of {output} through a link, which is neither followed nor replaced; choose another folder"
        )
    if not run.is_dir():
        return
    names = {entry.name for entry in run.iterdir() if not entry.name.startswith((_EVENTS, "."))}
    discard(run, foreign=sorted(names - _LEFT_BY_TRAINING))
