"""Values of new Gaussians, at given points or at random in a cube, in splatfacto's parametrization."""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.models.splatfacto import RGB2SH, num_sh_bases
from torch import Tensor

_NEIGHBOURS = 3  # splatfacto's and Inria's choice
_LONELY_DISTANCE = 0.1  # scene units, where a point has no neighbour at all
_SMALLEST_DISTANCE = 1e-6  # coinciding points would give a log scale of minus infinity
_SATURATION = 1e-3  # sigmoid colours keep this distance from black and white, where their gradient vanishes


def gaussians_at(
    points: Float[Tensor, "m 3"],
    colors: Float[Tensor, "m 3"],
    *,
    sh_degree: int,
    opacity: float = 0.1,
    among: Float[Tensor, "k 3"] | None = None,
) -> dict[str, Tensor]:
    """Parameters of round Gaussians at ``points`` (world) with ``colors`` in [0, 1]; the keys are splatfacto's.

    Their standard deviation is the mean distance to the three nearest other points, those of ``among`` included (means
    that exist already). With ``sh_degree`` 0 colours go through a sigmoid, otherwise they are the constant harmonic.
    """
    spread = neighbour_distance(points, among).clamp_min(_SMALLEST_DISTANCE)
    dc = RGB2SH(colors) if sh_degree > 0 else torch.logit(colors, eps=_SATURATION)
    return {
        "means": points.clone(),
        "scales": torch.log(spread)[:, None].repeat(1, 3),
        "quats": F.normalize(torch.randn(len(points), 4), dim=-1).to(points),
        "features_dc": dc,
        "features_rest": points.new_zeros(len(points), num_sh_bases(sh_degree) - 1, 3),
        "opacities": torch.logit(points.new_full((len(points), 1), opacity)),
    }


def first_gaussians(
    seeds: tuple[Tensor, Tensor] | None, *, random: tuple[int, float], limit: int | None, sh_degree: int
) -> dict[str, Tensor]:
    """What a training starts with: Gaussians at the scene's points, or at random ones where there are none.

    Args:
        seeds: points [m, 3] and their colours in 8 bits; nerfstudio allows points without colours.
        random: how many random points, and the side of their cube.
        limit: most Gaussians; of more points an evenly spread part is taken.
        sh_degree: of the harmonics.
    """
    if seeds is not None and len(seeds[0]) > 0:
        points, colors = seeds[0].float(), seeds[1].float() / 255.0
        if len(colors) != len(points):
            colors = torch.rand(len(points), 3)
    else:
        count, side = random
        points, colors = random_points(count if limit is None else min(count, limit), side)
    chosen = evenly_chosen(len(points), len(points) if limit is None else limit)
    return gaussians_at(points[chosen], colors[chosen], sh_degree=sh_degree)


def colors_of(splats: Mapping[str, Tensor], degree: int) -> tuple[Tensor, int | None]:
    """Colours in [0, 1] (of Gaussians without harmonics), or harmonics and the degree up to which they are to be
    evaluated.
    """
    if splats["features_rest"].shape[1] == 0:
        return splats["features_dc"].sigmoid(), None
    return torch.cat([splats["features_dc"][:, None], splats["features_rest"]], dim=1), degree


def require_points(points: Tensor, colors: Tensor) -> None:
    """Raises ValueError when points and colors are not two [m, 3] of finite values."""
    if points.ndim != 2 or points.shape[1] != 3 or points.shape != colors.shape:
        raise ValueError(
            f"points and colors: expected two shapes [m, 3], got {list(points.shape)} and {list(colors.shape)}"
        )
    if not bool(points.isfinite().all() and colors.isfinite().all()):
        raise ValueError("points and colors: expected finite values, got NaN or infinity; drop those points first")


def random_points(count: int, side: float) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Points uniform in the cube of this side (scene units) around the origin, and random colours in [0, 1]."""
    return (torch.rand(count, 3) - 0.5) * side, torch.rand(count, 3)


def neighbour_distance(points: Float[Tensor, "m 3"], among: Float[Tensor, "k 3"] | None = None) -> Float[Tensor, " m"]:
    """Mean distance of each point to its three nearest others, in ``points`` and ``among``; fewer where there are
    fewer.

    Without any neighbour: 0.1 scene units.
    """
    from scipy.spatial import KDTree

    if len(points) == 0:
        return points.new_zeros(0)
    everything = points if among is None else torch.cat([points, among])
    count = min(_NEIGHBOURS, len(everything) - 1)
    if count == 0:
        return points.new_full((1,), _LONELY_DISTANCE)
    tree = KDTree(everything.detach().cpu().double().numpy())
    distances, _ = tree.query(points.detach().cpu().double().numpy(), k=count + 1)
    return torch.from_numpy(distances[:, 1:].mean(axis=1)).to(points)


def evenly_chosen(count: int, at_most: int) -> Tensor:
    """Indices of ``at_most`` of ``count`` items, spread evenly over their order; all of them where they fit."""
    if count <= at_most:
        return torch.arange(count)
    return torch.linspace(0, count - 1, at_most, dtype=torch.float64).round().long()
