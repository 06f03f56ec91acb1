"""``fillerbuster bench inference``: seconds of a whole sampling by views, size and steps, on the device at hand (paper,
table 3).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from fb_core.files.limits import MOST_SIDE, MOST_VIEWS, require_between, require_room
from fb_core.machine.devices import chosen_device
from method_configs.benchmarks.table_files import TableFiles, origin_of

if TYPE_CHECKING:
    import torch

    from fb_core.checkpoint import ModelConfig
    from fb_core.evaluation.results import Report
    from fb_core.inpainter import Fillerbuster

PAPER_SECONDS = {
    256: {4: 9, 8: 9, 16: 12, 32: 23},
    512: {4: 12, 8: 23, 16: 53, 32: 120},
}
"""Table 3 of the paper: an A100, 50 steps, with encoding and decoding; by side in pixels and number of views."""
_PAPER_STEPS = 50
CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}
_BYTES = 40  # of a pixel: colours, what is known, rays, in float32
_FEW, _FEWEST = (4, 12), (1, 2)  # steps that are measured where the rest is reckoned
_LONG, _TOO_LONG = 1e11, 2.5e12  # operations of a step beyond which fewest steps are measured, and none
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Inference(TableFiles):
    """Seconds of a whole sampling, encoding and decoding included, beside the paper's A100; long ones are reckoned from
    few steps, and longer ones from a smaller one by counted operations.
    """

    model: Path | None = None
    """Model folder; by default the bundled one."""
    released_architecture: bool = False
    """The released model's sizes with random weights instead of a model, as what a step costs does not depend on them
    (4 GB of memory)."""
    views: tuple[int, ...] = (4, 8, 16, 32)
    """Views of a sequence, half of them known."""
    sizes: tuple[int, ...] = (256, 512)
    """Sides in pixels, multiples of 16."""
    steps: tuple[int, ...] = (50, 24)
    """Denoising steps."""
    reckoned: bool | None = None
    """Measure 4 and 12 steps, or 1 and 2 long ones, and reckon the rest, as every step costs the same; where already
    one step would take minutes, reckon all by counted operations. By default on CPUs."""
    device: str | None = None
    """Where to compute, e.g. cpu or cuda:1; by default a GPU if there is one."""
    clock: Literal["wall", "processor"] = "wall"
    """What is counted: time that passes, or this process's seconds on processors, for a CPU that others use too (with
    OMP_NUM_THREADS=1 both agree on an idle machine)."""

    def run(self) -> None:
        """Measure what was not measured before, and report. Raises ValueError for options that no measurement has."""
        from rich.progress import track

        from fb_core.evaluation.results import Report
        from fb_core.inpainter import Fillerbuster

        if not self.views or not self.sizes or not self.steps or min(self.views) < 1 or min(self.steps) < 1:
            raise ValueError(
                f"inference: expected numbers of views, sizes and steps from 1, got {self.views}, {self.sizes}, "
                f"{self.steps}"
            )
        if any(size < 16 or size % 16 for size in self.sizes):
            raise ValueError(
                f"inference: expected sizes that are multiples of 16 pixels, got {' '.join(map(str, self.sizes))}"
            )
        require_between("views", max(self.views), 1, MOST_VIEWS)
        require_between("sizes", max(self.sizes), 16, MOST_SIDE)
        pixels = max(self.views) * max(self.sizes) ** 2
        require_room("inference", _BYTES * pixels, f"{max(self.views)} views of {max(self.sizes)} pixels")
        if self.released_architecture and self.model is not None:
            raise ValueError("inference: expected --model or --released-architecture, got both; leave one out")
        device = chosen_device(self.device)
        model = (
            untrained(None, self.seed, device)
            if self.released_architecture
            else Fillerbuster.from_pretrained(self.model, device=device)
        )
        if self.clock == "processor" and model.device.type != "cpu":
            raise ValueError(
                f"clock: a processor's seconds say nothing of the device {model.device}; leave --clock out, or add "
                "--device cpu"
            )
        reckoned = model.device.type == "cpu" if self.reckoned is None else self.reckoned
        cells = [Cell.of(model, size, views) for size in self.sizes for views in self.views]
        affordable = [cell for cell in cells if not reckoned or cell.step <= _TOO_LONG]
        affordable = affordable or [min(cells, key=lambda cell: cell.step)]
        measured = {
            cell: self._seconds(model, cell, reckoned)
            for cell in track(affordable, description="inference", transient=True)
        }
        report = Report(seed=self.seed)
        for cell in cells:
            report.rows.extend(self._rows(model, cell, measured, reckoned))
        self.publish(report, draw)

    def _seconds(self, model: Fillerbuster, cell: Cell, reckoned: bool) -> dict[int, float]:
        """What is measured of a cell: seconds of samplings by their number of steps."""
        from fb_core.evaluation.results import hardware

        few = _FEWEST if cell.step > _LONG else _FEW
        counts = few if reckoned else tuple(self.steps)
        asked = {
            "model": model.model_hash,
            "hardware": hardware(),
            "device": str(model.device),
            "counts": list(counts),
            "seed": self.seed,
            "clock": self.clock,
        }
        clock = CLOCKS[self.clock]

        def measure() -> dict[str, float]:
            first = (cell.views, cell.size) if cell.step <= _LONG else (1, 32)
            timed(model, *first, 1, self.seed, clock)  # what is set up at first use
            return {str(count): timed(model, cell.views, cell.size, count, self.seed, clock) for count in counts}

        seconds = self.kept(f"{_weights(model)}/{cell.size}-{cell.views}".replace(" ", "-"), asked, measure)
        return {int(count): value for count, value in seconds.items()}

    def _rows(
        self, model: Fillerbuster, cell: Cell, measured: dict[Cell, dict[int, float]], reckoned: bool
    ) -> list[dict[str, Any]]:
        like = cell if cell in measured else max(measured, key=lambda one: one.step)
        counts = " and ".join(map(str, sorted(measured[like])))
        how = f"reckoned from {counts} steps" if reckoned else "measured"
        if like is not cell:
            how = f"reckoned by operations from {like.views} views of {like.size} pixels, {counts} steps"
        rows = []
        for steps in self.steps:
            value = measured[like][steps] if not reckoned else cell.seconds(steps, like, measured[like])
            paper = PAPER_SECONDS.get(cell.size, {}).get(cell.views) if steps == _PAPER_STEPS else None
            preset = model.info.get("preset", "the model")
            rows.append(
                {
                    "part": f"inference with {preset} ({_weights(model)}), half of the views known",
                    "model": _weights(model),
                    "size": cell.size, "views": cell.views, "steps": steps, "seconds": value, "how": how,
                    "tera_operations": 1e-12 * (cell.once + steps * cell.step),
                    "clock": self.clock, "device": str(model.device),
                    "parameters": sum(weight.numel() for weight in model.dit.parameters()),
                    "paper_a100_seconds": paper,
                }
            )  # fmt: skip
        return rows


def _weights(model: Fillerbuster) -> str:
    return model.model_hash[:8] or "random weights"


def _known(views: int) -> int:
    return max(1, views // 2)


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A sampling of so many views of a side, and the floating-point operations of its products and convolutions."""

    size: int
    """Side in pixels."""
    views: int
    """Half of them known."""
    once: float
    """Operations of encoding, decoding and, where known tokens stand apart, of these."""
    step: float
    """Operations of a step, in all branches of guidance."""

    @staticmethod
    def of(model: Fillerbuster, size: int, views: int) -> Cell:
        """Counted for this model's networks and guidance."""
        from fb_core.completion.duration import coding_flops
        from method_configs.benchmarks.networks import WORDS, step_flops

        config, image, rays = model.config.transformer, model.config.image_vae, model.config.raymap_vae
        known, sampling = _known(views), model.recommended_sampling
        per_view = (size // (image.factor * config.patch)) ** 2
        apart = known * per_view if config.known_tokens == "apart" else 0
        step = step_flops(config, views * per_view, 1, WORDS, apart=apart)
        coded = views * (coding_flops(image, size)[0] + coding_flops(rays, size)[0])
        coded += (views - known) * coding_flops(image, size)[1]
        if not sampling.guidance_known == sampling.guidance_unknown == 1:  # a second branch, of which nothing is known
            step += step_flops(config, views * per_view, 1, WORDS)
            coded += coding_flops(rays, size)[0]  # all rays are unknown alike
        return Cell(size=size, views=views, once=coded + step_flops(config, apart, 1, WORDS), step=step)

    def seconds(self, steps: int, like: Cell, measured: dict[int, float]) -> float:
        """Of so many steps, along the line through what was measured of a cell ``like`` this one (or itself), its
        beginning and its steps each in proportion to their operations.
        """
        if like is self:
            return reckoned_seconds(measured, steps)
        begun, step = beginning_and_step(measured)
        return max(0.0, begun) * self.once / like.once + step * steps * self.step / like.step


def untrained(sizes: ModelConfig | None, seed: int, device: torch.device) -> Fillerbuster:
    """A model with random weights, by default of the released sizes; its empty prompt has as many words as CLIP's."""
    import dataclasses

    import torch

    from fb_core.checkpoint import ModelConfig
    from fb_core.inpainter import Fillerbuster
    from fb_core.networks.transformer.dit import DiTConfig
    from fb_core.networks.vae import IMAGE_VAE, RAYMAP_VAE
    from method_configs.benchmarks.networks import WORDS, random_model

    sizes = sizes or ModelConfig(transformer=DiTConfig(), image_vae=IMAGE_VAE, raymap_vae=RAYMAP_VAE)
    model = random_model(sizes, seed)
    for network in (model.dit, model.image_vae, model.raymap_vae):
        network.to(device)
    width = sizes.transformer.text_width
    prompt = torch.randn(WORDS, width, generator=torch.Generator().manual_seed(seed)).to(device) if width else None
    info = {"preset": "the released architecture"}
    return Fillerbuster(dataclasses.replace(model, info=info, empty_prompt=prompt))


def reckoned_seconds(seconds: dict[int, float], steps: int) -> float:
    """The line through the times of two numbers of steps; never less than the shorter one."""
    few, begun, step = min(seconds), *beginning_and_step(seconds)
    return begun + step * steps if steps >= few else seconds[few]


def beginning_and_step(seconds: dict[int, float]) -> tuple[float, float]:
    """The line through the times of two numbers of steps: its value at none, and its slope, which is never below 0."""
    (few, short), (more, long) = sorted(seconds.items())
    step = max(0.0, long - short) / (more - few)
    return short - step * few, step


def timed(
    model: Fillerbuster, views: int, size: int, steps: int, seed: int, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Seconds by a clock of one whole sampling: pictures in memory to pictures in memory."""
    import dataclasses

    import torch

    from fb_core.geometry.cameras import Pinholes
    from fb_core.views import Views

    draw = torch.Generator().manual_seed(seed)
    angles = torch.arange(views) * 2 * torch.pi / views
    centers = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0])
    cameras = Pinholes.looking_at(2 * centers, 0.1 * centers, up=up, fov_degrees=60.0, width=size, height=size)
    known = torch.zeros(views, 1, size, size)
    known[: _known(views)] = 1
    asked = dataclasses.replace(
        Views.known(torch.rand(views, 3, size, size, generator=draw), cameras), image_known=known
    )
    sampling = dataclasses.replace(model.recommended_sampling, steps=steps)
    began = clock()
    model.complete(asked, generator=torch.Generator().manual_seed(seed), sampling=sampling)
    if model.device.type == "cuda":
        torch.cuda.synchronize(model.device)
    return clock() - began


def draw(report: Report, path: Path) -> None:
    """Seconds over the number of views, a curve for each size and number of steps, and the paper's beside them."""
    from method_configs.benchmarks.figures import new_axes, save_figure

    processor = any(row["clock"] == "processor" for row in report.rows)
    figure, axes = new_axes("seconds on a processor" if processor else "seconds")
    for size, steps in dict.fromkeys((row["size"], row["steps"]) for row in report.rows):
        rows = [row for row in report.rows if (row["size"], row["steps"]) == (size, steps)]
        label = f"{size} pixels, {steps} steps"
        (line,) = axes.plot([row["views"] for row in rows], [row["seconds"] for row in rows], label=label)
        for row in rows:
            filled = line.get_color() if "operations from" not in row["how"] else "white"
            axes.plot(row["views"], row["seconds"], "o", color=line.get_color(), markerfacecolor=filled)
        paper = [(row["views"], row["paper_a100_seconds"]) for row in rows if row["paper_a100_seconds"] is not None]
        if paper:
            axes.plot(*zip(*paper, strict=True), "x--", label=f"paper: A100, {size} pixels, {steps} steps, its model")
    axes.set_yscale("log")
    axes.set_xlabel("views (hollow: reckoned by operations from fewer or smaller views)")
    figure.legend(loc="outside lower center", ncols=2, fontsize="small")
    save_figure(figure, path, origin_of(report))
