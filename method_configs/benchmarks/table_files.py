"""Tables of the paper on disk: JSON, CSV, Markdown and a figure; what was measured is kept, so that an interrupted
command goes on.
"""

from __future__ import annotations

import csv as csv_format
import hashlib
import io
import json as json_format
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fb_core.files.whole import whole_file

if TYPE_CHECKING:
    from fb_core.evaluation.results import Report

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TableFiles:
    """Where a table goes; options that all tables of the paper share."""

    seed: int = 0
    """Decides all that is drawn."""
    keep: Path | None = None
    """Folder for measurements; the same command again goes on where it was interrupted."""
    json: Path | None = None
    """Write all measurements to this file."""
    csv: Path | None = None
    """Write the rows to this file, each with command, commit, hardware and seed."""
    markdown: Path | None = None
    """Write the table to this file, with command, commit, hardware and seed."""
    figure: Path | None = None
    """Draw the table into this file (png, svg or pdf)."""

    def publish(self, report: Report, draw: Callable[[Report, Path], None]) -> None:
        """Show the table and write the files that were asked for."""
        from method_configs.benchmarks.command import command_line, show

        drawings = [] if self.figure is None else [lambda figure=self.figure: draw(report, figure)]
        show(report, self.json, drawings)
        texts = (
            (self.csv, lambda: csv_text(with_origin(report, command_line()))),
            (self.markdown, lambda: markdown_text(report, command_line())),
        )
        for path, text in texts:
            if path is not None:
                with whole_file(path) as unfinished:
                    unfinished.write_text(text(), encoding="utf-8")
                _logger.info("wrote %s", path)

    def kept(self, name: str, asked: Mapping[str, Any], measure: Callable[[], Any]) -> Any:
        """What was measured before under this name for the same question, or is measured now and kept.

        Args:
            name: of the file, without its suffix; a digest of the question follows, so that one folder may keep the
                answers to several.
            asked: all that decides the result, in what JSON can hold.
            measure: gives what JSON can hold.
        """
        if self.keep is None:
            return measure()
        question = json_format.loads(json_format.dumps(asked))
        digest = hashlib.sha256(json_format.dumps(question, sort_keys=True).encode()).hexdigest()[:8]
        path = self.keep / f"{name}-{digest}.json"
        if path.is_file():
            from fb_core.files.json_files import read_json

            try:
                before = read_json(path)
            except ValueError:  # a person's edit; it is measured again
                before = None
            if isinstance(before, dict) and before.get("asked") == question and "measured" in before:
                _logger.info("%s was measured before", name)
                return before["measured"]
        measured = measure()
        with whole_file(path) as unfinished:
            unfinished.write_text(
                json_format.dumps({"asked": question, "measured": measured}, indent=1) + "\n", encoding="utf-8"
            )
        return measured


def with_origin(report: Report, command: str) -> list[dict[str, Any]]:
    """The rows, each with what is needed to make it again, for a form that has no other place for it."""
    from fb_core.evaluation.results import commit, hardware

    origin = {"seed": report.seed, "commit": commit(), "hardware": hardware(), "command": command}
    return [{**row, **origin} for row in report.rows]


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows with the columns of all of them, in order of appearance; what a row lacks stays empty."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv_format.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if _missing(value) else value for name, value in row.items()} for row in rows)
    return text.getvalue()


def markdown_text(report: Report, command: str) -> str:
    """One table for each part, and below them what is needed to make them again."""
    lines = []
    for part in dict.fromkeys(row["part"] for row in report.rows):
        rows = [row for row in report.rows if row["part"] == part]
        columns = [name for name in dict.fromkeys(name for row in rows for name in row) if name != "part"]
        lines += [f"**{part}**", "", _line(name.replace("_", " ") for name in columns), _line("---" for _ in columns)]
        lines += [_line(_told(row.get(name)) for name in columns) for row in rows]
        lines.append("")
    lines.append(origin_of(report, f"`{command}`"))
    return "\n".join(lines) + "\n"


def origin_of(report: Report, command: str = "") -> str:
    """What a table or a figure needs to be made again; by default with this process's command."""
    from fb_core.evaluation.results import commit, hardware
    from method_configs.benchmarks.command import command_line

    models = sorted({row["model"] for row in report.rows if row.get("model", "-") != "-"})
    model_part = f"model {', '.join(models)}, " if models else ""
    return f"{command or command_line()}, {model_part}commit {commit()}, seed {report.seed}, {hardware()}"


def _line(cells: Any) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"


def _told(value: Any) -> str:
    if _missing(value):
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _missing(value: Any) -> bool:
    return value is None or (isinstance(value, float) and not math.isfinite(value))
