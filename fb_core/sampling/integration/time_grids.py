"""Time grids: the descending times from noise (t = 1) to data (t = 0) at which a flow is evaluated.

The best grid depends on the flow (docs/speed_and_accuracy.md), so it is an option and never hard-coded.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

from fb_core.files.limits import MOST_SAMPLING_STEPS, is_finite, require_whole

GRIDS = ("even", "reference")
REFERENCE_LAST = 0.001
"""The original's smallest time before 0."""


def time_grid(
    steps: int, *, shift: float = 1.0, grid: str = "even", start: float = 1.0, through: Iterable[float] = ()
) -> list[float]:
    """Times from `start` to 0: ``steps + 1`` of them from 1, fewer from a later start, about as many through further
    times.

    Args:
        steps: steps of the whole way from 1 to 0.
        shift: t -> s t / (1 + (s - 1) t); above 1 spends more steps near the noise, below 1 more near the data (Esser
            et al. 2024).
        grid: "even" is uniform before the shift; "reference" is the original's, evenly from 1 to 0.001 and then 0,
            whose last step is worth almost nothing.
        start: where sampling starts, for SDEdit; the steps below it keep their places.
        through: times that must be among them, such as those where the velocity jumps; from the last of them on the
            times are those of a sampling that starts there. What is not between `start` and 0 does not count.

    Raises ValueError for no steps, a shift that is not positive or so far from 1 that steps vanish, an unknown grid,
    and a start outside (0, 1].
    """
    require_whole("sampling steps", steps, 1, MOST_SAMPLING_STEPS)
    if not is_finite(shift) or shift <= 0:
        raise ValueError(f"time shift: expected a positive number, got {shift}")
    if grid not in GRIDS:
        raise ValueError(f"time grid: expected one of {', '.join(GRIDS)}, got {grid!r}")
    if not 0 < start <= 1:
        raise ValueError(f"start: expected a time above 0 and at most 1, got {start}")
    whole = reference_grid(steps) if grid == "reference" else [1.0 - k / steps for k in range(steps + 1)]
    first = 1.0 + (shift - 1.0)  # 0 where a shift is too small beside 1, and the first time has no value
    times = [shift * t / (1.0 + (shift - 1.0) * t) for t in whole] if first > 0 else []
    if not times or any(later >= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError(f"time shift: {shift:g} leaves steps without length; choose one nearer to 1")
    way, ends = [], sorted({time for time in through if 0 < time < start}, reverse=True)
    for begin, end in itertools.pairwise([start, *ends, 0.0]):
        way += _before(end, _from(begin, times))
    return [*way, 0.0]


def reference_grid(steps: int) -> list[float]:
    """The original's ``steps + 1`` times."""
    if steps == 1:
        return [1.0, 0.0]
    gap = (1.0 - REFERENCE_LAST) / (steps - 1)
    return [1.0, *(1.0 - k * gap for k in range(1, steps - 1)), REFERENCE_LAST, 0.0]


def _from(start: float, times: list[float]) -> list[float]:
    """The times below `start`, after it. The first step is never a sliver, from which a multistep method would
    extrapolate noise.
    """
    if start >= times[0]:
        return times
    later = [time for time in times if time < start]
    if len(later) > 1 and start - later[0] < (later[0] - later[1]) / 2:
        later = later[1:]
    return [start, *later]


def _before(end: float, times: list[float]) -> list[float]:
    """The times above `end`. The last step is no sliver where `end` was put in: it would cost an evaluation for next to
    nothing.
    """
    earlier = [time for time in times if time > end]
    if end not in times and len(earlier) > 1 and earlier[-1] - end < (earlier[-2] - earlier[-1]) / 2:
        earlier = earlier[:-1]
    return earlier
