"""How Gaussians multiply, by the options of the splat model."""

from __future__ import annotations

from typing import Literal, Protocol

from fb_nerfstudio.splats.strategies.densification import CappedStrategy
from fb_nerfstudio.splats.strategies.mcmc import CappedMCMC

_MOST_WITHOUT_LIMIT = 1_000_000
"""Where MCMC stops growing without a limit: it grows until one is reached (gsplat's default)."""


class GrowthSettings(Protocol):
    """What of the splat model's options decides how Gaussians multiply; most are splatfacto's."""

    strategy: Literal["default", "mcmc"]
    max_gaussians: int | None
    mcmc_noise_lr: float
    warmup_length: int
    refine_every: int
    stop_split_at: int
    cull_alpha_thresh: float
    cull_scale_thresh: float
    cull_screen_size: float
    densify_grad_thresh: float
    densify_size_thresh: float
    split_screen_size: float
    stop_screen_size_at: int
    reset_alpha_every: int
    use_absgrad: bool


def strategy_of(config: GrowthSettings, *, views: int) -> CappedStrategy | CappedMCMC:
    """The strategy of a training on so many captured views."""
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
        pause_refine_after_reset=views + config.refine_every,
        absgrad=config.use_absgrad,
        max_gaussians=config.max_gaussians,
    )
