"""The masked protocol: which pictures are inpainted, what of them is new, what supervises; and the 2D baseline on grids
of views.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from helpers.scenes.completions import MeanFiller, captured, room_cameras

from fb_core.completion.inpainters.grid_inpainter import GridInpainter, OpenCvInpainter, grids_of
from fb_core.completion.inpainting import announcement_of_inpainting, pasted, plan_inpainting, run_inpainting
from fb_core.completion.options import CompletionConfig, MaskedConfig
from fb_core.completion.results.completed_views import INPAINTED, CompletedViews
from fb_core.completion.rounds import CapturedView
from fb_core.geometry.cameras import Pinholes
from fb_core.inpainter import SamplingConfig
from fb_core.views import Views

SAMPLING = SamplingConfig(steps=2)


def options(views: int = 32, dilate: int = 0, **more) -> CompletionConfig:
    return CompletionConfig(task="inpaint", steps=2, masked=MaskedConfig(views=views, dilate=dilate), **more)


def with_holes(
    cameras: list[Pinholes], *, every: int = 1, rows: slice = slice(4, 8), columns: slice = slice(6, 12)
) -> list[CapturedView]:
    """Flat pictures of different greys, every so many with a block that is unknown and holds NaN."""
    views = captured(cameras)
    for index, view in enumerate(views):
        if index % every == 0:
            view.known[:, rows, columns] = 0
            view.image[:, rows, columns] = float("nan")
    return views


def inpaint(
    views: list[CapturedView], config: CompletionConfig, model=None, done=None
) -> tuple[list[CompletedViews], MeanFiller]:
    model = model or MeanFiller()
    plan = plan_inpainting([view.camera for view in views], None, config, size=16)
    return list(run_inpainting(plan, [views[index] for index in plan.context], model, config, done=done)), model


def test_known_pixels_are_the_captures_and_the_hole_is_filled_and_supervises():
    views = with_holes(room_cameras(6, size=16))
    (bank,), model = inpaint(views, options())
    assert len(model.asked) == 1 and len(model.asked[0]) == 6  # all together, once
    for view, image, mask in zip(views, bank.images, bank.masks, strict=True):
        known = view.known[0] > 0
        assert torch.equal(mask[..., 0], ~known)
        expected = (view.image.permute(1, 2, 0) * 255).round().to(torch.uint8)
        assert torch.equal(image[known], expected[known])
    assert {origin.role for origin in bank.origins} == {INPAINTED} and bank.rounds == [0]


def test_the_filling_meets_the_known_pixels_in_colour():
    """The stand-in fills with the mean grey of all pictures; beside a hole each picture's own grey is known."""
    (bank,), model = inpaint(with_holes(room_cameras(6, size=64), rows=slice(28, 32), columns=slice(28, 32)), options())
    asked = model.asked[0]
    filling = float(asked.images[asked.image_known.expand_as(asked.images) > 0].mean())
    for index in (0, 5):
        own = 0.2 + 0.1 * index
        assert (bank.images[index, 28:32, 28:32].float() / 255 - own).abs().max() < 0.7 * abs(filling - own)


def test_full_resolution_is_kept_and_the_model_sees_its_own_size():
    views = with_holes(room_cameras(3, size=50), rows=slice(10, 30), columns=slice(10, 30))
    (bank,), model = inpaint(views, options())
    assert bank.images.shape == (3, 50, 50, 3) and model.asked[0].size == (16, 16)
    assert torch.allclose(bank.cameras[1].camera_to_world, views[1].camera.camera_to_world)
    assert torch.allclose(bank.cameras[1].focal, views[1].camera.focal)


def test_dilation_hides_a_rim_from_the_model_which_supervises_with_captured_colours():
    views = with_holes(room_cameras(2, size=16))
    (bank,), model = inpaint(views, options(dilate=2))
    assert float((model.asked[0].image_known[0] == 0).sum()) == 8 * 10 and int(bank.masks[0].sum()) == 8 * 10
    assert torch.equal(bank.images[0, 2, 4], (views[0].image[:, 2, 4] * 255).round().to(torch.uint8))


