"""Generated views in the viewer: frustums, rounds, switches."""

from __future__ import annotations

from pathlib import Path

import torch
from helpers.plugin.datamanagers import (
    generated,
    make,
    stand_in_model,  # noqa: F401
    toy_viewer,
)

# ---- viewer ---------------------------------------------------------------------------------------------------------


def test_without_a_viewer_the_panel_does_nothing(tiny_capture: Path):
    manager = make(tiny_capture)
    generated(manager)
    assert not manager.completion_panel.is_open


def test_frustums_stand_in_one_group_per_round_with_a_switch_each(tiny_capture: Path):
    manager, viewer = make(tiny_capture), toy_viewer()
    manager.completion_panel._setup(viewer)
    server = viewer.viser_server
    assert list(server.boxes) == ["Captured (6)"] and "No generated" in server.status.content
    assert "Nothing trains here" in server.status.content and all(field.disabled for field in server.fields.values())
    generated(manager)
    assert list(server.boxes) == ["Captured (6)", "Anchors (4)", "Round 1 (2)"]
    assert len([name for name in server.nodes if "view_" in name]) == 6
    assert server.status.content == "6 generated views"
    server.switch("Anchors (4)", False)
    assert not server.nodes["/completion/round_00"].visible and server.nodes["/completion/round_01"].visible
    server.switch("Captured (6)", False)
    assert viewer.visible == [False]
    frustum, camera = server.nodes["/completion/round_00/view_000"], manager.generated_views.cameras
    assert torch.allclose(torch.from_numpy(frustum.position).float(), 10 * camera.centers[0], atol=1e-5)
    assert frustum.image.shape == (16, 16, 3)


def test_a_saved_run_is_drawn_whether_the_viewer_comes_first_or_last(tiny_capture: Path):
    trained = make(tiny_capture)
    generated(trained)
    state = trained.state_dict()
    for viewer_first in (True, False):
        manager, viewer = make(tiny_capture, test_mode="test"), toy_viewer()
        if viewer_first:  # ns-train --load-dir
            manager.completion_panel._setup(viewer)
        manager.load_state_dict(state, strict=False)
        if not viewer_first:  # ns-viewer
            manager.completion_panel._setup(viewer)
        assert len([name for name in viewer.viser_server.nodes if "view_" in name]) == 6
        manager.generation.set_views(None)
        assert viewer.viser_server.nodes == {}


def test_nerfstudios_viewer_finds_the_panel(tiny_capture: Path):
    from nerfstudio.viewer.utils import parse_object
    from nerfstudio.viewer.viewer_elements import ViewerControl

    manager = make(tiny_capture)
    holder = torch.nn.Module()
    holder.datamanager = manager
    assert [found for _, found in parse_object(holder, ViewerControl, "Custom Elements")] == [manager.completion_panel]
