"""``fillerbuster eval model``: models completing sequences of captures or rooms, a quarter known, a quarter partly
(paper, table 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from fb_core.files.limits import MOST_SIDE, MOST_VIEWS, require_between
from fb_core.machine.devices import chosen_device
from method_configs.benchmarks.table_files import TableFiles, origin_of

if TYPE_CHECKING:
    from fb_core.evaluation.ablations import Asked
    from fb_core.evaluation.results import Report
    from fb_core.inpainter import Fillerbuster

METRICS = ("psnr", "ssim", "lpips", "val")
PAPER = {
    "paper, 100K steps": {
        8: (11.97, 0.435, 0.415, 0.2383),
        16: (15.81, 0.481, 0.329, 0.2407),
        32: (14.21, 0.486, 0.366, 0.2426),
    },
    "paper, 1M steps": {
        8: (12.77, 0.442, 0.381, 0.2365),
        16: (17.20, 0.485, 0.281, 0.2388),
        32: (14.13, 0.498, 0.352, 0.2396),
    },
}
"""Table 2 of the paper: metrics in the order of `METRICS` for each number of views."""
_PAPER_PART = "paper (another scale: its own model and autoencoders, 256 pixels, Nerfstudio dataset)"
_OTHER_MASKS = 1_000_003  # between the seeds of one number's masks, as in the comparison of designs


@dataclass(frozen=True, kw_only=True)
class ModelOnCaptures(TableFiles):
    """Complete sequences of N crops of captures, N/4 known and N/4 partly known: PSNR, SSIM, LPIPS and VAL, several
    models in one table.
    """

    data: Path | None = None
    """A capture with transforms.json, or a folder of captures at any depth; without it, procedural rooms."""
    models: tuple[Path, ...] = ()
    """Model folders; by default the bundled one."""
    lengths: tuple[int, ...] = (8, 16, 32)
    """Views of a sequence."""
    sequences: int = 50
    """Sequences of each length."""
    times: int = 20
    """Equally spaced times of the validation loss."""
    size: int | None = None
    """Side of the crops in pixels (paper: 256); by default the first model's."""
    steps: int | None = None
    """Denoising steps; by default each model's recommendation."""
    lpips: Path | None = None
    """torchvision's weights of SqueezeNet 1.1; without them LPIPS is left out."""
    device: str | None = None
    """Where to compute, e.g. cpu or cuda:1; by default a GPU if there is one."""
    family: Literal["narrow", "medium", "wide"] = "narrow"
    """Which rooms, where there is no data."""

    def run(self) -> None:
        """Complete what was not completed before, and report. Raises ValueError for lengths below 4, counts below 1,
        and folders of one name.
        """
        from rich.progress import track

        from fb_core.evaluation.results import Report
        from fb_core.inpainter import Fillerbuster
        from method_configs.evaluations.ablations import _distance

        if not self.lengths or min(self.lengths) < 4 or self.sequences < 1 or self.times < 1:
            raise ValueError(
                "model: expected lengths of 4 or more views, sequences and times, "
                f"got lengths {' '.join(map(str, self.lengths)) or 'none'}, sequences {self.sequences}, times "
                f"{self.times}"
            )
        require_between("lengths", max(self.lengths), 4, MOST_VIEWS)
        if self.size is not None:
            require_between("size", self.size, 16, MOST_SIDE)
        distance, models = _distance(self.lpips), {}
        for folder in self.models or (None,):
            model = Fillerbuster.from_pretrained(folder, device=chosen_device(self.device))
            models["bundled" if folder is None else folder.name] = model
        if len(models) < len(self.models):
            raise ValueError(
                "models: two folders have the same name; rename one, as the table tells models by their folders' names"
            )
        size = self.size or next(iter(models.values())).size
        question = self._questions(size)
        question(self.lengths[-1], 0)  # what is wrong with the data is said before anything is computed
        cells = [
            (name, length, number)
            for name in models
            for length in dict.fromkeys(self.lengths)  # one that is named twice is one
            for number in range(self.sequences)
        ]
        scores: dict[tuple[str, int], list[dict[str, float]]] = {}
        for name, length, number in track(cells, description="sequences", transient=True):
            row = self._scores(models[name], size, length, number, question, distance)
            scores.setdefault((name, length), []).append(row)
        report = Report(seed=self.seed, rows=[*self._rows(scores, models, size), *paper_rows(self.lengths)])
        self.publish(report, draw)

    def _questions(self, size: int) -> Any:
        """(views, number) -> the sequence that all models are asked."""
        import torch

        from fb_core.data.training.capture_sequences import CaptureConfig
        from fb_core.evaluation.ablations import Asked
        from fb_core.evaluation.capture_questions import (
            ScaledPictures,
            capture_folders,
            drawn_views,
            readable_captures,
        )
        from fb_core.evaluation.completion import unseen_room
        from fb_core.masks import training_mixture

        folders = None if self.data is None else capture_folders(self.data)
        captures = (
            {} if folders is None else {length: readable_captures(folders, views=length) for length in self.lengths}
        )

        config, pictures = CaptureConfig(image_size=size), ScaledPictures()

        @cache
        def question(length: int, number: int) -> Asked:
            draw = torch.Generator().manual_seed(self.seed * _OTHER_MASKS + number)
            if folders is None:
                room = unseen_room(family=self.family, seed=self.seed, number=number, views=length, size=size)
                known = training_mixture(length, size, size, generator=draw, in_order=True)
            else:
                room = drawn_views(captures[length], length, config, generator=draw, pictures=pictures)
                known = training_mixture(length, size, size, generator=draw, in_order=True) * room.truth
            return Asked(room, known, self.seed + number)

        return question

    def _scores(
        self, model: Fillerbuster, size: int, length: int, number: int, question: Any, distance: Any
    ) -> dict[str, float]:
        import dataclasses

        from fb_core.evaluation.ablations import sequence_scores

        sampling = model.recommended_sampling
        sampling = sampling if self.steps is None else dataclasses.replace(sampling, steps=self.steps)
        asked = {
            "data": None if self.data is None else str(self.data.absolute()),
            "family": self.family if self.data is None else None,
            "lengths": list(self.lengths), "seed": self.seed, "times": self.times, "size": size,
            "lpips": distance is not None,
            "sampling": repr(sampling), "model": model.model_hash,
        }  # fmt: skip
        return self.kept(
            f"{model.model_hash[:8]}/{length}-views-{number:03d}",
            asked,
            lambda: sequence_scores(model, question(length, number), sampling, self.times, distance),
        )

    def _rows(
        self, scores: dict[tuple[str, int], list[dict[str, float]]], models: dict[str, Fillerbuster], size: int
    ) -> list[dict[str, Any]]:
        from fb_core.evaluation.ablations import interval

        where = f"{self.family} rooms" if self.data is None else self.data.name
        rows = []
        for (name, length), per_sequence in scores.items():
            row: dict[str, Any] = {
                "part": f"{where}, {size} pixels, {self.sequences} sequences",
                "method": name,
                "views": length,
            }
            row["model"] = models[name].model_hash[:8]
            for metric in METRICS:
                if metric in per_sequence[0]:
                    row[metric], row[f"{metric}_interval"] = interval([one[metric] for one in per_sequence])
            rows.append(row)
        return rows


def paper_rows(lengths: tuple[int, ...]) -> list[dict[str, Any]]:
    """What the paper reports for these numbers of views."""
    return [
        {"part": _PAPER_PART, "method": name, "views": views} | dict(zip(METRICS, values, strict=True))
        for name, cells in PAPER.items()
        for views, values in cells.items()
        if views in lengths
    ]


def draw(report: Report, path: Path) -> None:
    """PSNR and VAL over the number of views, one curve with 95 % intervals for each model."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    from method_configs.benchmarks.figures import save_figure

    rows = [row for row in report.rows if row["part"] != _PAPER_PART]
    figure, panels = pyplot.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for axes, metric, label in zip(panels, ("psnr", "val"), ("PSNR (dB)", "validation loss"), strict=True):
        for method in dict.fromkeys(row["method"] for row in rows):
            mine = [row for row in rows if row["method"] == method]
            axes.errorbar(
                [row["views"] for row in mine], [row[metric] for row in mine],
                [row[f"{metric}_interval"] for row in mine],
                fmt="o-", capsize=3, label=method,
            )  # fmt: skip
        axes.set_xlabel("views of a sequence")
        axes.set_ylabel(label)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].legend()
    save_figure(figure, path, origin_of(report))
