"""``fillerbuster bench builds``: this build of the project and another one, in turns: whole samplings, their seconds
beside their error.
"""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, median, stdev
from typing import TYPE_CHECKING, Any

from method_configs.benchmarks.build_worker import ANSWER
from method_configs.benchmarks.table_files import TableFiles

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from fb_core.evaluation.results import Report

_HERE = Path(__file__).resolve().parent
_ROOT = _HERE.parents[1]
_EXACT_STEPS = 64
"""Steps whose latents stand for exact ones."""
_ROOMS_WITH_ERROR = 2
"""Rooms in which latents are compared with them, which takes as long as eight samplings; none in rounds."""
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Builds(TableFiles):
    """Whole samplings by this build and by another checkout of the project, each with its own bundled model,
    recommended sampling and the precision that it chooses on this machine.
    """

    other: Path
    """Root of the other checkout (git worktree add ../other COMMIT)."""
    cases: tuple[str, ...] = ("16+24", "36+4")
    """Known + unknown views; 16+24x4 are four rounds of 24 views each that share 16 known ones."""
    rooms: int = 10
    """Unseen rooms."""
    training_steps: int = 0
    """Also so many training steps of the preset rooms-tiny in the paper's design, which every build knows."""
    threads: int = 1
    """Threads of each build."""

    def run(self) -> None:
        """Measure and report.

        Raises ValueError for options that make no benchmark.
        """
        from fb_core.evaluation.results import Report

        if not (self.other / "fb_core").is_dir():
            raise ValueError(f"other: expected the root of a checkout, which holds fb_core, got {self.other}")
        if self.keep is not None:
            raise ValueError(
                "keep: the builds are timed in turns in one run, of which nothing can be kept; leave it out"
            )
        if self.rooms < 1 or self.threads < 1:
            raise ValueError(
                f"bench builds: expected at least one room and one thread, got {self.rooms} and {self.threads}"
            )
        if self.training_steps < 0 or not (self.cases or self.training_steps):
            raise ValueError(
                f"bench builds: expected at least one case or training step, got {len(self.cases)} cases and "
                f"{self.training_steps} steps"
            )
        cases = [_Case.of(text) for text in self.cases]
        report = Report(seed=self.seed)
        with (
            tempfile.TemporaryDirectory(prefix="fillerbuster-builds-") as folder,
            _Build("this", _ROOT, self.threads) as this,
            _Build("other", self.other.resolve(), self.threads) as other,
        ):
            for case in cases:
                report.rows.extend(self._rows(Path(folder), (this, other), case))
            if self.training_steps:
                report.rows.extend(self._training_rows(this, other))
        self.publish(report, draw)

    def _rows(self, folder: Path, builds: tuple[_Build, ...], case: _Case) -> list[dict[str, Any]]:
        """The builds' figures for one case, this one's with its gain over the other one."""
        _logger.info("%s views in %d rooms", case.text, self.rooms)
        results: dict[str, list[dict[str, float]]] = {build.name: [] for build in builds}
        for number in range(self.rooms):
            stored, truth = _stored_views(folder, case, seed=self.seed, number=number)
            exact_steps = _EXACT_STEPS if number < _ROOMS_WITH_ERROR and case.rounds == 1 else 0
            for build in builds:
                answer = build.complete(stored, truth, case, seed=self.seed + number, exact_steps=exact_steps)
                results[build.name].append(answer)
            stored.unlink()
        return [self._row(build, results, builds[-1].name, case.text) for build in builds]

    def _training_rows(self, this: _Build, other: _Build) -> list[dict[str, Any]]:
        """Both builds' training steps; the loss is a running mean over all of them."""
        from fb_core.evaluation.results import commit

        _logger.info("%d training steps", self.training_steps)
        pairs = [(this.trained(), other.trained()) for _ in range(self.training_steps)]
        return [
            {
                "part": "a training step", "build": f"{build.name} ({commit(build.root)})",
                "steps": self.training_steps,
                "cpu_seconds": median(pair[number]["cpu_seconds"] for pair in pairs),
                "seconds": median(pair[number]["seconds"] for pair in pairs),
                "times_as_fast": median(pair[1]["cpu_seconds"] / pair[number]["cpu_seconds"] for pair in pairs),
                "loss": pairs[-1][number]["loss"],
            }
            for number, build in enumerate((this, other))
        ]  # fmt: skip

    def _row(self, build: _Build, found: dict[str, list[dict[str, float]]], against: str, case: str) -> dict[str, Any]:
        """One build's figures for one case, with its gain over the other one, room by room."""
        from fb_core.evaluation.results import commit

        mine, theirs = found[build.name], found[against]
        psnrs = [one["psnr"] for one in mine]
        errors = [one["latent_error"] for one in mine if "latent_error" in one]
        gains = [one["psnr"] - other["psnr"] for one, other in zip(mine, theirs, strict=True)]
        times = [other["cpu_seconds"] / one["cpu_seconds"] for one, other in zip(mine, theirs, strict=True)]
        return {
            "part": f"{case} views", "case": case, "build": f"{build.name} ({commit(build.root)})",
            "steps": build.steps,
            "rooms": len(mine), "cpu_seconds": median(one["cpu_seconds"] for one in mine),
            "seconds": median(one["seconds"] for one in mine), "psnr": mean(psnrs),
            "psnr_error": _standard_error(psnrs),
            "latent_error": mean(errors) if errors else None,
            "times_as_fast": median(times), "psnr_gain": mean(gains), "psnr_gain_error": _standard_error(gains),
        }  # fmt: skip


