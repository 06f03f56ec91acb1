"""A picture of one colour with any mask keeps that colour where it is known: at every scale, on every way to networks
and splats.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.folders.photos import made
from helpers.plugin.splat_models import make_model

from fb_core.completion.brought_views import _fitted
from fb_core.completion.fly_through import generate, plan_passes
from fb_core.completion.results.completed_views import CompletedViews, Origin
from fb_core.completion.rounds import CapturedView, fitted_view
from fb_core.data import media
from fb_core.data.capture.captures import FrameToWrite, write_capture
from fb_core.data.capture.undistort import undistort
from fb_core.data.photos.collection import read_photos
from fb_core.data.training.captioned_images import CaptionedConfig, CaptionedImages, picture_of
from fb_core.data.training.capture_sequences import CaptureConfig, Window
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import Fillerbuster
from fb_core.masks import grow_hole, partly_known, resampled, wholly_known
from fb_core.registration.by_raymaps import Square
from fb_core.sampling.options import SamplingConfig
from fb_core.views import Views
from fb_nerfstudio.capture.splat_renders import Rendered
from fb_nerfstudio.capture.unseen import Unseen, with_matched_colors

COLOUR = torch.tensor([0.2, 0.7, 0.4])
LOUD = torch.tensor([1.0, 0.0, 1.0])
SIZES = [(48, 64), (37, 91), (130, 50), (72, 72)]
SIDES = (16, 33, 64, 200)
Known = Callable[[int, int, int], torch.Tensor]


def rectangles(height: int, width: int, seed: int) -> torch.Tensor:
    return partly_known(height, width, generator=torch.Generator().manual_seed(seed))


def speckles(height: int, width: int, seed: int) -> torch.Tensor:
    holes = (torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(seed)) > 0.003).float()
    return grow_hole(holes, pixels=1)[0]


def fractions(height: int, width: int, seed: int) -> torch.Tensor:
    """Alpha as of a soft brush: 0 and 1 and everything between."""
    mask = rectangles(height, width, seed)[None]
    return torch.nn.functional.avg_pool2d(mask, 7, stride=1, padding=3, count_include_pad=False)[0]


MASKS: list[Known] = [rectangles, speckles, fractions]


def picture(height: int, width: int, known: torch.Tensor, unknown: torch.Tensor = LOUD) -> torch.Tensor:
    colour = COLOUR[:, None, None].expand(3, height, width)
    return torch.where(known > 0, colour, unknown[:, None, None].expand(3, height, width))


def camera_of(height: int, width: int) -> Pinholes:
    return Pinholes(
        camera_to_world=torch.eye(4, dtype=torch.float64)[None, :3],
        focal=torch.full((1, 2), 60.0, dtype=torch.float64),
        principal=torch.tensor([[width / 2, height / 2]], dtype=torch.float64),
        width=width,
        height=height,
    )


def assert_colour(image: torch.Tensor, known: torch.Tensor, *, least: float = 0.01, atol: float = 2e-5) -> None:
    """[3, h, w] and [1, h, w]: the colour where anything is known, and something is."""
    there = known[0] > 0
    assert float(there.float().mean()) >= least
    torch.testing.assert_close(image[:, there], COLOUR[:, None].expand(3, int(there.sum())), atol=atol, rtol=0)


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("side", SIDES)
def test_one_colour_stays_one_colour_at_every_scale(mask: Known, size: tuple[int, int], side: int):
    known = mask(*size, 3)
    image = picture(*size, known, torch.tensor([math.nan, math.inf, -math.inf]))
    assert_colour(*resampled(image, known, lambda channels: media.resize(channels, side, side + 5)))
    assert_colour(*resampled(image, known, lambda channels: media.shrink(channels, side)))
    binary = (known >= 0.5).float()
    colours, whole = wholly_known(image, binary, lambda channels: media.resize(channels, side, side))
    if bool((whole > 0).any()):  # of a speckled picture a few large pixels may all hold a speck
        assert_colour(colours, whole, least=0)
    assert set(whole.unique().tolist()) <= {0.0, 1.0} and not bool(colours[:, whole[0] == 0].any())


def test_shares_are_those_of_the_resampling():
    known = rectangles(60, 60, 0)
    _, share = resampled(picture(60, 60, known), known, lambda channels: media.shrink(channels, 20))
    torch.testing.assert_close(share, torch.nn.functional.avg_pool2d(known[None], 3)[0])


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("side", [33, 64, 200])
def test_every_way_into_a_network(mask: Known, size: tuple[int, int], side: int):
    known = mask(*size, 5)
    image, camera = picture(*size, known), camera_of(*size)
    square = Square.of(made(image, mask=known), side)
    assert_colour(square.image, square.known)
    assert set(square.known.unique().tolist()) <= {0.0, 1.0}, "networks were trained on pixels that are known or not"
    photo = made(image, mask=known)
    assert_colour(*photo.load_with_mask(min(side, max(size))))
    binary = (known >= 0.5).float()
    views = fitted_view(CapturedView(image=image, known=binary, camera=camera.to("cpu", torch.float32)), side)
    assert_colour(views.images[0], views.image_known[0])
    brought, _ = _fitted(torch.cat([image, binary]), camera, side)
    assert_colour(brought[:3], brought[3:])
    if size[0] == size[1]:  # then both show the whole picture
        assert torch.equal(square.known, views.image_known[0]) and torch.allclose(
            square.image, views.images[0], atol=1e-6
        )


def test_what_complete_tells_the_model_of_masked_photos():
    """Known pixels have the photo's colour and others are unknown: no dark rim."""
    side, told = 32, []

    class Listening(Fillerbuster):
        def complete(self, views: Views, **_) -> Views:  # pyright: ignore[reportIncompatibleMethodOverride]
            told.append(views)
            return views

    known = fractions(90, 70, 1)
    photo, camera = made(picture(90, 70, known), mask=known), camera_of(90, 70)
    path = Pinholes.cat([camera_of(side, side).to(torch.float32)] * 2)
    model = object.__new__(Listening)
    generate([photo] * 2, [camera] * 2, path, plan_passes(2, room=2), model, seed=0, sampling=SamplingConfig(steps=1))
    (views,) = told
    for view in range(2):
        assert_colour(views.images[view], views.image_known[view])
        assert set(views.image_known[view].unique().tolist()) == {0.0, 1.0}


