"""``fillerbuster eval designs``: what a training can do differently, each change alone, on the same batches."""

from __future__ import annotations

import dataclasses
import json as json_format
import logging
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from fb_core.files.whole import whole_file

if TYPE_CHECKING:
    from fb_core.inpainter import Fillerbuster
    from fb_core.networks.transformer.dit import DiT
    from fb_core.training.kept_batches import KeptBatches
    from fb_core.training.recipe import Recipe
    from fb_core.training.run.loop import Run
    from fb_core.training.run.stage import Stage
    from method_configs.evaluations.designs.stages import KeptStage
    from method_configs.evaluations.designs.task import AskedRooms, DesignTask

_logger = logging.getLogger(__name__)
_METRICS = ("psnr_sample", "psnr_one_step", "edges_sample", "edges_one_step", "val", "cpu_seconds_per_step")
_WINDOWS = 10  # of a training's steps, over which its losses are told


class Design(NamedTuple):
    """One change."""

    recipe: Recipe
    """What is trained."""
    predicts_data: bool = False
    """Whether the last layer says the data instead of the velocity."""
    depth: bool = False
    """Whether a head that is dropped afterwards learns the rooms' distances."""
    told_guess: bool = False
    """Whether unseen rooms come with a guess."""


def base_recipe() -> Recipe:
    """The small training that all designs are one change away from: the paper's design on rooms of 64 pixels."""
    from fb_core.data.training.task import TaskConfig
    from fb_core.networks.transformer.dit import DiTConfig
    from fb_core.training.run.options import EngineConfig
    from fb_core.training.stages.dit_stage import DiTLossConfig
    from method_configs.presets import ROOMS_ABLATION

    return dataclasses.replace(
        ROOMS_ABLATION,
        name="base",
        dit=DiTConfig(heads=2, head_dim=64, depth=4, text_width=0),
        dit_loop=dataclasses.replace(ROOMS_ABLATION.dit_loop, steps=600),
        dit_loss=DiTLossConfig(
            batch=4, ray_weight=0.3, task=TaskConfig(views=8, ray_task=0.15, random_heading=False, random_fill=False)
        ),
        engine=EngineConfig(precision="auto"),
    )


