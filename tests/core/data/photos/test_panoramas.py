"""360-degree pictures and panoramas are told from photos of one lens, and refused with what to do."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from helpers.folders.films import write_film
from helpers.textured_box import HALF, cameras_on_an_arc, render, save_photos

from fb_core.data import media
from fb_core.data.photos.collection import read_photos
from fb_core.data.photos.panoramas import goes_on_at_its_edge, panorama_fault

HEIGHT = 64


def around(turn: float = 0.0) -> torch.Tensor:
    """The textured box all around one place, equirectangular, [3, h, 2 h]."""
    up = (0.5 - (torch.arange(HEIGHT) + 0.5) / HEIGHT) * math.pi
    along = ((torch.arange(2 * HEIGHT) + 0.5) / HEIGHT - 1) * math.pi + turn
    x, y = torch.cos(up)[:, None] * torch.cos(along), torch.cos(up)[:, None] * torch.sin(along)
    directions = torch.stack([x, y, torch.sin(up)[:, None].expand_as(x)], dim=-1)
    places = directions / directions.abs().amax(dim=-1, keepdim=True) * HALF * 0.98 / HALF
    volumes = [torch.rand(1, 3, n, n, n, generator=torch.Generator().manual_seed(n)) for n in (5, 12)]
    return torch.stack(
        [F.grid_sample(volume, places[None, None], align_corners=True)[0, :, 0] for volume in volumes]
    ).mean(dim=0)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
def test_an_equirectangular_picture_goes_on_at_its_edge(turn: float):
    assert goes_on_at_its_edge(around(turn))


def test_pictures_of_one_lens_do_not():
    wide = cameras_on_an_arc(6, width=2 * HEIGHT, height=HEIGHT, degrees=300.0)
    background = torch.full((3, HEIGHT, 2 * HEIGHT), 0.9)
    background[:, 20:50, 40:90] = around()[:, 20:50, 40:90]  # a thing before a plain background
    others = [
        background,
        around()[:, :, : HEIGHT + 20],
        torch.rand(3, HEIGHT, 2 * HEIGHT, generator=torch.Generator().manual_seed(0)),
    ]
    assert not any(goes_on_at_its_edge(picture) for picture in [*render(wide), *others])


def test_a_folder_of_360_degree_photos_is_refused_with_what_to_do(tmp_path: Path):
    for number in range(3):
        media.write_image(tmp_path / f"{number}.png", around(number))
    with pytest.raises(
        ValueError, match=r"a 360-degree picture \(128 x 64.*ns-process-data images --camera-type equirectangular"
    ):
        read_photos(tmp_path)


def test_one_among_photos_is_left_out_and_named(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    save_photos(tmp_path, cameras_on_an_arc(2))
    media.write_image(tmp_path / "around.png", around())
    media.write_image(tmp_path / "long.png", torch.rand(3, 20, 80))
    assert [photo.name for photo in read_photos(tmp_path)] == ["photo_000", "photo_001"]
    assert "around.png: a 360-degree picture" in caplog.text and "long.png: a panorama (80 x 20)" in caplog.text


def test_a_360_degree_film_is_refused(tmp_path: Path):
    frames = [(around(0.1 * number) * 255).byte().movedim(0, -1).numpy() for number in range(12)]
    with pytest.raises(ValueError, match="ns-process-data video --camera-type equirectangular"):
        read_photos(write_film(tmp_path / "film.mp4", frames))


def test_xmp_data_tell_a_panorama(tmp_path: Path):
    picture = render(cameras_on_an_arc(1))[0]
    media.write_image(tmp_path / "photo.png", picture)
    assert panorama_fault(tmp_path / "photo.png", picture) == ""
    with (tmp_path / "photo.png").open("ab") as file:
        file.write(b'<rdf:Description GPano:ProjectionType="cylindrical"/>')
    assert "a panorama (160 x 120)" in panorama_fault(tmp_path / "photo.png", picture)
