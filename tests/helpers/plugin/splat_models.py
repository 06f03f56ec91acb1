"""Splat models at toy size, their cameras and steps."""

from __future__ import annotations

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.optimizers import Optimizers

from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.bridge import to_nerfstudio
from fb_nerfstudio.splats.fused_adam import FusedAdamOptimizerConfig
from fb_nerfstudio.splats.schedulers import FloatExponentialDecaySchedulerConfig
from fb_nerfstudio.splats.splat_model import FillerbusterSplatModel, FillerbusterSplatModelConfig

SIZE = 32


def make_model(points: int = 60, *, seed: int = 0, **options) -> FillerbusterSplatModel:
    """A model of seed points in a box two units in front of :func:`camera`."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(points, 3, generator=generator) * 2 - 1
    colors = torch.randint(0, 256, (points, 3), generator=generator).to(torch.uint8)
    settings = {"num_downscales": 0, "sh_degree": 1, "sh_degree_interval": 1} | options
    return FillerbusterSplatModelConfig(**settings).setup(
        scene_box=SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
        num_train_data=4,
        seed_points=(positions, colors),
    )


def make_optimizers(model: FillerbusterSplatModel, lr: float = 1e-2) -> Optimizers:
    groups = model.get_param_groups()
    schedule = FloatExponentialDecaySchedulerConfig(lr_final=lr / 100, max_steps=100)
    config = {name: {"optimizer": FusedAdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": schedule} for name in groups}
    return Optimizers(config, groups)


def camera(size: int = SIZE, distance: float = 3.0) -> Cameras:
    pinhole = Pinholes.looking_at(
        torch.tensor([[0.0, -distance, 0.5]]),
        torch.zeros(1, 3),
        up=torch.tensor([0.0, 0.0, 1.0]),
        fov_degrees=50.0,
        width=size,
        height=size,
    )
    return to_nerfstudio(pinhole)


def make_batch(size: int = SIZE) -> dict:
    return {"image": torch.randint(0, 256, (size, size, 3), generator=torch.Generator().manual_seed(5)).to(torch.uint8)}


def train_step(
    model: FillerbusterSplatModel, optimizers: Optimizers, step: int, batch: dict | None = None
) -> dict[str, torch.Tensor]:
    """One iteration in the order of nerfstudio's trainer."""
    batch = make_batch() if batch is None else batch
    model.train()
    model.step_cb(optimizers, step)
    optimizers.zero_grad_all()
    outputs = model(camera(batch["image"].shape[0]))
    losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
    sum(losses.values()).backward()
    optimizers.optimizer_step_all()
    for scheduler in optimizers.schedulers.values():
        scheduler.step()
    model.step_post_backward(step)
    return losses


def held(optimizers: Optimizers, name: str) -> torch.nn.Parameter:
    return optimizers.optimizers[name].param_groups[0]["params"][0]
