"""``fillerbuster bench networks``: our sampling against the plain twin, in one run, with the difference beside every
time.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from fb_core.checkpoint import Loaded, ModelConfig
from fb_core.conditioning import Conditioning, decode_in_chunks, encode_known, encode_null, split
from fb_core.evaluation.results import Bar, OnCell, Report, median_seconds, relative_difference
from fb_core.memory.live_bytes import LiveBytes
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.transformer.prepared import Prepared
from fb_core.networks.vae import VAE, VAEConfig
from fb_core.sampling import branches, evaluated_by, guidance_map, guided, integrate, time_grid
from method_configs.benchmarks.plain_sampling import plain_conditionings, plain_integrate, plain_step

WORDS = 77
USUAL_STEPS = 24
_PARTS = ("sampling", "encoding", "step", "decoding")
_VAE = VAEConfig(widths=(8, 16, 16, 16), norm_groups=4, encoder_resnets=1, decoder_resnets=1)
_RAYMAP_VAE = dataclasses.replace(_VAE, in_channels=6, norm="none", padding="replicate")
SMALL = ModelConfig(
    transformer=DiTConfig(heads=2, head_dim=32, depth=2, text_width=64), image_vae=_VAE, raymap_vae=_RAYMAP_VAE
)
"""Architecture of the cells of whole samplings; it reads text, of which the empty prompt is given."""


@dataclass(frozen=True, kw_only=True)
class NetworksBenchmark:
    """What is measured."""

    cells: tuple[tuple[int, int], ...] = ((8, 128), (16, 128), (40, 128), (8, 256), (16, 256), (40, 256))
    """(views, side in pixels) of whole samplings with the small model; half of the views are known."""
    steps: int = 4
    """Denoising steps of these samplings."""
    runs: int = 3
    """Runs that medians are taken of."""
    full_size: tuple[int, int] | None = (4, 128)
    """(views, side in pixels) of one step of the released architecture; None leaves it out."""
    full_transformer: DiTConfig = DiTConfig()
    """That architecture."""
    seed: int = 0
    """Decides weights and inputs."""

    def __post_init__(self) -> None:
        for views, size in self.cells:
            if views < 1 or size < 16 or size % 16:
                raise ValueError(f"cells: expected at least one view of a multiple of 16 pixels, got {views} of {size}")
        if not self.cells or self.steps < 1 or self.runs < 1:
            raise ValueError(
                f"benchmark: expected at least one cell, step and run, got {len(self.cells)}, {self.steps}, {self.runs}"
            )


QUICK = NetworksBenchmark(
    cells=((8, 32), (12, 32)),
    steps=3,
    runs=1,
    full_size=(1, 32),
    full_transformer=DiTConfig(heads=2, head_dim=32, depth=3),
)
"""A miniature that runs in seconds; its times mean nothing."""


@dataclass(frozen=True, kw_only=True)
class _Cell:
    """One task, both ways."""

    model: Loaded
    text: Tensor
    images: Tensor
    image_known: Tensor
    raymaps01: Tensor
    rays_known: Tensor
    noise: Tensor
    times: list[float]

    def encode_plain(self) -> tuple[Conditioning, Conditioning]:
        return plain_conditionings(
            self.images,
            self.image_known,
            self.raymaps01,
            self.rays_known,
            image_vae=self.model.image_vae,
            raymap_vae=self.model.raymap_vae,
        )

    def encode(self) -> tuple[Conditioning, Conditioning]:
        vaes: dict[str, Any] = {"image_vae": self.model.image_vae, "raymap_vae": self.model.raymap_vae}
        known = encode_known(self.images, self.image_known, self.raymaps01, self.rays_known, **vaes)
        height, width = self.images.shape[-2:]
        return encode_null(known, **vaes, pixels=(height, width)), known

    def denoise_plain(self, null: Conditioning, known: Conditioning, steps: int | None = None) -> Tensor:
        return plain_integrate(self.model.dit, self.noise, self._grid(steps), (null, known), self.text, _scale(known))

    def denoise(self, null: Conditioning, known: Conditioning, steps: int | None = None) -> Tensor:
        scale, times = _scale(known), self._grid(steps)
        channels = torch.stack([part.channels for part in branches(known, null, scale)])
        prepared = Prepared(self.model.dit, channels, times[:-1], text=self.text)
        return integrate(guided(prepared, scale), self.noise, times)

    def decode(self, latents: Tensor, views_at_once: int) -> tuple[Tensor, Tensor]:
        image, rays = split(latents)
        return decode_in_chunks(self.model.image_vae, image, views_at_once), decode_in_chunks(
            self.model.raymap_vae, rays, views_at_once
        )

    def sample_plain(self, steps: int | None = None) -> tuple[Tensor, Tensor]:
        return self.decode(self.denoise_plain(*self.encode_plain(), steps), len(self.images))

    def sample(self, steps: int | None = None) -> tuple[Tensor, Tensor]:
        return self.decode(self.denoise(*self.encode(), steps), 16)

    def _grid(self, steps: int | None) -> list[float]:
        return self.times if steps is None else [*self.times[:steps], 0.0]


def _scale(known: Conditioning) -> Tensor:
    return guidance_map(known, known=1.1, unknown=7.0)


def random_model(config: ModelConfig, seed: int) -> Loaded:
    """A model with random weights, none of which is zero, at which activations keep their size."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        dit, image_vae, raymap_vae = DiT(config.transformer), VAE(config.image_vae), VAE(config.raymap_vae)
        for network in (dit, image_vae, raymap_vae):
            network.requires_grad_(False).eval()
        for name, parameter in dit.named_parameters():
            if parameter.ndim > 1:
                gain = 0.2 if name.endswith(("to_out.0.weight", "ff.net.2.weight", "norm1.linear.weight")) else 0.5
                torch.nn.init.normal_(parameter, std=gain * parameter[0].numel() ** -0.5)
    return Loaded(dit=dit, image_vae=image_vae, raymap_vae=raymap_vae, config=config)