def test_whole_pictures_help_and_are_not_trained_on_again():
    (bank,), model = inpaint(with_holes(room_cameras(6, size=16), every=2), options(generated_pixels="all"))
    assert len(model.asked[0]) == 6 and len(bank) == 3 and bool(bank.masks.all())


def test_equally_spaced_pictures_fewer_when_there_are_fewer():
    cameras = room_cameras(9, size=16)
    assert plan_inpainting(cameras, None, options(views=5), size=16).context == (0, 2, 4, 6, 8)
    plan = plan_inpainting(cameras, None, options(), size=16)
    assert plan.context == tuple(range(9)) and len(plan.rounds) == 1 and plan.rounds[0].role == INPAINTED
    assert "9 equally spaced of 9 captured views (asked for 32" in announcement_of_inpainting(
        plan, options(), MeanFiller()
    )


@pytest.mark.parametrize("count", [1, 2, 3])
def test_captures_of_one_two_and_three_pictures(count: int):
    (bank,), _ = inpaint(with_holes(room_cameras(3, size=16)[:count]), options())
    assert len(bank) == count


def test_mixed_sizes_and_portrait_share_a_bank_and_padding_supervises_nothing():
    cameras = room_cameras(3, size=48)
    cameras[1] = cameras[1].scaled(24, 40)
    (bank,), _ = inpaint(with_holes(cameras), options(generated_pixels="all"))
    assert bank.images.shape == (3, 48, 48, 3)
    assert bool(bank.masks[1, :40, :24].all()) and int(bank.masks[1].sum()) == 40 * 24
    assert torch.allclose(bank.cameras[1].principal, cameras[1].principal)  # a pixel looks where it looked


def test_a_picture_that_is_wholly_unknown_is_generated():
    views = with_holes(room_cameras(3, size=16), every=5)
    views[1].known[:] = 0
    (bank,), _ = inpaint(views, options())
    assert len(bank) == 2 and bool(bank.masks[1].all()) and bool(torch.isfinite(bank.images.float()).all())


def test_nothing_to_inpaint_and_nothing_known_are_one_sentence_each():
    views = captured(room_cameras(3, size=16))
    with pytest.raises(ValueError, match=r"the 3 pictures that were chosen have no unknown pixels"):
        inpaint(views, options())
    for view in views:
        view.known[:] = 0
    with pytest.raises(ValueError, match=r"no known pixels"):
        inpaint(views, options())
    with pytest.raises(ValueError, match="the only picture has no known pixels"):
        inpaint(with_holes(room_cameras(1, size=16)), options(dilate=16))


def test_an_interrupted_run_that_has_its_views_generates_nothing():
    views = with_holes(room_cameras(2, size=16))
    (bank,), _ = inpaint(views, options())
    rounds, model = inpaint(views, options(), done=bank)
    assert rounds == [] and model.asked == []


def test_pasting_undoes_the_fit():
    """A smooth picture that was generated perfectly comes back at its own size and shape."""
    from fb_core.completion.rounds import fitted_view

    camera = room_cameras(1, size=64)[0].scaled(64, 36)
    rows, columns = torch.linspace(0, 1, 36), torch.linspace(0, 1, 64)
    image = torch.stack([rows[:, None].expand(36, 64), columns[None].expand(36, 64), 0.5 * torch.ones(36, 64)])
    known = torch.ones(1, 36, 64)
    square = fitted_view(CapturedView(image=image, known=known, camera=camera), 32).images[0]
    known[:, 10:20, 20:40] = 0
    assert (pasted(CapturedView(image=image, known=known, camera=camera), square) - image).abs().max() < 0.02


