"""A recipe in miniature, a training of a tiny transformer that needs no data, and the child processes that share
one.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from pathlib import Path

import torch

from fb_core.data.training.sequences import PoolConfig
from fb_core.data.training.task import TaskConfig
from fb_core.flow import at_time, masked_loss, velocity
from fb_core.networks.transformer.dit import DiT, DiTConfig
from fb_core.networks.vae import VAEConfig
from fb_core.sampling import SamplingConfig
from fb_core.training.recipe import Recipe
from fb_core.training.run.distributed import Group, in_group, left_at_once, whole
from fb_core.training.run.loop import Run
from fb_core.training.run.options import EngineConfig, LoopConfig
from fb_core.training.run.stage import Stage, row_generator
from fb_core.training.stages.dit_stage import DiTLossConfig
from fb_core.training.stages.vae_stage import VAELossConfig

SMALL_VAE = {"widths": (8, 8, 8, 8), "encoder_resnets": 1, "decoder_resnets": 1, "norm": "none"}
TOY_LOOP = LoopConfig(steps=4, learning_rate=1e-3, warmup_steps=1, save_every=2)
TOY = Recipe(
    name="toy",
    image_vae=VAEConfig(**SMALL_VAE),
    raymap_vae=VAEConfig(in_channels=6, padding="replicate", **SMALL_VAE),
    dit=DiTConfig(heads=2, head_dim=16, depth=1, text_width=0),
    pool=PoolConfig(rooms=3, views=5, image_size=16, renewed_per_step=0.5, supersample=1),
    vae_pool=PoolConfig(rooms=2, views=4, image_size=16, renewed_per_step=0.5, supersample=1),
    image_vae_loop=TOY_LOOP,
    raymap_vae_loop=TOY_LOOP,
    dit_loop=TOY_LOOP,
    image_vae_loss=VAELossConfig(batch=2),
    raymap_vae_loss=VAELossConfig(batch=2),
    dit_loss=DiTLossConfig(batch=2, task=TaskConfig(views=4)),
    sampling=SamplingConfig(guidance_unknown=2.0, steps=3),
)
"""All three stages in miniature, on rooms."""

LOOP = LoopConfig(steps=20, learning_rate=3e-3, warmup_steps=2, save_every=7, average=0.9)


class TinyStage(Stage):
    """Flow matching on random latents; can be told to have a row whose data are not finite."""

    name, batch = "tiny", 4

    def __init__(self, bad: tuple[int, int] | None = None):
        torch.manual_seed(0)
        self.network = DiT(
            DiTConfig(heads=2, head_dim=8, depth=2, text_width=0)
        )  # torch's own weights: no layer starts at zero
        self.bad = bad

    def draw(self, step: int, rows: range) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        generators = [row_generator(0, step, row) for row in rows]
        sequence = torch.stack([torch.randn(3, 66, 4, 4, generator=generator) for generator in generators])
        times = torch.cat([torch.rand(1, generator=generator) for generator in generators])
        data, noise = sequence[:, :, :32] + sequence[:, :, 32:64], sequence[:, :, :32]
        if self.bad is not None and self.bad[0] == step:
            data = data / torch.tensor([float(row != self.bad[1]) for row in rows])[:, None, None, None, None]
        return torch.cat([at_time(data, noise, times), sequence[:, :, 32:]], dim=2), times, velocity(data, noise)

    def losses(self, drawn: tuple[torch.Tensor, torch.Tensor, torch.Tensor]) -> dict[str, torch.Tensor]:
        inputs, times, wanted = drawn
        error = masked_loss(self.network(inputs, times), wanted)
        return {"loss": error, "half": error / 2}


def losses_of(folder: Path) -> list[float]:
    return [json.loads(line)["loss"] for line in (folder / "log.jsonl").read_text().splitlines()]


def run_in(folder: Path, group: Group, *, bad: tuple[int, int] | None = None, **engine: bool | int) -> Run:
    def sheet(path: Path, state: dict[str, torch.Tensor]) -> dict[str, float]:
        path.write_text(f"{state['proj_out_2.weight'].shape}")
        return {"val": 0.0}

    options = EngineConfig(**engine)  # type: ignore[arg-type]
    return Run(TinyStage(bad), LOOP, folder, preset="tiny", engine=options, group=group, on_sheet=sheet)


def _child(folder: Path) -> None:
    """One of two processes: everything that the tests ask about, one after the other."""
    torch.set_num_threads(1)
    # No curves: importing it takes longer than the training.
    sys.modules["matplotlib"] = None  # type: ignore[assignment]
    with in_group(torch.device("cpu")) as (group, _):
        for name, engine in {
            "two": {},
            "parts": {"accumulate": 2},
            "sharded": {"shard": True, "accumulate": 2, "recompute": True, "sheet_every": 5},
        }.items():
            run_in(folder / name, group, **engine).train(at_most=9)
            resumed = run_in(folder / name, group, **engine)
            resumed.train()
            weights = whole(resumed.stage.network.state_dict()), resumed.averaged_state()
            if group.is_main:
                torch.save(weights, folder / name / "weights.pt")
        run_in(folder / "handed over", group).train(at_most=9)
        stopped = run_in(folder / "stopped", group)

        def stop_one(done: int, of: int, losses: dict[str, float]) -> None:
            if done == 3 and not group.is_main:
                os.kill(os.getpid(), signal.SIGTERM)

        stopped.train(on_progress=stop_one)
        try:
            run_in(folder / "bad", group, bad=(5, 3)).train()
            message = "nothing was wrong"
        except FloatingPointError as error:
            message = str(error)
        (folder / f"told-{group.rank}.json").write_text(
            json.dumps({"step": stopped.step, "signal": stopped.signal, "message": message})
        )


if __name__ == "__main__":
    with left_at_once():
        _child(Path(sys.argv[1]))
