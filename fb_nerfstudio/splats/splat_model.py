"""Splatfacto that also runs on a CPU, resumes correctly, shows normals, and weighs known pixels only."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import torch.nn.functional as F
from gsplat.strategy.ops import remove
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.model_components import renderers
from nerfstudio.model_components.lib_bilagrid import BilateralGrid, color_correct, total_variation_loss
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.utils.colors import get_color
from torch import Tensor

from fb_core.evaluation.metrics.lazy_lpips import LazyLpips
from fb_core.files.faults import Refused
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.normals import normal_picture, normals_from_depth, normals_of_picture
from fb_core.masks import resampled
from fb_core.splatting import photometric
from fb_core.splatting.normal_losses import alignment_loss, blended_normals, gaussian_normals, total_variation
from fb_core.splatting.spherical_harmonics import sh_colors
from fb_nerfstudio.bridge import batch_image, flip_axes, to_pinholes
from fb_nerfstudio.splats.backend import render_splats
from fb_nerfstudio.splats.densification import CappedStrategy, append_rows
from fb_nerfstudio.splats.gaussians import evenly_chosen, gaussians_at, random_points
from fb_nerfstudio.splats.mcmc import CappedMCMC, penalize
from fb_nerfstudio.splats.panoramas import draw_panorama, is_panorama

logger = logging.getLogger(__name__)

_VIEWER_BACKGROUND = (0.1490, 0.1647, 0.2157)
"""Viser's default grey: what stands behind renders where training uses random backgrounds."""
_MOST_WITHOUT_LIMIT = 1_000_000
"""Where MCMC stops growing without a limit: it grows until one is reached (gsplat's default)."""
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
        self.gauss_params = torch.nn.ParameterDict(
            {name: torch.nn.Parameter(values) for name, values in self._initial_gaussians().items()}
        )
        self.camera_optimizer = config.camera_optimizer.setup(num_cameras=self.num_train_data, device="cpu")
        if config.use_bilateral_grid:
            x, y, w = config.grid_shape
            self.bil_grids = BilateralGrid(num=self.num_train_data, grid_X=x, grid_Y=y, grid_W=w)
        self.step = 0
        self.info: dict[str, Any] = {}
        self.crop_box: OrientedBox | None = None
        self.background_color = (
            torch.tensor(_VIEWER_BACKGROUND)
            if config.background_color == "random"
            else get_color(config.background_color)
        )
        self.lpips = LazyLpips()
        self.strategy = self._make_strategy()
        self.strategy_state = self.strategy.initialize_state(scene_scale=1.0)

    def _initial_gaussians(self) -> dict[str, Tensor]:
        config = self.config
        limit = config.max_gaussians
        if self.seed_points is not None and len(self.seed_points[0]) > 0 and not config.random_init:
            points, colors = self.seed_points[0].float(), self.seed_points[1].float() / 255.0
            if len(colors) != len(points):  # nerfstudio allows points without colours
                colors = torch.rand(len(points), 3)
        else:
            points, colors = random_points(
                config.num_random if limit is None else min(config.num_random, limit), config.random_scale
            )
        chosen = evenly_chosen(len(points), len(points) if limit is None else limit)
        return gaussians_at(points[chosen], colors[chosen], sh_degree=config.sh_degree)

    def _make_strategy(self) -> CappedStrategy | CappedMCMC:
        config = self.config
        if config.strategy == "mcmc":
            return CappedMCMC(
                cap_max=_MOST_WITHOUT_LIMIT if config.max_gaussians is None else config.max_gaussians,
                noise_lr=config.mcmc_noise_lr,
                refine_start_iter=config.warmup_length,
                refine_stop_iter=config.stop_split_at,
                refine_every=config.refine_every,
            )
        return CappedStrategy(
            prune_opa=config.cull_alpha_thresh,
            grow_grad2d=config.densify_grad_thresh,
            grow_scale3d=config.densify_size_thresh,
            grow_scale2d=config.split_screen_size,
            prune_scale3d=config.cull_scale_thresh,
            prune_scale2d=config.cull_screen_size,
            refine_scale2d_stop_iter=config.stop_screen_size_at,
            refine_start_iter=config.warmup_length,
            refine_stop_iter=config.stop_split_at,
            reset_every=config.reset_alpha_every * config.refine_every,
            refine_every=config.refine_every,
            pause_refine_after_reset=self.num_train_data + config.refine_every,
            absgrad=config.use_absgrad,
            max_gaussians=config.max_gaussians,
        )

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
        if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape:
            raise ValueError(
                f"points and colors: expected two shapes [m, 3], got {list(points.shape)} and {list(colors.shape)}"
            )
        if not bool(points.isfinite().all() and colors.isfinite().all()):
            raise ValueError("points and colors: expected finite values, got NaN or infinity; drop those points first")
        chosen = evenly_chosen(len(points), len(points) if self.room is None else self.room).to(points.device)
        if len(chosen) == 0:
            return 0
        points, colors = points[chosen].to(self.means), colors[chosen].to(self.means)
        rows = gaussians_at(
            points,
            colors,
            sh_degree=self.config.sh_degree,
            opacity=min(2 * self.config.cull_alpha_thresh, 0.5),
            among=self.means.detach(),
        )
        append_rows(self.gauss_params, optimizers.optimizers, self.strategy_state, rows)
        for name in rows:
            if name in optimizers.parameters:  # what gradient clipping reads
                optimizers.parameters[name] = [self.gauss_params[name]]
        self.info = {}
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
        for name in self.gauss_params:
            if name in optimizers.parameters:  # what gradient clipping reads
                optimizers.parameters[name] = [self.gauss_params[name]]
        self.info = {}
        return int(chosen.sum())

    # ---------------------------------------------------------------------------------------------------- rendering

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor]:
        """Render one camera: rgb, accumulation, background; in evaluation also depth, normal, surface_normal ([h, w,
        c]).

        Normals are pictures in [0, 1] (see ``normal_picture``). Training renders depth and normals only when a loss or
        ``output_depth_during_training`` needs them. Raises ValueError for anything but one camera.
        """
        if (
            not self.training
            and isinstance(camera, Cameras)
            and camera.camera_to_worlds.numel() == 12
            and is_panorama(camera)
        ):
            return draw_panorama(camera, self.get_outputs)
        pinhole = self._pinhole(camera)
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
        rgb = background.expand(height, width, 3)
        no_normal = torch.full_like(rgb, 0.5)
        return {
            "rgb": rgb,
            "accumulation": rgb.new_zeros(height, width, 1),
            "background": rgb,
            "depth": rgb.new_full((height, width, 1), 10.0),
            "normal": no_normal,
            "surface_normal": no_normal,
        }

    def _pinhole(self, camera: Cameras) -> Pinholes:
        """The camera with the optimizer's correction, at the resolution of this stage of training."""
        if isinstance(camera, RayBundle):
            raise Refused(
                "splats are drawn picture by picture and answer no single rays; ns-export has gaussian-splat and "
                "cameras for them"
            )
        if not isinstance(camera, Cameras) or camera.camera_to_worlds.numel() != 12:
            got = (
                f"{camera.camera_to_worlds.numel() // 12} cameras"
                if isinstance(camera, Cameras)
                else type(camera).__name__
            )
            raise ValueError(f"camera: expected one nerfstudio camera, got {got}; render cameras one by one")
        # ns-render reads the focal lengths of camera paths in double precision.
        pinhole = to_pinholes(camera).to(self.device, self.means.dtype)
        if not self.training:  # paths of scaled scenes (nerfstudio's Blender add-on) carry the scale in their rotations
            turn = F.normalize(pinhole.rotations, dim=1)
            pinhole = dataclasses.replace(
                pinhole, camera_to_world=torch.cat([turn, pinhole.camera_to_world[:, :, 3:]], dim=2)
            )
        if self.training:
            corrected = self.camera_optimizer.apply_to_camera(camera).reshape(-1, 3, 4)
            pinhole = dataclasses.replace(pinhole, camera_to_world=flip_axes(corrected))
        factor = self._get_downscale_factor()
        if factor == 1:
            return pinhole
        # Not Pinholes.scaled: images are averaged over whole blocks and a remainder is dropped, so the factor is exact.
        return dataclasses.replace(
            pinhole,
            focal=pinhole.focal / factor,
            principal=pinhole.principal / factor,
            width=pinhole.width // factor,
            height=pinhole.height // factor,
        )

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
        colors, sh_degree = self._colors(splats, pinhole, evaluate_harmonics=with_normals)
        if with_normals:
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

    def _colors(
        self, splats: dict[str, Tensor], pinhole: Pinholes, *, evaluate_harmonics: bool
    ) -> tuple[Tensor, int | None]:
        """Colours or harmonics, and their degree. Beside normals in one pass, harmonics must be evaluated
        beforehand.
        """
        if self.config.sh_degree == 0:
            return splats["features_dc"].sigmoid(), None
        degree = min(self.step // self.config.sh_degree_interval, self.config.sh_degree)
        coefficients = torch.cat([splats["features_dc"][:, None], splats["features_rest"]], dim=1)
        if not evaluate_harmonics:
            return coefficients, degree
        return sh_colors(degree, splats["means"] - pinhole.centers, coefficients), None

    # ------------------------------------------------------------------------------------------- losses and metrics

    def get_loss_dict(
        self, outputs: dict[str, Tensor], batch: dict[str, Any], metrics_dict: Any = None
    ) -> dict[str, Tensor]:
        """Splatfacto's losses over known pixels (``batch["mask"]``, 1 = known) and the normal losses from their step
        on.

        ``batch["view_weight"]`` (default 1) multiplies what this view contributes, ``batch["trust"]`` (default 1) what
        each of its pixels does; neither touches the regularisers of the scene.
        """
        config, known, weight = self.config, self._known(batch), batch.get("view_weight", 1.0)
        target, rgb, trust = self._target(outputs, batch), outputs["rgb"], self._trust(batch)
        main = (1 - config.ssim_lambda) * photometric.l1(rgb, target, known, trust)
        if config.ssim_lambda > 0:
            main = main + config.ssim_lambda * photometric.dissimilarity(rgb, target, known, trust)
        losses = {"main_loss": weight * main, "scale_reg": self._scale_regularization()}
        if self.training and self._normals_wanted():
            if trust is not None:  # losses of normals are means over what counts: of so much of it, by so much weight
                mean, known = photometric.known_mean(trust, known), trust if known is None else known * trust
                weight = weight * mean
            losses |= {name: weight * value for name, value in self._normal_losses(outputs, known).items()}
        if self.training:
            self.camera_optimizer.get_loss_dict(losses)
            if config.use_bilateral_grid:
                losses["tv_loss"] = 10 * total_variation_loss(self.bil_grids.grids)
        return losses

    def _normal_losses(self, outputs: dict[str, Tensor], known: Tensor | None) -> dict[str, Tensor]:
        config, losses = self.config, {}
        if config.normal_alignment_weight > 0:
            rendered, surface = normals_of_picture(outputs["normal"]), normals_of_picture(outputs["surface_normal"])
            alignment = alignment_loss(rendered, surface, known, form=config.normal_alignment)
            losses["normal_alignment"] = config.normal_alignment_weight * alignment
        if config.normal_tv_weight > 0:
            losses["normal_tv"] = config.normal_tv_weight * total_variation(outputs["normal"], known)
        return losses

    def _scale_regularization(self) -> Float[Tensor, ""]:
        """Penalty on needles (PhysGaussian), every tenth step if it is on at all."""
        if not self.config.use_scale_regularization or self.step % 10:
            return self.means.new_zeros(())
        log_ratio = self.scales.amax(dim=-1) - self.scales.amin(dim=-1)
        return 0.1 * (log_ratio.exp() - self.config.max_gauss_ratio).clamp_min(0.0).mean()

    def _target(self, outputs: dict[str, Tensor], batch: dict[str, Any]) -> Float[Tensor, "h w 3"]:
        """The batch's picture at the current resolution."""
        image = batch["image"]
        if (
            "mask" in batch and image.shape[-1] == 3 and self._get_downscale_factor() > 1
        ):  # unknown colours must not be mixed in
            mask = batch["mask"].reshape(1, *image.shape[:2]).float()
            smaller = resampled(
                batch_image(batch), mask, lambda both: self._downscale_if_required(both.movedim(0, -1)).movedim(-1, 0)
            )
            return smaller[0].movedim(0, -1).to(self.device)
        return self.composite_with_background(self.get_gt_img(image), outputs["background"])

    def _known(self, batch: dict[str, Any]) -> Float[Tensor, "h w 1"] | None:
        """The batch's mask at the current resolution; fractions where a block is known in part."""
        if "mask" not in batch:
            return None
        mask, size = batch["mask"], tuple(batch["image"].shape[:2])
        if tuple(mask.shape[:2]) != size:
            raise ValueError(f"batch['mask']: expected the image's size {size}, got {tuple(mask.shape[:2])}")
        return self._downscale_if_required(mask.reshape(*size, 1).float()).to(self.device)

    def _trust(self, batch: dict[str, Any]) -> Float[Tensor, "h w 1"] | None:
        """How far the batch's pixels are believed, at the current resolution; None where wholly."""
        return self._downscale_if_required(batch["trust"].float()).to(self.device) if "trust" in batch else None

    @torch.no_grad()
    def get_metrics_dict(self, outputs: dict[str, Tensor], batch: dict[str, Any]) -> dict[str, Any]:
        """PSNR over known pixels and the number of Gaussians."""
        target, known = self._target(outputs, batch), self._known(batch)
        metrics: dict[str, Any] = {
            "psnr": photometric.psnr(outputs["rgb"], target, known),
            "gaussian_count": self.num_points,
        }
        if self.config.color_corrected_metrics:
            metrics["cc_psnr"] = photometric.psnr(color_correct(outputs["rgb"], target), target, known)
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    @torch.no_grad()
    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and, where its weights are at hand, LPIPS over known pixels; and the pair target | render."""
        target, rgb, known = self._target(outputs, batch), outputs["rgb"], self._known(batch)
        compared = {"": rgb}
        if self.config.color_corrected_metrics:
            compared["cc_"] = color_correct(rgb, target)
        metrics: dict[str, float] = {}
        for prefix, image in compared.items():
            metrics[f"{prefix}psnr"] = float(photometric.psnr(image, target, known))
            metrics[f"{prefix}ssim"] = float(photometric.ssim(image, target, known))
            distance = self.lpips(image, target) if known is None else self.lpips(image * known, target * known)
            if distance is not None:
                metrics[f"{prefix}lpips"] = distance
        return metrics, {"img": torch.cat([target, rgb], dim=1)}
