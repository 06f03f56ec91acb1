"""``fillerbuster eval masked`` and ``fillerbuster bench paper``: inpainted pictures against the final renders (paper,
table 1).
"""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from fb_core.files.limits import MOST_TRAINING_STEPS, require_between
from method_configs.benchmarks.table_files import TableFiles, origin_of
from method_configs.evaluations.consistency import scene_name

if TYPE_CHECKING:
    from fb_core.evaluation.results import Report

METRICS = ("psnr", "ssim", "lpips")
METHODS = ("fillerbuster-masked", "nerfiller-grid")
NORMALS = {True: "with", False: "without"}
PAPER = {
    ("nerfiller-grid", True): (25.57, 0.89, 0.182),
    ("nerfiller-grid", False): (25.94, 0.88, 0.194),
    ("fillerbuster-masked", True): (29.60, 0.92, 0.096),
    ("fillerbuster-masked", False): (30.65, 0.93, 0.069),
}
"""Table 1 of the paper, with and without normal regularisation: metrics in the order of `METRICS`."""
_PAPER_PART = "paper (another scale: NeRFiller's scenes, its own model and 2D inpainter)"
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Masked(TableFiles):
    """How far the final renders of runs of the masked protocol agree with their inpainted pictures: PSNR, SSIM,
    LPIPS.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs of fillerbuster-masked or nerfiller-grid, each with config.yml."""
    lpips: Path | None = None
    """torchvision's weights of SqueezeNet 1.1; without them LPIPS is left out."""

    def run(self) -> None:
        """Render and report. Raises ValueError for options that name nothing to judge."""
        if not self.runs:
            raise ValueError("masked: expected one or more folders of runs, got none; name a folder with config.yml")
        publish(self, [masked_row(run, self) for run in self.runs], self.seed)


