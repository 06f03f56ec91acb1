"""What generation starts from where the splats show something already: their own picture of it (SDEdit)."""

from __future__ import annotations

from jaxtyping import Bool, Float
from torch import Tensor

from fb_core.data.telea import inpainted
from fb_core.geometry.cameras import Pinholes
from fb_core.masks import grow_hole
from fb_core.views import Views
from fb_nerfstudio.capture.splat_renders import FIRM, SOLID, TrainedSplats, render_geometry

# How far half opaque splats decide where generation starts: half way between noise and where it starts from firm ones
_HALF = 0.5
# Pixels by which a guess is continued beyond firm splats: half a latent, so that latents at the edge are known wholly
_CONTINUED = 4


def first_guess(splats: TrainedSplats, cameras: Pinholes, *, soft: bool = False) -> Views | None:
    """The splats' renders, known where accumulation is at least `FIRM` and a few inpainted pixels beyond; None where it
    is nowhere.

    Elsewhere generation has to start from noise: what is inpainted over a large hole would be generated again. With
    ``soft``, pixels of accumulation from `SOLID` on have a mask of one half: there it starts half way between noise and
    the render.
    """
    rendered = render_geometry(splats, cameras)
    firm = rendered.accumulation >= FIRM
    there = rendered.accumulation >= SOLID if soft else firm
    if not bool(there.any()):
        return None
    near = _continued(firm)
    mask = near.maximum(_HALF * _continued(there)) if soft else near
    return Views.known(inpainted(rendered.rgb, there), cameras, mask=mask)


def _continued(there: Bool[Tensor, "n h w"]) -> Float[Tensor, "n 1 h w"]:
    """The mask of these pixels and a few beyond."""
    return 1 - grow_hole(1 - there[:, None].float(), pixels=_CONTINUED)