class _Build:
    """A process that runs one checkout's code."""

    def __init__(self, name: str, root: Path, threads: int):
        self.name, self.root, self._threads = name, root, threads

    def __enter__(self) -> _Build:
        environment = os.environ | {"PYTHONPATH": str(self.root), "OMP_NUM_THREADS": str(self._threads)}
        self._process = subprocess.Popen(
            [sys.executable, str(_HERE / "build_worker.py")], cwd=self.root, env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        self.steps = self._answer()["steps"]
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.communicate()

    def complete(
        self, stored: Path, truth: Float[Tensor, "m 3 h w"], case: _Case, *, seed: int, exact_steps: int
    ) -> dict[str, float]:
        """Seconds, CPU seconds and PSNR of the unknown views; with ``exact_steps`` also how far their latents are from
        those of so many steps.
        """
        import numpy as np
        import torch

        from fb_core.evaluation.metrics.image_metrics import psnr

        answer = stored.with_suffix(".answer.npy")
        took = self._asked(
            {
                "views": str(stored), "known": case.known, "unknown": case.unknown, "seed": seed,
                "answer": str(answer), "exact_steps": exact_steps,
            }
        )  # fmt: skip
        return took | {"psnr": float(psnr(torch.from_numpy(np.load(answer)), truth).mean())}

    def trained(self) -> dict[str, Any]:
        """Seconds, CPU seconds and loss of a further training step."""
        return self._asked({})

    def _asked(self, question: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        print(json.dumps(question), file=self._process.stdin, flush=True)
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith(ANSWER):
                return json.loads(line[len(ANSWER) :])
        raise ValueError(
            f"the build in {self.root} ended with code {self._process.wait()}; it has to run in this environment"
        )


@dataclass(frozen=True, kw_only=True)
class _Case:
    """What is sampled."""

    text: str
    """As it was asked for."""
    known: int
    """Views that are known, the same in all rounds."""
    unknown: int
    """Views to be generated in each round."""
    rounds: int

    @staticmethod
    def of(text: str) -> _Case:
        """Raises ValueError for what names no case."""
        found = re.fullmatch(r"(\d{1,4})\+(\d{1,4})(?:x(\d{1,3}))?", text)
        known, unknown, rounds = (0, 0, 0) if found is None else (int(part or 1) for part in found.groups())
        if not (1 <= known <= 1000 and 1 <= unknown <= 1000 and 1 <= rounds <= 100):
            raise ValueError(
                f"cases: expected KNOWN+UNKNOWN views such as 16+24, got {text!r}; 16+24x4 are four rounds of them"
            )
        return _Case(text=text, known=known, unknown=unknown, rounds=rounds)


def _stored_views(folder: Path, case: _Case, *, seed: int, number: int) -> tuple[Path, Float[Tensor, "m 3 h w"]]:
    """A file with the views of an unseen room, and the truth of the unknown ones of all rounds."""
    import numpy as np

    from fb_core.evaluation.completion import unseen_room
    from fb_core.geometry.raymap import raymaps_of

    views = case.known + case.rounds * case.unknown
    room = unseen_room(family="narrow", seed=seed, number=number, views=views, size=64)
    path = folder / f"{case.text}-{number}.npz"
    np.savez(path, images=room.images.numpy(), raymaps=raymaps_of(room.cameras).float().numpy())
    return path, room.images[case.known :]


def _standard_error(values: list[float]) -> float:
    return stdev(values) / len(values) ** 0.5 if len(values) > 1 else float("nan")


def draw(report: Report, path: Path) -> None:
    """PSNR over CPU seconds, one line a case from the other build to this one."""
    from method_configs.benchmarks.figures import new_axes, save_figure

    figure, axes = new_axes("PSNR of unknown views (dB)")
    for case in dict.fromkeys(row["case"] for row in report.rows if "case" in row):
        rows = [row for row in report.rows if row.get("case") == case]
        axes.plot(
            [row["cpu_seconds"] for row in rows], [row["psnr"] for row in rows], marker="o", label=f"{case} views"
        )
        for row in rows:
            axes.annotate(row["build"], (row["cpu_seconds"], row["psnr"]), fontsize=7)
    axes.set(xscale="log", xlabel="CPU seconds of a whole sampling")
    axes.legend()
    save_figure(figure, path)