@dataclass(frozen=True, kw_only=True)
class Paper(TableFiles):
    """Train and judge what a table of the paper needs, by one command; runs that are there already are not trained
    again.
    """

    table: Literal[1] = 1
    """Table of the paper. Tables 2 and 3 need no training: eval model, bench inference."""
    data: Path
    """Scene with masks: a capture with transforms.json."""
    output: Path = Path("outputs/paper-table-1")
    """Folder of the runs."""
    methods: tuple[str, ...] = METHODS
    """Methods of the masked protocol, each trained with and without normal regularisation."""
    iterations: int | None = None
    """Training steps instead of the methods' own."""
    normals_from: int | None = None
    """Step from which normals are regularised, instead of the methods' own."""
    scale: float = 1.0
    """Of the pictures that the runs are trained on (0.125 = an eighth of the photos' sides)."""
    model: Path | None = None
    """Model folder; by default the bundled one."""
    inpainter_weights: Path | None = None
    """diffusers folder of the 2D inpainter of nerfiller-grid; by default OpenCV's, without weights."""
    completion: dict[str, str] = dataclasses.field(default_factory=dict)
    """Further options of every method's completion, as names and values."""
    lpips: Path | None = None
    """torchvision's weights of SqueezeNet 1.1; without them LPIPS is left out."""

    def run(self) -> None:
        """Train what is missing, judge, report. Raises ValueError for options that name nothing to judge."""
        unknown = sorted(set(self.methods) - set(METHODS))
        if unknown or not self.methods:
            raise ValueError(f"methods: expected some of {', '.join(METHODS)}, got {', '.join(unknown) or 'none'}")
        self._check()
        runs = [self._trained(method, normals) for method in self.methods for normals in NORMALS]
        publish(self, [masked_row(run, self) for run in runs], self.seed)

    def _check(self) -> None:
        """Raises ValueError, before hours of training, for what would end them or what follows them."""
        from fb_core.checkpoint import read_config
        from fb_core.inpainter import BUNDLED_MODEL
        from method_configs.evaluations.ablations import _distance

        if not 0 < self.scale <= 1:
            raise ValueError(f"scale: expected a part of the photos' sides above 0 and up to 1, got {self.scale:g}")
        if self.iterations is not None:
            require_between("iterations", self.iterations, 1, MOST_TRAINING_STEPS)
        if self.normals_from is not None:
            require_between("normals-from", self.normals_from, 0, MOST_TRAINING_STEPS)
        if self.inpainter_weights is not None and not self.inpainter_weights.is_dir():
            raise ValueError(
                f"inpainter-weights: no folder {self.inpainter_weights}; give the diffusers folder of a 2D inpainter, "
                "or leave it out for OpenCV's"
            )
        _distance(self.lpips)
        read_config(self.model or BUNDLED_MODEL)
        require_masks(self.data)

    def arguments(self, method: str, normals: bool) -> list[str]:
        """What follows ``ns-train``; runs with and without normals differ in the two weights alone."""
        options: dict[str, Any] = {
            "data": self.data.absolute(), "output-dir": self.output.absolute(),
            "experiment-name": self._name(method, normals),
            "timestamp": "run", "vis": "tensorboard", "machine.seed": self.seed, "logging.local-writer.max-log-size": 0,
            "pipeline.datamanager.completion.seed": self.seed,
        }  # fmt: skip
        if self.iterations is not None:
            for name in ("max-num-iterations", "steps-per-save", "optimizers.means.scheduler.max-steps"):
                options[name] = self.iterations
        if self.normals_from is not None:
            options["pipeline.model.normal-loss-from"] = self.normals_from
        if self.scale != 1:
            options["pipeline.datamanager.camera-res-scale-factor"] = self.scale
        if self.model is not None:
            options["pipeline.datamanager.completion.model"] = self.model.absolute()
        if self.inpainter_weights is not None and method == "nerfiller-grid":
            options["pipeline.datamanager.completion.inpainter-weights"] = self.inpainter_weights.absolute()
        if not normals:
            options |= {"pipeline.model.normal-alignment-weight": 0.0, "pipeline.model.normal-tv-weight": 0.0}
        options |= {f"pipeline.datamanager.completion.{name}": value for name, value in self.completion.items()}
        return [method, *(text for name, value in options.items() for text in (f"--{name}", str(value)))]

    def _name(self, method: str, normals: bool) -> str:
        return f"{scene_name(self.data)}-{NORMALS[normals]}-normals"

    def _trained(self, method: str, normals: bool) -> Path:
        """The run's folder, trained to its end."""
        import time

        from rich.progress import Progress, TimeRemainingColumn

        from fb_core.machine.resources import usable_cores
        from fb_nerfstudio.runs.earlier_runs import clear_run
        from fb_nerfstudio.runs.training_process import TrainingProcess
        from method_configs import splats

        own: Any = getattr(splats, method.replace("-", "_")).config
        steps = self.iterations or own.max_num_iterations
        run = self.output / self._name(method, normals) / method / "run"
        if (run / "nerfstudio_models" / f"step-{steps - 1:09d}.ckpt").is_file():
            _logger.info("%s was trained before", run)
            return run
        clear_run(run, self.output)
        self.output.mkdir(parents=True, exist_ok=True)
        with Progress(*Progress.get_default_columns()[:3], TimeRemainingColumn(), transient=True) as bars:
            bar = bars.add_task(f"{method}, {NORMALS[normals]} normals", total=steps)
            process = TrainingProcess(
                self.arguments(method, normals),
                log=self.output / f"{method}-{self._name(method, normals)}.log",
                iterations=steps,
                rounds=1,
                threads=usable_cores(),
                report=lambda phase, done, total: bars.update(bar, completed=done) if phase == "train" else None,
            )
            try:
                while process.running:
                    time.sleep(0.2)
                process.finish()
            finally:
                process.stop()
        return run


def require_masks(data: Path) -> None:
    """Raises ValueError for a capture in which every pixel is known: table 1 is about what masks leave out."""
    from fb_core.data.capture.captures import read_capture

    if not any(bool((frame.load_mask() < 1).any()) for frame in read_capture(data).photos.frames):
        raise ValueError(
            f"data {data}: table 1 needs pictures with masks (black = to be inpainted) or with transparent parts, "
            "this capture has "
            "none; add a mask_path to its frames, or give a scene of NeRFiller's"
        )


