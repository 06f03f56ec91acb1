"""``fillerbuster bench methods``: every method on room captures with ground truth, one ``ns-train`` after the other.

Two parts. *new views*: a casual capture, judged on held-out views that it covers and that it does not. *masked*: the
same capture with a block cut out of every captured picture (the masked protocol), where also inpainted pictures are
compared with the final renders from the same viewpoints (paper, table 1) and the renders' blocks with what was cut out.
Heavy imports wait until it runs.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from fb_core.files.ownership import Target
from fb_core.files.whole import whole_file, whole_folder
from fb_core.machine.resources import usable_cores
from fb_nerfstudio.runs.earlier_runs import clear_run
from fb_nerfstudio.runs.training_process import TrainingProcess
from method_configs.room_runs import run_folder, training_arguments

if TYPE_CHECKING:
    from torch import Tensor

    from fb_core.data.capture.frames import Capture
    from fb_core.evaluation.results import Bar, Report
    from fb_core.geometry.cameras import Pinholes

NEW_VIEWS = ("fillerbuster-none", "fillerbuster", "fillerbuster-paper", "fillerbuster-cat3d-size")
MASKED = ("fillerbuster-none", "fillerbuster-masked", "nerfiller-grid")
_ROW = "bench_row.json"  # in a run's folder: what was measured, so that an interrupted benchmark goes on
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Methods:
    """All methods on rooms with ground truth: holes, PSNR, SSIM, seconds, memory; and the masked protocol (minutes per
    run).
    """

    rooms: tuple[int, ...] = (0, 1, 2)
    """Seeds of the rooms."""
    new_views: tuple[str, ...] = NEW_VIEWS
    """Methods on the plain capture."""
    masked: tuple[str, ...] = MASKED
    """Methods on the capture with a block cut out of every picture."""
    iterations: int = 1500
    """Training steps of each run."""
    views: int = 24
    """Captured pictures."""
    size: int = 128
    """Their side in pixels."""
    held_out: int = 16
    """Held-out pictures, half of them covered by the capture."""
    family: Literal["narrow", "medium", "wide"] = "narrow"
    """How varied the rooms are; the bundled model knows narrow ones."""
    block: float = 0.35
    """Side of the block that is cut out, as a part of the picture's."""
    block_in: Literal["picture", "world"] = "picture"
    """Cut the middle out of every picture, or, as people's masks do, one cube of the room out of the pictures that show
    it.
    """
    model: Path | None = None
    """Model folder; by default the bundled one."""
    completion: dict[str, str] = field(default_factory=dict)
    """Further options of every method's completion, as names and values (start render strength 0.7)."""
    output: Path = Path("outputs/methods")
    """Folder for captures and runs. Runs that are there already are not trained again."""
    json: Path | None = None
    """Write all measurements to this file."""
    quick: bool = False
    """A miniature that shows that everything runs; its figures mean nothing."""

    def run(self) -> None:
        """Measure and report."""
        from method_configs.benchmarks.command import show

        show(run_methods(self.miniature() if self.quick else self), self.json, [])

    def miniature(self) -> Methods:
        """One room, a few steps."""
        return dataclasses.replace(self, rooms=self.rooms[:1], iterations=4, views=4, size=32, held_out=2)


def run_methods(config: Methods) -> Report:
    """Train and measure every method on every room. Raises ValueError when a training fails, with its last line."""
    from fb_core.evaluation.results import Report

    if not 0 < config.block < 1:
        raise ValueError(f"block: expected a part of the picture's side between 0 and 1, got {config.block}")
    rows: list[dict[str, Any]] = []
    for room in config.rooms:
        masked = "masked" if config.block_in == "picture" else "masked-in-world"
        name = f"room-{room}" if config.family == "narrow" else f"{config.family}-room-{room}"
        plain, cut = config.output / name, config.output / f"{name}-{masked}"
        make_captures(plain / "capture", cut / "capture", room, config)
        rows += [_measured("new views", method, room, plain, config) for method in config.new_views]
        rows += [_measured("masked", method, room, cut, config) for method in config.masked]
    return Report(seed=min(config.rooms), rows=[*rows, *means_of(rows)], bars=bars_of(rows))


