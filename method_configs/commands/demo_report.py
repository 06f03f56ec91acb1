"""The demo's picture: what was captured, what was generated, and held-out cameras rendered without and with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fb_core.completion.results.completed_views import ANCHOR
from fb_core.data.capture.captures import read_capture
from fb_core.evaluation.figures.contact_sheet import Strip, evenly, write_contact_sheet
from fb_nerfstudio.runs.held_out_views import HeldOutViews

COLUMNS = 8


def write_report(output: Path, views: dict[str, HeldOutViews], quality: dict[str, Any], *, seed: int) -> None:
    """Write ``output/report.png`` from the capture in ``output`` and the two runs, ``without`` and ``with``."""
    capture = read_capture(output / "capture")
    captured = [frame.load_image() for frame in capture.frames if frame.extra.get("covered") is None]
    generated = views["with"].generated
    anchors = [picture for role, picture in generated if role == ANCHOR]
    densified = [picture for role, picture in generated if role != ANCHOR]
    strips = [
        _some("Captured views", captured),
        _some("Generated anchors", anchors),
        _some("Generated densified views", densified),
    ]
    uncovered, covered = ((views["with"].covered == wanted).nonzero().flatten().tolist() for wanted in (False, True))
    chosen = evenly(uncovered, COLUMNS - 3)
    chosen += evenly(covered, COLUMNS - len(chosen))
    for name, heading in (
        ("without", "Held-out cameras, without completion"),
        ("with", "Held-out cameras, with completion"),
    ):
        one, scores = views[name], views[name].psnr.tolist()
        strips.append(
            Strip(
                heading=heading,
                pictures=[one.renders[i] for i in chosen],
                captions=[f"{scores[i]:.1f} dB" for i in chosen],
            )
        )
    kinds = ["covered" if views["with"].covered[i] else "uncovered" for i in chosen]
    strips.append(
        Strip(
            heading="Held-out cameras, ground truth", pictures=[views["with"].truth[i] for i in chosen], captions=kinds
        )
    )
    summary = "; ".join(
        f"{kind} views: {quality['without'][kind]['psnr']:.1f} → {quality['with'][kind]['psnr']:.1f} dB, "
        f"holes {100 * quality['without'][kind]['hole_share']:.0f} → {100 * quality['with'][kind]['hole_share']:.0f} %"
        for kind in ("uncovered", "covered")
    )
    title = f"A casual capture of room {seed}, completed"
    write_contact_sheet(
        output / "report.png",
        strips,
        title=title,
        subtitle=f"{summary} (held-out, without → with completion)",
        columns=COLUMNS,
    )


def _some(heading: str, pictures: list) -> Strip:
    shown = evenly(pictures, COLUMNS)
    return Strip(heading=f"{heading} ({len(shown)} of {len(pictures)})", pictures=shown)
