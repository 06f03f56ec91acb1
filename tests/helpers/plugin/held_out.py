"""Held-out views as the demo measures them."""

from __future__ import annotations

import torch

from fb_nerfstudio.runs.held_out_views import HeldOutViews


def held_out(error: float, holes: float) -> HeldOutViews:
    """Eight 16x16 views, half of them covered; uncovered ones have the error and the share of holes."""
    truth = torch.full((8, 3, 16, 16), 0.5)
    covered = torch.arange(8) % 2 == 0
    accumulation = torch.ones(8, 16, 16)
    accumulation[1::2, : round(16 * holes)] = 0.0
    renders = truth + torch.where(covered, 0.01, error)[:, None, None, None]
    return HeldOutViews(renders=renders, truth=truth, accumulation=accumulation, covered=covered, generated=())
