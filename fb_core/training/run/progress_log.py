"""What a training leaves to read: its losses, what unseen data say (both as JSON lines and as a curve), TensorBoard's
files on demand.
"""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

from fb_core.files.faults import all_told
from fb_core.files.whole import whole_file

_logger = logging.getLogger(__name__)


class ProgressLog:
    """The log in a training's folder."""

    def __init__(self, folder: Path, title: str, *, from_step: int, tensorboard: bool = False):
        """Lines of steps after ``from_step``, which will be done again, are dropped."""
        self.folder, self.title = folder, title
        self._path, self._validation = folder / "log.jsonl", folder / "validation.jsonl"
        self._board = _board(folder / "tensorboard", from_step) if tensorboard else None
        for path in (self._path, self._validation):
            if path.exists():
                lines = [
                    line
                    for line in path.read_text().splitlines()
                    if line.endswith("}") and json.loads(line)["step"] <= from_step
                ]
                with whole_file(path) as unfinished:
                    unfinished.write_text("".join(line + "\n" for line in lines))

    def add(self, step: int, losses: dict[str, float], speed: dict[str, float]) -> None:
        """Note a step; ``speed`` goes to TensorBoard alone, so that two logs of one training are the same."""
        _append(self._path, step, losses)
        self._show("loss", losses, step)
        self._show("speed", speed, step)

    def add_validation(self, step: int, measured: dict[str, float]) -> None:
        """Note how good the averaged weights are on unseen data."""
        _append(self._validation, step, measured)
        self._show("validation", measured, step)

    def _show(self, group: str, values: dict[str, float], step: int) -> None:
        if self._board is not None:
            for name, value in values.items():
                with all_told(self.folder / "tensorboard"):
                    self._board.add_scalar(f"{group}/{name}", value, step)

    def close(self) -> None:
        """Draw the curves of all losses and of what unseen data say."""
        if self._board is not None:
            with all_told(self.folder / "tensorboard"):
                self._board.flush()
        for path, name in ((self._path, "loss.png"), (self._validation, "validation.png")):
            if path.exists():
                self._draw([json.loads(line) for line in path.read_text().splitlines()], name)

    def _draw(self, rows: list[dict[str, float]], file: str) -> None:
        if len(rows) < 2:
            return
        try:
            import matplotlib
        except ImportError:
            _logger.info(
                "%s: no %s, because matplotlib is not installed; its numbers are in a file beside it", self.title, file
            )
            return
        matplotlib.use("Agg")
        from matplotlib import pyplot

        figure, axes = pyplot.subplots(figsize=(6, 3.5), layout="constrained")
        width = max(1, len(rows) // 100)
        for name in rows[0]:
            if name != "step":
                values = [row[name] for row in rows]
                means = [sum(values[k : k + width]) / len(values[k : k + width]) for k in range(0, len(values), width)]
                axes.plot([rows[k]["step"] for k in range(0, len(rows), width)], means, label=name)
        axes.set(xlabel="step", ylabel=file.removesuffix(".png"), yscale="log", title=self.title)
        axes.legend()
        try:
            with whole_file(self.folder / file) as unfinished:
                figure.savefig(unfinished, dpi=120)
        finally:
            pyplot.close(figure)


def _append(path: Path, step: int, values: dict[str, float]) -> None:
    """A further line, whole or not at all."""
    line = json.dumps({"step": step, **{name: round(value, 6) for name, value in values.items()}}) + "\n"
    with all_told(path), path.open("ab") as log:
        end = log.tell()
        try:
            log.write(line.encode())
            log.flush()
        except OSError:
            os.truncate(path, end)
            raise


def _board(folder: Path, from_step: int):
    """TensorBoard's writer, or None with a message where it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        _logger.warning("no TensorBoard files, because it is not installed (%s)", error)
        return None
    return SummaryWriter(str(folder), purge_step=from_step + 1)