def test_a_window_reaches_the_sampler():
    _, model = inpaint(with_holes(room_cameras(4, size=16)), options(window=2))
    assert model.sampling[0].window == 2


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"inpainter": "grid"}, "knows no cameras"),
        ({"inpainter_weights": Path("weights")}, "need completion.inpainter grid"),
        ({"task": "inpaint", "camera_path": Path("path.json")}, "places no camera"),
        ({"window": 0}, "window"),
    ],
)
def test_options_that_contradict_each_other_are_refused(wrong: dict, sentence: str):
    with pytest.raises(ValueError, match=sentence):
        CompletionConfig(**wrong)


@pytest.mark.parametrize("wrong", [{"views": 0}, {"dilate": -1}])
def test_nonsense_options_of_masks_are_refused(wrong: dict):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        MaskedConfig(**wrong)


# ------------------------------------------------------------------------------------------------------------ the grids


def some_views(count: int, size: int = 16) -> Views:
    cameras = Pinholes.cat(room_cameras(max(count, 1), size=size)[:count])
    known = torch.ones(count, 1, size, size)
    known[:, :, 4:8, 6:12] = 0
    return Views.known(torch.rand(count, 3, size, size), cameras, mask=known)


def test_each_view_stands_in_one_grid_and_the_seed_decides_which():
    grids = grids_of(torch.arange(10), torch.Generator().manual_seed(0))
    assert [len(grid) for grid in grids] == [4, 4, 4]
    placed = [cell for grid in grids for cell in grid]
    assert sorted(placed[:10]) == list(range(10)) and placed[10:] == placed[:2]
    assert grids == grids_of(torch.arange(10), torch.Generator().manual_seed(0))
    assert grids != grids_of(torch.arange(10), torch.Generator().manual_seed(1))
    assert grids_of(torch.tensor([7]), torch.Generator()) == [[7, 7, 7, 7]]
    assert grids_of(torch.tensor([], dtype=torch.long), torch.Generator()) == []


class Recorder:
    """A 2D inpainter that fills with the place in the grid: 0.25 above left, then to the right and down."""

    name, model_hash, weight_free = "a recorder", "ab" * 32, True

    def __init__(self) -> None:
        self.asked: list[tuple[torch.Tensor, torch.Tensor]] = []

    def fill(self, image, known, *, seed, sampling, prompt):
        self.asked.append((image, known))
        half = image.shape[1] // 2
        filled = torch.full_like(image, 0.25)
        filled[:, :half, half:], filled[:, half:, :half], filled[:, half:, half:] = 0.5, 0.75, 1.0
        return filled


