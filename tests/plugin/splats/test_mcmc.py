"""MCMC densification in plain torch: the paper's formulas, the cap, and that what few views show does not melt."""

from __future__ import annotations

import math

import pytest
import torch
from helpers.plugin.splat_models import camera, held, make_model, make_optimizers, train_step
from torch import Tensor
from twins.dense_rasterizer import covariance

from fb_nerfstudio.splats.splat_model import FillerbusterSplatModel, FillerbusterSplatModelConfig
from fb_nerfstudio.splats.strategies.mcmc import CappedMCMC, penalize, position_noise, shared_opacity_and_scale

BEHIND = torch.tensor([0.0, -8.0, 0.5])  # behind the camera of these tests


def mcmc_model(points: int = 60, **options) -> FillerbusterSplatModel:
    return make_model(points, **({"strategy": "mcmc", "warmup_length": 2, "refine_every": 4} | options))


# ------------------------------------------------------------------------------------------------------------- formulas


def equation_nine(opacity: float, copies: int) -> tuple[float, float]:
    """The slow twin: the paper's double sum as it stands. New opacity, and the factor on the scale."""
    after = 1 - (1 - opacity) ** (1 / copies)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * after ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    return after, opacity / total


@pytest.mark.parametrize("opacity", [0.006, 0.3, 0.9, 0.9999])
@pytest.mark.parametrize("copies", [1, 2, 3, 17, 51])
def test_relocation_is_equation_nine(opacity: float, copies: int):
    scales = torch.tensor([[0.2, 0.5, 3.0]], dtype=torch.float64)
    after, shrunk = shared_opacity_and_scale(
        torch.tensor([opacity], dtype=torch.float64), scales, torch.tensor([copies])
    )
    expected, factor = equation_nine(opacity, copies)
    assert float(after) == pytest.approx(expected, rel=1e-9)
    assert torch.allclose(shrunk, scales * factor, rtol=1e-6)


def test_one_gaussian_alone_keeps_what_it_has_and_many_compose_to_it():
    opacities, scales = torch.tensor([0.2, 0.7, 0.99]), torch.rand(3, 3) + 0.1
    after, shrunk = shared_opacity_and_scale(opacities, scales, torch.ones(3, dtype=torch.long))
    assert torch.allclose(after, opacities) and torch.allclose(shrunk, scales)
    for copies in (2, 7, 51, 400):  # more than 51 count as 51
        after, _ = shared_opacity_and_scale(opacities, scales, torch.full((3,), copies))
        assert torch.allclose(1 - (1 - after.double()) ** min(copies, 51), opacities.double(), atol=1e-6)


@pytest.mark.parametrize("copies", [2, 5])
def test_copies_cover_the_same_area_as_the_one(copies: int):
    """What equation 9 is for: along a line through the centre, alpha of all copies together integrates to that of the
    one.
    """
    x = torch.linspace(-12, 12, 20001, dtype=torch.float64)
    opacity, scale = 0.8, 1.0
    after, shrunk = shared_opacity_and_scale(
        torch.tensor([opacity], dtype=torch.float64),
        torch.full((1, 3), scale, dtype=torch.float64),
        torch.tensor([copies]),
    )
    one = opacity * torch.exp(-0.5 * (x / scale) ** 2)
    together = 1 - (1 - after * torch.exp(-0.5 * (x / shrunk[0, 0]) ** 2)) ** copies
    assert float(torch.trapezoid(together, x)) == pytest.approx(float(torch.trapezoid(one, x)), rel=1e-6)


