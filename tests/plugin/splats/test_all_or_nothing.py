"""What is asked for in the viewer is done whole or not at all: views, Gaussians, optimizers, what is outdated,
checkpoint and folder.
"""

from __future__ import annotations

import logging
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers.plugin.datamanagers import (
    GreyFiller,
    ToyTrainer,
    generated,
    make,
    options,
    run_callbacks,
    stand_in_model,  # noqa: F401  # a fixture that every test here uses
)
from helpers.plugin.requests import TrackedSplats, ask_for, bank_of, opened_panel, said
from helpers.plugin.splat_models import make_model, make_optimizers, train_step
from helpers.processes.contents import content
from nerfstudio.engine.callbacks import TrainingCallbackAttributes

from fb_core.completion.requests import RegenerateRound, RemoveView, RequestQueue, key_of
from fb_core.completion.results.completed_views import ANCHOR
from fb_core.data import media
from fb_nerfstudio.datamanager import FillerbusterDataManager
from fb_nerfstudio.generation import due_rounds, generation
from fb_nerfstudio.generation.bank import Bank
from fb_nerfstudio.splats.all_or_nothing import undone_on_error

# ---- Gaussians -------------------------------------------------------------------------------------------------------


def everything(model: Any, optimizers: Any) -> dict[str, torch.Tensor]:
    found = {f"gaussians {name}": values.detach().clone() for name, values in model.gauss_params.items()}
    found |= {
        f"counted {name}": values.clone()
        for name, values in model.strategy_state.items()
        if isinstance(values, torch.Tensor)
    }
    for name, optimizer in optimizers.optimizers.items():
        for key, value in optimizer.state[optimizer.param_groups[0]["params"][0]].items():
            found[f"{name} {key}"] = value.clone()
    return found


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_gaussians_that_went_and_came_are_as_before(error: type[BaseException]):
    """And training goes on to the same bits as if nothing had been tried."""

    def seeded(step: int, model: Any = None, its: Any = None) -> Any:
        torch.manual_seed(step)
        return make_model() if model is None else train_step(model, its, step)

    trained, twin = seeded(0), seeded(0)
    optimizers, twins = make_optimizers(trained), make_optimizers(twin)
    for step in (1, 2):
        seeded(step, trained, optimizers)
        seeded(step, twin, twins)
    before, held = everything(trained, optimizers), dict(trained.gauss_params.items())
    with pytest.raises(error), undone_on_error(trained, optimizers):
        trained.remove_gaussians(torch.arange(60) < 20, optimizers)
        trained.add_gaussians(torch.rand(5, 3), torch.rand(5, 3), optimizers)
        assert trained.num_points == 45
        raise error
    after = everything(trained, optimizers)
    assert before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in before)
    assert all(trained.gauss_params[name] is values for name, values in held.items())
    assert all(optimizers.parameters[name][0] is values for name, values in held.items())
    seeded(3, trained, optimizers)
    seeded(3, twin, twins)
    assert all(
        torch.equal(values, everything(twin, twins)[name]) for name, values in everything(trained, optimizers).items()
    )


def test_without_an_error_the_change_stays():
    model = make_model()
    optimizers = make_optimizers(model)
    with undone_on_error(model, optimizers):
        model.remove_gaussians(torch.arange(60) < 20, optimizers)
    assert model.num_points == 40
    with pytest.raises(ValueError), undone_on_error(TrackedSplats(), None):  # stand-ins have nothing to keep
        raise ValueError


# ---- requests --------------------------------------------------------------------------------------------------------


def of_bank(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> Any:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(Bank, "of", staticmethod(fail))


def of_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Any, views: Any) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr("fb_nerfstudio.viewer.CompletionPanel.show", fail)


def of_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise OSError(28, "out of memory")

    monkeypatch.setattr(media, "write_image", fail)


def of_checkpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(ToyTrainer, "save_checkpoint", fail)


