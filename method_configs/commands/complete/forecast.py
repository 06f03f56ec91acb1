"""How long ``fillerbuster complete`` may take: counted work of all stages over the machine's rate, corrected by what
has passed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fb_core.completion.duration import SquareSequence, expected_seconds, seconds_of_products
from fb_core.data.photos.photo import Photo
from fb_core.geometry.features.pairs import FEATURES, pairs_at_most
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.memory.budget import GIB
from fb_core.registration.by_features import LONGEST_SIDE
from method_configs.commands.complete.options import CHECKED, POSES_AT_ONCE, CompleteOptions
from method_configs.commands.complete.plan import Plan

# What takes as long as so many products of numbers, measured on one core (docs/speed_and_accuracy.md, "From photos
# alone").
_READ = 6e9  # a million pixels of a file
_FEATURES = 42e9  # a million pixels in which features are looked for
_PER_PIXEL = 1 / 20  # features per pixel, at most
_MATCH = 1000  # two features of two photos
_BUILD, _CROWD = 6.3e9, 24  # a photo and each of the others, up to so many, that cameras are found together with
_DRAWS = 2  # a model is asked twice for cameras
_DRAW, _SHOWN = 400e9, 12e9  # the sheet and the cameras' picture; each picture in them
_PROCESS, _BYTES = int(1.3 * GIB), 4  # with all libraries loaded; of a pixel of every photo
_SLOWEST, _FASTEST = 8.0, 1 / 8  # by which the rest is corrected at most


@dataclass(frozen=True, kw_only=True)
class Forecast:
    """Seconds of stages by their names, in order."""

    stages: Mapping[str, float]

    @property
    def total(self) -> float:
        """Of all stages."""
        return sum(self.stages.values())

    def left(self, passed: Mapping[str, float]) -> float:
        """Seconds of the stages to come, given what those behind took: the machine stays as slow or fast as it was."""
        expected = sum(seconds for name, seconds in self.stages.items() if name in passed)
        taken = sum(seconds for name, seconds in passed.items() if name in self.stages)
        factor = min(max(taken / expected, _FASTEST), _SLOWEST) if expected > 0 else 1.0
        return factor * sum(seconds for name, seconds in self.stages.items() if name not in passed)


def forecast(
    photos: Sequence[Photo],
    options: CompleteOptions,
    model: Fillerbuster | None,
    plan: Plan | None,
    sampling: SamplingConfig | None,
) -> Forecast:
    """Of the stages after reading and loading; ``auto`` is counted with both methods, since the second is asked where
    the first fails.
    """
    stages = {"cameras": 0.0}
    if any(photo.camera is None for photo in photos):
        if options.cameras != "model":
            stages["cameras"] += _seconds_of_features(
                [_looked_at(photo) for photo in photos], [_pixels(photo) for photo in photos]
            )
        if model is not None and sampling is not None and options.cameras != "features":
            stages["cameras"] += _seconds_of_raymaps(model, len(photos), sampling)
    if plan is not None and model is not None:
        stages["new views"] = sum(_seconds_of_pass(model, plan, number) for number in range(len(plan.passes.views)))
        if options.check:
            checked = min(plan.photos, CHECKED)
            if sampling is not None and options.cameras != "features":
                stages["self-consistency"] = _seconds_of_raymaps(model, 2 * CHECKED, sampling)
            else:
                sides = [_looked_at(photo, longest=512) for photo in photos[:checked]] + [plan.side**2 / 1e6] * CHECKED
                stages["self-consistency"] = _seconds_of_features(sides, [_pixels(photo) for photo in photos[:checked]])
    views = 0 if plan is None else sum(map(len, plan.passes.views))
    written = 4 * _READ * sum(map(_pixels, photos)) + _DRAW + _SHOWN * (len(photos) + views)
    return Forecast(stages=stages | {"writing": seconds_of_products(written)})


def memory_beside(photos: Sequence[Photo], model: Fillerbuster | None = None) -> int:
    """Bytes that the process takes beside the model and what is trained: libraries, drawing, photos at full size. 0
    beside a model on a GPU, whose memory is another.
    """
    if model is not None and model.device.type != "cpu":
        return 0
    return _PROCESS + int(_BYTES * 1e6 * sum(map(_pixels, photos)))


def _pixels(photo: Photo) -> float:
    """Millions."""
    return photo.size[0] * photo.size[1] / 1e6


def _looked_at(photo: Photo, longest: int = LONGEST_SIDE) -> float:
    """Millions of pixels in which features are looked for."""
    return _pixels(photo) * min(1.0, longest / max(photo.size)) ** 2


def _seconds_of_features(looked_at: Sequence[float], stored: Sequence[float]) -> float:
    """Given millions of pixels of each photo."""
    count = len(looked_at)
    features = min(FEATURES, _PER_PIXEL * 1e6 * sum(looked_at) / max(count, 1))
    matching = pairs_at_most(count) * _MATCH * features**2
    building = _BUILD * count * min(count, _CROWD) * features / FEATURES
    return seconds_of_products(_READ * sum(stored) + _FEATURES * sum(looked_at) + matching + building)


def _seconds_of_raymaps(model: Fillerbuster, count: int, sampling: SamplingConfig) -> float:
    """Of a model that finds cameras; one that finds none is asked once, in half the time."""
    together = min(count, POSES_AT_ONCE)
    window = SquareSequence(views=together, known=together, side=model.size, recovers_rays=True)
    return _DRAWS * count / together * expected_seconds(model, window, sampling)


def _seconds_of_pass(model: Fillerbuster, plan: Plan, number: int) -> float:
    new = len(plan.passes.views[number])
    known = plan.photos + (plan.passes.anchors if number else 0)
    return expected_seconds(model, SquareSequence(views=known + new, known=known, side=plan.side), plan.sampling)
