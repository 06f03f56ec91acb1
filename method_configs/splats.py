"""nerfstudio methods: `fillerbuster`, its baseline without completion, the paper's protocols, and a 2D baseline.

The TrainerConfigs are built from parts: nerfstudio discovers plugins in the middle of importing its own
`configs.method_configs`, which therefore must not be imported here. This module is paid by every `ns-*` command.
"""

from __future__ import annotations

import copy
import dataclasses
from typing import Any, cast

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from fb_core.completion.options import CompletionConfig
from fb_nerfstudio.datamanager import FillerbusterDataManagerConfig
from fb_nerfstudio.splats.fused_adam import FusedAdamOptimizerConfig
from fb_nerfstudio.splats.schedulers import FloatExponentialDecaySchedulerConfig
from fb_nerfstudio.splats.splat_model import FillerbusterSplatModelConfig
from fb_nerfstudio.trainer import FillerbusterTrainerConfig

_ON_GPU = torch.cuda.is_available()
_ITERATIONS = 30000 if _ON_GPU else 3000


def _model() -> FillerbusterSplatModelConfig:
    """Splatfacto's defaults and a cap; without a GPU fewer Gaussians, simpler colours and a schedule of a tenth of the
    length.

    Normals are regularised from 10000 of 30000 steps on; in the short schedule from where Gaussians have ceased to
    split, since a tenth of that would meet geometry that has hardly begun to settle.
    """
    if _ON_GPU:
        return FillerbusterSplatModelConfig(max_gaussians=1_000_000)
    return FillerbusterSplatModelConfig(
        max_gaussians=20000,
        num_random=10000,
        sh_degree=1,
        num_downscales=0,
        warmup_length=300,
        stop_screen_size_at=1000,
        stop_split_at=2000,
        normal_loss_from=2000,
    )


def _optimizers() -> dict[str, Any]:
    """Splatfacto's learning rates; the decay of the means ends with the training."""

    def adam(lr: float, scheduler: FloatExponentialDecaySchedulerConfig | None = None) -> dict[str, Any]:
        return {"optimizer": FusedAdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": scheduler}

    def decay(lr_final: float, warmup_steps: int = 0) -> FloatExponentialDecaySchedulerConfig:
        return FloatExponentialDecaySchedulerConfig(
            lr_final=lr_final, max_steps=_ITERATIONS, warmup_steps=warmup_steps, lr_pre_warmup=0.0
        )

    return {
        "means": adam(1.6e-4, decay(1.6e-6)),
        "features_dc": adam(2.5e-3),
        "features_rest": adam(2.5e-3 / 20),
        "opacities": adam(5e-2),
        "scales": adam(5e-3),
        "quats": adam(1e-3),
        "camera_opt": adam(1e-4, decay(5e-7, warmup_steps=1000)),
        "bilateral_grid": adam(2e-3, decay(1e-4, warmup_steps=1000)),
    }


def _trainer() -> TrainerConfig:
    return FillerbusterTrainerConfig(
        method_name="fillerbuster",
        machine=MachineConfig(device_type="cuda" if _ON_GPU else "cpu"),
        max_num_iterations=_ITERATIONS,
        steps_per_save=2000 if _ON_GPU else 1000,
        steps_per_eval_batch=0,
        steps_per_eval_image=100 if _ON_GPU else 500,
        steps_per_eval_all_images=1000,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=FillerbusterDataManagerConfig(
                dataparser=NerfstudioDataParserConfig(load_3D_points=True),
                cache_images_type="uint8",
                completion=CompletionConfig(),
            ),
            model=_model(),
        ),
        optimizers=_optimizers(),
        # Listens on this machine only; depth would hide the frustums of generated views that stand behind a wall.
        viewer=ViewerConfig(websocket_host="127.0.0.1", num_rays_per_chunk=1 << 15, default_composite_depth=False),
        vis="viewer",
    )


def with_completion(config: TrainerConfig, method_name: str, **options: Any) -> TrainerConfig:
    """A copy under another name with other options of its completion; everything else is equal."""
    other = copy.deepcopy(config)
    other.method_name = method_name
    datamanager: Any = other.pipeline.datamanager
    datamanager.completion = dataclasses.replace(datamanager.completion, **options)
    return other


def without_completion(config: TrainerConfig, method_name: str) -> TrainerConfig:
    """A copy under another name whose datamanager generates nothing; everything else is equal."""
    return with_completion(config, method_name, enabled=False)


def optimized_as_in_the_paper(config: TrainerConfig, method_name: str) -> TrainerConfig:
    """A copy under another name that is optimised as the authors did (paper, section 3.2 and their released options).

    Gaussians start at random in a cube and have no harmonics; the loss is L1 alone; generated views are there from the
    first step, are trained on wholly and take half of the steps; nothing of ours mends them.
    """
    other = with_completion(
        config,
        method_name,
        at_step=0,
        context_choice="stride",
        anchor_views=24,
        trust="full",
        densify_rounds=4,
        generated_share=0.5,
        generated_steps="shared",
        generated_pixels="all",
        match_colors=False,
        seed_gaussians=False,
    )
    datamanager, model = cast(Any, other.pipeline.datamanager), cast(Any, other.pipeline.model)
    datamanager.start_points = 0
    datamanager.dataparser.load_3D_points = False
    steps = {"stop_screen_size_at": _ITERATIONS, "stop_split_at": _ITERATIONS}
    chosen = {
        "random_init": True,
        "sh_degree": 0,
        "ssim_lambda": 0.0,
        "num_downscales": 0,
        "use_scale_regularization": True,
    }
    other.pipeline.model = dataclasses.replace(model, **chosen, **steps)
    return other


fillerbuster = MethodSpecification(
    config=_trainer(),
    description="Complete a casual capture with multi-view diffusion, then train Gaussian splats on captured and "
    "generated views.",
)
fillerbuster_none = MethodSpecification(
    config=without_completion(fillerbuster.config, "fillerbuster-none"),
    description="The splats of fillerbuster on the captured views only (baseline).",
)
fillerbuster_paper = MethodSpecification(
    config=optimized_as_in_the_paper(fillerbuster.config, "fillerbuster-paper"),
    description="Complete a casual capture and optimise as the paper's authors did: random start, no harmonics, L1 "
    "alone.",
)
fillerbuster_cat3d_size = MethodSpecification(
    # No anchors: CAT3D's model has no room for them beside its conditioning.
    config=with_completion(
        fillerbuster.config,
        "fillerbuster-cat3d-size",
        context_views=3,
        anchor_views=0,
        densify_rounds=20,
        densify_views=6,
        trust="full",
    ),
    description="The paper's baseline with CAT3D's sequence size: 3 conditioning views, 20 rounds of 6 new ones.",
)
fillerbuster_masked = MethodSpecification(
    config=with_completion(
        fillerbuster.config, "fillerbuster-masked", task="inpaint", at_step=0, seed_gaussians=False, trust="full"
    ),
    description="Inpaint what masks leave unknown in 32 captured views, together and once, then train splats "
    "(NeRFiller's protocol).",
)
nerfiller_grid = MethodSpecification(
    config=with_completion(fillerbuster_masked.config, "nerfiller-grid", inpainter="grid"),
    description="fillerbuster-masked with a 2D inpainter on 2x2 grids of views: diffusers' from a folder, or OpenCV's "
    "without weights.",
)
