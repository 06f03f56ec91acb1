"""``fillerbuster eval trust``: is what is believed right? Errors of generated pixels against the truth, in five bins of
trust.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from fb_core.machine.devices import chosen_device
from method_configs.benchmarks.table_files import TableFiles

if TYPE_CHECKING:
    import torch

    from fb_core.completion.trust import Trust as Measured
    from fb_core.evaluation.results import Bar, Report
    from fb_core.inpainter import Fillerbuster

_BINS = 5
_POINTS = 2000  # surface points of a room that are told, as structure from motion would
PARTS = ("all pixels", "pixels that no known view shows")


@dataclass(frozen=True, kw_only=True)
class Trust(TableFiles):
    """Trust in generated pixels of unseen rooms, as known views alone tell it, beside their errors: five bins of
    equally many pixels.
    """

    model: Path | None = None
    """Model folder; by default the bundled one."""
    rooms: int = 10
    """Unseen rooms."""
    views: int = 16
    """Views per room."""
    known: int = 8
    """How many of them are given; a quarter of these is hidden to learn what evidence is worth."""
    family: Literal["narrow", "medium", "wide"] = "narrow"
    """How varied room and cameras are; the bundled model knows narrow rooms."""
    steps: int | None = None
    """Denoising steps; by default the model's recommendation."""
    samples: int = 1
    """Samples of every view, whose spread is evidence, too."""
    device: str | None = None
    """Where to compute, e.g. cpu or cuda:1; by default a GPU if there is one."""

    def run(self) -> None:
        """Generate, compare, report.

        Raises ValueError for options that make no evaluation.
        """
        import torch
        from rich.progress import track

        from fb_core.evaluation.results import Report
        from fb_core.inpainter import Fillerbuster

        if not 4 <= self.known < self.views or self.rooms < 1 or self.samples < 1:
            raise ValueError(
                "trust: expected at least 4 known views, fewer than views, and at least one room and sample, "
                f"got known {self.known}, views {self.views}, rooms {self.rooms}, samples {self.samples}"
            )
        model = Fillerbuster.from_pretrained(self.model, device=chosen_device(self.device))
        rooms = [self._room(model, number) for number in track(range(self.rooms), description="rooms", transient=True)]
        rows = []
        for part in PARTS:
            chosen = [
                torch.tensor(one["unseen"]) if part == PARTS[1] else torch.ones(len(one["trust"]), dtype=torch.bool)
                for one in rooms
            ]
            trust, error, expected = (
                torch.cat(
                    [
                        torch.tensor(one[name], dtype=torch.float64)[mask]
                        for one, mask in zip(rooms, chosen, strict=True)
                    ]
                )
                for name in ("trust", "error", "expected")
            )
            rows += bins(f"{part}, {self.rooms} unseen {self.family} rooms", trust, error, expected)
        self.publish(Report(seed=self.seed, rows=rows, bars=bars_of(rows)), draw)

    def _room(self, model: Fillerbuster, number: int) -> dict[str, list]:
        """Of one room's blocks of pixels: trust, squared error, the expected one, and whether no known view shows
        them.
        """
        import dataclasses

        sampling = model.recommended_sampling
        sampling = sampling if self.steps is None else dataclasses.replace(sampling, steps=self.steps)
        asked = {
            "family": self.family, "seed": self.seed, "views": self.views, "known": self.known, "samples": self.samples,
            "sampling": repr(sampling), "model": model.model_hash,
        }  # fmt: skip
        return self.kept(
            f"{model.model_hash[:8]}/room-{number:03d}", asked, lambda: self._measured(model, sampling, number)
        )

    def _measured(self, model: Fillerbuster, sampling: Any, number: int) -> dict[str, list]:
        import torch

        from fb_core.completion.options import CompletionConfig
        from fb_core.completion.pixel_trust import evidence_of
        from fb_core.completion.planning.site import shell_of
        from fb_core.completion.rounds import CapturedView
        from fb_core.completion.trust import Surroundings, along_rays, measured_trust
        from fb_core.evaluation.completion import complete_hidden, unseen_room
        from fb_core.geometry.carry_over import carried_over
        from fb_core.geometry.raymap import raymaps_of
        from fb_core.geometry.viewpoints.paths import CaptureShape
        from fb_nerfstudio.generation.trusted_views import shell_depth

        room = unseen_room(family=self.family, seed=self.seed, number=number, views=self.views, size=model.size)
        given, hidden = room[: self.known], room[self.known :]
        points = given.cameras.unproject(given.depth).reshape(-1, 3)
        points = points[:: max(1, len(points) // _POINTS)]
        shell = shell_of(CaptureShape.of([given.cameras[index] for index in range(self.known)]), points)
        ones = torch.ones(1, *room.images.shape[2:])
        context = [
            CapturedView(image=given.images[index], known=ones, camera=given.cameras[index])
            for index in range(self.known)
        ]
        config = CompletionConfig(seed=self.seed + number, steps=self.steps)
        trust: Measured = measured_trust(
            context,
            model,
            config,
            size=model.size,
            surroundings=lambda cameras: Surroundings(shell_depth(shell, cameras), None),
        )
        assert trust.curve is not None  # at least 4 views are known
        drawn = torch.stack([
            complete_hidden(model, given, hidden.cameras, sampling, seed=self.seed + number + 10**6 * sample)
            for sample in range(self.samples)
        ])  # fmt: skip
        images, depth = drawn[0], shell_depth(shell, hidden.cameras)
        known = torch.ones_like(given.images[:, :1])
        away = along_rays(depth, hidden.cameras)
        carried = carried_over(
            given.images, known, raymaps_of(given.cameras), raymaps_of(hidden.cameras), distance=away
        )
        there = carried.there[:, 0] > 0
        spread = drawn.var(dim=0).mean(dim=1) if self.samples > 1 else None
        evidence = evidence_of(images, hidden.cameras, depth, there, carried.images, spread=spread)
        error = (images - hidden.images).square().mean(dim=1)
        return {
            "trust": _blocks(trust.curve.trust(evidence)),
            "error": _blocks(error),
            "expected": _blocks(trust.curve.error(evidence)),
            "unseen": [bool(share < 0.5) for share in _blocks(there.float())],
        }


def _blocks(values: torch.Tensor) -> list[float]:
    """Means over blocks of 4 x 4 pixels, one after the other."""
    import torch.nn.functional as F

    return [round(float(value), 7) for value in F.avg_pool2d(values[:, None].float(), 4).flatten()]


def bins(
    part: str, trust: torch.Tensor, error: torch.Tensor, expected: torch.Tensor, *, count: int = _BINS
) -> list[dict[str, Any]]:
    """Rows of ``count`` bins with equally many pixels, the least believed first: mean trust, error, and the error that
    was expected.
    """
    import math

    rows = []
    for number, chosen in enumerate(trust.argsort(stable=True).chunk(count)):
        mean = float(error[chosen].mean())
        rows.append({
            "part": part,
            "method": f"bin {number + 1} of {count}",
            "trust": round(float(trust[chosen].mean()), 4),
            "psnr": round(-10 * math.log10(max(mean, 1e-12)), 3),
            "error": round(mean, 6),
            "expected_error": round(float(expected[chosen].mean()), 6),
        })  # fmt: skip
    return rows


def bars_of(rows: Sequence[dict[str, Any]]) -> list[Bar]:
    """Errors must fall from bin to bin: the greatest rise must not be above 0."""
    from fb_core.evaluation.results import Bar

    bars = []
    for part in dict.fromkeys(row["part"] for row in rows):
        errors = [row["error"] for row in rows if row["part"] == part]
        rise = max(later - earlier for earlier, later in pairwise(errors))
        bars.append(
            Bar(name=f"greatest rise of the squared error from bin to bin, {part}", value=rise, limit=0.0, sense="<=")
        )
    return bars


def draw(report: Report, path: Path) -> None:
    """Error over trust, measured and expected, one panel for each part."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    from method_configs.benchmarks.figures import save_figure

    parts = list(dict.fromkeys(row["part"] for row in report.rows))
    figure, panels = pyplot.subplots(
        1, len(parts), figsize=(4.5 * len(parts), 3.8), layout="constrained", squeeze=False
    )
    for axes, part in zip(panels[0], parts, strict=True):
        mine = [row for row in report.rows if row["part"] == part]
        for name, style in (("error", "o-"), ("expected_error", "x--")):
            axes.plot([row["trust"] for row in mine], [row[name] for row in mine], style, label=name.replace("_", " "))
        axes.set_title(part, fontsize=9)
        axes.set_xlabel("trust (mean of a fifth of the pixels)")
        axes.set_ylabel("squared error")
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend()
    save_figure(figure, path)
