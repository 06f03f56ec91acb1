"""The torch twin of gsplat's `rasterization`: same arguments, same pictures, same gradients, on any CPU.

It stands in for gsplat where there is no CUDA. The steps: project (`projection`), choose what can be seen and put it in
depth order, colours (`spherical_harmonics`), lists by cell (`cells`), compositing (`compositing`).

Arguments of `rasterization`, whose shapes stand in its signature:
    means: centres, world units.
    quats: rotations (wxyz) of any length; a zero quaternion is the identity rotation with a zero gradient.
    scales: standard deviations along the Gaussians' axes, world units (already exponentiated).
    opacities: in [0, 1] (already through the sigmoid).
    colors: d channels, or spherical-harmonics coefficients where `sh_degree` (0 to 4) is given; for all cameras or
        each.
    viewmats: world to camera, OpenCV axes (x right, y down, z forward).
    Ks: pinhole matrices in pixels; pixel centres lie at +0.5. No gradient flows to them.
    near_plane: Gaussians with a smaller camera z are not drawn. far_plane: nor those with a greater one.
    radius_clip: Gaussians whose radius is at most this many pixels are not drawn.
    eps2d: blur added to every screen covariance, square pixels.
    tile_size: a multiple of 4; in gsplat 1.4 the picture depends on it, because the three-sigma square of a Gaussian is
        rounded up to whole tiles.
    backgrounds: colour behind everything, for each camera; the depth channel's background is 0.
    render_mode: D is the sum of weight times z, ED that sum over alpha; RGB+D and RGB+ED append it as the last channel.
    absgrad: backward also sets `meta["means2d"].absgrad`, the sum over pixels of |d loss / d mean2d|.
    rasterize_mode: "antialiased" multiplies the opacities by sqrt(det before blur / det after it).
    covars: covariances in place of quats and scales.
    semantics: the version of gsplat to agree with.
    engine: what draws: torch, the compiled library (see `compiled.library`), or auto: the library where
        it has been made and fits (at most 15 channels), else torch. They agree within rounding.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from fb_core.files.limits import MOST_PIXELS
from fb_core.splatting.compiled.compositing import MOST_CHANNELS, Chosen, can_draw, composite_compiled
from fb_core.splatting.compiled.projection import project_compiled
from fb_core.splatting.projection import ALPHA_MIN, SEMANTICS, Gaussians, Projection, ProjectionSettings, project_splats
from fb_core.splatting.single_thread import single_thread
from fb_core.splatting.spherical_harmonics import MAX_DEGREE, sh_colors
from fb_core.splatting.tiles.cells import CELL_WIDTH, CellGrid, Ellipses, tile_bounds
from fb_core.splatting.tiles.compositing import CompositingSettings, composite

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
Engine = Literal["auto", "torch", "compiled"]
_logger = logging.getLogger(__name__)


def rasterization(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"] | None,
    scales: Float[Tensor, "n 3"] | None,
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "n d"] | Float[Tensor, "c n d"] | Float[Tensor, "n k 3"] | Float[Tensor, "c n k 3"],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Float[Tensor, "c d"] | None = None,
    render_mode: RenderMode = "RGB",
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    covars: Float[Tensor, "n 3 3"] | None = None,
    semantics: Literal["1.4", "1.5", "1.6"] = "1.4",
    engine: Engine = "auto",
) -> tuple[Float[Tensor, "c h w x"], Float[Tensor, "c h w 1"], dict[str, Any]]:
    """Images of Gaussians as gsplat 1.4.0 draws them; what the arguments mean stands at the head of this module.

    Returns:
        colors [c, h, w, x], alphas [c, h, w, 1], and meta for gsplat's strategies (as with packed=False): `means2d` is
        the very tensor that the gradient flows through; rows that are not drawn hold zeros. gsplat's tile lists
        (`isect_*`, `flatten_ids`) are not made, since cells take their place. `dropped` counts the Gaussians left out
        because a value was not finite.

    Raises ValueError for shapes, dtypes or options that do not fit.
    """
    splats = Gaussians(means=means, quats=quats, scales=scales, covars=covars, opacities=opacities)
    _check(splats, viewmats, Ks, backgrounds)
    _check_colors(splats, viewmats.shape[0], colors, backgrounds, sh_degree, render_mode)
    _check_options(width, height, packed, tile_size, rasterize_mode, semantics)
    numbers = {"near_plane": near_plane, "far_plane": far_plane, "radius_clip": radius_clip, "eps2d": eps2d}
    _check_numbers(viewmats.shape[0] * width * height, **numbers)
    antialiased, rules = rasterize_mode == "antialiased", SEMANTICS[semantics]
    settings = ProjectionSettings(width=width, height=height, antialiased=antialiased, semantics=rules, **numbers)
    look = _Look(sh_degree, tile_size, backgrounds, render_mode, absgrad, engine)
    with single_thread():
        return _drawn(splats, colors, viewmats, Ks, settings, look)


@dataclass(frozen=True)
class _Look:
    """What of `rasterization`'s arguments says how the Gaussians look, and by what they are drawn."""

    sh_degree: int | None
    tile_size: int
    backgrounds: Float[Tensor, "c d"] | None
    render_mode: RenderMode
    absgrad: bool
    engine: Engine