def designs_of(base: Recipe) -> dict[str, Design]:
    """The base and all that is one change away from it, by name."""

    def changed(
        name: str, *, dit: Mapping = {}, loss: Mapping = {}, task: Mapping = {}, engine: Mapping = {}
    ) -> Recipe:
        return dataclasses.replace(
            base,
            name=name,
            dit=dataclasses.replace(base.dit, **dit),
            dit_loss=dataclasses.replace(base.dit_loss, task=dataclasses.replace(base.dit_loss.task, **task), **loss),
            engine=dataclasses.replace(base.engine, **engine),
        )

    plain = {
        "base": changed("base"),
        "ray-frames": changed("ray-frames", dit={"ray_frames": True}),
        "apart": changed("apart", dit={"known_tokens": "apart"}),
        "apart-4-draws": changed("apart-4-draws", dit={"known_tokens": "apart"}, loss={"draws": 4}),
        "guesses": changed("guesses", task={"guess": 0.7}),
        "predicts-data": changed("predicts-data"),
        "depth-head": changed("depth-head"),
        "pure-noise": changed("pure-noise", loss={"pure_noise": 0.1}),
        "wider": changed("wider", dit={"heads": base.dit.heads * 3 // 2}),
        "deeper": changed("deeper", dit={"depth": base.dit.depth * 3 // 2}),
        "smaller-patch": changed("smaller-patch", dit={"patch": 1}),
        "larger-patch": changed("larger-patch", dit={"patch": 2 * base.dit.patch}),
        "more-views": changed("more-views", task={"views": base.dit_loss.task.views * 3 // 2}),
        "larger-batch": changed("larger-batch", loss={"batch": 2 * base.dit_loss.batch}),
        "float32": changed("float32", engine={"precision": "float32"}),
        "bfloat16": changed("bfloat16", engine={"precision": "bfloat16"}),
    }
    designs = {name: Design(recipe) for name, recipe in plain.items()}
    designs["predicts-data"] = Design(plain["predicts-data"], predicts_data=True)
    designs["depth-head"] = Design(plain["depth-head"], depth=True)
    designs["guesses"] = Design(plain["guesses"], told_guess=True)
    return designs


ALL = (
    *("base", "ray-frames", "apart", "apart-4-draws", "guesses", "predicts-data", "depth-head", "pure-noise"),
    *("wider", "deeper", "smaller-patch", "more-views", "larger-batch"),
)
"""What is compared unless asked otherwise."""


@dataclass(frozen=True, kw_only=True)
class Designs:
    """Designs of a training, each one change away from a small base, on the same batches; completing the same unseen
    rooms.
    """

    output: Path = Path("outputs/designs")
    """Folder of the trainings and their batches; what is there already is neither made again nor measured again."""
    designs: tuple[str, ...] = ALL
    """What to compare with the base; float32 and bfloat16 are there, too."""
    seeds: tuple[int, ...] = (0, 1)
    """Trainings of each design; a seed decides weights, rooms, views, masks and noise."""
    steps: int = 600
    """Training steps."""
    batches: int = 600
    """Batches that differ; they are gone through again where there are more steps, with other noise."""
    rooms: int = 30
    """Unseen rooms that every design completes."""
    model: Path | None = None
    """Model folder whose autoencoders all designs share; by default the bundled one."""
    json: Path | None = None
    """Write all measurements to this file."""

    def run(self) -> None:
        """Train what is missing, measure what is missing, report. Raises ValueError for unknown designs, and for no
        seeds or batches.
        """
        from fb_core.evaluation.results import Report
        from fb_core.inpainter import Fillerbuster
        from method_configs.benchmarks.command import show
        from method_configs.evaluations.designs.task import DesignTask

        base = base_recipe()
        base = dataclasses.replace(base, dit_loop=dataclasses.replace(base.dit_loop, steps=self.steps))
        known = designs_of(base)
        if unknown := sorted({*self.designs} - {*known}):
            raise ValueError(f"designs: expected some of {', '.join(known)}, got {', '.join(unknown)}")
        if not self.seeds or min(self.seeds) < 0 or self.batches < 1:
            raise ValueError(
                f"designs: expected at least one seed from 0 on and at least one batch, got {self.seeds} and "
                f"{self.batches}"
            )
        names = ["base", *(name for name in self.designs if name != "base")]
        work = DesignTrainings(
            self.output, self.batches, Fillerbuster.from_pretrained(self.model), DesignTask(rooms=self.rooms)
        )
        results: dict[tuple[str, int], dict[str, Any]] = {}
        for seed in self.seeds:
            for name in names:
                recipe = dataclasses.replace(known[name].recipe, seed=seed)
                results[name, seed] = work.measured(known[name]._replace(recipe=recipe))
        report = Report(seed=self.seeds[0])
        report.rows.extend(table(results, names, self.seeds))
        report.rows.extend(curves(results, names, self.seeds))
        show(report, self.json, [])


class DesignTrainings:
    """Trainings and measurements, kept in a folder."""

    def __init__(self, output: Path, batches: int, autoencoders: Fillerbuster, task: DesignTask):
        from method_configs.evaluations.ablations import content_of

        self._output, self._batches, self._task = output, batches, task
        self._vaes = {"image_vae": autoencoders.image_vae, "raymap_vae": autoencoders.raymap_vae}
        self._content = content_of(autoencoders)
        self._kept = cache(self._keep)
        self._asked: dict[int, AskedRooms] = {}

    def measured(self, design: Design) -> dict[str, Any]:
        """What a design's training came to; from its folder if it is there."""
        recipe = design.recipe
        folder = self._output / f"{recipe.name}-{recipe.dit_loop.steps}-{recipe.seed}"
        asked = dataclasses.asdict(self._task) | {
            "autoencoders": self._content,
            "batches": self._batches,
            "recipe": str(recipe),
        }
        path = folder / "measured.json"
        if path.exists() and (stored := json_format.loads(path.read_text()))["asked"] == asked:
            return stored["found"]
        self._claim(folder, {name: asked[name] for name in ("recipe", "batches", "autoencoders")})
        network, result = self._trained(design, folder)
        result |= self._scores(network, design, guess=design.told_guess)
        if design.told_guess:
            result["without"] = self._scores(network, design, guess=False)
        with whole_file(path) as unfinished:
            unfinished.write_text(json_format.dumps({"asked": asked, "found": result}, indent=1) + "\n")
        _logger.info("%s: %s", folder.name, ", ".join(f"{name} {result[name]:.3f}" for name in _METRICS))
        return result

    def _claim(self, folder: Path, settings: dict[str, Any]) -> None:
        """A training is gone on with only if all that decides it is as before."""
        note = folder / "settings.json"
        before = json_format.loads(note.read_text()) if note.exists() else None
        if before != settings and (folder / "checkpoint.pt").exists():
            names = ", ".join(name for name in settings if before is None or before.get(name) != settings[name])
            raise ValueError(
                f"{folder} holds a training with another {names}; choose another output folder, or remove this one"
            )
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(note) as unfinished:
            unfinished.write_text(json_format.dumps(settings, indent=1) + "\n")

    def _scores(self, network: DiT, design: Design, *, guess: bool) -> dict[str, float]:
        from method_configs.evaluations.designs.task import asked_rooms, evaluate

        patch = design.recipe.dit.patch
        if patch not in self._asked:
            self._asked[patch] = asked_rooms(self._task, **self._vaes, size=design.recipe.pool.image_size, patch=patch)
        return evaluate(network, self._asked[patch], self._task, image_vae=self._vaes["image_vae"], told_guess=guess)

    def _trained(self, design: Design, folder: Path) -> tuple[DiT, dict[str, Any]]:
        """The averaged network, and CPU seconds per step (of the steps that are done now; nan for none) with the losses
        on the way.
        """
        from fb_core.networks.transformer.dit import DiT
        from fb_core.training.run.loop import Run

        recipe = design.recipe
        batches = self.batches_of(recipe)
        batches.make(recipe.dit_loop.steps)
        run = Run(self.stage_of(design, batches), recipe.dit_loop, folder, preset=recipe.name, engine=recipe.engine)
        seconds = _timed(run, recipe.seed)
        if run.signal:
            raise SystemExit(128 + run.signal)
        assert isinstance(run.stage.network, DiT)
        network = type(run.stage.network)(recipe.dit)
        network.load_state_dict(run.averaged_state())
        result = {
            "parameters": sum(parameter.numel() for parameter in network.parameters()),
            "cpu_seconds_per_step": statistics.median(seconds) if seconds else math.nan,
            "losses": windows([json_format.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]),
        }
        return network, result

    def stage_of(self, design: Design, batches: KeptBatches) -> Stage:
        """What a design minimises, with fresh weights."""
        import torch

        from fb_core.networks.transformer.dit import DiT
        from method_configs.evaluations.designs.stages import (
            DepthTaughtStage,
            KeptStage,
            PredictsData,
            PredictsDataStage,
        )

        recipe = design.recipe
        kinds: tuple[type[DiT], type[KeptStage]] = (
            (PredictsData, PredictsDataStage) if design.predicts_data else (DiT, KeptStage)
        )
        network = kinds[0](recipe.dit)
        network.initialize(torch.Generator().manual_seed(recipe.seed))
        stage = kinds[1](
            network, batches, **self._vaes, pool=batches.stage.pool, config=recipe.dit_loss, seed=recipe.seed
        )
        return DepthTaughtStage(stage) if design.depth else stage

    def batches_of(self, recipe: Recipe) -> KeptBatches:
        """The batches of its seed, task and batch size; what else there is in a recipe is left behind, so that designs
        share them.
        """
        loss = dataclasses.replace(recipe.dit_loss, draws=1, pure_noise=0.0)
        # Frames of tokens that no compared network attends in need not be kept for each size of patch.
        return self._kept(dataclasses.replace(base_recipe(), dit_loss=loss, seed=recipe.seed))

    def _keep(self, recipe: Recipe) -> KeptBatches:
        from fb_core.training.kept_batches import KeptBatches
        from fb_core.training.recipe import dit_stage

        framed = dataclasses.replace(recipe, dit=dataclasses.replace(recipe.dit, ray_frames=True))
        stage = dit_stage(framed, self._vaes["image_vae"], self._vaes["raymap_vae"])
        data = f"{recipe.data} {recipe.pool} {self._content}"
        return KeptBatches(stage, self._output / "batches", count=self._batches, data=data)


def _timed(run: Run, seed: int) -> list[float]:
    """Train to the end; CPU seconds of every step."""
    seconds: list[float] = []
    began = time.process_time()

    def on_progress(step: int, steps: int, losses: dict[str, float]) -> None:
        nonlocal began
        now = time.process_time()
        seconds.append(now - began)
        began = now
        if step % 100 == 0:
            _logger.info("%s, seed %d: step %d of %d", run.preset, seed, step, steps)

    run.train(on_progress=on_progress)
    return seconds


def windows(log: Sequence[dict[str, float]]) -> list[dict[str, float]]:
    """Means of a training's losses over tenths of its steps, with the last step of each."""
    size = max(1, len(log) // _WINDOWS)
    parts = [log[first : first + size] for first in range(0, len(log), size)]
    names = [name for name in ("loss", "image", "rays", "depth") if name in log[0]]
    return [
        {"step": part[-1]["step"]} | {name: statistics.fmean(line[name] for line in part) for name in names}
        for part in parts
    ]


def table(
    found: Mapping[tuple[str, int], dict[str, Any]], names: Sequence[str], seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Means over each design's trainings; and how far they are from the base's, training by training, with the spread
    (`beside`).
    """
    trainings = {name: [found[name, seed] for seed in seeds] for name in names}
    for name in names:
        if "without" in trainings[name][0]:
            trainings[f"{name}, none told"] = [one | one["without"] for one in trainings[name]]
    means, differences = [], []
    for name, mine in trainings.items():
        values = {metric: [one[metric] for one in mine] for metric in _METRICS}
        row = {"part": "designs", "design": name, "parameters": mine[0]["parameters"]}
        means.append(row | {metric: statistics.fmean(values[metric]) for metric in _METRICS})
        if name != "base":
            differences.append(_beside_base(name, values, trainings["base"]))
    return means + differences


def _beside_base(name: str, values: Mapping[str, list[float]], base: list[dict[str, Any]]) -> dict[str, Any]:
    from method_configs.evaluations.designs.task import beside

    row: dict[str, Any] = {"part": "beside the base", "design": name}
    for metric in _METRICS[:-1]:
        row[f"{metric}_gain"], row[f"{metric}_spread"] = beside(values[metric], [one[metric] for one in base])
    seconds = _METRICS[-1]
    return row | {
        f"{seconds}_ratio": statistics.fmean(values[seconds]) / statistics.fmean(one[seconds] for one in base)
    }


def curves(
    found: Mapping[tuple[str, int], dict[str, Any]], names: Sequence[str], seeds: Sequence[int]
) -> list[dict[str, Any]]:
    """Losses on the way, a row for each training and window of steps."""
    trainings = [(name, seed) for name in names for seed in seeds]
    return [
        {"part": "losses", "design": name, "seed": seed} | one
        for name, seed in trainings
        for one in found[name, seed]["losses"]
    ]