@pytest.mark.parametrize("lens", [{"k1": -0.2}, {"k1": 0.15, "p1": 0.01}])
@pytest.mark.parametrize("mask", [rectangles, speckles])
def test_undistortion(lens: dict[str, float], mask: Known):
    known = mask(80, 100, 2)
    image, whole, _ = undistort(
        picture(80, 100, known, torch.full((3,), math.nan)), known, camera_of(80, 100), "OPENCV", lens
    )
    assert_colour(image, whole)


def test_captures_for_training_and_for_complete(tmp_path: Path):
    """Through files: 8 bits, alpha beside masks; colours are off by the files' rounding alone."""
    known = (rectangles(120, 90, 4) > 0).float()
    stored = picture(120, 90, known)
    camera = camera_of(120, 90)
    frames = [FrameToWrite(name=f"{index}", image=stored, mask=known, camera=camera) for index in range(2)]
    capture = write_capture(tmp_path / "capture", frames)
    for place in ((0.5, 0.5), (0.0, 1.0)):
        window = Window.of(capture.frames[0], place, CaptureConfig(image_size=32))
        assert_colour(*window.read(), atol=0.5 / 255 + 1e-5)
    photo = read_photos(tmp_path / "capture")[0]
    square = Square.of(photo, 32)
    assert_colour(square.image, square.known, atol=0.5 / 255 + 1e-5)


def _png(tmp_path: Path, image: torch.Tensor, alpha: torch.Tensor, dtype: type) -> bytes:
    import cv2

    top = np.iinfo(dtype).max
    rgba = (torch.cat([image, alpha]) * top).round().numpy().astype(dtype)
    cv2.imwrite(str(tmp_path / "a.png"), np.ascontiguousarray(rgba[[2, 1, 0, 3]].transpose(1, 2, 0)))
    return (tmp_path / "a.png").read_bytes()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_captioned_pictures_with_alpha(tmp_path: Path, dtype: type):
    known = rectangles(70, 110, 6)
    data = _png(tmp_path, picture(70, 110, known), known, dtype)
    image, truth = picture_of({"png": data})
    assert torch.equal(truth, known)
    source = object.__new__(CaptionedImages)
    source.config = CaptionedConfig(image_size=32)
    assert_colour(*source._crop(image, truth, [1.0, 0.3, 0.6]), atol=0.5 / 255 + 1e-5)
    jpeg, everywhere = picture_of(
        {"jpg": data}
    )  # the name does not matter to a decoder: colours without alpha are all true
    assert jpeg.shape == image.shape and bool((everywhere == 1).all())


def test_the_splats_coarse_target():
    """While training at a half or a quarter of the resolution, unknown colours are not averaged into pixels that are
    known in part.
    """
    known = rectangles(64, 96, 7)
    image = picture(64, 96, known)
    model = make_model(num_downscales=2, resolution_schedule=1000).train()
    model.step = 0
    batch = {"image": (image * 255).round().to(torch.uint8).movedim(0, -1), "mask": known.movedim(0, -1) > 0}
    supervision = model._supervision({"background": torch.zeros(3)}, batch)
    share, target = supervision.known, supervision.target
    assert share is not None and target.shape == (16, 24, 3) and bool(((share > 0) & (share < 1)).any())
    assert_colour(target.movedim(-1, 0), share.movedim(-1, 0), atol=0.5 / 255 + 1e-5)


def test_generated_views_take_their_colours_from_reliable_splats_alone():
    reliable = rectangles(8, 8, 8) > 0
    rgb = picture(8, 8, reliable.float())[None]
    colour = (COLOUR * 255).round().to(torch.uint8)
    views = CompletedViews(
        images=colour.expand(1, 64, 64, 3).contiguous(),
        masks=torch.ones(1, 64, 64, 1, dtype=torch.bool),
        cameras=camera_of(64, 64).to(torch.float32),
        origins=(Origin(role="anchor", round=0, seed=0, prompt="", model_hash=""),),
    )
    rendered = Rendered(rgb=rgb, depth=torch.ones(1, 8, 8), accumulation=torch.ones(1, 8, 8))
    unseen = Unseen(mask=~reliable, points=torch.zeros(1, 8, 8, 3))
    matched = with_matched_colors(views, unseen, rendered)
    assert int((matched.images.int() - views.images.int()).abs().max()) <= 1
