"""Rounds in turn: the next is planned by what the splats of the former show, is the same after a kill, and ends where
little is left.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from helpers.plugin.datamanagers import GreyFiller, attributes, make, options, run_callbacks, stand_in_model
from helpers.plugin.rounds import TURNS
from helpers.scenes.completions import box_points
from helpers.scenes.coverages import AUTO, turning
from helpers.scenes.trusted import views_of

from fb_core.completion.options import CompletionConfig
from fb_core.completion.planning.plan import CompletionPlan, plan_completion
from fb_core.completion.planning.site import Former
from fb_core.completion.trust import Trust
from fb_core.files.json_files import read_json
from fb_core.geometry.cameras import Pinholes
from fb_nerfstudio.generation.fitting_in import most_seeds
from fb_nerfstudio.generation.next_round import Rounds, due_after, former_of, in_turn
from fb_nerfstudio.splats.splat_model import FillerbusterSplatModel

__all__ = ["stand_in_model"]  # no test here loads real weights


def planned(former: Former | None, config: CompletionConfig = AUTO) -> CompletionPlan:
    return plan_completion(turning(4, last=1.5), box_points().double(), config, size=16, former=former)


def single(cameras: Pinholes) -> tuple[Pinholes, ...]:
    return tuple(cameras[index] for index in range(len(cameras)))


def after(plan: CompletionPlan, shown: bool, number: int = 1) -> Former:
    """The plan's views have been generated, and all of their pixels count as seen, or none."""
    cameras = Pinholes.cat([one.cameras for one in plan.rounds])
    return Former(number=number, cameras=single(cameras), shown=(torch.full((16, 16), shown),) * len(cameras))


def test_the_first_round_in_turn_is_the_first_of_all_rounds_at_once() -> None:
    (first,), whole = planned(Former(number=0)).rounds, planned(None).rounds
    assert torch.equal(first.cameras.camera_to_world, whole[0].cameras.camera_to_world) and first.seed == whole[0].seed


def test_what_former_views_show_is_seen_and_what_they_do_not_show_is_not() -> None:
    first = planned(Former(number=0))
    assert first.covered is not None
    shown, in_vain = planned(after(first, True)), planned(after(first, False))
    assert shown.covered is not None and in_vain.covered is not None
    assert shown.covered[0] > first.covered[0] and in_vain.covered[0] == pytest.approx(first.covered[0])
    assert in_vain.new_views >= first.new_views > shown.new_views
    assert all(one.number == 1 and one.role == "densify" for one in [*shown.rounds, *in_vain.rounds])


def test_a_round_that_would_add_too_little_is_the_end() -> None:
    first = planned(Former(number=0))
    little = dataclasses.replace(AUTO, least_gain=0.0, least_round_gain=0.0)
    half = first.without([torch.arange(len(one.cameras)) % 2 == 1 for one in first.rounds])
    more = planned(after(half, True), little)
    none = planned(after(half, True), dataclasses.replace(little, least_round_gain=0.9))
    assert more.new_views > 0 and none.new_views == 0
    assert none.covered is not None and none.covered[0] == none.covered[1]
    assert planned(after(first, False, number=9), little).new_views == 0, (
        "there are no more rounds than the options say"
    )


def test_the_plan_of_a_round_is_decided_by_seed_and_former_views_alone() -> None:
    former = after(planned(Former(number=0)), False)
    one, two = planned(former).rounds[0], planned(former).rounds[0]
    assert torch.equal(one.cameras.camera_to_world, two.cameras.camera_to_world) and one.seed == two.seed


def test_when_a_next_round_is_due() -> None:
    config = CompletionConfig(rounds_apart=100, densify_rounds=2)
    plan, empty = planned(Former(number=0)), dataclasses.replace(planned(Former(number=0)), rounds=())
    assert due_after(config, Rounds(number=0), plan, None, step=500, last=3000) == 600
    assert due_after(config, Rounds(number=0), plan, None, step=500, last=550) == 500, (
        "a training that ends before does it at once"
    )
    assert due_after(config, Rounds(number=0), plan, None, step=500, last=None) == 600
    assert due_after(config, Rounds(number=2), plan, None, step=500, last=3000) is None
    assert due_after(config, Rounds(number=0), empty, None, step=500, last=3000) is None
    hopeless = Trust(hidden=2, model=1.0, mean=0.1, nearest=0.1)
    assert due_after(config, Rounds(number=0), plan, hopeless, step=500, last=3000) is None
    assert (
        due_after(config, Rounds(number=0), plan, dataclasses.replace(hopeless, hidden=0), step=500, last=3000) == 600
    )
    assert (
        in_turn(CompletionConfig())
        and not in_turn(CompletionConfig(anchor_views=3))
        and not in_turn(CompletionConfig(task="inpaint"))
    )