def of_fitting_in(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr(generation, "fitted_in", fail)


REQUESTS = {
    "a view goes": (of_bank, of_drawing, of_pictures, of_checkpoints),
    "anchors anew": (of_fitting_in, of_checkpoints),
}


@pytest.mark.parametrize(("asked", "fault"), [(asked, fault) for asked, faults in REQUESTS.items() for fault in faults])
def test_a_request_that_fails_changes_nothing(
    asked: str, fault: Any, tiny_capture: Path, tmp_path: Path, monkeypatch, caplog
):
    manager = make(tiny_capture, options(generated_pixels="all"))
    attrs: TrainingCallbackAttributes = generated(manager, tmp_path)
    model = make_model(300)
    with torch.no_grad():
        model.gauss_params["means"] *= 20  # all around
    attrs.pipeline.model, attrs.optimizers = model, make_optimizers(model)  # type: ignore[union-attr]
    bank, gaussians = manager.generated_views, model.gauss_params["means"]
    files = content(tmp_path)
    request = RegenerateRound(number=0, seed=3) if asked == "anchors anew" else RemoveView(key=key_of(bank, 0))
    ask_for(manager, request)
    with monkeypatch.context() as broken, caplog.at_level(logging.WARNING):
        fault(broken)
        run_callbacks(manager, attrs, 1)
    assert (
        said(manager).startswith("Not done: ") and "out of memory" in said(manager) and "out of memory" in caplog.text
    )
    assert manager.generated_views is bank and model.gauss_params["means"] is gaussians and model.num_points == 300
    assert manager.get_extra_state()["outdated"] == []
    assert content(tmp_path) == files
    ask_for(manager, request)  # nothing is broken any more
    run_callbacks(manager, attrs, 2)
    assert manager.generated_views is not bank and (model.num_points < 300 or asked == "anchors anew")


def test_an_interruption_amid_a_request_changes_nothing(tiny_capture: Path, tmp_path: Path, monkeypatch):
    manager = make(tiny_capture)
    attrs = generated(manager, tmp_path)
    bank = manager.generated_views

    def interrupted(*_: Any) -> None:
        raise SystemExit(130)

    monkeypatch.setattr(ToyTrainer, "save_checkpoint", interrupted)
    ask_for(manager, RemoveView(key=key_of(bank, 0)))
    with pytest.raises(SystemExit):
        run_callbacks(manager, attrs, 1)
    assert manager.generated_views is bank and not manager.at_work


def test_an_outdated_round_stays_outdated_until_it_is_generated(
    tiny_capture: Path, tmp_path: Path, monkeypatch, caplog
):
    manager = make(tiny_capture, options(densify_rounds=2))
    attrs = generated(manager, tmp_path)
    ask_for(manager, RegenerateRound(number=0, seed=77))
    run_callbacks(manager, attrs, 1)
    assert manager.get_extra_state()["outdated"] == [1, 2]

    def fail(self: Any, *_: Any, **__: Any) -> Any:
        GreyFiller.calls += 1
        raise RuntimeError("out of memory")

    with monkeypatch.context() as broken, caplog.at_level(logging.WARNING):
        broken.setattr(GreyFiller, "complete", fail)
        GreyFiller.calls = 0
        for step in (2, 3, 4, 5):
            run_callbacks(manager, attrs, step)
    assert GreyFiller.calls == 2, "each is tried once"
    assert manager.get_extra_state()["outdated"] == [1, 2] and "Round 1 stays outdated" in caplog.text
    resumed = make(tiny_capture, options(densify_rounds=2))
    resumed.set_extra_state(manager.get_extra_state())
    ask_for(manager, RegenerateRound(number=2, seed=5))  # a person insists
    run_callbacks(manager, attrs, 6)
    assert manager.get_extra_state()["outdated"] == [1]
    attrs.pipeline.datamanager = resumed  # type: ignore[union-attr]
    for step in (7, 8):
        run_callbacks(resumed, attrs, step)  # another day
    assert resumed.get_extra_state()["outdated"] == []


# ---- shared state ----------------------------------------------------------------------------------------------------


class _Watched:
    """A lock that knows whether this thread holds it."""

    def __init__(self) -> None:
        self._lock, self.owner, self.depth = threading.RLock(), 0, 0

    def __enter__(self) -> None:
        self._lock.acquire()
        self.owner, self.depth = threading.get_ident(), self.depth + 1

    def __exit__(self, *_: object) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.owner = 0
        self._lock.release()


def test_the_panel_changes_only_under_its_lock():
    bank = bank_of((ANCHOR, 0, 2), ("densify", 1, 1))
    panel, viewer = opened_panel(bank)
    server = viewer.viser_server
    panel._lock = watched = _Watched()  # type: ignore[assignment]
    unlocked: list[str] = []

    class Watching(type(panel)):
        def __setattr__(self, name: str, value: Any) -> None:
            if watched.owner != threading.get_ident():
                unlocked.append(name)
            super().__setattr__(name, value)

    panel.__class__ = Watching
    panel.report("x", share=0.5)
    server.fields["Round"].value = "Anchors (2)"
    panel.show(bank[[0, 2]])
    for thing in [name for name in server.nodes if "view_" in name][:1]:
        server.click(thing)
    for button in ("Remove this view", "Go to selected view", "Regenerate round", "Complete from here"):
        server.click(button)
    panel.training_ended()
    assert unlocked == []


def test_two_clicks_at_a_time_have_a_seed_each():
    panel, viewer = opened_panel(bank_of((ANCHOR, 0, 2)))
    server = viewer.viser_server
    server.fields["Round"].value = "Anchors (2)"
    clicks = [threading.Thread(target=server.click, args=("Regenerate round",)) for _ in range(8)]
    for click in clicks:
        click.start()
    for click in clicks:
        click.join()
    seeds = [request.seed for request in iter(panel.requests.take, None)]  # type: ignore[union-attr]
    assert sorted(seeds) == list(range(seeds[0], seeds[0] + 8))


def test_the_queue_is_read_under_its_lock():
    queue = RequestQueue()
    held = SimpleNamespace(count=0)

    class Counting:
        def __enter__(self) -> None:
            held.count += 1

        def __exit__(self, *_: object) -> None:
            pass

    queue._lock = Counting()  # type: ignore[assignment]
    _ = len(queue), queue.closed, queue.take()
    assert held.count == 3


def test_the_manager_keeps_what_was_trained_before_it_generates(tiny_capture: Path, tmp_path: Path, monkeypatch):
    manager: FillerbusterDataManager = make(tiny_capture, options(at_step=2))
    order: list[str] = []
    monkeypatch.setattr(ToyTrainer, "generation_begins", lambda self: order.append("kept"), raising=False)
    monkeypatch.setattr(due_rounds, "complete", lambda *_: order.append(f"generated, at work: {manager.at_work}"))
    attrs = generated(manager, tmp_path, step=1)
    run_callbacks(manager, attrs, 2)
    assert order == ["kept", "generated, at work: True"] and not manager.at_work
