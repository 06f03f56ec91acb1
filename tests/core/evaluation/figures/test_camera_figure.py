"""The picture of cameras in space: everything that is asked for is in it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from helpers.textured_box import cameras_on_an_arc, render

from fb_core.data import media
from fb_core.data.capture.point_cloud import Points
from fb_core.evaluation.figures.camera_figure import draw_cameras
from fb_core.geometry.cameras import Pinholes
from fb_core.geometry.viewpoints.camera_paths import path_cameras

SIZE = (360, 240)


def drawn(path: Path, cameras: list[Pinholes], pictures: list[torch.Tensor], **options) -> torch.Tensor:
    draw_cameras(path, cameras, pictures, size=SIZE, **options)
    image = media.read_image(path)
    assert image.shape == (3, SIZE[1], SIZE[0])
    return image


def near(image: torch.Tensor, color: tuple[float, float, float], tolerance: float = 0.2) -> torch.Tensor:
    return ((image - torch.tensor(color)[:, None, None]).abs().amax(dim=0) < tolerance).nonzero()


def test_photos_show_their_pictures_and_new_cameras_are_blue(tmp_path: Path):
    group = cameras_on_an_arc(4)
    cameras = [group[index] for index in range(4)]
    green = [torch.tensor([0.0, 0.9, 0.1])[:, None, None].expand(3, 12, 16)] * 4
    alone = drawn(tmp_path / "a.png", cameras, green)
    both = drawn(tmp_path / "b.png", cameras, green, new=path_cameras("orbit", cameras, 12, size=16))
    pictures = near(alone, (0.0, 0.9, 0.1))
    assert len(pictures) > 0.05 * SIZE[0] * SIZE[1]  # large enough to be recognised
    assert len(near(both, (0.12, 0.44, 0.71))) > 200 > len(near(alone, (0.12, 0.44, 0.71)))
    edge = torch.cat(
        [alone[:, :4, 150:].flatten(1), alone[:, 30:, :3].flatten(1), alone[:, 30:, -3:].flatten(1)], dim=1
    )
    assert bool((edge.amin(dim=0) > 0.7).all())  # nothing but paper and the grid touches the border


def test_any_world_any_sizes_one_place_and_one_camera_can_be_drawn(tmp_path: Path):
    """A world 1000 times as large that stands on its head, pictures of three sizes, all cameras in one place, a single
    one; points.
    """
    group = cameras_on_an_arc(3)
    turned = Pinholes(
        camera_to_world=torch.tensor([1.0, -1.0, -1.0]).diag()
        @ group.camera_to_world
        * torch.tensor([1.0, 1.0, 1.0, 1000.0]),
        focal=group.focal,
        principal=group.principal,
        width=group.width,
        height=group.height,
    )
    points = Points(positions=1000 * torch.rand(100, 3), colors=torch.rand(100, 3))
    cameras = [turned[0], turned[1].scaled(80, 60), turned[2].cropped(40, 0, 60, 120)]
    pictures = list(render(group))
    for number, chosen in enumerate((cameras, [turned[0]] * 3, cameras[:1])):
        image = drawn(tmp_path / f"{number}.png", chosen, pictures[: len(chosen)], points=points)
        assert float((image.amin(dim=0) < 0.9).float().mean()) > 0.05


def test_nothing_to_draw_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="expected at least one camera, got none"):
        draw_cameras(tmp_path / "a.png", [], [])


def test_what_is_imported_after_a_drawing_does_not_end_the_process(tmp_path: Path):
    """torch's counter of operations imports triton, whose LLVM and Mesa's are in one another's way: a segmentation
    fault in the second `complete` of a process.
    """
    program = (
        "import sys, torch\nfrom pathlib import Path\n"
        "from fb_core.evaluation.figures.camera_figure import draw_cameras\n"
        "from fb_core.geometry.cameras import Pinholes\n"
        "one = Pinholes(camera_to_world=torch.eye(4)[None, :3], focal=torch.full((1, 2), 8.0), "
        "principal=torch.full((1, 2), 4.0), width=8, height=8)\n"
        "draw_cameras(Path(sys.argv[1]), [one], [torch.zeros(3, 8, 8)])\n"
        "import torch.utils.flop_counter\nprint('went on')"
    )
    child = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "cameras.png")], capture_output=True, text=True, check=False
    )
    assert child.returncode == 0 and child.stdout.strip() == "went on", child
