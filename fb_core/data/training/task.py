"""What every source of training data shares: a batch of sequences, how views become a task, and the frames of its
raymaps.

A source gives rows of a batch. What a row holds depends on its generator alone, so on (seed, step, row).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.raymap import CanonicalFrame
from fb_core.geometry.rotations import rotations_of
from fb_core.masks import drop_conditioning, partly_known, training_mixture

Draw = Callable[[int], torch.Generator]
"""The generator, on the CPU, of a row of the batch."""


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """A batch of b sequences of n views, all in canonical frames."""

    images: Float[Tensor, "b n 3 h w"]
    """RGB in [0, 1]; 0 where there is no ground truth."""
    raymaps: Float[Tensor, "b n 6 h w"]
    """Canonical raymaps: origins in [-1, 1]^3, unit directions; zeros where there is no ground truth."""
    image_known: Float[Tensor, "b n 1 h w"]
    """What the network is told of the images (1 = known); never more than there is."""
    rays_known: Float[Tensor, "b n 1 h w"]
    """What the network is told of the rays (1 = known); never more than there is."""
    image_latents: Float[Tensor, "b n 16 lh lw"] | None = None
    """Latents of the whole images where the source keeps them."""
    image_truth: Float[Tensor, "b n 1 h w"] | None = None
    """1 where the image has ground truth; None = everywhere."""
    rays_truth: Float[Tensor, "b n 1 h w"] | None = None
    """1 where the raymap has ground truth; None = everywhere."""
    distance: Float[Tensor, "b n 1 h w"] | None = None
    """How far along each ray the surface lies, in the unit of the raymaps' origins, where the source knows it."""
    captions: tuple[str, ...] | None = None
    """One text for each sequence; None = the empty one (all multi-view data, paper figure A.1)."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """How views become a training task (paper, appendix "Training recipe")."""

    views: int = 12
    """Views per sequence."""
    mixture: Literal["shares", "quarters"] = "shares"
    """Which views are known: by the two shares below, or the paper's quarter known, quarter partly known, half
    unknown.
    """
    known_share: tuple[float, float] = (0.25, 0.75)
    """Range of the share of views whose image is known (mixture "shares")."""
    partial_share: float = 0.15
    """Odds that a view that would be known or unknown is partly known instead (mixture "shares")."""
    ray_task: float = 0.25
    """Odds that rays are to be recovered from images instead of images from rays (paper: 0.25)."""
    dropout: float = 0.1
    """Odds that conditioning is dropped: images, rays or both (paper: 0.1)."""
    frame: Literal["upright", "random"] = "upright"
    """One camera at the origin and upright (paper), or any centre and rotation (paper's ablation "random-poses")."""
    random_heading: bool = True
    """Turn the canonical frame by a random heading (paper); off, the heading is 0 as in inference."""
    random_fill: bool = True
    """Rescale small scenes at random (paper); off, they fill the cube as in inference."""
    guess: float = 0.0
    """Odds that a sequence's unknown views come with a guess (`fb_core.training.stages.guesses`); the paper has
    none.
    """
    guess_by_depth: float = 0.5
    """Odds that a guess comes by the true distance with the errors of splats, where the source knows it, instead of by
    direction.
    """
    sector: float = 0.0
    """Odds that the views of a sequence stand in the order of their angle to the first one's axis (`task_order`), so
    that its known views look one way and its unknown ones another, as in a casual capture that lacks a side; otherwise,
    as in the paper, in random order.
    """

    def __post_init__(self) -> None:
        if not 0 <= self.sector <= 1:
            raise ValueError(f"training: expected odds of known views in one sector from 0 to 1, got {self.sector}")


@runtime_checkable
class Source(Protocol):
    """Where training data come from. ``rows`` are numbers of rows of a batch of ``rows.stop`` rows."""

    @property
    def views(self) -> int:
        """Views that a sequence can have without showing one twice."""
        ...

    def advance(self, step: int, rows: range | None = None) -> None:
        """Get ready for a step; called before its rows are drawn."""
        ...

    def images(self, rows: range, draw: Draw) -> Float[Tensor, "b 3 h w"]:
        """Single images in [0, 1], for the image autoencoder; a row may hold several."""
        ...

    def raymaps(self, rows: range, task: TaskConfig, draw: Draw) -> Float[Tensor, "b 6 h w"]:
        """Single canonical raymaps, for the raymap autoencoder."""
        ...

    def sequences(self, rows: range, task: TaskConfig, draw: Draw) -> Sequences:
        """Training sequences; a row may hold several of them."""
        ...


def stacked(parts: list[dict[str, Tensor]]) -> Sequences:
    """One batch of sequences that are given field by field."""
    fields: dict[str, Any] = {name: torch.stack([part[name] for part in parts]) for name in parts[0]}
    return Sequences(**fields)


def training_frame(cameras: Pinholes, task: TaskConfig, *, generator: torch.Generator) -> CanonicalFrame:
    """The frame of a training sequence; upright in the first camera, which is a random one where the views are in
    random order.
    """
    turn, fill = torch.rand(2, generator=generator).tolist()
    fill = fill if task.random_fill else 1.0
    if task.frame == "random":
        return _random_frame(cameras, fill, generator)
    return CanonicalFrame.of(cameras, heading_radians=2 * math.pi * turn if task.random_heading else 0.0, fill=fill)


def task_order(cameras: Pinholes, task: TaskConfig, *, generator: torch.Generator) -> Int[Tensor, "n"]:
    """The order in which views that are in random order stand in a sequence: as they are, or by their angles
    (``task.sector``).
    """
    if not task.sector or float(torch.rand((), generator=generator)) >= task.sector:
        return torch.arange(len(cameras))
    axes = cameras.rotations[:, :, 2].cpu()
    closeness = axes @ axes[0]
    closeness[0] = torch.inf  # the first view stays the reference, whatever rounding says
    return closeness.argsort(descending=True, stable=True)


def _random_frame(cameras: Pinholes, fill: float, generator: torch.Generator) -> CanonicalFrame:
    """Any rotation, and any centre in the cube around the cameras."""
    rotation = rotations_of(F.normalize(torch.randn(4, generator=generator).double(), dim=0)[None])[0]
    centers = cameras.centers.detach().cpu().double()
    low, high = centers.amin(dim=0), centers.amax(dim=0)
    center = (low + high) / 2 + (high - low).max() / 2 * (2 * torch.rand(3, generator=generator).double() - 1)
    extent = float(((centers - center) @ rotation.T).abs().max())
    scale = extent if extent >= 1 else extent * fill + 1 - fill
    rounded = max(scale, 1e-6) * (1 + 1e-6)  # one camera alone has no extent
    return CanonicalFrame(rotation=rotation.to(cameras.centers), center=center.to(cameras.centers), scale=rounded)


def draw_task(
    count: int, size: int, task: TaskConfig, *, generator: torch.Generator, device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor]:
    """(image mask, ray mask), each [n, 1, size, size]: one modality is to be completed, the other is known, or dropped.

    With mixture "shares" the first view, the frame's reference, is known or partly known, as in inference.
    """
    if task.mixture == "quarters":
        masks = training_mixture(count, size, size, generator=generator).to(device)
    else:
        masks = _by_shares(count, size, task, generator, device)
    everything = torch.ones_like(masks)
    is_ray_task = float(torch.rand((), generator=generator)) < task.ray_task
    image_known, rays_known = (everything, masks) if is_ray_task else (masks, everything)
    drop_images, drop_rays = drop_conditioning(generator, share=task.dropout)
    return image_known * (not drop_images), rays_known * (not drop_rays)


def _by_shares(
    count: int, size: int, task: TaskConfig, generator: torch.Generator, device: torch.device | str
) -> Float[Tensor, "n 1 size size"]:
    low, high = task.known_share
    share = low + (high - low) * float(torch.rand((), generator=generator))
    known = min(count, max(1, round(share * count)))
    masks = torch.zeros(count, 1, size, size, device=device)
    masks[:known] = 1.0
    partial = torch.rand(count, generator=generator) < task.partial_share
    for view in partial.nonzero()[:, 0].tolist():
        masks[view] = partly_known(size, size, generator=generator, device=device)
    return masks
