"""Trainings on one procedural room, as the demo and ``bench methods`` start them."""

from __future__ import annotations

from pathlib import Path

METHODS = {"without": "fillerbuster-none", "with": "fillerbuster"}
"""The two runs that are compared, by their names in metrics.json."""


FAMILY, VIEWS, SIZE, HELD_OUT = "narrow", 24, 128, 16
"""The capture: a room of the family that the bundled model knows."""


ROUNDS = 4
"""Passes of the diffusion model: the anchors and three densify rounds."""


def run_folder(output: Path, method: str) -> Path:
    """Where ``ns-train`` leaves a method's run."""
    return output / "runs" / "room" / method / "run"


def training_arguments(output: Path, method: str, *, seed: int, iterations: int, model: Path | None) -> list[str]:
    """What follows ``ns-train`` for one of the runs. Both are the same but for completion."""
    shared = {
        "data": output / "capture",
        "output-dir": output / "runs",
        "experiment-name": "room",
        "timestamp": "run",
        "vis": "tensorboard",
        "machine.seed": seed,
        "max-num-iterations": iterations,
        "steps-per-save": iterations,
        "steps-per-eval-image": 10 * iterations,  # held-out views are rendered once, after the training
        "steps-per-eval-all-images": 10 * iterations,
        "logging.local-writer.max-log-size": 0,
        "optimizers.means.scheduler.max-steps": iterations,
        "pipeline.model.max-gaussians": 20000,
    }
    if method == METHODS["with"]:
        completion = {"seed": seed, "densify-rounds": ROUNDS - 1, "at-step": iterations // 3} | (
            {} if model is None else {"model": model.absolute()}
        )
        shared |= {f"pipeline.datamanager.completion.{name}": value for name, value in completion.items()}
    return [method, *(text for name, value in shared.items() for text in (f"--{name}", str(value)))]