def masked_row(run: Path, files: Masked | Paper) -> dict[str, Any]:
    """One run, as a row of table 1. Raises ValueError for a run whose method inpaints nothing."""
    from fb_nerfstudio.runs.finished_run import capture_of, identity_of, read_run

    config, state = read_run(run)
    step, model = state["step"], config.pipeline.model
    if config.pipeline.datamanager.completion.task != "inpaint":
        raise ValueError(
            f"run {run}: expected a run of {' or '.join(METHODS)}, got one of {config.method_name}, which inpaints no "
            "captured pictures; for films of it there is fillerbuster eval consistency"
        )
    normals = step > model.normal_loss_from and max(model.normal_alignment_weight, model.normal_tv_weight) > 0
    capture, asked = capture_of(config), identity_of(run, state) | {"lpips": str(files.lpips)}
    measured = files.kept(
        f"{config.method_name}-{scene_name(capture)}-{NORMALS[normals]}-normals",
        asked,
        lambda: _agreement(run, files.lpips),
    )
    row = {
        "part": "inpainted pictures against final renders",
        "method": config.method_name,
        "capture": scene_name(capture),
    }
    return row | {"normals": NORMALS[normals]} | measured


def _agreement(run: Path, lpips: Path | None) -> dict[str, Any]:
    from fb_nerfstudio.runs.finished_run import load_run, quiet

    with quiet():
        pipeline = load_run(run)
    bank = pipeline.datamanager.generated_views
    if bank is None or not len(bank):
        raise ValueError(
            f"run {run}: it has no inpainted pictures; give a run of {' or '.join(METHODS)} on a capture with masks"
        )
    return agreement(pipeline, bank, lpips) | {"pictures": len(bank), "model": bank.origins[0].model_hash[:8]}


def agreement(pipeline: Any, bank: Any, lpips: Path | None) -> dict[str, float]:
    """Means over a run's generated pictures of PSNR (dB), SSIM and, with weights, LPIPS against renders at the same
    cameras; intervals.
    """
    import torch

    from fb_core.evaluation.ablations import interval
    from fb_core.evaluation.metrics.image_metrics import psnr, ssim
    from fb_nerfstudio.bridge import to_nerfstudio
    from method_configs.evaluations.ablations import _distance

    distance, values = _distance(lpips), dict[str, list[float]]()
    with torch.no_grad():
        for number in range(len(bank)):
            camera = to_nerfstudio(bank.cameras[number], pipeline.device)
            render = pipeline.model.get_outputs_for_camera(camera)["rgb"].float().cpu().movedim(-1, 0).clamp(0, 1)[None]
            picture = bank.images[number].cpu().movedim(-1, 0).float()[None] / 255
            metrics = {"psnr": psnr, "ssim": ssim} | ({} if distance is None else {"lpips": distance})
            for name, metric in metrics.items():
                values.setdefault(name, []).append(float(metric(render, picture).mean()))
    row: dict[str, float] = {}
    for name, per_view in values.items():
        row[name], row[f"{name}_interval"] = interval(per_view)
    return row


def publish(files: TableFiles, rows: list[dict[str, Any]], seed: int) -> None:
    """The rows, what the paper has, and the figure."""
    from fb_core.evaluation.results import Report

    paper = [
        {"part": _PAPER_PART, "method": method, "normals": NORMALS[normals]} | dict(zip(METRICS, values, strict=True))
        for (method, normals), values in PAPER.items()
    ]
    files.publish(Report(seed=seed, rows=[*rows, *paper]), draw)


def draw(report: Report, path: Path) -> None:
    """PSNR of each run with its 95 % interval."""
    from method_configs.benchmarks.figures import new_axes, save_figure

    rows = [row for row in report.rows if row["part"] != _PAPER_PART]
    figure, axes = new_axes("PSNR of renders against inpainted pictures (dB)")
    labels = [f"{row['method']}\n{row['capture']}\n{row['normals']} normals" for row in rows]
    axes.bar(range(len(rows)), [row["psnr"] for row in rows], yerr=[row["psnr_interval"] for row in rows], capsize=4)
    axes.set_xticks(range(len(rows)), labels)
    save_figure(figure, path, origin_of(report))