def test_noise_has_the_covariance_of_the_gaussian_squared_and_spares_the_opaque():
    n = 60_000
    quats, log_scales = torch.randn(1, 4, dtype=torch.float64), torch.tensor([[-1.0, 0.2, 0.5]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    noise = position_noise(
        quats.expand(n, 4),
        log_scales.expand(n, 3),
        torch.full((n,), 0.005, dtype=torch.float64),
        0.1,
        generator=generator,
    )
    expected = (0.1 * 0.5) ** 2 * torch.linalg.matrix_power(
        covariance(quats, log_scales.exp())[0], 2
    )  # the gate is 1/2 at 0.005
    assert (torch.cov(noise.T) - expected).abs().max() < 0.03 * expected.abs().max()
    opaque = position_noise(quats, log_scales, torch.tensor([0.2], dtype=torch.float64), 0.1)
    assert float(opaque.abs().max()) < 1e-7


def test_a_penalty_reaches_only_what_the_picture_pulls_at():
    values = torch.rand(5, 3, requires_grad=True)
    passed = values * 1.0
    penalize(passed, 0.3)
    weights = torch.zeros(5, 3)
    weights[1:3] = 2.0
    (passed * weights).sum().backward()
    assert torch.allclose(values.grad[1:3], torch.full((2, 3), 2.0 + 0.3 / 15))
    assert values.grad[[0, 3, 4]].abs().max() == 0


# ------------------------------------------------------------------------------------------------------------- strategy


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_both_strategies_grow_on_a_cpu_up_to_the_cap(strategy: str):
    torch.manual_seed(0)
    model = mcmc_model(
        60, strategy=strategy, max_gaussians=66, densify_grad_thresh=1e-9, cull_alpha_thresh=1e-4, cull_scale_thresh=1e9
    )
    if strategy == "default":
        model.strategy.pause_refine_after_reset = 0
    optimizers = make_optimizers(model)
    counts = []
    for step in range(1, 22):
        train_step(model, optimizers, step)
        counts.append(model.num_points)
        for name, values in model.gauss_params.items():
            assert (
                held(optimizers, name) is values and len(values) == model.num_points and bool(values.isfinite().all())
            )
    assert counts[0] == 60 and max(counts) == counts[-1] == 66


def test_growth_is_a_twentieth_and_hardly_changes_the_picture():
    torch.manual_seed(0)
    model = mcmc_model(400, mcmc_noise_lr=0.0)
    optimizers = make_optimizers(model, lr=1e-3)
    for step in range(1, 3):
        train_step(model, optimizers, step)
    model.eval()
    before = model.get_outputs(camera())["rgb"]
    assert model.strategy._grow(model.gauss_params, optimizers.optimizers, model.strategy_state) == 20
    assert model.num_points == 420
    assert (model.get_outputs(camera())["rgb"] - before).abs().mean() < 0.01


def test_dead_gaussians_move_to_living_ones_and_start_without_moments():
    torch.manual_seed(0)
    model = mcmc_model(60, sh_degree=0)
    optimizers = make_optimizers(model)
    for step in range(1, 3):
        train_step(model, optimizers, step)
    dead = torch.arange(60) % 6 == 0
    with torch.no_grad():
        model.gauss_params["opacities"][dead] = -7.0
    identities = dict(model.gauss_params.items())
    living = model.means.detach()[~dead]
    assert model.strategy._relocate(model.gauss_params, optimizers.optimizers) == 10
    assert model.num_points == 60 and all(model.gauss_params[name] is values for name, values in identities.items())
    moved = model.means.detach()[dead]
    assert all(bool((living == place).all(dim=-1).any()) for place in moved)
    assert float(model.opacities.detach().sigmoid().min()) > model.strategy.min_opacity
    moments = optimizers.optimizers["means"].state[model.means]["exp_avg"]
    assert moments[dead].abs().max() == 0 and moments[~dead].abs().sum() > 0


def test_nobody_alive_or_nobody_dead_is_no_error():
    model = mcmc_model(10)
    optimizers = make_optimizers(model)
    assert model.strategy._relocate(model.gauss_params, optimizers.optimizers) == 0
    with torch.no_grad():
        model.gauss_params["opacities"].fill_(-20.0)
    assert model.strategy._relocate(model.gauss_params, optimizers.optimizers) == 0
    assert model.strategy._grow(model.gauss_params, optimizers.optimizers, model.strategy_state) == 0


def test_gaussians_can_be_added_and_training_goes_on():
    model = mcmc_model(60, max_gaussians=75)
    optimizers = make_optimizers(model)
    for step in range(1, 4):
        train_step(model, optimizers, step)
    assert model.add_gaussians(torch.rand(30, 3), torch.rand(30, 3), optimizers) == 15
    for step in range(4, 10):
        train_step(model, optimizers, step)
    assert model.num_points == 75


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="strategy"):
        FillerbusterSplatModelConfig(strategy="langevin")
    with pytest.raises(ValueError, match="mcmc_noise_lr"):
        FillerbusterSplatModelConfig(mcmc_noise_lr=-1.0)


# ------------------------------------------------------------------------------------------------ rarely seen regions


def model_with_hidden_half(opacity: float = 0.1) -> tuple[FillerbusterSplatModel, Tensor]:
    """120 Gaussians, of which 60 stand behind the camera; none is dead and the cap leaves no room, so only steps move
    them.
    """
    torch.manual_seed(0)
    model = mcmc_model(120, max_gaussians=120)
    hidden = torch.arange(120) >= 60
    with torch.no_grad():
        model.gauss_params["means"][hidden] += BEHIND
        model.gauss_params["opacities"].fill_(math.log(opacity / (1 - opacity)))
    return model, hidden


def test_what_no_view_shows_stays_exactly_as_it_is():
    model, hidden = model_with_hidden_half()
    optimizers = make_optimizers(model, lr=5e-2)
    before = {name: values.detach().clone() for name, values in model.gauss_params.items()}
    for step in range(1, 40):
        train_step(model, optimizers, step)
    for name, values in model.gauss_params.items():
        assert torch.equal(values.detach()[hidden], before[name][hidden]), name
    assert not torch.equal(model.means.detach()[~hidden], before["means"][~hidden])


def test_a_penalty_at_every_step_would_melt_it():
    """The contrast, the published rule: however small its weight, Adam empties what is out of sight within 150
    steps.
    """
    model, _ = model_with_hidden_half()
    optimizer = make_optimizers(model, lr=5e-2).optimizers["opacities"]
    for _ in range(150):
        optimizer.zero_grad()
        (1e-9 * model.opacities.sigmoid().mean()).backward()
        optimizer.step()
    assert float(model.opacities.detach().sigmoid().max()) < model.strategy.min_opacity


def test_what_one_view_in_twenty_shows_is_pulled_by_that_view_alone():
    """Only penalties speak here: the region that is seen rarely fades at a quarter of the speed (1/sqrt(20), as Adam
    goes).
    """
    model, hidden = model_with_hidden_half()
    model.strategy.noise_lr = 0.0
    optimizers = make_optimizers(model, lr=1e-2)
    turned = camera()
    turned.camera_to_worlds = turned.camera_to_worlds * torch.tensor([-1.0, 1.0, -1.0, 1.0])  # looks backwards
    for step in range(1, 101):
        model.train()
        model.step_cb(optimizers, step)
        optimizers.zero_grad_all()
        (1e-12 * model(turned if step % 20 == 10 else camera())["rgb"].sum()).backward()
        optimizers.optimizer_step_all()
        model.step_post_backward(step)
    lost = math.log(0.1 / 0.9) - model.opacities.detach().flatten()
    assert 0 < float(lost[hidden].median()) < 0.35 * float(lost[~hidden].median())


def test_the_strategy_takes_what_gsplats_does():
    from gsplat.strategy import MCMCStrategy

    strategy = CappedMCMC(cap_max=5, noise_lr=0.0)
    assert isinstance(strategy, MCMCStrategy) and strategy.initialize_state() == {}
    sizes = {"means": 3, "scales": 3, "quats": 4, "opacities": 1}
    params = {name: torch.nn.Parameter(torch.randn(5, size)) for name, size in sizes.items()}
    optimizers = {name: torch.optim.Adam([values]) for name, values in params.items()}
    strategy.check_sanity(params, optimizers)
    strategy.step_post_backward(params, optimizers, {}, 1000, {}, lr=1e-3)
    assert len(params["means"]) == 5
