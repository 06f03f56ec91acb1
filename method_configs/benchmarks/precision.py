"""``fillerbuster bench precision``: whole samplings in bfloat16 against float32, over guidance scales and numbers of
views.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass
from typing import Any

import torch

from fb_core.checkpoint import Loaded, ModelConfig
from fb_core.evaluation.results import Bar, OnCell, Report, median_seconds
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import Fillerbuster, SamplingConfig
from fb_core.networks.transformer.dit import DiTConfig
from fb_core.networks.vae import VAEConfig
from fb_core.views import Views
from method_configs.benchmarks.networks import random_model

_VAE = VAEConfig(widths=(8, 8, 8, 8), norm_groups=4, encoder_resnets=1, decoder_resnets=1)
TINY = ModelConfig(
    transformer=DiTConfig(heads=2, head_dim=16, depth=2, text_width=0),
    image_vae=_VAE,
    raymap_vae=dataclasses.replace(_VAE, in_channels=6, norm="none", padding="replicate"),
)
"""A CPU without bfloat16 hardware emulates it about ten times slower, so the architecture is tiny."""


@dataclass(frozen=True, kw_only=True)
class PrecisionBenchmark:
    """What is measured."""

    guidance: tuple[float, ...] = (1.0, 3.0, 7.0, 10.0, 20.0)
    """Guidance scales of unknown content; known content has 1.1, or 1 beside 1."""
    views: tuple[int, ...] = (1, 4, 16, 64)
    """Numbers of views; a quarter is known, a quarter has unknown rays."""
    steps: int = 24
    """Denoising steps."""
    size: int = 32
    """Side of the views in pixels (with a given model, that model's)."""
    seed: int = 0
    """Decides weights and inputs."""


QUICK = PrecisionBenchmark(guidance=(1.0, 20.0), views=(1, 3), steps=2, size=16)
"""A miniature that runs in seconds."""


@torch.no_grad()
def run_precision(
    config: PrecisionBenchmark = PrecisionBenchmark(),
    model: Fillerbuster | None = None,
    *,
    on_cell: OnCell = lambda _: None,
) -> Report:
    """One row per (guidance, views): errors of generated pixels and rays, and whether all is finite. None is a tiny
    random model.
    """
    exact = model or Fillerbuster(random_model(TINY, config.seed))
    rough = _in_bfloat16(exact)
    size = config.size if model is None else exact.size
    report = Report(seed=config.seed)
    for guidance in config.guidance:
        for count in config.views:
            on_cell(f"guidance {guidance:g}, {count} views")
            report.rows.append(_row(exact, rough, _views(count, size, config.seed), guidance, config))
    report.bars.append(
        Bar(
            name="cells that are not finite",
            value=float(sum(not row["finite"] for row in report.rows)),
            limit=0,
            sense="<=",
        )
    )
    return report


def _in_bfloat16(model: Fillerbuster) -> Fillerbuster:
    """The same weights as `from_pretrained(..., dtype=torch.bfloat16)` would load them."""
    loaded = Loaded(
        dit=copy.deepcopy(model.dit).to(torch.bfloat16),
        image_vae=copy.deepcopy(model.image_vae).to(torch.bfloat16),
        raymap_vae=model.raymap_vae,
        config=model.config,
        info=model.info,
        empty_prompt=model.text,
    )
    return Fillerbuster(loaded)


def _views(count: int, size: int, seed: int) -> Views:
    """Views of smooth pictures: the first quarter known, the last without rays, the first always with its rays."""
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(count, 3, generator=generator) * 2 - 1
    targets = centers + torch.randn(count, 3, generator=generator)
    cameras = Pinholes.looking_at(
        centers, targets, up=torch.tensor([0.0, 0.0, 1.0]), fov_degrees=60.0, width=size, height=size
    )
    views = Views.known(
        torch.rand(count, 3, 1, 1, generator=generator).expand(-1, -1, size, size).contiguous(), cameras
    )
    image_known, rays_known = torch.zeros(count, 1, size, size), torch.ones(count, 1, size, size)
    image_known[: count // 4] = 1
    rays_known[count - count // 4 :] = 0
    return dataclasses.replace(views, image_known=image_known, rays_known=rays_known)


def _row(
    exact: Fillerbuster, rough: Fillerbuster, views: Views, guidance: float, config: PrecisionBenchmark
) -> dict[str, Any]:
    sampling = SamplingConfig(steps=config.steps, guidance_unknown=guidance, guidance_known=min(guidance, 1.1))
    answers: dict[str, Views] = {}

    def completes(name: str, model: Fillerbuster) -> None:
        answers[name] = model.complete(views, generator=torch.Generator().manual_seed(config.seed), sampling=sampling)

    seconds = median_seconds(
        {"float32": lambda: completes("float32", exact), "bfloat16": lambda: completes("bfloat16", rough)},
        1,
        warm_up=False,
    )
    wanted, got = answers["float32"], answers["bfloat16"]
    generated = (views.image_known < 1).expand_as(wanted.images)
    error = (got.images - wanted.images).abs()[generated]
    recovered = views.rays_known[:, 0] < 1
    cosines = (got.raymaps[:, 3:] * wanted.raymaps[:, 3:]).sum(dim=1)[recovered].clamp(-1, 1)
    degrees = torch.rad2deg(torch.acos(cosines))
    return {
        "part": "precision", "guidance": guidance, "views": len(views), "size": views.size[0], "steps": config.steps,
        "image_mean_error": float(error.mean()), "image_max_error": float(error.max()),
        "ray_mean_degrees": float(degrees.mean()) if len(degrees) else 0.0,
        "finite": bool(torch.isfinite(got.images).all() and torch.isfinite(got.raymaps).all()),
        "seconds": seconds["bfloat16"], "float32_seconds": seconds["float32"],
    }  # fmt: skip