@pytest.mark.parametrize("count", [1, 3, 4, 6])
def test_grids_keep_known_pixels_and_fill_every_hole(count: int):
    views, recorder, steps = some_views(count), Recorder(), []
    filled = GridInpainter(recorder).complete(
        views, generator=torch.Generator().manual_seed(0), sampling=SAMPLING, on_step=lambda *step: steps.append(step)
    )
    known = views.image_known.expand_as(views.images) > 0
    assert torch.equal(filled.images[known], views.images[known]) and bool((filled.image_known == 1).all())
    holes = filled.images[:, 0, 4:8, 6:12]
    assert set(holes.flatten().tolist()) <= {0.25, 0.5, 0.75, 1.0} and all(len(hole.unique()) == 1 for hole in holes)
    grids = -(-count // 4)
    assert steps == [(number + 1, grids) for number in range(grids)]
    if count == 6:  # the last grid is filled up with views that are done, and these are known there
        assert float((recorder.asked[1][1] == 0).sum()) == 2 * 4 * 6


def test_whole_views_stay_out_of_the_grids():
    views = some_views(5)
    views.image_known[:4] = 1
    recorder = Recorder()
    GridInpainter(recorder).complete(views, generator=torch.Generator(), sampling=SAMPLING)
    assert len(recorder.asked) == 1


def test_opencv_continues_a_flat_picture_flatly_and_needs_no_known_pixel():
    image, known = torch.full((3, 32, 32), 0.4), torch.ones(1, 32, 32)
    image[:, 10:20, 10:20], known[:, 10:20, 10:20] = 0.0, 0.0
    filled = OpenCvInpainter().fill(image, known, seed=0, sampling=SAMPLING, prompt="")
    assert (filled - 0.4).abs().max() < 0.01
    assert bool(
        (OpenCvInpainter().fill(image, torch.zeros_like(known), seed=0, sampling=SAMPLING, prompt="") == 0.5).all()
    )


def test_the_baseline_completes_a_masked_capture_and_says_what_it_is():
    model = GridInpainter.of(None, "cpu")
    views = with_holes(room_cameras(5, size=16))
    config = options(inpainter="grid")
    (bank,), _ = inpaint(views, config, model=model)
    for index, image in enumerate(bank.images):  # OpenCV continues what is around the hole
        assert (image.float() / 255 - (0.2 + 0.1 * index)).abs().max() < 0.15
    said = announcement_of_inpainting(plan_inpainting(room_cameras(5), None, config, size=16), config, model)
    assert (
        "weight-free 2D inpainter (OpenCV, Telea) on 2x2 grids" in said
        and "without diffusion" in said
        and "steps" not in said
    )


def test_without_diffusers_or_a_pipeline_one_sentence_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    with pytest.raises(ValueError, match=r"completion\.inpainter_weights .*no model_index\.json"):
        GridInpainter.of(tmp_path, "cpu")
    (tmp_path / "model_index.json").write_text("{}")
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(ValueError, match=r"diffusers is not installed; pip install 'fillerbuster\[baselines\]'"):
        GridInpainter.of(tmp_path, "cpu")


def test_diffusers_is_called_with_what_it_documents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The glue alone, with a stand-in module: no pipeline is run here."""
    calls: dict[str, dict] = {}

    class Pipeline:
        @staticmethod
        def from_pretrained(folder: str, **options):
            if not (Path(folder) / "unet.safetensors").exists():
                raise OSError("no file named unet.safetensors\nmore lines")
            calls["load"] = {"folder": folder, **options}
            return Pipeline()

        def set_progress_bar_config(self, disable: bool) -> None: ...

        def to(self, device):
            return self

        def __call__(self, **options):
            calls["run"] = options
            return SimpleNamespace(images=torch.full((1, 3, options["height"], options["width"]), 0.75))

    module = ModuleType("diffusers")
    module.AutoPipelineForInpainting = Pipeline
    monkeypatch.setitem(sys.modules, "diffusers", module)
    (tmp_path / "model_index.json").write_text('{"safety_checker": [null, null]}')
    with pytest.raises(ValueError, match=r"diffusers cannot load it \(no file named unet\.safetensors\)"):
        GridInpainter.of(tmp_path, "cpu")
    (tmp_path / "unet.safetensors").write_bytes(b"weights")
    model = GridInpainter.of(tmp_path, "cpu")
    views = some_views(4)
    filled = model.complete(views, generator=torch.Generator(), sampling=SAMPLING, prompt="a room")
    assert (
        calls["load"]["local_files_only"]
        and calls["load"]["use_safetensors"]
        and calls["load"]["safety_checker"] is None
    )
    run = calls["run"]
    assert (
        run["image"].shape == (1, 3, 32, 32) and run["mask_image"].shape == (1, 1, 32, 32) and run["prompt"] == "a room"
    )
    assert float(run["mask_image"].sum()) == 4 * 4 * 6 and run["num_inference_steps"] == 2
    assert bool((filled.images[:, :, 4:8, 6:12] == 0.75).all())
    before = model.model_hash
    (tmp_path / "unet.safetensors").write_bytes(b"others")
    assert GridInpainter.of(tmp_path, "cpu").model_hash != before