def make_captures(plain: Path, cut: Path, room: int, config: Methods) -> None:
    """The room's capture, and the same with a block cut out of every captured picture; what is there already stays."""
    from fb_core.data.rooms.room_captures import rooms

    if not plain.exists():
        rooms(room, plain, family=config.family, views=config.views, size=config.size, held_out=config.held_out)
    if not cut.exists():
        cut_blocks(plain, cut, share=config.block, block_in=config.block_in)


def cut_blocks(plain: Path, cut: Path, *, share: float, block_in: Literal["picture", "world"] = "picture") -> None:
    """Copy a capture; captured pictures lose a block (black in picture and mask), held-out ones keep all.

    Args:
        plain: the capture, with ``train_filenames`` and points.
        cut: the new folder.
        share: the block's side as a part of the picture's.
        block_in: a centred square in every picture, or a cube in the world that is about as large in the pictures that
            show it.
    """
    import torch

    from fb_core.data import media
    from fb_core.data.capture.captures import read_capture

    capture = read_capture(plain)
    cameras = [frame.camera for frame in capture.frames]
    with whole_folder(Target(folder=cut, kind="capture", inputs=(plain,))) as unfinished:
        shutil.copytree(plain, unfinished, dirs_exist_ok=True)
        content = json.loads((unfinished / "transforms.json").read_text(encoding="utf-8"))
        captured = [name in content["train_filenames"] for name in (frame["file_path"] for frame in content["frames"])]
        theirs = [camera for camera, one in zip(cameras, captured, strict=True) if one]
        cube = _cube(capture, theirs, share) if block_in == "world" else None
        (unfinished / "masks").mkdir(exist_ok=True)
        for frame, camera, one in zip(content["frames"], cameras, captured, strict=True):
            image = media.read_image(unfinished / frame["file_path"])
            known = torch.ones_like(image[:1])
            if one:
                if cube is None:
                    rows, columns = (_middle(side, share) for side in image.shape[1:])
                    known[:, rows, columns] = 0
                else:
                    known[:, shows_cube(camera, *cube)] = 0
                media.write_image(unfinished / frame["file_path"], image * known)
            frame["mask_path"] = f"masks/{Path(frame['file_path']).stem}.png"
            media.write_image(unfinished / frame["mask_path"], known)
        (unfinished / "transforms.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def shows_cube(camera: Pinholes, center: Tensor, side: float) -> Tensor:
    """Which pixels [h, w] of one camera look at an axis-aligned cube, by its three pairs of planes (Kay and Kajiya
    1986).
    """
    directions, start = camera.directions()[0], center.to(camera.centers) - camera.centers[0]
    near, far = ((start + sign * side / 2) / directions for sign in (-1, 1))
    enters, leaves = near.minimum(far).amax(dim=-1), near.maximum(far).amin(dim=-1)
    return (leaves > enters) & (leaves > 0)


def _cube(capture: Capture, cameras: Sequence[Pinholes], share: float) -> tuple[Tensor, float]:
    """Centre and side of a cube around the surface point that most captured pictures show."""
    import torch

    from fb_core.data.capture.points import read_points

    assert capture.points_path is not None  # rooms have points
    points = read_points(capture.points_path).positions
    shown = torch.zeros(len(points))
    for camera in cameras:
        pixels, depth = camera.project(points.to(camera.centers))
        inside = (pixels[0] > 0) & (pixels[0] < pixels.new_tensor([camera.width, camera.height]))
        shown += inside.all(dim=-1) & (depth[0] > 0)
    center = points[int(shown.argmax())]
    distances = torch.stack([(center.to(camera.centers) - camera.centers[0]).norm() for camera in cameras])
    width = torch.stack([camera.width / camera.focal[0, 0] for camera in cameras])
    return center, share * float((distances * width).median())


def arguments_of(method: str, folder: Path, room: int, config: Methods) -> list[str]:
    """What follows ``ns-train``: the demo's options, the same for all methods, and those of the method's completion."""
    from method_configs import splats

    own = getattr(splats, method.replace("-", "_")).config.pipeline.datamanager.completion
    completion: dict[str, Any] = {"seed": room}
    if own.at_step > 0:
        completion["at-step"] = min(own.at_step, config.iterations // 3)
    if config.model is not None:
        completion["model"] = config.model.absolute()
    if config.quick:
        completion |= {"steps": 2, "anchor-views": min(own.most_anchors, 2), "densify-rounds": 1, "densify-views": 2}
    completion |= config.completion
    shared = training_arguments(
        folder.absolute(), "fillerbuster-none", seed=room, iterations=config.iterations, model=None
    )
    extra = (
        text for name, value in completion.items() for text in (f"--pipeline.datamanager.completion.{name}", str(value))
    )
    return [method, *shared[1:], *extra]


def _measured(part: str, method: str, room: int, folder: Path, config: Methods) -> dict[str, Any]:
    """One run, trained unless it is there, and what came of it."""
    run = run_folder(folder, method)
    if (run / _ROW).exists():
        return json.loads((run / _ROW).read_text(encoding="utf-8"))
    _logger.info("room %d, %s: %s", room, part, method)
    clear_run(run, folder)
    row: dict[str, Any] = {"part": part, "method": method, "room": room} | trained(method, folder, room, config)
    row |= quality_of(run, folder / "capture")
    if part == "masked":
        row |= consistency_of(run, folder.with_name(f"room-{room}") / "capture")
    with whole_file(run / _ROW) as unfinished:
        unfinished.write_text(json.dumps(row, indent=1, allow_nan=False), encoding="utf-8")
    return row


def trained(method: str, folder: Path, room: int, config: Methods) -> dict[str, float]:
    """Run ``ns-train``; ``seconds`` in all and of the generation, and ``peak_gib``, the largest resident memory that
    was seen.
    """
    import psutil

    (folder / "runs").mkdir(exist_ok=True)
    threads = usable_cores()
    process = TrainingProcess(
        arguments_of(method, folder, room, config),
        log=folder / "runs" / f"{method}.log",
        iterations=config.iterations,
        rounds=1,
        threads=threads,
        report=lambda phase, done, total: None,
    )
    peak = 0
    try:
        while process.running:
            try:
                peak = max(peak, psutil.Process(process.pid).memory_info().rss)
            except psutil.NoSuchProcess:
                break
            time.sleep(0.2)
        process.finish()
    finally:
        process.stop()
    return {
        "seconds": round(process.seconds["all"], 1),
        "generate_seconds": round(process.seconds["generate"], 1),
        "peak_gib": round(peak / 2**30, 3),
    }


def quality_of(run: Path, capture: Path) -> dict[str, float]:
    """PSNR, SSIM and holes on held-out views, covered and uncovered, how many views were generated; LPIPS where its
    weights are.
    """
    from fb_core.evaluation.metrics.lazy_lpips import LazyLpips
    from fb_nerfstudio.runs.held_out_views import render_held_out

    views, lpips = render_held_out(run, capture), LazyLpips()
    row: dict[str, float] = {"generated": len(views.generated)}
    for kind, values in views.quality().items():
        row |= {f"{kind}_{name}": round(value, 4) for name, value in values.items()}
        chosen = views.covered if kind == "covered" else ~views.covered
        pairs = zip(views.renders[chosen].movedim(1, -1), views.truth[chosen].movedim(1, -1), strict=True)
        distances = [distance for pair in pairs if (distance := lpips(*pair)) is not None]
        if distances:
            row[f"{kind}_lpips"] = round(sum(distances) / len(distances), 4)
    return row


def consistency_of(run: Path, plain: Path) -> dict[str, float | None]:
    """How far the final renders agree with the inpainted pictures, and inside the block with what was cut out.

    ``consistency_psnr`` and ``consistency_ssim`` are the paper's table 1: inpainted pictures against renders from the
    same viewpoints; None without inpainted pictures. ``block_psnr`` compares the renders' blocks in all captured views
    with the ground truth.
    """
    import torch

    from fb_core.data.capture.captures import read_capture
    from fb_core.evaluation.metrics.image_metrics import psnr, ssim
    from fb_nerfstudio.bridge import to_nerfstudio
    from fb_nerfstudio.runs.finished_run import load_run

    pipeline = load_run(run)
    manager: Any = pipeline.datamanager

    def render(camera: Any) -> torch.Tensor:
        return pipeline.model.get_outputs_for_camera(camera.to(pipeline.device))["rgb"].cpu().movedim(-1, 0).clamp(0, 1)

    bank, row = manager.generated_views, dict[str, float | None](consistency_psnr=None, consistency_ssim=None)
    with torch.no_grad():
        if bank is not None:
            renders = torch.stack([render(to_nerfstudio(bank.cameras[index])) for index in range(len(bank))])
            pictures = bank.images.permute(0, 3, 1, 2).float() / 255
            row["consistency_psnr"] = round(float(psnr(renders, pictures).mean()), 3)
            row["consistency_ssim"] = round(float(ssim(renders, pictures).mean()), 4)
        truth = {frame.image_path.name: frame.load_image() for frame in read_capture(plain).frames}
        blocks = []
        for index, name in enumerate(manager.train_dataset.image_filenames):
            block = ~manager.cached_train[index]["mask"][..., 0].cpu()
            if bool(block.any()):
                rendered = render(manager.train_dataset.cameras[index : index + 1])
                blocks.append(psnr(rendered[None, :, block, None], truth[Path(name).name][None, :, block, None]))
        row["block_psnr"] = round(float(torch.cat(blocks).mean()), 3)
    return row


def means_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The mean over rooms of each method in each part, as rows of their own; None where a room has none."""
    means = []
    for part, method in dict.fromkeys((row["part"], row["method"]) for row in rows):
        same = [row for row in rows if (row["part"], row["method"]) == (part, method)]
        mean: dict[str, Any] = {"part": f"{part}, mean of {len(same)} rooms", "method": method, "room": "all"}
        for name in same[0]:
            if name not in mean:
                values = [row.get(name) for row in same]
                mean[name] = None if None in values else round(sum(values) / len(values), 4)  # type: ignore[arg-type]
        means.append(mean)
    return means


def bars_of(rows: Sequence[dict[str, Any]]) -> list[Bar]:
    """What completion must be worth: fewer holes and better uncovered views than plain splats; more consistent than the
    2D baseline.
    """
    from fb_core.evaluation.results import Bar

    means = {(row["part"].split(",")[0], row["method"]): row for row in means_of(rows)}
    bars = []
    plain, ours = means.get(("new views", "fillerbuster-none")), means.get(("new views", "fillerbuster"))
    if plain is not None and ours is not None:
        gain = ours["uncovered_psnr"] - plain["uncovered_psnr"]
        bars.append(Bar(name="PSNR gained on uncovered views (dB)", value=gain, limit=1.0, sense=">="))
        limit = plain["uncovered_hole_share"] / 3
        bars.append(
            Bar(name="hole share on uncovered views", value=ours["uncovered_hole_share"], limit=limit, sense="<=")
        )
    masked, grid = means.get(("masked", "fillerbuster-masked")), means.get(("masked", "nerfiller-grid"))
    if (
        masked is not None
        and grid is not None
        and masked["consistency_psnr"] is not None
        and grid["consistency_psnr"] is not None
    ):
        name = "inpainted views against renders, PSNR (dB), against the grid's"
        bars.append(Bar(name=name, value=masked["consistency_psnr"], limit=grid["consistency_psnr"], sense=">="))
    return bars


def _middle(side: int, share: float) -> slice:
    length = max(1, round(side * share))
    return slice((side - length) // 2, (side - length) // 2 + length)
