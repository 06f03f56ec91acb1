"""``fillerbuster bench splat``: its options. Heavy imports wait until it runs."""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Splat:
    """Drawing splats on a CPU: time, memory and error, beside gsplat's torch functions, a loop over tiles, and the
    floor.
    """

    json: Path | None = None
    """Write all measurements to this file."""
    quick: bool = False
    """A miniature that shows that everything runs; its times mean nothing."""
    capture: Path | None = None
    """An npz file of real points and cameras (means3d, colors, viewmats, Ks, width, height) to draw as well."""
    peers: bool = True
    """Also measure what we compare with (takes minutes, and 2 GB of memory)."""
    runs: int = 7
    """Runs, of which the median is reported."""
    seed: int = 0
    """Decides rooms and Gaussians."""

    def run(self) -> None:
        """Measure and report."""
        from method_configs.benchmarks.command import show
        from method_configs.benchmarks.splats import speed_and_error as benchmark

        config = benchmark.QUICK if self.quick else benchmark.SplatBenchmark(runs=self.runs)
        config = dataclasses.replace(
            config, capture=self.capture, seed=self.seed, **({} if self.peers else {"peer_runs": 0})
        )
        show(benchmark.run_splat(config, on_cell=lambda cell: _logger.info("measuring %s", cell)), self.json, [])
