"""``fillerbuster eval ablations``: trains the designs of the paper's table 2 at a small size and compares them."""

from __future__ import annotations

import json as json_format
import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fb_core.files.whole import whole_file

if TYPE_CHECKING:
    from fb_core.evaluation.ablations import AblationTask, Asked, Distance
    from fb_core.inpainter import Fillerbuster
    from fb_core.training.recipe import Recipe

_logger = logging.getLogger(__name__)
_METRICS = ("psnr", "ssim", "lpips", "val")


@dataclass(frozen=True, kw_only=True)
class Ablations:
    """The designs of the paper's table 2, each trained from scratch with several seeds on small rooms, and completing
    unseen ones.
    """

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
        from fb_core.evaluation.ablations import AblationTask, asked_sequences
        from fb_core.evaluation.results import Report
        from fb_core.inpainter import Fillerbuster
        from method_configs.benchmarks.command import show

        task = AblationTask(sequences=self.sequences, lengths=self.lengths, seed=self.seed)
        autoencoders = Fillerbuster.from_pretrained(self.model)
        designs = designs_of(self.base, self.steps)
        asked = cache(lambda: asked_sequences(task, designs["base"].pool.image_size))
        results: dict[tuple[str, int], list[dict[str, float]]] = {}
        for seed in self.seeds:
            folders = {self.output / f"{recipe.name}-{seed}": recipe for recipe in designs.values()}
            rows = _measured(folders, seed, autoencoders, task, asked, _distance(self.lpips))
            results.update({(name, seed): rows[folder] for name, folder in zip(designs, folders, strict=True)})
        report = Report(seed=self.seed)
        report.rows.extend(table(results, tuple(designs), self.seeds))
        report.rows.extend(claims(results, self.seeds, trained=designs["base"].dit_loss.task.views))
        show(report, self.json, [])


def designs_of(base: str, steps: int | None) -> dict[str, Recipe]:
    """The preset and each of its ablations, by name, perhaps with other numbers of steps. Raises ValueError for an
    unknown preset.
    """
    import dataclasses

    from method_configs.presets import PRESETS, ablations_of

    if base not in PRESETS:
        raise ValueError(f"base: expected one of the presets {sorted(PRESETS)}, got {base!r}")
    recipe = PRESETS[base]
    if steps is not None:
        recipe = dataclasses.replace(recipe, dit_loop=dataclasses.replace(recipe.dit_loop, steps=steps))
    return {"base": recipe} | {other.name.removeprefix(f"{base}-"): other for other in ablations_of(recipe)}


def _distance(weights: Path | None) -> Distance | None:
    if weights is None:
        return None
    from fb_core.training.stages.perceptual import load_lpips

    network = load_lpips(weights)
    return lambda first, second: network(first, second, normalize=True)


def _measured(
    folders: dict[Path, Recipe],
    seed: int,
    autoencoders: Fillerbuster,
    task: AblationTask,
    asked: Callable[[], dict[int, list[Asked]]],
    distance: Distance | None,
) -> dict[Path, list[dict[str, float]]]:
    """For each training one row for each length; kept beside the training with all that decides it."""
    import dataclasses

    from fb_core.evaluation.ablations import evaluate_design

    what = dataclasses.asdict(task) | {"autoencoders": content_of(autoencoders), "lpips": distance is not None}
    decides = {
        folder: json_format.loads(json_format.dumps(what | {"steps": recipe.dit_loop.steps}))
        for folder, recipe in folders.items()
    }
    measured: dict[Path, list[dict[str, float]]] = {}
    for folder in folders:
        path = folder / "measured.json"
        if path.exists() and (stored := json_format.loads(path.read_text()))["asked"] == decides[folder]:
            measured[folder] = stored["rows"]
    missing = {
        folder: dataclasses.replace(recipe, seed=seed) for folder, recipe in folders.items() if folder not in measured
    }
    for folder, model in _trained(missing, autoencoders).items():
        count = partial(_count, f"{folder.name}: sequence")
        rows = evaluate_design(
            model, asked(), missing[folder].sampling, times=task.times, distance=distance, on_sequence=count
        )
        with whole_file(folder / "measured.json") as unfinished:
            unfinished.write_text(json_format.dumps({"asked": decides[folder], "rows": rows}, indent=1) + "\n")
        measured[folder] = rows
    return measured


def content_of(autoencoders: Fillerbuster) -> str:
    """Stands for the weights that all designs share."""
    import hashlib

    digest = hashlib.sha256()
    for network in (autoencoders.image_vae, autoencoders.raymap_vae):
        for name, value in network.state_dict().items():
            digest.update(name.encode() + value.cpu().numpy().tobytes())
        digest.update(str(network.config).encode())
    return digest.hexdigest()[:16]


def _trained(recipes: dict[Path, Recipe], autoencoders: Fillerbuster) -> dict[Path, Fillerbuster]:
    """The designs' transformers between the shared autoencoders."""
    import dataclasses

    from fb_core.checkpoint import Loaded
    from fb_core.inpainter import Fillerbuster
    from fb_core.training.side_by_side import train_side_by_side

    if not recipes:
        return {}
    image_vae, raymap_vae = autoencoders.image_vae, autoencoders.raymap_vae
    trained = train_side_by_side(
        recipes,
        image_vae=image_vae,
        raymap_vae=raymap_vae,
        on_step=lambda name, step, steps: _count(f"{name}: step", step, steps),
    )
    return {
        folder: Fillerbuster(
            Loaded(
                dit=transformer,
                image_vae=image_vae,
                raymap_vae=raymap_vae,
                config=dataclasses.replace(autoencoders.config, transformer=transformer.config),
                info={"image_size": recipes[folder].pool.image_size},
            )
        )
        for folder, transformer in trained.items()
    }


def _count(what: str, done: int, total: int) -> None:
    """Say so after every fifth of the work."""
    if done % max(1, total // 5) == 0:
        _logger.info("%s %d of %d", what, done, total)


def table(
    results: dict[tuple[str, int], list[dict[str, float]]], designs: tuple[str, ...], seeds: tuple[int, ...]
) -> list[dict[str, Any]]:
    """Means over trainings with 95 % confidence intervals, a row for each design and length."""
    from fb_core.evaluation.ablations import interval

    rows = []
    for design in designs:
        for place, first in enumerate(results[design, seeds[0]]):
            row: dict[str, Any] = {
                "part": "designs",
                "design": design,
                "views": int(first["views"]),
                "trainings": len(seeds),
            }
            for metric in _METRICS:
                if metric in first:
                    row[metric], row[f"{metric}_interval"] = interval(
                        [results[design, seed][place][metric] for seed in seeds]
                    )
            rows.append(row)
    return rows


def claims(
    results: dict[tuple[str, int], list[dict[str, float]]], seeds: tuple[int, ...], *, trained: int
) -> list[dict[str, Any]]:
    """What the paper says, and whether it was seen here: paired differences of the validation loss, seed by seed, with
    95 % intervals.

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
            rows.append(
                {
                    "part": "claims",
                    "claim": claim,
                    "views": int(first["views"]),
                    "val_gain": mean,
                    "interval": half,
                    "seen": seen,
                }
            )
    return rows
