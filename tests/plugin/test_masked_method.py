"""The masked protocol, camera paths and grids through the datamanager: what joins the bank, what is drawn, what is left
alone.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.folders.camera_paths import write_path
from helpers.plugin.datamanagers import (  # noqa: F401
    GreyFiller,
    attributes,
    draws,
    generated,
    make,
    options,
    run_callbacks,
    stand_in_model,
)

from fb_core.completion.inpainters.grid_inpainter import GridInpainter
from fb_core.completion.options import CompletionConfig, MaskedConfig
from fb_core.completion.results.completed_views import INPAINTED
from fb_core.data.capture.camera_path import read_camera_path
from fb_core.data.capture.captures import validate_capture
from fb_nerfstudio.datamanager import FillerbusterDataManager, Refused

MASKED = [1, 3, 5]  # of the tiny capture's six pictures
LOAD = FillerbusterDataManager.load_inpainter


def inpainting(dilate: int = 1, **changes) -> CompletionConfig:
    return options(task="inpaint", masked=MaskedConfig(dilate=dilate), **changes)


def test_masked_pictures_are_inpainted_at_full_size_and_supervise_their_holes(tiny_capture: Path, tmp_path: Path):
    manager = make(tiny_capture, inpainting())
    attrs = generated(manager, tmp_path / "run")
    bank = manager.generated_views
    assert (
        GreyFiller.calls == 1 and len(bank) == 3 and bank.images.shape[1:] == (32, 48, 3)
    )  # whole pictures are no copies
    assert {origin.role for origin in bank.origins} == {INPAINTED}
    assert bool(bank.masks[:, 7:17, 9:31].all()) and int(bank.masks.sum()) == 3 * 10 * 22
    assert attrs.pipeline.model.added == []  # no seed Gaussians, no depth
    capture = validate_capture(tmp_path / "run" / "completion", decode=True)
    assert len(capture) == 3 and capture.frames[0].extra["role"] == INPAINTED
    for place, index in enumerate(MASKED):
        data = manager.cached_train[index]
        known = data["mask"][..., 0] > 0
        assert int((~known).sum()) == 8 * 20  # the captured picture keeps its own mask
        assert torch.equal(bank.images[place][known], data["image"][known])


def test_captured_pictures_are_drawn_as_before_and_copies_by_their_holes(tiny_capture: Path):
    manager = make(tiny_capture, inpainting(generated_share=1.0, generated_steps="shared"))
    generated(manager)
    holes = 3 * 10 * 22 / (32 * 48)
    assert manager.generated_probability == pytest.approx(holes / (holes + 6))
    seen = draws(manager, range(200))
    assert {one for one in seen if isinstance(one, int)} == set(range(6))
    assert len({one for one in seen if isinstance(one, str)}) == 3


def test_a_resumed_run_inpaints_nothing_again(tiny_capture: Path):
    first = make(tiny_capture, inpainting())
    generated(first)
    second = make(tiny_capture, inpainting())
    second.load_state_dict(first.state_dict())
    generated(second)
    assert GreyFiller.calls == 1 and torch.equal(first.generated_views.images, second.generated_views.images)


def test_later_inpainting_leaves_colours_and_masks_as_they_are(tiny_capture: Path):
    """Splats that see a wall must not mend what was mended against the photos."""
    early, late = make(tiny_capture, inpainting()), make(tiny_capture, inpainting(at_step=200))
    generated(early)
    generated(late, step=200)
    assert torch.equal(early.generated_views.images, late.generated_views.images)
    assert torch.equal(early.generated_views.masks, late.generated_views.masks)


def test_nothing_to_inpaint_in_the_chosen_pictures_is_one_sentence(tiny_capture: Path):
    config = options(task="inpaint", masked=MaskedConfig(views=1, dilate=0))  # picture 0, which is whole
    with pytest.raises(Refused, match="the only picture has no unknown pixels"):
        generated(make(tiny_capture, config))


def test_the_grid_inpainter_is_chosen_and_runs(tiny_capture: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(FillerbusterDataManager, "load_inpainter", LOAD)
    manager = make(tiny_capture, inpainting(inpainter="grid", image_size=32))
    assert isinstance(manager.load_inpainter(), GridInpainter)
    generated(manager)
    bank = manager.generated_views
    assert len(bank) == 3 and bank.origins[0].model_hash == GridInpainter.of(None, "cpu").model_hash
    inside = bank.images[:, 8:16, 10:30].float().std(dim=(1, 2))
    assert bool((inside < 60).all()) and bool((bank.images[:, 8:16, 10:30] > 0).any())  # continued, not black


def test_a_path_is_generated_in_the_splats_world_and_its_margins_are_not_trained_on(tiny_capture: Path, tmp_path: Path):
    file = write_path(tmp_path / "path.json", 5, width=32, height=16)
    manager = make(tiny_capture, options(anchor_views=3, camera_path=file))
    generated(manager)
    bank = manager.generated_views
    wanted = read_camera_path(file, size=16).cameras.camera_to_world
    assert sorted(map(str, bank.cameras.camera_to_world.tolist())) == sorted(map(str, wanted.tolist()))
    assert not bool(bank.masks[:, :4].any()) and not bool(bank.masks[:, 12:].any())


def test_no_copy_of_a_conditioning_view_is_ever_in_the_bank(tiny_capture: Path):
    manager = make(tiny_capture, options())
    generated(manager)
    captured = torch.stack([camera.camera_to_world[0] for camera in manager.captured_cameras()])
    distance = (manager.generated_views.cameras.camera_to_world[:, None] - captured[None]).abs().amax(dim=(2, 3))
    assert float(distance.min()) > 1e-3


def test_requests_are_not_taken_where_no_camera_is_placed(tiny_capture: Path):
    manager = make(tiny_capture, inpainting())
    run_callbacks(manager, attributes(manager))
    assert "without new views" in (manager.completion_panel.requests.closed or "")
