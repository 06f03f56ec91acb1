"""``fillerbuster eval ablations``: trains the designs of the paper's table 2 at a small size and compares them."""

from __future__ import annotations

import json as json_format
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fb_core.evaluation.ablations import AblationTask, Distance
    from fb_core.inpainter import Fillerbuster
    from fb_core.training.recipe import Recipe

_logger = logging.getLogger(__name__)
_METRICS = ("psnr", "ssim", "lpips", "val")


@dataclass(frozen=True, kw_only=True)
class Ablations:
    """The designs of the paper's table 2, each trained from scratch with several seeds on small rooms, and completing unseen ones."""

    output: Path = Path("outputs/ablations")
    """Folder of the trainings; what is there already is neither trained nor measured again."""
    base: str = "rooms-ablation"
    """Preset that the designs are one field away from."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Trainings of each design."""
    steps: int | None = None
    """Training steps instead of the preset's."""
    sequences: int = 50
    """Unseen rooms for each length."""
    lengths: tuple[int, ...] = (8, 16, 32)
    """Views of a sequence: a quarter known, a quarter partly known, the rest generated."""
    model: Path | None = None
    """Model folder whose autoencoders all designs share; by default the bundled one."""
    lpips: Path | None = None
    """torchvision's weights of SqueezeNet 1.1; without them LPIPS is left out."""
    seed: int = 0
    """Decides the unseen rooms, cameras, masks and samples."""
    json: Path | None = None
    """Write all measurements to this file."""

    def run(self) -> None:
        """Train what is missing, measure what is missing, report."""
        from fb_core.evaluation.ablations import AblationTask
        from fb_core.evaluation.benchmarks import Report
        from fb_core.inpainter import Fillerbuster
        from method_configs.bench_command import show

        task = AblationTask(sequences=self.sequences, lengths=self.lengths, seed=self.seed)
        autoencoders = Fillerbuster.from_pretrained(self.model)
        designs = _designs(self.base, self.steps)
        results: dict[tuple[str, int], list[dict[str, float]]] = {}
        for seed in self.seeds:
            for name, recipe in designs.items():
                folder = self.output / f"{recipe.name}-{seed}"
                results[name, seed] = _measured(recipe, seed, folder, autoencoders, task, _distance(self.lpips))
        report = Report(seed=self.seed)
        report.rows.extend(table(results, tuple(designs), self.seeds))
        report.rows.extend(claims(results, self.seeds, trained=designs["base"].dit_loss.task.views))
        show(report, self.json, [])


def _designs(base: str, steps: int | None) -> dict[str, Recipe]:
    import dataclasses

    from method_configs.ablations import PRESETS, ablations_of

    if base not in PRESETS:
        raise ValueError(f"base: expected one of the presets {sorted(PRESETS)}, got {base!r}")
    recipe = PRESETS[base]
    if steps is not None:
        recipe = dataclasses.replace(recipe, dit_loop=dataclasses.replace(recipe.dit_loop, steps=steps))
    return {"base": recipe} | {other.name.removeprefix(f"{base}-"): other for other in ablations_of(recipe)}


def _distance(weights: Path | None) -> Distance | None:
    if weights is None:
        return None
    from fb_core.training.perceptual import load_lpips

    network = load_lpips(weights)
    return lambda first, second: network(first, second, normalize=True)


def _measured(
    recipe: Recipe, seed: int, folder: Path, autoencoders: Fillerbuster, task: AblationTask, distance: Distance | None
) -> list[dict[str, float]]:
    """One row for each length; kept beside the training with all that decides it."""
    import dataclasses

    from fb_core.evaluation.ablations import evaluate_design

    asked = dataclasses.asdict(task) | {"steps": recipe.dit_loop.steps, "model": autoencoders.model_hash, "lpips": distance is not None}
    asked = json_format.loads(json_format.dumps(asked))
    path = folder / "measured.json"
    if path.exists() and (kept := json_format.loads(path.read_text()))["asked"] == asked:
        return kept["rows"]
    model = _trained(dataclasses.replace(recipe, seed=seed), folder, autoencoders)
    rows = evaluate_design(model, task, recipe.sampling, distance=distance, on_sequence=_counting(f"{recipe.name}, seed {seed}: sequence"))
    path.write_text(json_format.dumps({"asked": asked, "rows": rows}, indent=1) + "\n")
    return rows


def _trained(recipe: Recipe, folder: Path, autoencoders: Fillerbuster) -> Fillerbuster:
    """The design's transformer between the shared autoencoders."""
    import dataclasses

    from fb_core.checkpoint import Loaded
    from fb_core.inpainter import Fillerbuster
    from fb_core.networks.dit import DiT
    from fb_core.training.loop import Run
    from fb_core.training.recipe import dit_stage

    task = dit_stage(recipe, autoencoders.image_vae, autoencoders.raymap_vae)
    run = Run(task, recipe.dit_loop, folder, preset=recipe.name, engine=recipe.engine)
    count = _counting(f"{recipe.name}, seed {recipe.seed}: step")
    run.train(on_progress=lambda done, total, _: count(done, total))
    if run.signal:
        raise SystemExit(128 + run.signal)
    transformer = DiT(recipe.dit)
    transformer.load_state_dict(run.averaged_state())
    return Fillerbuster(
        Loaded(
            dit=transformer,
            image_vae=autoencoders.image_vae,
            raymap_vae=autoencoders.raymap_vae,
            config=dataclasses.replace(autoencoders.config, transformer=recipe.dit),
            info={"image_size": recipe.pool.image_size},
        )
    )


def _counting(what: str, parts: int = 5) -> Callable[[int, int], None]:
    def count(done: int, total: int) -> None:
        if done % max(1, total // parts) == 0:
            _logger.info("%s %d of %d", what, done, total)

    return count


def table(results: dict[tuple[str, int], list[dict[str, float]]], designs: tuple[str, ...], seeds: tuple[int, ...]) -> list[dict[str, Any]]:
    """Means over trainings with 95 % confidence intervals, a row for each design and length."""
    from fb_core.evaluation.ablations import interval

    rows = []
    for design in designs:
        for place, first in enumerate(results[design, seeds[0]]):
            row: dict[str, Any] = {"part": "designs", "design": design, "views": int(first["views"]), "trainings": len(seeds)}
            for metric in _METRICS:
                if metric in first:
                    row[metric], row[f"{metric}_interval"] = interval([results[design, seed][place][metric] for seed in seeds])
            rows.append(row)
    return rows


def claims(results: dict[tuple[str, int], list[dict[str, float]]], seeds: tuple[int, ...], *, trained: int) -> list[dict[str, Any]]:
    """What the paper says, and whether it was seen here: paired differences of the validation loss, seed by seed, with 95 % intervals.

    VAL is the paper's measure of generation, and by far the least noisy one here.
    """
    from fb_core.evaluation.ablations import interval

    said = {
        "no-index-emb": "an index embedding helps",
        "fixed-index-emb": "random index positions help beyond the trained length",
        "no-poses": "denoising raymaps too helps",
        "random-poses": "an upright frame at a camera helps",
    }
    rows = []
    for design, claim in said.items():
        for place, first in enumerate(results[design, seeds[0]]):
            if design == "fixed-index-emb" and first["views"] <= trained:
                continue
            gains = [results[design, seed][place]["val"] - results["base", seed][place]["val"] for seed in seeds]
            mean, half = interval(gains)
            seen = "reproduced" if mean - half > 0 else "reversed" if mean + half < 0 else "undecided"
            rows.append({"part": "claims", "claim": claim, "views": int(first["views"]), "val_gain": mean, "interval": half, "seen": seen})
    return rows
