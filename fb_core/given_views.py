"""Views on their way into the networks and back: looked at, padded, in working precision, and cut to size again."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from fb_core.conditioning import only_known
from fb_core.geometry.raymap import CanonicalFrame
from fb_core.memory.budget import SIDE_MULTIPLE, Cut
from fb_core.networks.shared_results import SharedResults
from fb_core.sampling.options import SamplingConfig
from fb_core.views import Views

# Known values beyond are no colours or places, and their squares would overflow.
_FARTHEST = {"pixels": 1e4, "rays": 1e12}


@dataclass(frozen=True, kw_only=True)
class Job:
    """Views to be completed, as the networks take them."""

    views: Views
    """Padded, in float32 (raymaps perhaps more exact), on the model's device."""
    frame: CanonicalFrame | None
    """Of the known rays, None where none are."""
    cut: Cut
    """How the work is cut to fit the memory."""
    sampling: SamplingConfig
    """As it was asked for."""
    shared: SharedResults | None
    """What other calls may have computed already."""

    def canonical(self, raymaps: Float[Tensor, "n 6 h w"]) -> Float[Tensor, "n 6 h w"]:
        """Raymaps of the world in the canonical frame."""
        return raymaps if self.frame is None else self.frame.apply(raymaps)


def check_views(views: Views) -> None:
    """Raises ValueError, in one sentence, for what cannot be completed."""
    if len(views) == 0:
        raise ValueError("complete: expected at least one view, got none")
    if min(views.size) < SIDE_MULTIPLE:
        raise ValueError(
            f"complete: expected views of at least {SIDE_MULTIPLE}x{SIDE_MULTIPLE} pixels, got "
            f"{views.size[1]}x{views.size[0]}; "
            "use larger images"
        )
    for what, values, known in (("pixels", views.images, views.image_known), ("rays", views.raymaps, views.rays_known)):
        if not bool(torch.isfinite(known).all()) or float(known.min()) < 0 or float(known.max()) > 1:
            raise ValueError(f"complete: the mask of known {what} must lie in [0, 1] (1 = known)")
        if not values.is_floating_point():
            raise ValueError(
                f"complete: expected {what} in floating-point numbers, got {values.dtype}; colours are in [0, 1]"
            )
        broken = int(((~torch.isfinite(values)) & (known > 0)).any(dim=1).sum())
        if broken:
            raise ValueError(
                f"complete: {broken} known {what} are NaN or infinite; mark them as unknown (mask 0) or repair them"
            )
        far = int(((values.abs() > _FARTHEST[what]) & (known > 0)).any(dim=1).sum())
        if far:
            raise ValueError(
                f"complete: {far} known {what} are beyond {_FARTHEST[what]:g}; mark them as unknown (mask 0) or scale "
                "them"
            )


def check_current(current: Views, views: Views) -> None:
    """Raises ValueError, in one sentence, for current views that do not belong to those to be completed."""
    if len(current) != len(views) or current.size != views.size:
        expected, got = (f"{len(some)} views of {some.size[1]}x{some.size[0]}" for some in (views, current))
        raise ValueError(f"current: expected {expected} like the views to be completed, got {got}")
    pixels, rays = only_known(current.images, current.image_known), only_known(current.raymaps, current.rays_known)
    if not bool(torch.isfinite(pixels).all() & torch.isfinite(rays).all()):
        raise ValueError(
            "current: pixels or rays are NaN or infinite; pass whole views, such as an earlier answer of complete"
        )


def padded(views: Views, *, mode: str = "constant") -> Views:
    """Sides brought up to multiples of 16 with pixels and rays that are unknown."""
    height, width = views.size
    extra = (0, -width % SIDE_MULTIPLE, 0, -height % SIDE_MULTIPLE)
    if not any(extra):
        return views
    return dataclasses.replace(
        views, **{f.name: F.pad(getattr(views, f.name), extra, mode=mode) for f in dataclasses.fields(Views)}
    )


def working(views: Views, device: torch.device) -> Views:
    """As the networks take them: float32; raymaps that are more exact stay so until they are in the canonical frame."""
    exact = torch.float32 if device.type == "mps" else torch.promote_types(views.raymaps.dtype, torch.float32)
    single = {f.name: getattr(views, f.name).to(device, torch.float32) for f in dataclasses.fields(Views)}
    return dataclasses.replace(views, **single | {"raymaps": views.raymaps.to(device, exact)})


def as_given(filled: Views, views: Views) -> Views:
    """Cut to the size of the views, on their device and in their precision; what they know keeps its bits."""
    height, width = views.size
    cut = {
        f.name: getattr(filled, f.name)[..., :height, :width].to(getattr(views, f.name))
        for f in dataclasses.fields(Views)
    }
    cut["images"] = torch.where(views.image_known < 1, cut["images"], views.images)
    cut["raymaps"] = torch.where(views.rays_known > 0, views.raymaps, cut["raymaps"])
    return Views(**cut)