def test_rounds_survive_a_checkpoint_and_runs_of_earlier_versions_have_had_theirs() -> None:
    rounds = Rounds().after(planned(Former(number=0)), step=500, due=600)
    assert Rounds.from_state(rounds.state(), None) == rounds and rounds.number == 1 and rounds.record[0]["views"] > 0
    assert Rounds.from_state(None, None).number == 0 and Rounds.from_state(None, views_of(1.0)).number == 1


@pytest.mark.parametrize(("trust", "shown"), [(0.05, False), (0.5, True)])
def test_only_believed_pixels_of_former_views_count_as_seen(trust: float, shown: bool) -> None:
    former = former_of(views_of(trust), None, 1)
    assert len(former.cameras) == len(former.shown) == 3 and all(bool((mask == shown).all()) for mask in former.shown)
    assert former_of(None, None, 1).cameras == ()


# ---- in a training --------------------------------------------------------------------------------------------------


def ran(manager, folder, steps) -> None:
    attrs = attributes(manager, folder)
    for step in steps:
        run_callbacks(manager, attrs, step)


def test_rounds_come_in_turn_and_a_run_that_was_killed_between_them_goes_on_with_the_same_plan(
    tiny_capture, tmp_path
) -> None:
    whole = make(tiny_capture, options(**TURNS))
    ran(whole, tmp_path / "whole", [200])
    assert whole.generated_views.rounds == [0] and not whole.get_extra_state()["finished"]
    ran(whole, tmp_path / "whole", [249, 250, 299, 300, 350, 400])
    state = whole.get_extra_state()
    assert (
        state["finished"]
        and [one["step"] for one in state["rounds"]["record"]] == [200, 250, 300][: len(state["rounds"]["record"])]
    )

    killed = make(tiny_capture, options(**TURNS))
    ran(killed, tmp_path / "killed", [200])
    saved = torch.load(tmp_path / "killed" / "nerfstudio_models" / "step-000000199.ckpt", weights_only=True)["pipeline"]
    resumed = make(tiny_capture, options(**TURNS))
    resumed.load_state_dict(saved, strict=False)
    calls = GreyFiller.calls
    ran(resumed, tmp_path / "killed", [200, 249])
    assert GreyFiller.calls == calls, "the first round is there"
    ran(resumed, tmp_path / "killed", [250, 300, 350, 400])
    assert torch.equal(resumed.generated_views.cameras.camera_to_world, whole.generated_views.cameras.camera_to_world)
    assert torch.equal(resumed.generated_views.images, whole.generated_views.images)
    assert torch.equal(resumed.generated_views.masks, whole.generated_views.masks)


def test_a_training_that_ends_before_the_next_round_is_due_gets_it_at_once(tiny_capture, tmp_path) -> None:
    manager = make(tiny_capture, options(**TURNS))
    attrs = attributes(manager, tmp_path)
    attrs.trainer.config.max_num_iterations = 220
    run_callbacks(manager, attrs, 200)
    assert manager.get_extra_state()["finished"] and {
        one["step"] for one in manager.get_extra_state()["rounds"]["record"]
    } == {200}


def test_the_run_s_report_tells_trust_rounds_and_views(tiny_capture, tmp_path) -> None:
    manager = make(tiny_capture, options(context_views=4, trust="measured"))
    ran(manager, tmp_path, [0])
    told = read_json(tmp_path / "completion.json")
    assert (
        told["trust"]["hidden"] == 1
        and "hidden view" in told["trust"]["in_words"]
        and told["trust"]["curve"]["baseline"] > 0
    )
    assert [one["trust"] for one in told["views"]] == [origin.trust for origin in manager.generated_views.origins]


@pytest.mark.parametrize(
    ("cap", "there", "most", "room"),
    [(None, 10, 500, 500), (100, 60, 500, 20), (100, 60, 7, 7), (100, 100, 9, 0), (100, 120, 9, 0)],
)
def test_generated_gaussians_leave_half_of_what_the_cap_leaves_to_the_capture(cap, there, most, room) -> None:
    model = SimpleNamespace(config=SimpleNamespace(max_gaussians=cap), num_points=there)
    free = FillerbusterSplatModel.room.fget(model)
    assert free == (None if cap is None else max(cap - there, 0)) and most_seeds(most, free) == room
