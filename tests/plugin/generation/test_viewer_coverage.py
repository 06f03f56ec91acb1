"""The viewer shows what nobody has seen, cameras before their views, trust; and completes what is missing on
request.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from helpers.plugin.datamanagers import GreyFiller, attributes, make, options, run_callbacks, stand_in_model, toy_viewer
from helpers.plugin.rounds import TURNS
from helpers.scenes.trusted import views_of

from fb_core.completion.requests import MOST_VIEWS, CompleteMissing
from fb_nerfstudio.viewer_coverage import picture_of

__all__ = ["stand_in_model"]  # no test here loads real weights


def test_pictures_show_trust_or_what_is_trained_on() -> None:
    views = views_of(1.0)
    trust = torch.zeros(3, 16, 16, 1, dtype=torch.uint8)
    trust[:, :, 8:] = 255
    masks = views.masks.clone()
    masks[:, :8] = False
    views = dataclasses.replace(views, images=views.images + 200, masks=masks, trust=trust)
    assert np.array_equal(picture_of(views, 0, "generated"), views.images[0].numpy())
    trained = picture_of(views, 0, "trained on", stride=2)
    assert trained.shape == (8, 8, 3) and trained[0, 0, 0] == 50 and trained[7, 0, 0] == 200
    shown = picture_of(views, 0, "trust").astype(int)
    assert shown[0, 0, 0] > shown[0, 0, 2] and shown[0, 15, 2] > shown[0, 15, 0], (
        "orange where doubted, blue where believed"
    )
    plain = dataclasses.replace(views, trust=None)
    assert np.array_equal(picture_of(plain, 0, "trust"), picture_of(plain, 1, "trust"))


def test_planned_cameras_stand_there_until_their_views_do_and_unseen_surroundings_are_points(
    tiny_capture, tmp_path
) -> None:
    manager, viewer = make(tiny_capture, options(**TURNS)), toy_viewer()
    manager.completion_panel._setup(viewer)
    server, seen = viewer.viser_server, []
    complete = GreyFiller.complete

    def watched(self, *given, **named):
        seen.append({name for name in server.nodes if "planned" in name})
        return complete(self, *given, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GreyFiller, "complete", watched)
        run_callbacks(manager, attributes(manager, tmp_path), 200)
    assert len(seen) == 1 and len(seen[0]) == len(manager.generated_views)
    assert not any("planned" in name for name in server.nodes), "the views themselves stand there now"
    cloud = server.nodes["/completion/unseen"]
    assert len(cloud.points) == len(cloud.colors) > 0 and np.isfinite(cloud.points).all()
    assert "is unseen" in server.status.content
    server.switch("What nobody has seen", False)
    assert not cloud.visible
    before = server.nodes["/completion/round_00/view_000"].image
    choice = server.fields["Pictures show"]
    choice.value = "trust"
    server.click("Pictures show")
    assert not np.array_equal(server.nodes["/completion/round_00/view_000"].image, before)


def test_what_is_missing_is_completed_on_request(tiny_capture, tmp_path) -> None:
    manager, viewer = make(tiny_capture, options(**TURNS)), toy_viewer()
    manager.completion_panel._setup(viewer)
    attrs = attributes(manager, tmp_path)
    run_callbacks(manager, attrs, 200)
    before = manager.generated_views
    viewer.viser_server.fields["Views"].value = 2
    viewer.viser_server.click("Complete what is missing")
    (request,) = manager.completion_panel.requests._waiting
    assert request == CompleteMissing(views=2, seed=1)
    run_callbacks(manager, attrs, 201)
    after = manager.generated_views
    said = viewer.viser_server.status.content
    if len(after) == len(before):
        assert "no further view would show enough" in said
    else:
        assert len(after) <= len(before) + 2 and after.origins[-1].role == "requested" and after.origins[-1].seed == 1
    for bad in (0, MOST_VIEWS + 1):
        with pytest.raises(ValueError, match="views: expected 1"):
            CompleteMissing(views=bad)