def _cell(model: Loaded, views: int, size: int, steps: int, seed: int) -> _Cell:
    generator = torch.Generator().manual_seed(seed)
    known = torch.zeros(views, 1, size, size)
    known[: max(views // 2, 1)] = 1
    width = model.config.transformer.text_width or 0
    return _Cell(
        model=model,
        text=torch.randn(1, WORDS, width, generator=generator),
        images=torch.rand(views, 3, size, size, generator=generator),
        image_known=known,
        raymaps01=torch.rand(views, 6, size, size, generator=generator),
        rays_known=torch.ones(views, 1, size, size),
        noise=torch.randn(views, 32, size // 8, size // 8, generator=generator),
        times=time_grid(steps),
    )


@torch.no_grad()
def run_networks(config: NetworksBenchmark = NetworksBenchmark(), *, on_cell: OnCell = lambda _: None) -> Report:
    """Measure everything; takes minutes with the default, seconds with `QUICK`."""
    report = Report(seed=config.seed)
    small = random_model(SMALL, config.seed)
    _cell(small, 2, 32, 1, config.seed).sample_plain()  # what torch sets up at first use
    for views, size in config.cells:
        on_cell(f"{views} views of {size}")
        report.rows.append(_sampling_row(_cell(small, views, size, config.steps, config.seed), config.runs))
    on_cell("savings one by one")
    views, size = config.cells[min(1, len(config.cells) - 1)]
    cell = _cell(small, views, size, config.steps, config.seed)
    report.rows.extend(_saving_rows(cell, config.runs))
    report.rows.append(_floor_row(cell, config.runs))
    report.bars.extend(_bars(report.rows))
    if config.full_size is not None:
        on_cell("one step of the released architecture")
        full = random_model(dataclasses.replace(SMALL, transformer=config.full_transformer), config.seed)
        report.rows.append(_full_size_row(_cell(full, *config.full_size, 2, config.seed), config.runs))
        report.bars.append(
            Bar(
                name="full-size step: relative difference",
                value=report.rows[-1]["relative_difference"],
                limit=1e-4,
                sense="<=",
            )
        )
    return report


def _sampling_row(cell: _Cell, runs: int) -> dict[str, Any]:
    """A whole sampling both ways, run in turn: medians of the whole and of its parts; times at 24 steps are put
    together from parts.
    """
    views, _, size, _ = cell.images.shape
    steps = len(cell.times) - 1
    ways = {
        "_plain": (cell.encode_plain, cell.denoise_plain, len(cell.images)),
        "": (cell.encode, cell.denoise, 16),
    }
    times: dict[str, dict[str, list[float]]] = {way: {part: [] for part in _PARTS} for way in ways}
    latents: dict[str, Tensor] = {}
    for _ in range(runs):
        for way, (encode, denoise, views_at_once) in ways.items():
            marks = [time.perf_counter()]
            null, known = encode()
            marks.append(time.perf_counter())
            latents[way] = denoise(null, known)
            marks.append(time.perf_counter())
            cell.decode(latents[way], views_at_once)
            marks.append(time.perf_counter())
            taken = (marks[3] - marks[0], marks[1] - marks[0], (marks[2] - marks[1]) / steps, marks[3] - marks[2])
            for part, seconds in zip(_PARTS, taken, strict=True):
                times[way][part].append(seconds)
    row: dict[str, Any] = {"part": "sampling", "views": views, "size": size, "steps": steps}
    median = {way: {part: statistics.median(values) for part, values in parts.items()} for way, parts in times.items()}
    for part in _PARTS:
        row |= {f"{part}{way}_seconds": median[way][part] for way in ways}
        row[f"{part}_ratio"] = median["_plain"][part] / median[""][part]
    usual = [parts["encoding"] + USUAL_STEPS * parts["step"] + parts["decoding"] for parts in median.values()]
    row[f"ratio_at_{USUAL_STEPS}_steps_from_parts"] = usual[0] / usual[1]
    row["relative_difference"] = relative_difference(latents[""], latents["_plain"])
    for name, job in (("plain_peak_bytes", cell.sample_plain), ("peak_bytes", cell.sample)):
        with LiveBytes() as live:
            job(1)
        row[name] = live.peak
    return row


def _saving_rows(cell: _Cell, runs: int) -> list[dict[str, Any]]:
    """One step's time as the savings are made one after the other, each with its difference from the plain step."""
    null, known = cell.encode()
    scale, dit, now = _scale(known), cell.model.dit, cell.times[0]

    def network(sequences: Tensor, times: Tensor) -> Tensor:
        return dit(sequences, times, cell.text.expand(len(sequences), -1, -1))

    def one_by_one(state: Tensor, at: float, views: Tensor | None = None) -> Tensor:
        return torch.cat([evaluated_by(network, [part])(state, at, views) for part in (null, known)])

    channels = torch.stack([null.channels, known.channels])
    prepared = Prepared(dit, channels, cell.times[:-1], text=cell.text)
    variants = {
        "three passes": lambda: plain_step(dit, cell.noise, now, (null, known), cell.text, scale),
        "no third pass for equal text": lambda: guided(one_by_one, scale)(cell.noise, now),
        "branches in one batch": lambda: guided(evaluated_by(network, [null, known]), scale)(cell.noise, now),
        "constants computed once": lambda: guided(prepared, scale)(cell.noise, now),
    }
    seconds, wanted = median_seconds(variants, max(runs, 2 * runs - 1)), variants["three passes"]()
    rows, before = [], seconds["three passes"]
    for name, job in variants.items():
        rows.append(
            {"part": "saving", "views": len(cell.noise), "size": cell.images.shape[-1], "saving": name,
             "step_seconds": seconds[name], "ratio_to_previous": before / seconds[name],
             "relative_difference": relative_difference(job(), wanted)}
        )  # fmt: skip
        before = seconds[name]
    return rows


def step_flops(config: DiTConfig, tokens: int, branch_count: int, words: int = WORDS, *, apart: int = 0) -> int:
    """Floating point operations of the matrix products in one prepared step (two per multiplication and addition).

    ``apart`` of the tokens are known and stand apart: no step computes them, but all others look at them.
    """
    width, patch = config.width, config.patch**2
    linear = width * width * (4 + 3 * config.mlp_ratio) + 2 * tokens * width
    if config.text_width:
        linear += 2 * width * width + 2 * words * width
    per_branch = (tokens - apart) * (config.depth * linear + width * patch * config.out_channels)
    return 2 * (branch_count * per_branch + tokens * width * patch * config.out_channels)


def _floor_row(cell: _Cell, runs: int) -> dict[str, Any]:
    """A step against the time that its matrix products would take at this machine's best rate for a large product."""
    null, known = cell.encode()
    prepared = Prepared(cell.model.dit, torch.stack([null.channels, known.channels]), cell.times[:-1], text=cell.text)
    square = torch.randn(1024, 1024)
    seconds = median_seconds(
        {"step": lambda: prepared(cell.noise, cell.times[0]), "product": lambda: square @ square}, 2 * runs + 1
    )
    rate = 2 * 1024**3 / seconds["product"]
    config = cell.model.config.transformer
    tokens = len(cell.noise) * cell.noise.shape[-1] * cell.noise.shape[-2] // config.patch**2
    floor = step_flops(config, tokens, 2) / rate
    return {
        "part": "floor", "views": len(cell.noise), "size": cell.images.shape[-1], "step_seconds": seconds["step"],
        "floor_seconds": floor, "share_of_floor": floor / seconds["step"], "matrix_gflops": rate / 1e9,
        "relative_difference": 0.0,
    }  # fmt: skip


def _full_size_row(cell: _Cell, runs: int) -> dict[str, Any]:
    """One step of the released architecture, without the preparation, whose time stands beside it."""
    null, known = cell.encode()
    scale, dit, now = _scale(known), cell.model.dit, cell.times[0]
    channels = torch.stack([null.channels, known.channels])
    prepared = Prepared(dit, channels, cell.times[:-1], text=cell.text)
    jobs = {
        "plain": lambda: plain_step(dit, cell.noise, now, (null, known), cell.text, scale),
        "ours": lambda: guided(prepared, scale)(cell.noise, now),
        "preparation": lambda: Prepared(dit, channels, cell.times[:-1], text=cell.text),
    }
    seconds = median_seconds(jobs, runs, warm_up=False)
    row: dict[str, Any] = {
        "part": "full-size step", "views": len(cell.noise), "size": cell.images.shape[-1],
        "parameters": sum(parameter.numel() for parameter in dit.parameters()),
        "step_plain_seconds": seconds["plain"], "step_seconds": seconds["ours"],
        "step_ratio": seconds["plain"] / seconds["ours"],
        "preparation_seconds": seconds["preparation"],
        "relative_difference": relative_difference(jobs["ours"](), jobs["plain"]()),
        "weight_bytes": sum(parameter.numel() * parameter.element_size() for parameter in dit.parameters()),
    }  # fmt: skip
    for name, job in (("plain_peak_bytes", jobs["plain"]), ("peak_bytes", jobs["ours"])):
        with LiveBytes() as live:
            job()
        row[name] = live.peak + row["weight_bytes"]
    return row


def _bars(rows: list[dict[str, Any]]) -> list[Bar]:
    samplings = [row for row in rows if row["part"] == "sampling"]
    at_usual = f"ratio_at_{USUAL_STEPS}_steps_from_parts"
    return [
        Bar(
            name="whole sampling, times faster, worst cell",
            value=min(row["sampling_ratio"] for row in samplings),
            limit=1.5,
            sense=">=",
        ),
        Bar(
            name=f"at {USUAL_STEPS} steps, times faster, worst cell",
            value=min(row[at_usual] for row in samplings),
            limit=1.5,
            sense=">=",
        ),
        Bar(
            name="encoding, times faster, worst cell",
            value=min(row["encoding_ratio"] for row in samplings),
            limit=6.0,
            sense=">=",
        ),
        Bar(
            name="relative difference, worst cell",
            value=max(row["relative_difference"] for row in samplings),
            limit=1e-4,
            sense="<=",
        ),
        Bar(
            name="peak memory over the plain one's, worst cell",
            value=max(row["peak_bytes"] / row["plain_peak_bytes"] for row in samplings),
            limit=1.0,
            sense="<=",
        ),
    ]
