"""The paper's comparison of model designs (table 2): sequences of N views of unseen rooms, N/4 known, N/4 partly, the
rest generated.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import Encoding, encode_in_chunks, encode_known, stacked_facts, unsplit
from fb_core.data.rooms.room import require_family
from fb_core.evaluation.capture_questions import CaptureViews
from fb_core.evaluation.completion import RoomViews, unseen_room
from fb_core.evaluation.metrics.image_metrics import psnr, ssim
from fb_core.flow import validation_loss
from fb_core.geometry.raymap import CanonicalFrame, raymaps_of, to_unit_range
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.masks import training_mixture
from fb_core.networks.transformer.prepared import Prepared
from fb_core.views import Views

Distance = Callable[[Tensor, Tensor], Tensor]
"""Perceptual distance of two batches of images in [0, 1]."""
_CHUNK = 64  # views encoded at once


@dataclass(frozen=True, kw_only=True)
class AblationTask:
    """What every design is asked."""

    sequences: int = 50
    """Sequences of each length (paper: 50)."""
    lengths: tuple[int, ...] = (8, 16, 32)
    """Views per sequence."""
    times: int = 20
    """Equally spaced times of the validation loss (paper: 20)."""
    family: str = "narrow"
    """Room family."""
    seed: int = 0
    """Decides rooms, cameras, masks and samples."""

    def __post_init__(self) -> None:
        if self.sequences < 1 or self.times < 1 or not self.lengths or min(self.lengths) < 4:
            raise ValueError(f"ablations: expected sequences and times, and lengths of at least 4 views, got {self}")
        require_family(self.family)


class Asked(NamedTuple):
    """One sequence, and what of it is told."""

    room: RoomViews | CaptureViews
    known: Float[Tensor, "n 1 h w"]
    seed: int
    """Decides the sample."""


def asked_sequences(task: AblationTask, size: int) -> dict[int, list[Asked]]:
    """The sequences of each length, rendered at this image size."""
    asked = {}
    for length in task.lengths:
        asked[length] = []
        for number in range(task.sequences):
            room = unseen_room(family=task.family, seed=task.seed, number=number, views=length, size=size)
            draw = torch.Generator().manual_seed(task.seed * 1_000_003 + number)
            known = training_mixture(length, size, size, generator=draw, in_order=True)
            asked[length].append(Asked(room, known, task.seed + number))
    return asked


def evaluate_design(
    model: Fillerbuster,
    asked: Mapping[int, Sequence[Asked]],
    sampling: SamplingConfig,
    *,
    times: int = 20,
    distance: Distance | None = None,
    on_sequence: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, float]]:
    """One row for each length: means over sequences of PSNR (dB), SSIM, and the image channels' validation loss at
    ``times`` times; LPIPS with a ``distance``.

    Pictures are scored whole, in all views that were not wholly known; what was known of them counts too (as in the
    paper's code).
    """
    rows, done, total = [], 0, sum(map(len, asked.values()))
    for length, sequences in asked.items():
        scores = []
        for sequence in sequences:
            scores.append(sequence_scores(model, sequence, sampling, times, distance))
            done += 1
            on_sequence(done, total)
        means = {name: sum(score[name] for score in scores) / len(scores) for name in scores[0]}
        rows.append({"views": length} | means)
    return rows


def sequence_scores(
    model: Fillerbuster, asked: Asked, sampling: SamplingConfig, times: int, distance: Distance | None
) -> dict[str, float]:
    """PSNR (dB), SSIM, LPIPS with a ``distance``, and VAL of one sequence, as `evaluate_design` averages them."""
    room, known, seed = asked
    views = dataclasses.replace(Views.known(room.images, room.cameras), image_known=known)
    completed = model.complete(views, generator=torch.Generator().manual_seed(seed), sampling=sampling).images
    incomplete = (known < (room.truth if isinstance(room, CaptureViews) else 1)).flatten(1).any(dim=1)
    pair = completed[incomplete], room.images[incomplete]
    if isinstance(room, CaptureViews):  # what nobody knows counts as right; PSNR is of the rest
        truth = room.truth[incomplete]
        pair = torch.where(truth > 0, pair[0], pair[1]), pair[1]
        unknown = -10 * truth.mean(dim=(1, 2, 3)).clamp_min(1e-6).log10()
    else:
        unknown = torch.zeros(len(pair[0]))
    scores = {"psnr": float((psnr(*pair) - unknown).mean()), "ssim": float(ssim(*pair).mean())}
    if distance is not None:
        scores["lpips"] = float(distance(*pair).mean())
    return scores | {"val": conditional_validation_loss(model, room, known, times=times, seed=seed)}


@torch.no_grad()
def conditional_validation_loss(
    model: Fillerbuster,
    room: RoomViews | CaptureViews,
    known: Float[Tensor, "n 1 h w"],
    *,
    times: int = 20,
    seed: int = 0,
) -> float:
    """VAL of the paper's table 2: the predicted image velocity's error, given the known pixels and all rays, over
    equally spaced times.
    """
    images, known = room.images.to(model.device), known.to(model.device)
    rays = to_unit_range(CanonicalFrame.of(room.cameras).apply(raymaps_of(room.cameras))).to(model.device)
    conditioning = encode_known(
        images,
        known,
        rays,
        torch.ones_like(known),
        image_vae=model.image_vae,
        raymap_vae=model.raymap_vae,
        encoding=Encoding(views_at_once=_CHUNK),
        transformer=model.dit.config,
    )
    facts = stacked_facts([conditioning], model.dit.config)
    data = unsplit(encode_in_chunks(model.image_vae, images, _CHUNK), encode_in_chunks(model.raymap_vae, rays, _CHUNK))[
        None
    ]
    noise = torch.randn(data.shape, generator=torch.Generator().manual_seed(seed)).to(data)
    text = None if model.text is None else model.text[None]
    prepared = Prepared(model.dit, conditioning.channels[None], (), text=text, facts=facts)  # the same at all times

    def network(state: Tensor, time: Tensor) -> Tensor:
        return prepared(state[0], float(time))

    return float(validation_loss(network, data, noise, steps=times)[:, 0].mean())


def interval(values: list[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % confidence interval (Student's t); of one value nan."""
    from scipy.stats import t

    numbers = torch.tensor(values, dtype=torch.float64)
    if len(values) < 2:
        return float(numbers.mean()), float("nan")
    return float(numbers.mean()), float(t.ppf(0.975, len(values) - 1) * numbers.std() / len(values) ** 0.5)
