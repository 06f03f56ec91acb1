"""What generation starts from where the splats show something already: their own picture of it (SDEdit)."""

from __future__ import annotations

from typing import Any

from jaxtyping import Float
from torch import Tensor

from fb_core.data.telea import inpainted
from fb_core.geometry.cameras import Pinholes
from fb_core.masks import grow_hole
from fb_core.views import Views
from fb_nerfstudio.unseen import FIRM, render_geometry

_CONTINUED = 4  # pixels by which a guess is continued beyond firm splats: half a latent, so that latents at the edge are known wholly


def first_guess(splats: Any, cameras: Pinholes) -> Views | None:
    """The splats' renders, known where accumulation is at least `FIRM` and a few inpainted pixels beyond; None where it is nowhere.

    Elsewhere generation has to start from noise: what is inpainted over a large hole would be generated again.
    """
    rendered = render_geometry(splats, cameras)
    firm = rendered.accumulation >= FIRM
    if not bool(firm.any()):
        return None
    near: Float[Tensor, "n 1 h w"] = 1 - grow_hole(1 - firm[:, None].float(), pixels=_CONTINUED)
    return Views.known(inpainted(rendered.rgb, firm), cameras, mask=near)
