"""Many captured and generated views: time grows no faster than their number, and memory stays bounded."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import torch
from test_completion import box_points
from test_coverage import AUTO, UP, turning

from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.free_space import FreeSpace
from fb_core.geometry.shell import sphere
from fb_core.live_bytes import LiveBytes
from fb_nerfstudio.completion_plan import plan_completion
from fb_nerfstudio.pixel_trust import disagreement
from fb_nerfstudio.trusted_views import shell_depth


def seconds(run: Callable[[], object]) -> float:
    """Least CPU time of two runs."""
    taken = []
    for _ in range(2):
        began = time.process_time()
        run()
        taken.append(time.process_time() - began)
    return min(taken)


def scattered(count: int, side: int = 8) -> Pinholes:
    draw = torch.Generator().manual_seed(0)
    looks = torch.nn.functional.normalize(torch.randn(count, 3, generator=draw) * torch.tensor([1.0, 1.0, 0.2]), dim=1)
    centers = 0.3 * torch.randn(count, 3, generator=draw)
    return Pinholes.looking_at(centers, centers + looks, up=UP.float(), fov_degrees=60.0, width=side, height=side)


def test_a_capture_of_2000_views_is_planned_in_bounded_time_and_memory() -> None:
    cameras, points = turning(2000, last=4.0), box_points().double()
    few = seconds(lambda: plan_completion(cameras[::20], points, AUTO, size=16))
    assert seconds(lambda: plan_completion(cameras, points, AUTO, size=16)) < 20 * few + 1.0
    with LiveBytes() as live:
        plan_completion(cameras, points, AUTO, size=16)
    assert live.peak < 512 * 2**20


def test_rays_of_2000_views_and_agreement_of_many_generated_ones() -> None:
    cameras = scattered(2000)
    space = FreeSpace(cameras=tuple(cameras[index] for index in range(2000)), depth=(torch.full((8, 8), 2.0),) * 2000)
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(1)) * 4 - 2
    with LiveBytes() as live:
        free = space.crossed(points)
    assert bool(free.any()) and live.peak < 2**20

    def compare(count: int) -> None:
        some = cameras[list(range(count))]
        disagreement(torch.rand(count, 3, 8, 8), some, shell_depth(sphere(torch.zeros(3), 3.0), some))

    assert seconds(lambda: compare(800)) < 20 * seconds(lambda: compare(100)) + 0.5


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_and_alike_views_agree_with_themselves(count: int) -> None:
    same = scattered(1)[[0] * count]
    images = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0)).expand(count, -1, -1, -1)
    found = disagreement(images, same, shell_depth(sphere(torch.zeros(3), 3.0), same))
    assert bool(found.isnan().all()) if count == 1 else float(found.max()) < 1e-9
