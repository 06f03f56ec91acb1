"""``fillerbuster eval conditioning``: the same hidden views of a capture from more and more known ones, as table, curve
and sheet.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fb_core.files.limits import MOST_SIDE, MOST_VIEWS, require_between
from fb_core.machine.devices import chosen_device
from method_configs.benchmarks.table_files import TableFiles, origin_of

if TYPE_CHECKING:
    from fb_core.evaluation.capture_questions import CaptureViews
    from fb_core.evaluation.results import Report
    from fb_core.inpainter import Fillerbuster, SamplingConfig


@dataclass(frozen=True, kw_only=True)
class Conditioning(TableFiles):
    """The same hidden views of captures, generated from 1, 2, 4, ... known ones (the paper's flexible conditioning)."""

    data: Path
    """A capture with transforms.json, or a folder of captures at any depth."""
    model: Path | None = None
    """Model folder; by default the bundled one."""
    known: tuple[int, ...] = (1, 2, 4, 8, 16, 32)
    """Numbers of known views; each of them contains the smaller ones."""
    hidden: int = 8
    """Hidden views of a sequence, which are scored."""
    sequences: int = 10
    """Sequences."""
    size: int | None = None
    """Side of the crops in pixels; by default the model's."""
    steps: int | None = None
    """Denoising steps; by default the model's recommendation."""
    device: str | None = None
    """Where to compute, e.g. cpu or cuda:1; by default a GPU if there is one."""
    sheet: Path | None = None
    """Draw the first sequence into this PNG."""

    def run(self) -> None:
        """Generate what was not generated before, and report. Raises ValueError for options below 1."""
        import dataclasses

        from rich.progress import track

        from fb_core.evaluation.ablations import interval
        from fb_core.evaluation.results import Report
        from fb_core.inpainter import Fillerbuster

        if not self.known or min(self.known) < 1 or self.hidden < 1 or self.sequences < 1:
            raise ValueError(
                "conditioning: expected known views, hidden views and sequences from 1, "
                f"got known {' '.join(map(str, self.known)) or 'none'}, hidden {self.hidden}, sequences "
                f"{self.sequences}"
            )
        require_between("known and hidden views together", max(self.known) + self.hidden, 2, MOST_VIEWS)
        if self.size is not None:
            require_between("size", self.size, 16, MOST_SIDE)
        model = Fillerbuster.from_pretrained(self.model, device=chosen_device(self.device))
        sampling = model.recommended_sampling
        sampling = sampling if self.steps is None else dataclasses.replace(sampling, steps=self.steps)
        sequences = self._sequences(self.size or model.size)
        cells = [(known, number) for known in dict.fromkeys(self.known) for number in range(self.sequences)]
        scores: dict[int, list[dict[str, float]]] = {known: [] for known in self.known}
        for known, number in track(cells, description="sequences", transient=True):
            scores[known].append(self._scores(model, sequences[number], known, number, sampling))
        report = Report(seed=self.seed)
        for known, rows in scores.items():
            row: dict[str, Any] = {
                "part": f"{self.hidden} hidden views of {self.data.name}",
                "known": known,
                "model": model.model_hash[:8],
            }
            for metric in ("psnr", "ssim"):
                row[metric], row[f"{metric}_interval"] = interval([one[metric] for one in rows])
            report.rows.append(row)
        self.publish(report, draw)
        if self.sheet is not None:
            self._draw_sheet(self.sheet, model, sequences[0], sampling)

    def _sequences(self, size: int) -> list[CaptureViews]:
        """Of as many views as the largest number of known ones needs, so that all numbers meet the same hidden
        views.
        """
        import torch

        from fb_core.data.training.capture_sequences import CaptureConfig
        from fb_core.evaluation.capture_questions import (
            ScaledPictures,
            capture_folders,
            drawn_views,
            readable_captures,
        )

        views = self.hidden + max(self.known)
        captures = readable_captures(capture_folders(self.data), views=views)
        draws = (torch.Generator().manual_seed(self.seed * 1_000_003 + number) for number in range(self.sequences))
        config, pictures = CaptureConfig(image_size=size, centered=1.0), ScaledPictures()
        return [drawn_views(captures, views, config, generator=draw, pictures=pictures) for draw in draws]

    def _scores(
        self, model: Fillerbuster, views: CaptureViews, known: int, number: int, sampling: SamplingConfig
    ) -> dict[str, float]:
        from fb_core.evaluation.conditioning import generated_from, scores_of

        def measure() -> dict[str, float]:
            seed = self.seed + number
            generated = generated_from(model, views, hidden=self.hidden, known=known, sampling=sampling, seed=seed)
            return scores_of(generated, views[: self.hidden])

        asked = {
            "data": str(self.data.absolute()), "hidden": self.hidden, "most": max(self.known), "seed": self.seed,
            "size": views.images.shape[-1], "sampling": repr(sampling), "model": model.model_hash,
        }  # fmt: skip
        return self.kept(f"{model.model_hash[:8]}/{known}-known-{number:03d}", asked, measure)

    def _draw_sheet(self, path: Path, model: Fillerbuster, views: CaptureViews, sampling: SamplingConfig) -> None:
        from fb_core.evaluation.conditioning import generated_from
        from fb_core.evaluation.figures.contact_sheet import Strip, write_contact_sheet

        strips = [Strip(heading="Hidden views", pictures=list(views.images[: self.hidden]))]
        for known in dict.fromkeys(self.known):
            generated = generated_from(model, views, hidden=self.hidden, known=known, sampling=sampling, seed=self.seed)
            strips.append(Strip(heading=f"From {known} known", pictures=list(generated)))
        path.parent.mkdir(parents=True, exist_ok=True)
        title = f"{views.capture}: the same hidden views from more and more known ones"
        write_contact_sheet(path, strips, title=title, subtitle=f"model {model.model_hash[:8]}; all cameras are known")


def draw(report: Report, path: Path) -> None:
    """PSNR over the number of known views, with 95 % intervals."""
    from method_configs.benchmarks.figures import new_axes, save_figure

    figure, axes = new_axes("PSNR of the hidden views (dB)")
    known, heights, spread = ([row[name] for row in report.rows] for name in ("known", "psnr", "psnr_interval"))
    axes.errorbar(known, heights, spread, fmt="o-", capsize=3)
    axes.set_xscale("log", base=2)
    axes.set_xticks(known, [str(count) for count in known])
    axes.set_xlabel("known views")
    save_figure(figure, path, origin_of(report))
