"""Which generated pixels the capture has not seen."""

from __future__ import annotations

import dataclasses

import torch
from helpers.plugin.datamanagers import (
    stand_in_model,  # noqa: F401
    two_views,
)

from fb_core.geometry.shell import sphere
from fb_nerfstudio.capture.splat_renders import Rendered
from fb_nerfstudio.capture.unseen import find_unseen, unseen_gaussians, with_matched_colors, with_unseen_masks

# ---- unseen pixels --------------------------------------------------------------------------------------------------


def test_the_captured_direction_is_seen_and_the_other_is_not():
    views = two_views()
    captured = dataclasses.replace(views.cameras[0], focal=views.cameras.focal[:1] / 2)  # looks the same way, wider
    unseen = find_unseen(views.cameras, [captured], sphere(torch.zeros(3), 3.0), None)
    assert not unseen.mask[0].any() and unseen.mask[1].all()
    assert torch.allclose(unseen.points.norm(dim=-1), torch.tensor(3.0), atol=1e-3)
    points, colors = unseen_gaussians(views, unseen, limit=10, generator=torch.Generator().manual_seed(0))
    assert points.shape == (10, 3) and bool((points[:, 0] < 0).all()) and torch.allclose(colors, torch.tensor(0.2))
    masked = with_unseen_masks(views, unseen)
    assert not masked.masks[0].any() and masked.masks[1].all()


def test_holes_of_trained_splats_are_unseen_and_so_is_what_no_camera_looked_at():
    views = two_views()
    captured = dataclasses.replace(views.cameras[0], focal=views.cameras.focal[:1] / 2)
    accumulation = torch.ones(2, 8, 8)
    accumulation[0, :, 4:] = 0.1
    rendered = Rendered(depth=torch.full((2, 8, 8), 2.0), accumulation=accumulation, rgb=torch.full((2, 3, 8, 8), 0.5))
    unseen = find_unseen(views.cameras, [captured], sphere(torch.zeros(3), 3.0), rendered)
    matched = with_matched_colors(views, unseen, rendered).images.float() / 255
    assert float((matched[0, :, :4] - 0.5).abs().max()) < 0.01, "what is seen has the splats' colour"
    assert torch.equal(with_matched_colors(views, unseen, rendered).images[1], views.images[1]), (
        "nothing seen, nothing changed"
    )
    assert not unseen.mask[0, :, :4].any() and unseen.mask[0, :, 4:].all() and unseen.mask[1].all()
    masked = with_unseen_masks(views, unseen)
    assert masked.masks[0, :, 4:].all() and not masked.masks[0, :, :4].any()