def _drawn(
    splats: Gaussians,
    colors: Tensor,
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],
    settings: ProjectionSettings,
    look: _Look,
) -> tuple[Float[Tensor, "c h w x"], Float[Tensor, "c h w 1"], dict[str, Any]]:
    """What `rasterization` returns, of arguments that fit."""
    usable, dropped = _usable(splats, _used_colors(colors, look.sh_degree, look.render_mode))
    if usable is not None:
        splats = replace(splats, opacities=splats.opacities.masked_fill(~usable, 0.0))
    compiled = _is_compiled(look, colors, splats.means)
    project = project_compiled if compiled else project_splats
    projection = project(splats, viewmats, Ks, usable, settings)
    opacities = splats.opacities.expand(viewmats.shape[0], -1)
    if settings.antialiased:
        opacities = opacities * projection.compensations
    chosen, tile_size = _chosen(projection, opacities), look.tile_size
    values = _values(splats.means, colors, viewmats, projection.depths, chosen, look.sh_degree, look.render_mode)
    grid = CellGrid(
        cameras=viewmats.shape[0],
        width=settings.width,
        height=settings.height,
        cell_width=CELL_WIDTH if tile_size % CELL_WIDTH == 0 else 4,
    )
    boxes = settings.semantics.square_boxes
    compositing = CompositingSettings(alpha_cap=settings.semantics.alpha_cap, absgrad=look.absgrad)
    drawn = projection.means2d, projection.conics, opacities, values
    if compiled:
        radii = projection.radii if boxes else None
        seen = Chosen(ranks=chosen, determinants=projection.determinants, radii=radii, tile_size=tile_size, grid=grid)
        images, alphas = composite_compiled(*drawn, seen, compositing)
    else:
        ellipses = _ellipses(projection, opacities, chosen, tile_size if boxes else None, grid)
        images, alphas = composite(*drawn, ellipses, compositing)
    images = _finish(images, alphas, look.backgrounds, look.render_mode)
    return images, alphas, _meta(projection, opacities, settings, tile_size, dropped)


def _is_compiled(look: _Look, colors: Tensor, means: Tensor) -> bool:
    """Whether the compiled library draws. Raises ValueError where it should but cannot."""
    channels = 0 if look.render_mode in ("D", "ED") else colors.shape[-1]
    channels += look.render_mode != "RGB"
    fits = can_draw(channels, means)
    if look.engine == "compiled" and not fits:
        raise ValueError(
            f"engine: expected torch or auto for {channels} channels of {means.dtype} on {means.device}, got "
            f"compiled, which takes up to {MOST_CHANNELS} channels on the CPU once `fillerbuster compile` has run."
        )
    return fits and look.engine != "torch"


def _used_colors(colors: Tensor, sh_degree: int | None, render_mode: RenderMode) -> Tensor | None:
    """What of the colours takes part, Gaussians first: no coefficients above the degree, and none of them in pictures
    of depth alone.
    """
    if render_mode in ("D", "ED"):
        return None
    used = colors if sh_degree is None else colors[..., : (sh_degree + 1) ** 2, :]
    return used.transpose(0, 1) if used.ndim == (3 if sh_degree is None else 4) else used


def _usable(splats: Gaussians, colors: Tensor | None) -> tuple[Tensor | None, int]:
    """Which Gaussians have finite values only (None = all of them), and how many have not."""
    with torch.no_grad():
        given = [t for t in (splats.means, splats.quats, splats.scales, splats.covars, colors) if t is not None]
        # The sums are the quickest look at all of them.
        if bool(torch.stack([t.sum() for t in (*given, splats.opacities)]).isfinite().all()):
            return None, 0
        finite = splats.opacities.isfinite()
        for tensor in given:
            finite = finite & tensor.flatten(1).isfinite().all(dim=1)
        dropped = int((~finite).sum())
    if dropped:
        _say_once(
            "Some Gaussians hold values that are not finite (NaN or infinite); they are left out of the picture and "
            "get no gradient."
        )
    return finite, dropped


