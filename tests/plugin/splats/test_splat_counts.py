"""The number of Gaussians: densification, caps, those that are added and those that go; what checkpoints bring back."""

from __future__ import annotations

import copy
import io

import pytest
import torch
from helpers.plugin.splat_models import held, make_model, make_optimizers, train_step
from nerfstudio.data.scene_box import SceneBox

from fb_nerfstudio.splats.gaussians import evenly_chosen, gaussians_at, neighbour_distance
from fb_nerfstudio.splats.splat_model import FillerbusterSplatModelConfig


def test_resume_keeps_identity_and_splats_move() -> None:
    """A checkpoint of more Gaussians is loaded into a fresh run, safely, and training goes on."""
    first = make_model(90)
    first_optimizers = make_optimizers(first)
    for step in range(1, 4):
        train_step(first, first_optimizers, step)
    file = io.BytesIO()
    torch.save(
        {
            "model": first.state_dict(),
            "optimizers": {name: value.state_dict() for name, value in first_optimizers.optimizers.items()},
            "schedulers": {name: value.state_dict() for name, value in first_optimizers.schedulers.items()},
        },
        file,
    )
    file.seek(0)
    saved = torch.load(file, weights_only=True)

    resumed = make_model(40, seed=1)
    optimizers = make_optimizers(resumed)
    params = dict(resumed.gauss_params.items())
    resumed.load_state_dict(saved["model"], strict=True)
    optimizers.load_optimizers(saved["optimizers"])
    optimizers.load_schedulers(saved["schedulers"])
    assert resumed.num_points == 90 and resumed.step == 30000
    for name, values in resumed.gauss_params.items():
        assert values is params[name] and values is held(optimizers, name), name
        assert torch.equal(values, first.gauss_params[name]), name
    for step in range(4, 7):
        train_step(first, first_optimizers, step)
    before = resumed.means.detach().clone()
    for step in range(4, 7):
        train_step(resumed, optimizers, step)
    assert (resumed.means - before).abs().max() > 1e-3
    assert optimizers.optimizers["means"].state[resumed.means]["step"] == 6


def test_loading_works_in_the_middle_of_training() -> None:
    """Named hard case: the last render's graph is alive while the parameters change their size."""
    model = make_model(50)
    optimizers = make_optimizers(model)
    state = copy.deepcopy(make_model(70).state_dict())  # the strategy's own state is a dictionary
    train_step(model, optimizers, 1)
    model.load_state_dict(state)
    for optimizer in optimizers.optimizers.values():
        optimizer.state.clear()
    train_step(model, optimizers, 2)
    assert model.num_points == 70


def test_old_checkpoints_without_prefix_load() -> None:
    source = make_model(30).state_dict()
    old = {name.removeprefix("gauss_params."): value for name, value in source.items()}
    model = make_model(10)
    model.load_state_dict(old)
    assert model.num_points == 30 and "means" in old, "the caller's dict stays as it was"


def test_checkpoints_hold_no_lpips() -> None:
    model = make_model()
    model.lpips._metric = torch.nn.Linear(2, 2)
    assert not [name for name in model.state_dict() if "lpips" in name or "weight" in name]
    assert not [name for name, _ in model.named_modules() if "lpips" in name]


def test_densification_runs_and_the_cap_holds() -> None:
    counts = []
    for cap in (None, 70):
        torch.manual_seed(0)
        model = make_model(
            60, warmup_length=2, refine_every=4, densify_grad_thresh=1e-9, cull_alpha_thresh=1e-4, max_gaussians=cap
        )
        model.strategy.pause_refine_after_reset = 0
        optimizers = make_optimizers(model)
        for step in range(1, 14):
            train_step(model, optimizers, step)
        for name, values in model.gauss_params.items():
            assert held(optimizers, name) is values and len(values) == model.num_points
        counts.append(model.num_points)
    assert counts[0] > 200, "without a cap every refinement doubles them"
    assert counts[1] == 70


def test_a_loose_cap_changes_nothing() -> None:
    results = []
    for cap in (None, 10_000):
        torch.manual_seed(0)
        model = make_model(60, warmup_length=2, refine_every=4, densify_grad_thresh=1e-4, max_gaussians=cap)
        model.strategy.pause_refine_after_reset = 0
        optimizers = make_optimizers(model)
        for step in range(1, 8):
            train_step(model, optimizers, step)
        results.append(model.means.detach())
    assert torch.equal(results[0], results[1])


def test_the_cap_bounds_seeds_and_random_starts() -> None:
    assert make_model(60, max_gaussians=25).num_points == 25
    assert make_model(60, random_init=True, num_random=80, max_gaussians=30).num_points == 30
    assert make_model(60, random_init=True, num_random=20).num_points == 20
    with pytest.raises(ValueError, match="max_gaussians"):
        FillerbusterSplatModelConfig(max_gaussians=0)
    with pytest.raises(ValueError, match="normal_tv_weight"):
        FillerbusterSplatModelConfig(normal_tv_weight=-1.0)


