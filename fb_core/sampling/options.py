"""How a sequence is denoised: the options of `Fillerbuster.complete`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from fb_core.files.limits import MOST_SAMPLING_STEPS, is_finite, require_between, require_whole
from fb_core.machine.precision import PRECISIONS, Precision
from fb_core.sampling.guidance import GuidanceVariant
from fb_core.sampling.integration.solvers import SOLVERS
from fb_core.sampling.integration.time_grids import time_grid

Guess = Literal["start", "told", "both"]
"""How a guess of what is to be generated enters."""
POSE_STEPS, POSE_WINDOW = 8, 8
"""Steps that raymaps need, and views per window."""
_MOST_GUIDANCE = 1000.0  # the paper's largest is 10; far beyond, latents overflow


@dataclass(frozen=True, kw_only=True)
class SamplingConfig:
    """How a sequence is denoised, and in how much memory."""

    steps: int = 24
    """Denoising steps; each evaluates the network once (twice with guidance, three times with a prompt)."""
    guidance_unknown: float = 7.0
    """Classifier-free guidance scale where content is unknown (paper: 7)."""
    guidance_known: float = 1.1
    """Guidance scale where content is known (paper: 1.1)."""
    guidance_text: float = 10.0
    """Guidance scale of a prompt; without a prompt, or at 0, text costs nothing."""
    guidance: GuidanceVariant = field(default_factory=GuidanceVariant)
    """Changes to the paper's guidance."""
    solver: str = "corrected"
    """'euler', 'heun' (two evaluations a step), 'ab2' (second-order Adams-Bashforth: Euler's error in a third of the
    steps) or 'corrected' (AB2 with a bounded correction at no further evaluation; docs/speed_and_accuracy.md).
    """
    grid: str = "even"
    """'even', or the original's 'reference', whose last step is worth nothing."""
    shift: float = 2.0
    """Time shift of the grid; above 1 spends more steps near the noise (docs/speed_and_accuracy.md has what 2 is
    worth).
    """
    strength: float = 1.0
    """Time at which sampling starts from the `current` views that are given; 1 is pure noise, and they do not
    matter.
    """
    guess: Guess = "start"
    """How `current` views enter: 'start', sampling starts from them at `strength`; 'told', they are part of the
    conditioning, for models that were trained to be told guesses; or 'both'.
    """
    belief: float = 0.7
    """How far a guess that is told is to be believed, 0 to 1 (see `fb_core.training.stages.guesses` for what models
    learn).
    """
    precision: Precision = "float32"
    """Of the transformer's matrix products: 'float32' for those of the weights, 'bfloat16', or 'auto', bfloat16 where
    the device is faster at it. The sampler's state, norms and guidance stay in float32.
    """
    known: str = "guided"
    """How known content enters: 'guided' by conditioning and guidance alone (paper), or 'imposed', re-imposed on wholly
    known latents.
    """
    window: int | None = None
    """Views denoised together; None is all of them (best for images; the paper uses 8 for poses)."""
    rounds: int = 1
    """Random partitions into windows that are averaged per step."""
    views_at_once: int | None = None
    """Views that pass through an autoencoder together; None is as many as memory allows, at most 16."""
    sample_posterior: bool = False
    """Condition on samples of the autoencoders' posteriors, as the original does, instead of on their means."""
    memory_budget_bytes: int | None = None
    """Most memory, weights included, in bytes; None is what the machine has. Decides how the work is cut
    (`fb_core.memory`).
    """
    reference_compatible: bool = False
    """Sample as the original does, with its flaws, for comparisons: Euler on its grid, a guidance map that lands on
    shuffled views, and a strength that only changes the initial state. `solver`, `grid`, `shift`, `guidance` and
    `known` do not matter then.
    """

    def __post_init__(self) -> None:
        time_grid(self.steps, shift=self.shift, grid=self.grid, start=self.strength)
        if self.solver not in SOLVERS:
            raise ValueError(f"solver: expected one of {', '.join(SOLVERS)}, got {self.solver!r}")
        if self.precision not in PRECISIONS:
            raise ValueError(f"precision: expected one of {', '.join(PRECISIONS)}, got {self.precision!r}")
        if self.guess not in get_args(Guess):
            raise ValueError(f"guess: expected one of {', '.join(get_args(Guess))}, got {self.guess!r}")
        if not 0 < self.belief < 1:
            raise ValueError(
                f"belief: expected a number between 0 and 1, got {self.belief}; what is certain is known, not guessed"
            )
        if self.known not in ("guided", "imposed"):
            raise ValueError(f"known: expected 'guided' or 'imposed', got {self.known!r}")
        require_whole("rounds", self.rounds, 1, MOST_SAMPLING_STEPS)
        for name in ("views_at_once", "window"):
            if getattr(self, name) is not None:
                require_whole(name, getattr(self, name), 1)
        if self.memory_budget_bytes is not None and not self.memory_budget_bytes >= 1:
            raise ValueError(f"memory_budget_bytes: expected at least 1, got {self.memory_budget_bytes}")
        for name in ("guidance_unknown", "guidance_known", "guidance_text"):
            if not is_finite(getattr(self, name)):
                raise ValueError(f"{name}: expected a finite number, got {getattr(self, name)!r}")
            require_between(name, getattr(self, name), -_MOST_GUIDANCE, _MOST_GUIDANCE)

    @property
    def guides(self) -> bool:
        """Whether a branch of which nothing is known is asked for anywhere."""
        return not self.guidance_known == self.guidance_unknown == 1

    @property
    def times(self) -> list[float]:
        """The times of a sampling, from where it starts to 0, through those at which guidance makes the velocity
        jump.
        """
        return self._times(start=self.strength)

    @property
    def times_from_noise_too(self) -> list[float]:
        """The times of a sampling in which some latents start from noise at 1 and all others join them at the strength:
        from there on those of `times`.
        """
        return self._times(through=(self.strength,))

    def joins_at(self, share: float) -> float:
        """When a latent joins of which the current views tell so much, 0 to 1: at the strength where wholly, at 1
        (noise) where nothing.
        """
        return self.strength + (1.0 - share) * (1.0 - self.strength)  # exactly the strength where wholly

    def times_from_noise_through(self, shares: Sequence[float]) -> list[float]:
        """`times_from_noise_too`, through the times at which latents of these shares join."""
        return self._times(through=(self.strength, *map(self.joins_at, shares)))

    def _times(self, *, start: float = 1.0, through: tuple[float, ...] = ()) -> list[float]:
        if self.reference_compatible:
            return time_grid(self.steps, grid="reference")
        return time_grid(
            self.steps, shift=self.shift, grid=self.grid, start=start, through=(*self.guidance.jumps, *through)
        )

    def for_poses(self) -> SamplingConfig:
        """The budget of recovering raymaps: few steps suffice (docs/speed_and_accuracy.md), in windows of 8 views as in
        the paper.

        In the precision of the weights: what rounding does to colours nobody sees, what it does to rays moves cameras.
        """
        return dataclasses.replace(
            self, steps=min(self.steps, POSE_STEPS), window=self.window or POSE_WINDOW, precision="float32"
        )

    @staticmethod
    def from_dict(options: Mapping[str, Any]) -> SamplingConfig:
        """Options as a model folder stores them (what is missing is the default). Raises ValueError for unknown
        ones.
        """
        options = dict(options)
        unknown = set(options) - {option.name for option in dataclasses.fields(SamplingConfig)}
        if unknown:
            raise ValueError(
                f"sampling options: {', '.join(sorted(unknown))} unknown to this version; update fillerbuster or "
                "remove them"
            )
        try:
            if "guidance" in options:
                options["guidance"] = GuidanceVariant(**options["guidance"])
            return SamplingConfig(**options)
        except TypeError as error:  # a text instead of a number
            raise ValueError(f"sampling options: {error}; remove them from the model's config.json") from error