@cache
def _say_once(message: str) -> None:
    _logger.warning(message)


def _chosen(projection: Projection, opacities: Tensor) -> Tensor:
    """Flat indices of what can reach alpha = 1/255 in the image, nearest first; equal depths keep their order."""
    with torch.no_grad():
        radii = projection.radii if projection.radii.ndim == 2 else projection.radii[..., 0]
        seen = ((radii > 0) & (opacities >= ALPHA_MIN)).view(-1).nonzero()[:, 0].int()
        depths = projection.depths.view(-1).index_select(0, seen).float()
        # Positive floats sort like their bits, and integers sort faster.
        return seen.index_select(0, torch.sort(depths.view(torch.int32), stable=True).indices)


def _values(means, colors, viewmats, depths, chosen: Tensor, sh_degree: int | None, render_mode: RenderMode) -> Tensor:
    """The channels of the chosen Gaussians [v, d]: colours, then depth."""
    cameras, number = viewmats.shape[0], means.shape[0]
    chosen = chosen.long()  # the gradient of a selection is several times faster with 64-bit indices
    depth = depths.reshape(-1).index_select(0, chosen)[:, None]
    if render_mode in ("D", "ED"):
        return depth
    splat = chosen if cameras == 1 else chosen % number
    per_camera = colors.ndim == (3 if sh_degree is None else 4)
    rows = colors.flatten(0, 1).index_select(0, chosen) if per_camera else colors.index_select(0, splat)
    if sh_degree is not None:
        # The inverse, not -R^T t: the same point, but this is the gradient that gsplat sends to the camera matrix.
        centers = torch.linalg.inv(viewmats)[:, :3, 3]
        centers = centers if cameras == 1 else centers.index_select(0, torch.div(chosen, number, rounding_mode="floor"))
        rows = sh_colors(sh_degree, means.index_select(0, splat) - centers, rows)
    return rows if render_mode == "RGB" else torch.cat([rows, depth], dim=1)


def _ellipses(
    projection: Projection, opacities: Tensor, chosen: Tensor, tile_size: int | None, grid: CellGrid
) -> Ellipses:
    """The chosen Gaussians as constants, in columns."""
    with torch.no_grad():
        cameras, number = projection.depths.shape

        def columns(tensor: Tensor) -> tuple[Tensor, ...]:
            rows = tensor.detach().flatten(0, 1).index_select(0, chosen)
            return (rows if rows.ndim == 2 else rows[:, None]).t().contiguous().unbind(0)

        x, y = columns(projection.means2d)
        A, B, C = columns(projection.conics)
        bounds = (
            None if tile_size is None else tile_bounds(x, y, columns(projection.radii)[0].to(x.dtype), tile_size, grid)
        )
        return Ellipses(
            chosen=chosen,
            camera=None if cameras == 1 else torch.div(chosen, number, rounding_mode="floor"),
            grid=grid,
            x=x,
            y=y,
            A=A,
            B=B,
            C=C,
            determinant=columns(projection.determinants)[0],
            opacity=columns(opacities)[0],
            bounds=bounds,
        )


def _finish(images: Tensor, alphas: Tensor, backgrounds: Tensor | None, render_mode: RenderMode) -> Tensor:
    """Put the background behind the colours, and turn accumulated into expected depth."""
    if backgrounds is None and not render_mode.endswith("ED"):
        return images
    color, depth = {"RGB": (images, None), "D": (None, images), "ED": (None, images)}.get(
        render_mode, (images[..., :-1], images[..., -1:])
    )
    if color is not None and backgrounds is not None:
        color = color + (1 - alphas) * backgrounds[:, None, None]
    if depth is not None and render_mode.endswith("ED"):
        depth = depth / alphas.clamp(min=1e-10)
    return torch.cat([part for part in (color, depth) if part is not None], dim=-1)


