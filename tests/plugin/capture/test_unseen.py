"""Which generated pixels the capture has not seen."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from helpers.plugin.datamanagers import (
    stand_in_model,  # noqa: F401
    two_views,
)

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_core.geometry.shell import sphere
from fb_nerfstudio.capture.splat_renders import Rendered, surface_points
from fb_nerfstudio.capture.unseen import (
    Unseen,
    find_unseen,
    unseen_gaussians,
    with_matched_colors,
    with_unseen_masks,
)

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


def test_nothing_is_put_before_what_is_seen_from_beside_the_capture():
    views = two_views()
    unseen = find_unseen(views.cameras, [], sphere(torch.zeros(3), 3.0), None)
    behind_a_wall = FreeSpace(cameras=(views.cameras[0],), depth=(torch.full((8, 8), 2.0),))
    before_a_wall = FreeSpace(cameras=(views.cameras[0],), depth=(torch.full((8, 8), 9.0),))
    assert unseen.mask.all() and torch.equal(unseen.without(None).mask, unseen.mask)
    assert torch.equal(unseen.without(behind_a_wall).mask, unseen.mask)
    left = unseen.without(before_a_wall).mask
    assert not left[0].any() and left[1].all(), "the other view looks elsewhere"


class Blobs(torch.nn.Module):
    """Splats of a wall at z = 4, and of a blob at z = 1 that only the first of three cameras has before it."""

    device = torch.device("cpu")

    def get_outputs_for_camera(self, camera):
        depth = torch.full((int(camera.height), int(camera.width), 1), 4.0)
        if float(camera.camera_to_worlds[0, 0, 3]) < -0.5:
            depth[:, :4] = 1.0
        return {"depth": depth, "accumulation": torch.ones_like(depth), "rgb": depth.expand(-1, -1, 3) / 4}


def three_cameras() -> list[Pinholes]:
    pose = torch.cat([torch.eye(3), torch.zeros(3, 1)], dim=1)[None]
    camera = Pinholes(
        camera_to_world=pose, focal=torch.full((1, 2), 8.0), principal=torch.full((1, 2), 8.0), width=16, height=16
    )
    return [camera.moved(torch.tensor([x, 0.0, 0.0])) for x in (-0.6, 0.0, 0.6)]


def test_a_surface_that_one_camera_alone_shows_is_none():
    points = surface_points(Blobs(), three_cameras())
    assert len(points) > 600 and bool((points[:, 2] == 4.0).all())


def test_a_single_camera_is_believed():
    points = surface_points(Blobs(), three_cameras()[:1])
    assert len(points) == 256 and int((points[:, 2] == 1.0).sum()) == 64


@pytest.mark.parametrize("turns", [(0.0, 0.0), (0.0, 30.0, 60.0)], ids=["twice the same", "a turn on the spot"])
def test_a_second_camera_in_the_same_place_bears_nothing_out(turns: tuple[float, ...]):
    """From one place splats look alike wherever they stand along its rays, so no direction is left out."""
    angles = torch.deg2rad(torch.tensor(turns))
    ahead = torch.stack([angles.sin(), torch.zeros_like(angles), angles.cos()], dim=1)
    looking = Pinholes.looking_at(
        torch.zeros(len(turns), 3), ahead, up=torch.tensor([0.0, -1.0, 0.0]), fov_degrees=90.0, width=16, height=16
    )
    assert len(surface_points(Blobs(), [looking[index] for index in range(len(turns))])) == 256 * len(turns)


def test_of_cameras_that_stand_apart_a_double_is_no_second_witness():
    first, *others = three_cameras()
    points = surface_points(Blobs(), [first, first, *others])
    assert len(points) > 600 and bool((points[:, 2] == 4.0).all()), "the blob before the doubled camera is none"


def test_what_is_infinitely_far_off_is_in_no_free_space():
    """Rays that never meet the shell point to infinity, some along an axis, where a coordinate is not a number."""
    camera = two_views().cameras[0]
    space = FreeSpace(cameras=(camera,), depth=(torch.full((8, 8), 1e9),))
    inf, nan = float("inf"), float("nan")
    points = torch.tensor([[inf, nan, nan], [inf, inf, inf], [-inf, inf, nan], [nan, nan, nan], [1e6, 0.0, 0.0]])
    views = Unseen(mask=torch.ones(1, 1, 5, dtype=torch.bool), points=points[None, None])
    assert views.without(space).mask[0, 0].tolist() == [True, True, True, True, False]
