"""Splatfacto that also runs on a CPU, resumes correctly, shows normals, and weighs known pixels only."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from gsplat.strategy.ops import remove
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.model_components import renderers
from nerfstudio.model_components.lib_bilagrid import BilateralGrid, color_correct, total_variation_loss
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils.colors import get_color
from torch import Tensor

from fb_core.evaluation.metrics.lazy_lpips import LazyLpips
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.normals import normal_picture, normals_from_depth
from fb_core.geometry.rotations import flip_axes
from fb_core.splatting.normal_losses import blended_normals, gaussian_normals
from fb_core.splatting.spherical_harmonics import sh_colors
from fb_nerfstudio.splats.backend import render_splats
from fb_nerfstudio.splats.drawn_camera import one_pinhole, shrunk, with_unit_axes
from fb_nerfstudio.splats.gaussians import colors_of, evenly_chosen, first_gaussians, gaussians_at, require_points
from fb_nerfstudio.splats.panoramas import draw_panorama, is_panorama
from fb_nerfstudio.splats.strategies.choice import strategy_of
from fb_nerfstudio.splats.strategies.densification import append_rows
from fb_nerfstudio.splats.strategies.mcmc import penalize
from fb_nerfstudio.splats.supervision import Supervision, empty_outputs, known_colors_smaller, known_share, needles

logger = logging.getLogger(__name__)

_VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""Viser's default grey: what stands behind renders where training uses random backgrounds."""
_FINAL_STEP = 30000
"""The step a restored model pretends to be at until training sets it: harmonics and resolution are final then."""


@dataclass
class FillerbusterSplatModelConfig(SplatfactoModelConfig):
    """Splatfacto's options, and ours for normals and for machines without a GPU."""

    _target: type = field(default_factory=lambda: FillerbusterSplatModel)
    """target class to instantiate"""
    strategy: Literal["default", "mcmc"] = "default"
    """How Gaussians multiply: by screen gradients (3DGS), or by Monte Carlo relocation up to the limit, without opacity
    resets (MCMC).
    """
    max_gaussians: int | None = None
    """Most Gaussians that initialisation, densification and added points may lead to; None for no limit. A CPU wants
    about 20000.
    """
    mcmc_noise_lr: float = 5e5
    """MCMC: noise on the positions of nearly transparent Gaussians, times the means' learning rate and their
    covariance.
    """
    mcmc_opacity_penalty: float = 0.01
    """MCMC: weight of the mean opacity, in views that draw the Gaussian; what nobody needs fades and moves
    elsewhere.
    """
    mcmc_scale_penalty: float = 0.01
    """MCMC: weight of the mean standard deviation (scene units), in views that draw the Gaussian."""
    output_normals: bool = True
    """Also render `normal` and `surface_normal` in the viewer and in evaluation."""
    normal_loss_from: int = 10000
    """Training step from which the normal losses act; geometry must have settled."""
    normal_alignment: Literal["squared", "absolute"] = "squared"
    """Alignment of Gaussian and depth normals: the paper's squared L2, or the released code's L1 on pictures (its
    weight: 0.1).
    """
    normal_alignment_weight: float = 0.01
    """Weight of the alignment loss; 0 turns it off."""
    normal_tv_weight: float = 0.001
    """Weight of the total variation of rendered normals; 0 turns it off."""

    def __post_init__(self) -> None:
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise ValueError(f"max_gaussians: expected at least 1 or None for no limit, got {self.max_gaussians}")
        if self.strategy not in ("default", "mcmc"):
            raise ValueError(f"strategy: expected 'default' or 'mcmc', got {self.strategy!r}")
        if min(self.mcmc_noise_lr, self.mcmc_opacity_penalty, self.mcmc_scale_penalty) < 0:
            raise ValueError(
                "mcmc_noise_lr, mcmc_opacity_penalty and mcmc_scale_penalty: expected values >= 0, got "
                f"{self.mcmc_noise_lr}, {self.mcmc_opacity_penalty} and {self.mcmc_scale_penalty}"
            )
        if min(self.normal_alignment_weight, self.normal_tv_weight) < 0:
            raise ValueError(
                "normal_alignment_weight and normal_tv_weight: expected values >= 0, got "
                f"{self.normal_alignment_weight} and {self.normal_tv_weight}"
            )