def _meta(
    projection: Projection, opacities: Tensor, settings: ProjectionSettings, tile_size: int, dropped: int
) -> dict[str, Any]:
    """What gsplat's strategies and nerfstudio read."""
    return {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": projection.radii,
        "means2d": projection.means2d,
        "depths": projection.depths,
        "conics": projection.conics,
        "opacities": opacities,
        "tile_width": -(-settings.width // tile_size),
        "tile_height": -(-settings.height // tile_size),
        "tile_size": tile_size,
        "width": settings.width,
        "height": settings.height,
        "n_cameras": projection.depths.shape[0],
        "dropped": dropped,
    }


def _expect(name: str, tensor: Tensor, shape: tuple[int, ...], like: Tensor) -> None:
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} should have shape {shape} but has {tuple(tensor.shape)}.")
    if tensor.dtype != like.dtype or tensor.device != like.device:
        raise ValueError(
            f"{name} is {tensor.dtype} on {tensor.device}, means is {like.dtype} on {like.device}: convert it to the "
            "same."
        )


def _check(splats: Gaussians, viewmats: Tensor, Ks: Tensor, backgrounds: Tensor | None) -> None:
    means = splats.means
    if means.ndim != 2 or means.shape[1] != 3 or means.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"means should be float32 or float64 [n, 3] but is {means.dtype} {tuple(means.shape)}.")
    number, cameras = means.shape[0], viewmats.shape[0]
    if splats.covars is not None:
        _expect("covars", splats.covars, (number, 3, 3), means)
    elif splats.quats is None or splats.scales is None:
        raise ValueError("quats and scales are needed where covars is not given.")
    else:
        _expect("quats", splats.quats, (number, 4), means)
        _expect("scales", splats.scales, (number, 3), means)
    _expect("opacities", splats.opacities, (number,), means)
    _expect("viewmats", viewmats, (cameras, 4, 4), means)
    _expect("Ks", Ks, (cameras, 3, 3), means)
    for name, tensor in {"viewmats": viewmats, "Ks": Ks, "backgrounds": backgrounds}.items():
        if (
            tensor is not None and not math.isfinite(float(tensor.detach().sum())) and not bool(tensor.isfinite().all())
        ):  # the sum is quicker
            raise ValueError(f"{name} should be finite but holds NaN or infinity: leave that camera out or repair it.")
    if not bool((Ks[:, [0, 1], [0, 1]] > 0).all()):
        raise ValueError(f"Ks should have focal lengths above 0 but has {Ks[:, [0, 1], [0, 1]].tolist()}.")


def _check_colors(
    splats: Gaussians,
    cameras: int,
    colors: Tensor,
    backgrounds: Tensor | None,
    sh_degree: int | None,
    render_mode: RenderMode,
) -> None:
    if render_mode not in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        raise ValueError(f"render_mode should be RGB, D, ED, RGB+D or RGB+ED but is {render_mode!r}.")
    if render_mode in ("D", "ED"):
        return
    trailing = 1 if sh_degree is None else 2
    means, number = splats.means, splats.means.shape[0]
    leading = (number,) if colors.ndim == 1 + trailing else (cameras, number)
    _expect("colors", colors, (*leading, *colors.shape[-trailing:]), means)
    if sh_degree is not None:
        if not 0 <= sh_degree <= MAX_DEGREE:
            raise ValueError(f"sh_degree should be 0 to {MAX_DEGREE} but is {sh_degree}.")
        if colors.shape[-1] != 3 or colors.shape[-2] < (sh_degree + 1) ** 2:
            raise ValueError(
                f"colors should hold at least {(sh_degree + 1) ** 2} x 3 coefficients for sh_degree {sh_degree} "
                f"but has shape {tuple(colors.shape)}."
            )
    if backgrounds is not None:
        _expect("backgrounds", backgrounds, (cameras, colors.shape[-1]), means)


def _check_numbers(pixels: int, **numbers: float) -> None:
    if pixels > MOST_PIXELS:
        raise ValueError(
            f"the pictures should have at most {MOST_PIXELS} pixels together but have {pixels}: draw fewer or smaller "
            "ones."
        )
    for name, number in numbers.items():
        if math.isnan(number):
            raise ValueError(f"{name} should be a number but is NaN.")
    if not 0 <= numbers["eps2d"] < math.inf:
        raise ValueError(f"eps2d should be finite and not negative but is {numbers['eps2d']}.")


def _check_options(width: int, height: int, packed: bool, tile_size: int, rasterize_mode: str, semantics: str) -> None:
    if not isinstance(width, int) or not isinstance(height, int):
        raise ValueError(f"width and height should be whole numbers but are {width!r} and {height!r}.")
    if width < 1 or height < 1:
        raise ValueError(f"width and height should be at least 1 but are {width} and {height}.")
    if packed:
        raise ValueError("packed=True is not offered on the CPU (the pictures are the same): pass packed=False.")
    if tile_size < 4 or tile_size % 4:
        raise ValueError(f"tile_size should be a multiple of 4 but is {tile_size}.")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode should be 'classic' or 'antialiased' but is {rasterize_mode!r}.")
    if semantics not in SEMANTICS:
        raise ValueError(f"semantics should be one of {', '.join(SEMANTICS)} but is {semantics!r}.")
