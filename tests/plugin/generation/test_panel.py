"""The viewer's panel: buttons, clicks, rounds, progress."""

from __future__ import annotations

from types import SimpleNamespace

import torch
from helpers.plugin.requests import bank_of, opened_panel

from fb_core.completion.requests import (
    RegenerateRound,
    RemoveView,
    key_of,
    without_view,
)

# ---- panel ----------------------------------------------------------------------------------------------------------


def test_the_button_asks_for_views_from_where_the_person_stands():
    panel, viewer = opened_panel(bank_of(("anchor", 0, 2)))
    server = viewer.viser_server
    server.client.camera.position = (10.0, 20.0, 30.0)
    server.fields["Views"].value, server.fields["Prompt"].value, server.fields["Seed"].value = 5, "  a door ", 11
    server.click("Complete from here")
    request = panel.requests.take()
    assert (request.views, request.seed, request.prompt) == (5, 11, "a door") and server.fields["Seed"].value == 12
    assert torch.allclose(
        request.camera_to_world, torch.cat([torch.eye(3), torch.tensor([[1.0], [2.0], [3.0]])], dim=1)
    )
    assert "5 views from here" in server.status.content and "Waiting for the training" in server.status.content
    viewer.trainer = SimpleNamespace(training_state="paused")
    server.click("Complete from here")
    assert "paused" in server.status.content
    server.fields["Views"].value = 0
    server.click("Complete from here")
    assert "expected 1 to" in server.status.content and len(panel.requests) == 1


def test_a_click_selects_a_view_and_the_button_asks_to_remove_it():
    bank = bank_of(("anchor", 0, 2), ("densify", 1, 2))
    panel, viewer = opened_panel(bank)
    server = viewer.viser_server
    assert server.fields["Remove this view"].disabled and not server.fields["Complete from here"].disabled
    server.click("/completion/round_01/view_001")
    assert "Selected: Round 1, seed 101" in server.status.content and "/completion/selected" in server.nodes
    server.click("Go to selected view")
    assert torch.allclose(torch.tensor(server.client.camera.position).float(), 10 * bank.cameras.centers[3], atol=1e-5)
    server.click("Remove this view")
    assert panel.requests.take() == RemoveView(key=key_of(bank, 3))
    other = server.nodes["/completion/round_00/view_000"]
    panel.show(without_view(bank, key_of(bank, 3)))
    assert "/completion/selected" not in server.nodes and server.fields["Remove this view"].disabled
    assert server.nodes["/completion/round_00/view_000"] is other, "rounds that did not change are not drawn again"
    assert "/completion/round_01/view_001" not in server.nodes and "3 generated views" in server.status.content


def test_a_hidden_round_stays_hidden_when_it_changes():
    bank = bank_of(("anchor", 0, 3))
    panel, viewer = opened_panel(bank)
    server = viewer.viser_server
    server.switch("Anchors (3)", False)
    panel.show(bank[[0, 2]])
    assert list(server.boxes) == ["Captured (0)", "Anchors (2)"]
    assert not server.boxes["Anchors (2)"].value and not server.nodes["/completion/round_00"].visible


def test_rounds_are_offered_to_be_generated_anew():
    panel, viewer = opened_panel(bank_of(("anchor", 0, 2), ("densify", 1, 2), ("requested", 4, 1)))
    server = viewer.viser_server
    assert server.fields["Round"].options == ("Anchors (2)", "Round 1 (2)", "Requested 4 (1)")
    server.fields["Round"].value = "Requested 4 (1)"
    server.click("Regenerate round")
    assert panel.requests.take() == RegenerateRound(number=4, seed=1)


def test_progress_is_a_bar_while_something_runs():
    panel, viewer = opened_panel(bank_of(("anchor", 0, 1)))
    bar = viewer.viser_server.bar
    assert not bar.visible
    panel.report("Generating, step 3 of 12", share=0.25)
    assert bar.visible and bar.value == 25.0
    panel.report("")
    assert not bar.visible
