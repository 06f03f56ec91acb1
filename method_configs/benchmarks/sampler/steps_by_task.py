"""How many steps the error of a trained model deserves, by task: pictures, raymaps, or both are generated."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import LATENT_CHANNELS, split
from fb_core.evaluation.completion import unseen_room
from fb_core.evaluation.metrics.image_metrics import psnr
from fb_core.evaluation.results import OnCell, Report
from fb_core.geometry.known_rays import frame_of_known_rays
from fb_core.geometry.raymap import from_unit_range
from fb_core.inpainter import Fillerbuster
from fb_core.views import Views

STEPS = (1, 2, 3, 4, 6, 8, 16, 64)
"""The latents of the last stand for exact ones."""
_TASKS = {
    "pictures (rays known)": (True, False),
    "raymaps (pictures known)": (False, True),
    "both": (True, True),
}
"""Whether pictures and rays of the second half of the views are unknown."""
_CHANNELS = {
    (True, False): slice(0, LATENT_CHANNELS),
    (False, True): slice(LATENT_CHANNELS, None),
    (True, True): slice(None),
}
"""Of the latents: those that the task generates."""


@torch.no_grad()
def run_tasks(
    model: Fillerbuster,
    *,
    rooms: int,
    views: int,
    size: int,
    seed: int,
    steps: tuple[int, ...] = STEPS,
    on_cell: OnCell = lambda _: None,
) -> Report:
    """One row per (task, steps): distance of the generated latents from those of the last number of steps over their
    length, with the same noise, and what that means: PSNR of pictures to the truth where their rays are known, angle of
    rays to those of the last number of steps and to the truth.

    Half of the views of each room are wholly known. Sampling is the model's recommended one but for its steps.

    Raises ValueError for fewer than one room or two views.
    """
    if rooms < 1 or views < 2:
        raise ValueError(f"steps by task: expected at least one room and two views, got {rooms} and {views}")
    report = Report(seed=seed)
    for task, (pictures, rays) in _TASKS.items():
        measured: dict[int, list[dict[str, float]]] = {count: [] for count in steps[:-1]}
        for number in range(rooms):
            on_cell(f"{task}, room {number + 1} of {rooms}")
            room = unseen_room(family="narrow", seed=seed, number=number, views=views, size=size)
            asked = _hidden(Views.known(room.images, room.cameras), pictures, rays)
            truth = Views.known(room.images, room.cameras)
            for count, figures in _errors(model, asked, truth, seed + number, steps):
                measured[count].append(figures)
        for count, figures in measured.items():
            means = {name: sum(one[name] for one in figures) / rooms for name in figures[0]}
            report.rows.append({"part": f"steps by task: {task}", "steps": count, "rooms": rooms, **means})
    return report


def _hidden(views: Views, pictures: bool, rays: bool) -> Views:
    """The second half without its pictures or its rays."""
    image_known, rays_known = views.image_known.clone(), views.rays_known.clone()
    half = len(views) // 2
    image_known[half:] = 0 if pictures else 1
    rays_known[half:] = 0 if rays else 1
    return dataclasses.replace(views, image_known=image_known, rays_known=rays_known)


def _errors(
    model: Fillerbuster, asked: Views, truth: Views, seed: int, steps: tuple[int, ...]
) -> Iterator[tuple[int, dict[str, float]]]:
    """Figures of every number of steps but the last, which is the exact one."""
    half = len(asked) // 2
    unknown = not bool(asked.image_known[half:].any()), not bool(asked.rays_known[half:].any())
    ends = {}
    for count in steps:
        sampling = dataclasses.replace(model.recommended_sampling, steps=count, precision="float32")
        ends[count] = model.denoising(asked, seed=seed, sampling=sampling).run()[half:]
    exact = ends[steps[-1]]
    chosen = _CHANNELS[unknown]
    for count in steps[:-1]:
        got = ends[count]
        figures = {"latent_error": float((got - exact)[:, chosen].norm() / exact[:, chosen].norm())}
        if unknown == (True, False):
            pictures = model.image_vae.decode(split(got)[0])
            figures["psnr"] = float(psnr(pictures, truth.images[half:]).mean())
        if unknown[1]:
            directions = _directions(model, got)
            frame = frame_of_known_rays(asked.raymaps, asked.rays_known)
            there = truth.raymaps[half:] if frame is None else frame.apply(truth.raymaps[half:])
            figures["degrees_to_exact"] = degrees(directions, _directions(model, exact))
            figures["degrees_to_truth"] = degrees(directions, there[:, 3:])
        yield count, figures


def _directions(model: Fillerbuster, latents: Float[Tensor, "n 32 h w"]) -> Float[Tensor, "n 3 hp wp"]:
    """Of the decoded rays, in the canonical frame."""
    return from_unit_range(model.raymap_vae.decode(split(latents)[1]))[:, 3:]


def degrees(first: Float[Tensor, "n 3 h w"], second: Float[Tensor, "n 3 h w"]) -> float:
    """Mean angle between directions."""
    cosine = torch.nn.functional.cosine_similarity(first, second, dim=1).clamp(-1, 1)
    return float(torch.rad2deg(torch.arccos(cosine)).mean())


def draw_tasks(report: Report, path: Path) -> None:
    """Distance of latents from exact ones over steps, one line per task, and PSNR of pictures beside it."""
    from method_configs.benchmarks.figures import new_axes, save_figure

    figure, axes = new_axes(f"distance of latents from those of {STEPS[-1]} steps")
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in report.rows:
        rows.setdefault(row["part"].removeprefix("steps by task: "), []).append(row)
    for task, points in rows.items():
        axes.plot([row["steps"] for row in points], [row["latent_error"] for row in points], marker="o", label=task)
        for row in points:
            if "psnr" in row:
                axes.annotate(f"{row['psnr']:.1f} dB", (row["steps"], row["latent_error"]), fontsize=7)
    axes.set(xscale="log", yscale="log", xlabel="steps")
    axes.legend()
    save_figure(figure, path)
