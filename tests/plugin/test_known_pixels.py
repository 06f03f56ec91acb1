"""Masks and alpha of a capture mean "1 = known" wherever they are looked at: training, metrics, context, placement,
start, export.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from helpers.plugin.datamanagers import generated, make, options, stand_in_model, two_views
from helpers.plugin.splat_models import make_model

from fb_core.completion.planning.context_views import nearest_context
from fb_core.completion.rounds import fitted_view
from fb_core.data import media
from fb_core.data.capture.captures import read_capture
from fb_core.geometry.shell import sphere
from fb_core.geometry.viewpoints.paths import seen_by
from fb_core.splatting import photometric
from fb_nerfstudio.capture.splat_renders import Rendered
from fb_nerfstudio.capture.start_points import start_points
from fb_nerfstudio.capture.unseen import coarse_mask, find_unseen, seen_by_nobody_else
from fb_nerfstudio.runs.export import write_export
from fb_nerfstudio.runs.saved_run import CompletedCapture

_ = stand_in_model  # no test here loads real weights
HOLE = (slice(8, 16), slice(10, 30))
"""Rows and columns that the capture does not know."""


@pytest.fixture
def transparent(tiny_capture: Path) -> Path:
    """The tiny capture, its masks as alpha of the pictures and loud colours where they are transparent."""
    content = json.loads((tiny_capture / "transforms.json").read_text())
    capture = read_capture(tiny_capture)
    for entry, frame in zip(content["frames"], capture.frames, strict=True):
        image, mask = 0.8 * frame.load_image(), frame.load_mask()  # as loud as the loud colour is nothing else
        loud = torch.tensor([1.0, 0.0, 1.0])[:, None, None].expand_as(image)
        entry.pop("mask_path", None)
        rgba = torch.cat([torch.where(mask > 0, image, loud), mask])
        from PIL import Image

        Image.fromarray((rgba * 255).round().byte().permute(1, 2, 0).numpy(), "RGBA").save(frame.image_path)
    (tiny_capture / "transforms.json").write_text(json.dumps(content))
    return tiny_capture


def hole_of(size: tuple[int, int] = (32, 48)) -> torch.Tensor:
    hole = torch.zeros(*size, dtype=torch.bool)
    hole[HOLE] = True
    return hole


# ---- alpha ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_alpha_becomes_the_mask_of_training_and_evaluation(transparent: Path, kind: str):
    manager = make(transparent, cache_images_type=kind)
    masked = [index for index, data in enumerate(manager.cached_train) if not bool(data["mask"].all())]
    assert masked == [1, 3, 5]
    for data in (*manager.cached_train, *manager.cached_eval):
        assert data["image"].shape == (32, 48, 3) and data["mask"].shape == (32, 48, 1)
    assert torch.equal(~manager.cached_train[1]["mask"][..., 0], hole_of())
    batches = [manager.next_train(step)[1] for step in range(6)]
    assert sum(not bool(batch["mask"].all()) for batch in batches) == 3


def test_transparent_pixels_teach_nothing_and_are_not_measured(transparent: Path):
    manager = make(transparent)
    data = manager.cached_train[1]
    model = make_model(background_color="black").train()
    rgb, background = torch.rand(32, 48, 3), torch.zeros(3)
    losses, figures = [], []
    for inside in (0.0, 1.0):
        rendered = torch.where(data["mask"], rgb, torch.full_like(rgb, inside))
        outputs = {"rgb": rendered, "background": background}
        losses.append(model.get_loss_dict(outputs, data)["main_loss"])
        figures.append(
            model.eval().get_image_metrics_and_images(outputs | {"background": background.expand_as(rgb)}, data)[0]
        )
        model.train()
    assert float(losses[0]) == float(losses[1]) and figures[0] == figures[1] and figures[0]["psnr"] > 0


def test_the_context_of_a_completion_has_holes_where_pictures_are_transparent(transparent: Path):
    manager = make(transparent)
    (captured,) = manager.captured_cameras()[1:2]
    view = manager.captured_view(1, captured)
    assert torch.equal(view.known[0] == 0, hole_of())
    fitted = fitted_view(view, 48)
    assert int((fitted.image_known[0, 0, 8:40] == 0).sum()) == 8 * 20
    assert float(fitted.images[0, :, 16:24, 10:30].abs().max()) == 0, "the loud colour reaches no model"


def test_no_start_point_comes_from_transparent_pixels(transparent: Path):
    """Points there would have the loud colour that nothing else has."""
    outputs = make(transparent, start_points=0, points=False).train_dataparser_outputs
    _, colors = start_points(outputs, count=400, seed=0)
    loud = (colors - torch.tensor([1.0, 0.0, 1.0])).abs().amax(dim=1) < 0.004
    assert len(colors) > 200 and not bool(loud.any())
    seen = start_points(
        dataclasses.replace(outputs, image_filenames=[_opaque(path) for path in outputs.image_filenames]),
        count=400,
        seed=0,
    )
    assert bool(((seen[1] - torch.tensor([1.0, 0.0, 1.0])).abs().amax(dim=1) < 0.004).any()), (
        "without alpha they would be there"
    )


def _opaque(path: Path) -> Path:
    target = path.with_name(f"opaque_{path.name}")
    media.write_image(target, media.read_image(path))
    return target


@pytest.mark.parametrize("format", ["nerfstudio", "colmap"])
def test_an_export_writes_alpha_as_masks_for_all_pictures(transparent: Path, tmp_path: Path, format):
    manager = make(transparent)
    generated(manager)
    from fb_core.geometry.similarity import Similarity

    completed = CompletedCapture(
        capture=read_capture(transparent),
        held_out=frozenset(),
        generated=dataclasses.replace(manager.generated_views, masks=torch.ones_like(manager.generated_views.masks)),
        world=Similarity.between(
            *[(torch.eye(3)[None].double(), torch.zeros(1, 3).double())] * 2, scale_of_one_place=1.0
        ),
        finished=True,
    )
    write_export(completed, tmp_path / "export", format=format, points=None)
    masks = sorted(path for path in (tmp_path / "export").rglob("*.png") if "masks" in path.parts)
    assert len(masks) == 6 + 6
    holes = [int((media.read_image(path)[0] == 0).sum()) for path in masks]
    assert sorted(holes) == [0] * 9 + [8 * 20] * 3


def test_alpha_is_told_from_the_header(transparent: Path, tiny_capture: Path, tmp_path: Path):
    assert all(media.has_alpha(frame.image_path) for frame in read_capture(transparent).frames)
    media.write_image(tmp_path / "plain.png", torch.rand(3, 4, 4))
    assert not media.has_alpha(tmp_path / "plain.png")


# ---- what was seen --------------------------------------------------------------------------------------------------


def test_a_point_in_an_unknown_part_of_a_picture_is_not_seen():
    (view,) = [two_views().cameras[0]]  # at the origin, along +x, 90 degrees wide
    points = torch.tensor([[2.0, 1.0, 1.0], [2.0, -1.0, 1.0], [2.0, 1.0, -1.0], [-2.0, 0.0, 0.0]])
    left = torch.zeros(4, 6, dtype=torch.bool)
    left[:, :3] = True
    assert seen_by([view], points).tolist() == [True, True, True, False]
    assert seen_by([view], points, [left]).tolist() == [True, False, True, False]  # +y is left
    assert seen_by([view], points, [None]).tolist() == seen_by([view], points).tolist()
    assert seen_by([view, view], points, [left, ~left]).tolist() == [True, True, True, False], "one of them is enough"


@pytest.mark.parametrize("trained", [False, True])
def test_pixels_masked_out_in_the_capture_are_unseen_in_generated_views(trained: bool):
    views = two_views()
    captured = dataclasses.replace(views.cameras[0], focal=views.cameras.focal[:1] / 2)  # looks the same way, wider
    known = torch.ones(64, 64, dtype=torch.bool)
    known[:, :32] = False  # the left half was masked out, and everything beside it to the left is as before
    rendered = None
    if trained:
        rendered = Rendered(
            depth=torch.full((2, 8, 8), 2.0), accumulation=torch.ones(2, 8, 8), rgb=torch.full((2, 3, 8, 8), 0.5)
        )
    whole = find_unseen(views.cameras, [captured], sphere(torch.zeros(3), 3.0), rendered)
    unseen = find_unseen(views.cameras, [captured], sphere(torch.zeros(3), 3.0), rendered, [known])
    assert not bool(whole.mask[0].any())
    assert bool(unseen.mask[0, :, :4].all()) and not bool(unseen.mask[0, :, 4:].any())


def test_small_masks_are_made_of_most_of_each_cell():
    known = torch.ones(1, 320, 480)
    assert coarse_mask(known) is None
    known[:, 80:160, 100:300] = 0
    small = coarse_mask(known)
    assert small.shape == (43, 64) and abs(float((~small).float().mean()) - 80 * 200 / (320 * 480)) < 0.01


def test_masked_pictures_leave_more_to_generate(tiny_capture: Path):
    """Through the datamanager: the same capture, without its masks, supervises less of the generated views."""
    config = options(generated_pixels="unseen", match_colors=False)
    masked = make(tiny_capture, config)
    generated(masked)
    content = json.loads((tiny_capture / "transforms.json").read_text())
    blocked = torch.zeros(1, 32, 48)
    blocked[:, 24:] = 1
    for entry in content["frames"]:
        media.write_image(tiny_capture / entry["mask_path"], blocked)
    fewer = make(tiny_capture, config)
    generated(fewer)
    assert int(fewer.generated_views.masks.sum()) > int(masked.generated_views.masks.sum())


def test_a_picture_that_hides_what_is_asked_for_is_no_context():
    views = two_views()
    hidden = torch.zeros(2, 2, dtype=torch.bool)
    same, shell = [views.cameras[0], views.cameras[0], views.cameras[1]], sphere(torch.zeros(3), 3.0)
    assert nearest_context(same, views.cameras[0], shell, 1, [hidden, None, None]) == [1]
    assert nearest_context(same, views.cameras[0], shell, 1, [None, hidden, None]) == [0]


def test_gaussians_that_only_leaving_views_saw():
    views = two_views()
    points = torch.tensor([[2.0, 0.0, 0.0], [-2.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
    captured, ahead, back = [views.cameras[0]], views[[0]], views[[1]]
    assert seen_by_nobody_else(points, back, None, captured).tolist() == [False, True, False]
    assert seen_by_nobody_else(points, views, None, []).tolist() == [True, True, False]
    assert seen_by_nobody_else(points, views, back, []).tolist() == [True, False, False]
    blind = torch.zeros(4, 4, dtype=torch.bool)
    assert seen_by_nobody_else(points, ahead, None, captured, [blind]).tolist() == [True, False, False]
    unsupervised = dataclasses.replace(back, masks=torch.zeros_like(back.masks))
    assert not bool(seen_by_nobody_else(points, unsupervised, None, captured).any())


def test_photometric_figures_are_of_known_pixels():
    first, second, known = torch.rand(20, 20, 3), torch.rand(20, 20, 3), torch.ones(20, 20, 1)
    known[:, :10] = 0
    changed = torch.where(known > 0, first, 1 - first)
    for figure in (photometric.l1, photometric.psnr, photometric.ssim):
        assert float(figure(first, second, known)) == pytest.approx(float(figure(changed, second, known)))


@pytest.mark.parametrize("told", ["masks", "alpha"])
@pytest.mark.parametrize("lens", [{"k1": -0.2, "p1": 0.01}, {"k1": 0.05, "k2": 0.01, "camera_model": "OPENCV_FISHEYE"}])
@pytest.mark.parametrize("kind", ["uint8", "float32"])
def test_a_bent_picture_of_one_colour_keeps_it_where_it_is_known(tiny_capture: Path, told: str, lens: dict, kind: str):
    """Undistortion mixes neighbours: what unknown ones were mixed into is unknown, on the way to splats and to the
    model.
    """
    content, colour = json.loads((tiny_capture / "transforms.json").read_text()), torch.tensor([51, 178, 102])
    capture = read_capture(tiny_capture)
    for entry, frame in zip(content["frames"], capture.frames, strict=True):
        known = frame.load_mask()
        loud = torch.tensor([1.0, 0.0, 1.0])[:, None, None]
        picture = torch.where(known > 0, colour[:, None, None] / 255, loud).expand(3, 32, 48)
        if told == "alpha":
            entry.pop("mask_path", None)
            _write_rgba(tiny_capture / entry["file_path"], torch.cat([picture, known]))
        else:
            media.write_image(tiny_capture / entry["file_path"], picture)
    (tiny_capture / "transforms.json").write_text(json.dumps(content | lens))
    manager = make(tiny_capture, start_points=0, cache_images_type=kind)
    holes = 0
    for index, data in enumerate(manager.cached_train):
        image = data["image"].float() * (1 if kind == "uint8" else 255)
        mask = data["mask"][..., 0]
        assert image.shape[-1] == 3 and mask.shape == image.shape[:2] and float(mask.float().mean()) > 0.6
        assert float((image[mask] - colour).abs().max()) <= 1, "a pixel of another colour counts as known"
        holes += int(not bool(mask[6:-6, 6:-6].all()))
        view = fitted_view(manager.captured_view(index, manager.captured_cameras()[index]), 24)
        there = view.image_known[0, 0] > 0
        assert float((255 * view.images[0][:, there].T - colour).abs().max()) <= 1
    assert holes >= 2


def _write_rgba(path: Path, rgba: torch.Tensor) -> None:
    from PIL import Image

    Image.fromarray((rgba * 255).round().to(torch.uint8).movedim(0, -1).contiguous().numpy()).save(path)
