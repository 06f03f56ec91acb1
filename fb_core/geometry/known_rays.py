"""The canonical frame of views whose rays are known in part. What is unknown decides nothing: neither padding nor what
stands there.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.geometry.raymap import CanonicalFrame, axes_of

_DETERMINED = 1e-10  # mean square by which a second camera has to miss the rays; float32 rays miss their own by 1e-14


def frame_of_known_rays(raymaps: Float[Tensor, "n 6 h w"], known: Float[Tensor, "n 1 h w"]) -> CanonicalFrame | None:
    """The frame that fills the cube with the centres of all views that have known rays (mask above 0); None where there
    are none.

    It is upright in the first view whose known rays tell a camera's axes. Where none does (a row of pixels, single
    rays), it follows the rays that there are, so that it still moves and turns with the world. Raymaps in the world,
    unknown rays may hold anything.

    Raises ValueError for a known ray that is not finite.
    """
    there = (known[:, 0] > 0).cpu()
    posed = there.flatten(1).any(dim=1).nonzero()[:, 0].tolist()
    if not posed:
        return None
    rays = [raymaps[view].detach().cpu()[:, there[view]] for view in posed]
    if not all(bool(torch.isfinite(one).all()) for one in rays):
        raise ValueError(
            "canonical frame: a known ray holds NaN or infinity; expected finite numbers, or mark the ray as unknown"
        )
    centers = torch.stack([one[:3].double().mean(dim=1) for one in rays]).to(raymaps.dtype)
    for place, view in enumerate(posed):
        whole = bool(there[view].all()) and min(there[view].shape) > 1
        axes = axes_of(raymaps[view, 3:].detach().cpu()) if whole else axes_of_some(rays[place][3:], there[view])
        if axes is not None:
            break
    else:
        place, axes = 0, _axes_at_all(rays, centers, there[posed[0]])
    frame = CanonicalFrame.around(axes, centers[place], centers)
    return CanonicalFrame(rotation=frame.rotation.to(raymaps), center=frame.center.to(raymaps), scale=frame.scale)


def axes_of_some(directions: Float[Tensor, "3 k"], there: Bool[Tensor, "h w"]) -> Float[Tensor, "3 3"] | None:
    """Camera-to-world rotation of a pinhole camera from k of its ray directions, those of the pixels that are there, in
    their order.

    The camera's axes are the columns of the matrix H with d ~ H (x, y, 1), which least squares finds up to its sign
    (the direct linear transform). Exact for pinholes without skew. None where other cameras have these rays too: fewer
    than four, or all in one line.
    """
    if directions.shape[1] < 4:
        return None
    rays = F.normalize(directions.double(), dim=0)
    pixels = torch.cat([_spread_pixels(there), rays.new_ones(1, rays.shape[1])])
    across = torch.eye(3, dtype=rays.dtype)[:, :, None] - rays[:, None] * rays[None]
    misses = torch.einsum("ijk,lk,mk->iljm", across, pixels, pixels).reshape(9, 9) / rays.shape[1]
    values, vectors = torch.linalg.eigh(misses)
    if not float(values[1]) > _DETERMINED:
        return None
    matrix = vectors[:, 0].reshape(3, 3)
    matrix = matrix * torch.sign((rays * (matrix @ pixels)).sum())
    right = F.normalize(matrix[:, 0], dim=0)
    down = F.normalize(matrix[:, 1] - (matrix[:, 1] @ right) * right, dim=0)
    return torch.stack([right, down, torch.linalg.cross(right, down)], dim=1).to(directions.dtype)


def _spread_pixels(there: Bool[Tensor, "h w"]) -> Float[Tensor, "2 k"]:
    """(x, y) of the pixels that are there, about their middle, in units of their spread."""
    row, column = there.nonzero().double().unbind(dim=1)
    pixels = torch.stack([column, row])
    pixels = pixels - pixels.mean(dim=1, keepdim=True)
    return pixels / pixels.abs().max().clamp(min=1.0)


def _axes_at_all(rays: list[Tensor], centers: Float[Tensor, "n 3"], there: Bool[Tensor, "h w"]) -> Float[Tensor, "3 3"]:
    """Axes that turn with the world: forward is the first view's mean ray, right is told by its other rays, else by the
    other views.
    """
    first = F.normalize(rays[0][3:].double(), dim=0)
    forward = F.normalize(first.mean(dim=1), dim=0)
    pixels = _spread_pixels(there)
    along_x, along_y = ((first - forward[:, None]) @ pixels.T).unbind(dim=1)
    ahead = [F.normalize(one[3:].double(), dim=0).mean(dim=1) for one in rays]
    # Forward takes down to minus right, so both slopes speak for the right axis; the rest only has to be the same in a
    # turned world.
    apart = centers.double() - centers[0].double()
    apart = apart / apart.abs().max().clamp(min=torch.finfo(torch.float64).tiny)
    hints = [along_x - torch.linalg.cross(forward, along_y), *apart, *ahead, *torch.eye(3, dtype=torch.float64)]
    across = [hint - (hint @ forward) * forward for hint in hints]
    right = F.normalize(next(one for one in across if float(one.norm()) > 1e-6), dim=0)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1).to(centers.dtype)
