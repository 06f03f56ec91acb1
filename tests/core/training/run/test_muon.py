"""Muon: steps along the nearest orthogonal matrix, whatever the gradient's scale or shape."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from fb_core.training.run.muon import FOUR, Muon, orthogonalised


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(8, 8), (24, 8), (8, 24), (1, 5)])
def test_singular_vectors_stay_and_singular_values_become_about_one(shape):
    matrix = random(1, *shape)
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    got = left.mT @ orthogonalised(matrix) @ right.mT
    spread = values[0] / values[0, 0]
    seen = got[0].diagonal()[spread > 0.02]
    assert (seen > 0.6).all() and (seen < 1.25).all()
    off = got[0] - torch.diag(got[0].diagonal())
    assert off.abs().max() < 1e-4


def test_scale_does_not_matter_even_far_from_one():
    matrix = random(1, 6, 4)
    for scale in (1e-20, 1e-6, 1e15):
        torch.testing.assert_close(orthogonalised(matrix * scale), orthogonalised(matrix), rtol=1e-4, atol=1e-5)


def test_transposed_matrices_give_transposed_answers():
    matrix = random(2, 6, 4)
    torch.testing.assert_close(orthogonalised(matrix.mT), orthogonalised(matrix).mT)


def test_a_zero_matrix_stays_zero_and_one_of_rank_one_keeps_its_rank():
    assert (orthogonalised(torch.zeros(1, 4, 7)) == 0).all()
    outer = random(4, 1) @ random(1, 7, seed=1)
    values = torch.linalg.svdvals(orthogonalised(outer[None])[0])
    assert 0.6 < values[0] < 1.25 and values[1:].max() < 1e-4


def test_matrices_of_one_shape_together_equal_each_by_itself():
    matrices = random(3, 5, 9)
    torch.testing.assert_close(
        orthogonalised(matrices), torch.cat([orthogonalised(matrix[None]) for matrix in matrices])
    )


def four_steps(matrices: torch.Tensor) -> torch.Tensor:
    """What the iteration in bfloat16 rounds: the same polynomials of the singular values, in float64."""
    left, values, right = torch.linalg.svd(matrices.double(), full_matrices=False)
    values = values / values.norm(dim=-1, keepdim=True)
    for a, b, c in FOUR:
        values = a * values + b * values**3 + c * values**5
    return left * values[:, None] @ right


@pytest.mark.parametrize("shape", [(2, 96, 8), (2, 8, 96), (1, 256, 32)])
def test_long_matrices_in_bfloat16_go_by_their_small_side_and_closer_to_the_exact_answer(shape):
    matrices = random(*shape)
    short = matrices[..., : 5 * min(shape[1:])] if shape[1] < shape[2] else matrices[:, : 5 * min(shape[1:])]
    plain = orthogonalised(short, torch.bfloat16) - four_steps(short)  # not long enough for the small side
    got = orthogonalised(matrices, torch.bfloat16)
    assert got.dtype == torch.float32
    assert (got - four_steps(matrices)).square().mean().sqrt() < plain.square().mean().sqrt()
    torch.testing.assert_close(got.mT, orthogonalised(matrices.mT, torch.bfloat16))
    assert (orthogonalised(torch.zeros(1, 96, 8), torch.bfloat16) == 0).all()


@pytest.mark.parametrize("columns", [64, 100, 128, 640])
@pytest.mark.parametrize("spectrum", ["random", "steep", "steeper", "of rank one", "of rank three", "one and noise"])
def test_in_bfloat16_singular_values_from_a_three_hundredth_of_the_norm_on_become_about_one(columns, spectrum):
    size = 64
    noise = random(1, size, columns, seed=3).double()
    left, values, right = torch.linalg.svd(noise, full_matrices=False)
    number = torch.arange(1, size + 1, dtype=torch.float64)
    if spectrum != "random":
        few = {"of rank one": 1, "of rank three": 3, "one and noise": 1}
        shaped = number**-1.0 if spectrum == "steep" else number**-2.0
        values = ((number <= few[spectrum]).double() if spectrum in few else shaped)[None]
    matrix = left * values[:, None] @ right + (1e-3 * noise if spectrum == "one and noise" else 0)
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    got = orthogonalised(matrix.float(), torch.bfloat16).double()
    large = values[0] / values.norm() > 1 / 300
    along = (left.mT @ got @ right.mT)[0].diagonal()[large]
    assert 0.75 < float(along.min()) and float(along.max()) < 1.25
    assert float(torch.linalg.matrix_norm(got, 2)) < 1.3, "and none leaves the range"


def test_a_step_has_the_size_that_adamw_takes():
    weight = nn.Parameter(torch.zeros(64, 16))
    weight.grad = random(64, 16)
    Muon([weight], learning_rate=1e-3).step()
    assert 0.15e-3 < float(weight.detach().square().mean().sqrt()) < 0.25e-3


def test_weight_decay_is_decoupled_and_parameters_without_gradient_rest():
    weight, idle = nn.Parameter(torch.ones(4, 4)), nn.Parameter(torch.ones(4, 4))
    weight.grad = torch.zeros(4, 4)
    Muon([weight, idle], learning_rate=0.5, weight_decay=0.1).step()
    torch.testing.assert_close(weight.detach(), torch.full((4, 4), 0.95))
    assert (idle == 1).all()


def test_it_agrees_with_torch_within_the_precision_of_bfloat16():
    if not hasattr(torch.optim, "Muon"):
        pytest.skip("this torch has no Muon to compare with")
    mine, theirs = (nn.Parameter(random(12, 20)) for _ in range(2))
    ours = Muon([mine], learning_rate=0.02, weight_decay=0.1)
    reference = torch.optim.Muon([theirs], lr=0.02, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    for step in range(3):
        mine.grad = random(12, 20, seed=step + 1)
        theirs.grad = mine.grad.clone()
        ours.step()
        reference.step()
    moved = (mine - random(12, 20)).detach().norm()
    assert float((mine - theirs).detach().norm() / moved) < 0.03


def test_vectors_are_refused():
    with pytest.raises(ValueError, match="expected matrices"):
        Muon([nn.Parameter(torch.zeros(3))], learning_rate=0.1)