def test_added_gaussians_keep_the_optimizer_state_of_the_others() -> None:
    model = make_model(60)
    optimizers = make_optimizers(model)
    for step in range(1, 4):
        train_step(model, optimizers, step)
    before = {name: values.detach().clone() for name, values in model.gauss_params.items()}
    moments = {name: optimizers.optimizers[name].state[held(optimizers, name)]["exp_avg"].clone() for name in before}
    counted = model.strategy_state["count"].clone()
    points, colors = torch.rand(15, 3), torch.rand(15, 3)
    assert model.add_gaussians(points, colors, optimizers) == 15
    for name, values in model.gauss_params.items():
        assert held(optimizers, name) is values and optimizers.parameters[name][0] is values, name
        assert torch.equal(values[:60], before[name]), name
        state = optimizers.optimizers[name].state[values]
        assert state["step"] == 3 and len(state["exp_avg_sq"]) == 75
        assert torch.equal(state["exp_avg"][:60], moments[name]) and state["exp_avg"][60:].abs().sum() == 0
    assert torch.equal(model.means[60:], points) and torch.allclose(model.colors[60:], colors, atol=1e-5)
    assert torch.equal(model.strategy_state["count"], torch.cat([counted, torch.zeros(15)]))
    train_step(model, optimizers, 4)
    assert not torch.equal(model.means[60:], points), "the new ones train"


def test_added_gaussians_before_the_first_step() -> None:
    model = make_model(60, sh_degree=0)
    optimizers = make_optimizers(model)
    assert model.add_gaussians(torch.rand(5, 3), torch.rand(5, 3), optimizers) == 5
    train_step(model, optimizers, 1)
    assert model.num_points == 65


def test_added_gaussians_survive_the_next_refinement() -> None:
    """They start above the culling threshold."""
    model = make_model(20, warmup_length=0, refine_every=4)
    model.strategy.pause_refine_after_reset = 0
    optimizers = make_optimizers(model, lr=1e-4)
    for step in range(1, 4):
        train_step(model, optimizers, step)
    hidden = torch.tensor([[0.0, -50.0, 0.0]]) + torch.rand(10, 3)
    model.add_gaussians(hidden, torch.rand(10, 3), optimizers)
    train_step(model, optimizers, 4)
    assert int((model.means[:, 1] < -40).sum()) == 10


def test_adding_respects_the_cap_and_refuses_nonsense() -> None:
    model = make_model(60, max_gaussians=64)
    optimizers = make_optimizers(model)
    points = torch.arange(30.0).reshape(10, 3)
    assert model.add_gaussians(points, torch.rand(10, 3), optimizers) == 4
    assert torch.equal(model.means[60:], points[[0, 3, 6, 9]]), "an even choice"
    assert model.add_gaussians(points, torch.rand(10, 3), optimizers) == 0
    assert model.add_gaussians(torch.zeros(0, 3), torch.zeros(0, 3), optimizers) == 0
    with pytest.raises(ValueError, match="points and colors"):
        model.add_gaussians(points, torch.rand(9, 3), optimizers)
    with pytest.raises(ValueError, match="finite"):
        model.add_gaussians(points * torch.nan, torch.rand(10, 3), optimizers)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_gaussians_that_go_leave_the_others_as_they_were(strategy: str) -> None:
    model = make_model(60, strategy=strategy)
    optimizers = make_optimizers(model)
    for step in range(1, 4):
        train_step(model, optimizers, step)
    before = {name: values.detach().clone() for name, values in model.gauss_params.items()}
    moments = {name: optimizers.optimizers[name].state[held(optimizers, name)]["exp_avg"].clone() for name in before}
    chosen = torch.zeros(60, dtype=torch.bool)
    chosen[10:25] = True
    assert model.remove_gaussians(chosen, optimizers) == 15
    for name, values in model.gauss_params.items():
        assert held(optimizers, name) is values and optimizers.parameters[name][0] is values, name
        assert torch.equal(values, before[name][~chosen]), name
        assert torch.equal(optimizers.optimizers[name].state[values]["exp_avg"], moments[name][~chosen])
    for step in range(4, 8):
        train_step(model, optimizers, step)
    assert model.remove_gaussians(torch.zeros(model.num_points, dtype=torch.bool), optimizers) == 0
    assert model.remove_gaussians(torch.ones(model.num_points, dtype=torch.bool), optimizers) == 0, "never all"


def test_seed_colours_are_bytes() -> None:
    model = FillerbusterSplatModelConfig(sh_degree=0).setup(
        scene_box=SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
        num_train_data=1,
        seed_points=(torch.rand(4, 3), torch.tensor([[255, 0, 128]]).repeat(4, 1)),
    )
    assert torch.allclose(model.colors, torch.tensor([1.0, 0.0, 128 / 255]).expand(4, 3), atol=2e-3)
    assert model.features_dc.isfinite().all()


def test_sizes_of_new_gaussians_are_distances_to_neighbours() -> None:
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    assert torch.allclose(neighbour_distance(line), torch.tensor([2.0, 4 / 3, 4 / 3, 2.0]))
    assert torch.allclose(neighbour_distance(line[:1], line[1:]), torch.tensor([2.0]))
    assert torch.allclose(neighbour_distance(line[:1]), torch.tensor([0.1])) and len(neighbour_distance(line[:0])) == 0
    coinciding = gaussians_at(torch.zeros(8, 3), torch.rand(8, 3), sh_degree=0)
    assert coinciding["scales"].isfinite().all()
    assert torch.equal(evenly_chosen(5, 9), torch.arange(5)) and len(evenly_chosen(5, 0)) == 0
    assert len(set(evenly_chosen(1000, 999).tolist())) == 999