class FillerbusterSplatModel(SplatfactoModel):
    """Gaussian splatting; gsplat draws where the parameters are on CUDA, our torch rasterizer everywhere else."""

    config: FillerbusterSplatModelConfig

    def populate_modules(self) -> None:
        """Everything that splatfacto sets up, without its move to CUDA and without LPIPS as a submodule (a download at
        start).
        """
        config = self.config
        limit, random = config.max_gaussians, (config.num_random, config.random_scale)
        seeds = None if config.random_init else self.seed_points
        gaussians = first_gaussians(seeds, random=random, limit=limit, sh_degree=config.sh_degree)
        self.gauss_params = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(values) for name, values in gaussians.items()}
        )
        self.camera_optimizer = config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        if config.use_bilateral_grid:
            x, y, w = config.grid_shape
            self.bil_grids = BilateralGrid(num=self.num_train_data, grid_X=x, grid_Y=y, grid_W=w)
        self.step = 0
        self.info: dict[str, Any] = {}
        self.info_beside: dict[str, Any] | None = None
        self.crop_box: OrientedBox | None = None
        self.background_color = (
            torch.tensor(_VIEWER_BACKGROUND)
            if config.background_color == "random"
            else get_color(config.background_color)
        )
        self.lpips = LazyLpips()
        self.strategy = strategy_of(config, views=self.num_train_data)
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def load_state_dict(self, dict: Mapping[str, Any], **kwargs: Any) -> Any:  # type: ignore[override]
        """Load Gaussians of any number into the very parameters that the optimizers hold.

        Splatfacto makes new parameters here, after the optimizers were created; a resumed run then trains nothing.
        """
        state = {f"gauss_params.{key}" if key in self.gauss_params else key: value for key, value in dict.items()}
        self.step = _FINAL_STEP
        self.info = {}
        count = len(state["gauss_params.means"])
        for param in self.gauss_params.values():
            param.grad = None
            param.data = param.data.new_zeros(count, *param.shape[1:])
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)
        state.setdefault(
            "_extra_state", {"strategy": {}}
        )  # checkpoints of earlier versions and of splatfacto have none
        return super(SplatfactoModel, self).load_state_dict(state, **kwargs)

    def get_extra_state(self) -> dict[str, Any]:
        """The strategy's running sums, so that the next refinement after a resumption is the one that was due."""
        return {"strategy": dict(self.strategy_state)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`get_extra_state` gave."""
        for name, value in state["strategy"].items():
            self.strategy_state[name] = value.to(self.device) if isinstance(value, Tensor) else value

    @property
    def room(self) -> int | None:
        """Gaussians that the limit leaves room for; None without a limit."""
        limit = self.config.max_gaussians
        return None if limit is None else max(limit - self.num_points, 0)

    @torch.no_grad()
    def add_gaussians(self, points: Float[Tensor, "m 3"], colors: Float[Tensor, "m 3"], optimizers: Optimizers) -> int:
        """Append Gaussians at world ``points`` with ``colors`` in [0, 1] during training; returns how many were added.

        Call it between iterations. The other Gaussians keep values and optimizer state. New ones are twice as opaque as
        the culling threshold, as after an opacity reset, lest the next refinement remove them. Where ``max_gaussians``
        leaves less room an evenly spread part of the points is taken.

        Raises ValueError when points and colors disagree in shape or are not finite.
        """
        require_points(points, colors)
        chosen = evenly_chosen(len(points), len(points) if self.room is None else self.room).to(points.device)
        if len(chosen) == 0:
            return 0
        points, colors = points[chosen].to(self.means), colors[chosen].to(self.means)
        opacity, among = min(2 * self.config.cull_alpha_thresh, 0.5), self.means.detach()
        rows = gaussians_at(points, colors, sh_degree=self.config.sh_degree, opacity=opacity, among=among)
        append_rows(self.gauss_params, optimizers.optimizers, self.strategy_state, rows)
        self._gaussians_changed(optimizers)
        return len(chosen)

    @torch.no_grad()
    def remove_gaussians(self, chosen: Bool[Tensor, " m"], optimizers: Optimizers) -> int:
        """Take the chosen Gaussians away during training, between iterations; returns how many went. Never the last of
        all.

        The others keep values and optimizer state.
        """
        chosen = chosen.to(self.device)
        if not bool(chosen.any()) or bool(chosen.all()):
            return 0
        remove(params=self.gauss_params, optimizers=optimizers.optimizers, state=self.strategy_state, mask=chosen)
        self._gaussians_changed(optimizers)
        return int(chosen.sum())

    def _gaussians_changed(self, optimizers: Optimizers) -> None:
        for name in self.gauss_params:
            if name in optimizers.parameters:  # what gradient clipping reads
                optimizers.parameters[name] = [self.gauss_params[name]]
        self.info = {}

    # ---------------------------------------------------------------------------------------------------- rendering

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one camera: rgb, accumulation, background; in evaluation also depth, normal, surface_normal ([h, w,
        c]).

        Normals are pictures in [0, 1] (see ``normal_picture``). Training renders depth and normals only when a loss or
        ``output_depth_during_training`` needs them. Raises ValueError for anything but one camera.
        """
        if not self.training and is_panorama(camera):
            return draw_panorama(camera, self.get_outputs)
        pinhole = self.drawn_camera(camera)
        self.last_size = (pinhole.height, pinhole.width)
        background = self._get_background_color()
        splats = self._cropped_splats()
        if len(splats["means"]) == 0:
            empty = self.get_empty_outputs(pinhole.width, pinhole.height, background)
            return empty if self.config.output_normals else {k: v for k, v in empty.items() if not k.endswith("normal")}
        with_normals = self._normals_wanted()
        with_depth = with_normals or not self.training or self.config.output_depth_during_training
        render, alpha, info = self._rasterize(splats, pinhole, with_normals, with_depth)
        if self.training:
            self.info = info  # of training renders only: the strategy reads it after the backward pass
            self.strategy.step_pre_backward(self.gauss_params, self.optimizers, self.strategy_state, self.step, info)
        rgb = (render[..., :3] + (1 - alpha) * background).clamp(0.0, 1.0)
        index = (camera.metadata or {}).get("cam_idx")  # generated views have none
        if self.config.use_bilateral_grid and self.training and index is not None:
            rgb = self._apply_bilateral_grid(rgb[None], index, pinhole.height, pinhole.width)[0]
        outputs = {
            "rgb": rgb,
            "accumulation": alpha,
            "background": background if self.training else background.expand_as(rgb),
        }
        if with_depth:
            depth = render[..., -1:]
            outputs["depth"] = torch.where(alpha > 0, depth, depth.detach().max())
        if with_normals:
            outputs["normal"] = normal_picture(blended_normals(render[..., 3:6]))
            surface = torch.where(alpha > 0, render[..., -1:], 0.0).squeeze(-1)
            outputs["surface_normal"] = normal_picture(normals_from_depth(surface[None], pinhole)[0])
        return outputs

    @staticmethod
    def get_empty_outputs(width: int, height: int, background: Tensor) -> dict[str, Tensor]:
        """The outputs of a view that contains no Gaussian; all keys of a full one."""
        return empty_outputs(width, height, background)

    def drawn_camera(self, camera: Cameras) -> Pinholes:
        """The camera with the optimizer's correction, at the resolution of this stage of training.

        Raises ValueError for anything but one camera.
        """
        pinhole = one_pinhole(camera).to(self.device, self.means.dtype)
        if self.training:
            corrected = self.camera_optimizer.apply_to_camera(camera).reshape(-1, 3, 4)
            pinhole = dataclasses.replace(pinhole, camera_to_world=flip_axes(corrected))
        else:
            pinhole = with_unit_axes(pinhole)
        return shrunk(pinhole, self._get_downscale_factor())

    def _get_background_color(self) -> Tensor:
        """As in splatfacto; renders of a camera path with a crop have the crop's own."""
        override = None if self.training else renderers.BACKGROUND_COLOR_OVERRIDE
        return super()._get_background_color() if override is None else override.to(self.device)

    def _cropped_splats(self) -> dict[str, Tensor]:
        """The Gaussians' parameters; in evaluation those inside the crop box, if there is one."""
        if self.crop_box is None or self.training:
            return dict(self.gauss_params.items())
        inside = self.crop_box.within(self.means).reshape(-1)
        return {name: values[inside] for name, values in self.gauss_params.items()}

    def _normals_wanted(self) -> bool:
        config = self.config
        if not self.training:
            return config.output_normals
        return self.step >= config.normal_loss_from and max(config.normal_alignment_weight, config.normal_tv_weight) > 0

    def _rasterize(
        self, splats: dict[str, Tensor], pinhole: Pinholes, with_normals: bool, with_depth: bool
    ) -> tuple[Float[Tensor, "h w x"], Float[Tensor, "h w 1"], dict[str, Any]]:
        """Channels: 3 colours, then 3 summed normals in the camera frame if wanted, then expected z-depth if wanted."""
        config = self.config
        colors, sh_degree = colors_of(splats, min(self.step // config.sh_degree_interval, config.sh_degree))
        if with_normals:  # beside normals in one pass, harmonics must be evaluated beforehand
            if sh_degree is not None:
                colors, sh_degree = sh_colors(sh_degree, splats["means"] - pinhole.centers, colors), None
            normals = gaussian_normals(splats["means"], splats["quats"], splats["scales"], pinhole)
            colors = torch.cat([colors, normals], dim=-1)
        scales, opacities = splats["scales"].exp(), splats["opacities"].sigmoid().squeeze(-1)
        if self.training and self.config.strategy == "mcmc":
            penalize(scales, self.config.mcmc_scale_penalty)
            penalize(opacities, self.config.mcmc_opacity_penalty)
        drawn = render_splats(
            means=splats["means"],
            quats=splats["quats"],
            scales=scales,
            opacities=opacities,
            colors=colors,
            viewmats=pinhole.world_to_camera,
            Ks=pinhole.intrinsics,
            width=pinhole.width,
            height=pinhole.height,
            sh_degree=sh_degree,
            render_mode="RGB+ED" if with_depth else "RGB",
            absgrad=self.strategy.absgrad and self.training,
            rasterize_mode=self.config.rasterize_mode,
        )
        return drawn.colors[0], drawn.alphas[0], drawn.meta

    # ------------------------------------------------------------------------------------------- losses and metrics

    def get_loss_dict(
        self, outputs: dict[str, Tensor], batch: dict[str, Any], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Splatfacto's losses over known pixels (``batch["mask"]``, 1 = known) and the normal losses from their step
        on.

        ``batch["view_weight"]`` (default 1) multiplies what this view contributes, ``batch["trust"]`` (default 1) what
        each of its pixels does; neither touches the regularisers of the scene. ``batch["beside"]``, if any, is the
        camera and the batch of a second view of the same step, whose losses are named ``beside_...``.
        """
        config = self.config
        losses = self._view_losses(outputs, batch) | {"scale_reg": self._scale_regularization()}
        if self.training:
            if "beside" in batch:
                losses |= self._losses_beside(*batch["beside"])
            self.camera_optimizer.get_loss_dict(losses)
            if config.use_bilateral_grid:
                losses["tv_loss"] = 10 * total_variation_loss(self.bil_grids.grids)
        return losses

    def _view_losses(self, outputs: dict[str, Tensor], batch: dict[str, Any]) -> dict[str, Tensor]:
        """What one view says of the scene."""
        config, seen = self.config, self._supervision(outputs, batch)
        losses = {"main_loss": seen.photometric(outputs["rgb"], ssim_lambda=config.ssim_lambda)}
        if self.training and self._normals_wanted():
            weights = {"alignment": config.normal_alignment_weight, "tv": config.normal_tv_weight}
            losses |= seen.normals(outputs["normal"], outputs["surface_normal"], weights, form=config.normal_alignment)
        return losses

    def _losses_beside(self, camera: Cameras, batch: dict[str, Any]) -> dict[str, Tensor]:
        """Those of a second view, whose screen gradients are counted after the backward pass as well."""
        first = self.info
        losses = self._view_losses(self(camera), batch)
        self.info, self.info_beside = first, self.info
        return {f"beside_{name}": loss for name, loss in losses.items()}

    def step_post_backward(self, step: int) -> None:
        """Called after an iteration: the strategy counts what was drawn, and refines when it is time."""
        if self.info_beside is not None:
            self.strategy.count(self.gauss_params, self.strategy_state, step, self.info_beside)
            self.info_beside = None
        super().step_post_backward(step)

    def _scale_regularization(self) -> Float[Tensor, ""]:
        """Penalty on needles (PhysGaussian), every tenth step if it is on at all."""
        if not self.config.use_scale_regularization or self.step % 10:
            return self.means.new_zeros(())
        return needles(self.scales, self.config.max_gauss_ratio)

    def _supervision(self, outputs: dict[str, Tensor], batch: dict[str, Any]) -> Supervision:
        """What the batch says of a render, at the current resolution."""
        image, smaller = batch["image"], lambda picture: self._downscale_if_required(picture).to(self.device)
        if "mask" in batch and image.shape[-1] == 3 and self._get_downscale_factor() > 1:
            target = known_colors_smaller(batch, smaller)
        else:
            target = self.composite_with_background(self.get_gt_img(image), outputs["background"])
        trust = smaller(batch["trust"].float()) if "trust" in batch else None
        weight = batch.get("view_weight", 1.0)
        return Supervision(target=target, known=known_share(batch, smaller), trust=trust, weight=weight)

    @torch.no_grad()
    def get_metrics_dict(self, outputs: dict[str, Tensor], batch: dict[str, Any]) -> dict[str, Any]:
        """PSNR over known pixels and the number of Gaussians."""
        seen, rgb = self._supervision(outputs, batch), outputs["rgb"]
        metrics: dict[str, Any] = {"psnr": seen.psnr(rgb), "gaussian_count": self.num_points}
        if self.config.color_corrected_metrics:
            metrics["cc_psnr"] = seen.psnr(color_correct(rgb, seen.target))
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    @torch.no_grad()
    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and, where its weights are at hand, LPIPS over known pixels; and the pair target | render."""
        seen, rgb = self._supervision(outputs, batch), outputs["rgb"]
        metrics = seen.metrics(rgb, self.lpips)
        if self.config.color_corrected_metrics:
            corrected = seen.metrics(color_correct(rgb, seen.target), self.lpips)
            metrics |= {f"cc_{name}": value for name, value in corrected.items()}
        return metrics, {"img": torch.cat([seen.target, rgb], dim=1)}
